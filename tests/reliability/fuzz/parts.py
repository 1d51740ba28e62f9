"""Broken parts of assets of version 4: their bytes, their lengths, the manifest's description of their
sections, and parts in place of others or in another order. What can be read is played and described."""

from __future__ import annotations

import copy
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from player.app.info import facts, page
from player.asset.asset import Asset, GridArrays, write_asset
from tests.reliability.fuzz.assets import BrokenAsset, broken_manifest, other_settings, play, special_files
from tests.reliability.fuzz.broken import broken_bytes, broken_value
from tests.reliability.fuzz.targets import Target


def whole_parts(folder: Path, old: Path) -> Path:
    """Write the asset of version 3 in `old` as version 4, with coarser levels."""
    from vfr_bake.baking.convert import with_coarser_levels

    asset = Asset.open(old)
    arrays = GridArrays(
        with_coarser_levels(asset.arrays.densities, "densities"),
        with_coarser_levels(asset.arrays.features, "features"),
    )
    steps = (1,) * len(arrays.densities.values)
    manifest = replace(asset.manifest, level_steps=steps, density_steps=steps, feature_steps=steps)
    rest = (asset.read(name) for name in ("head.onnx", "mesh.ply", "cameras.json"))
    write_asset(folder, manifest, arrays, *rest)
    opened = Asset.open(folder)
    play(opened)  # loads compiled code now, not while an input is watched
    space = replace(opened.manifest, contracted=True, aabb=((-2.0,) * 3, (2.0,) * 3), step=0.05)
    play(replace(opened, manifest=space))
    return folder


def _numbers(document: dict[str, Any], random: np.random.Generator) -> None:
    """Change numbers of sections to numbers near the right ones, or to anything."""
    sections = [section for part in document["parts"] for section in part["sections"]]
    for _ in range(int(random.integers(1, 3))):
        section = sections[random.integers(0, len(sections))]
        key = list(section)[random.integers(0, len(section))]
        if isinstance(section[key], int) and random.random() < 0.7:
            section[key] = max(section[key] + int(random.choice([-8, -1, 1, 2, 100])), 0)
        else:
            section[key] = broken_value(section[key], random)


def _order(document: dict[str, Any], random: np.random.Generator) -> None:
    """Reorder, repeat or remove parts or sections."""
    parts = document["parts"]
    some = parts if random.random() < 0.3 else parts[random.integers(0, len(parts))]["sections"]
    match int(random.integers(0, 3)):
        case 0:
            random.shuffle(some)
        case 1:
            some.append(some[random.integers(0, len(some))])
        case _:
            some.pop(int(random.integers(0, len(some))))


def _parts(asset: BrokenAsset) -> Target:
    names = sorted(name for name in asset.manifest["files"] if name.startswith("part_"))

    def prepare(random: np.random.Generator) -> None:
        asset.restore()
        name = names[random.integers(0, len(names))]
        data, document = asset.bytes_of(name), copy.deepcopy(asset.manifest)
        kind = int(random.integers(0, 7))
        if kind == 0:  # unknown to the manifest
            asset.place(name).write_bytes(broken_bytes(data, random))
            return
        if kind == 1:
            asset.place(name).unlink()
            return
        if kind == 2:
            asset.place(name).write_bytes(asset.bytes_of(names[random.integers(0, len(names))]))
            return
        if kind == 3:
            _numbers(document, random)
        elif kind == 4:
            _order(document, random)
        elif kind == 5:
            document = other_settings(document, random)
        broken = {} if kind in (3, 4) and random.random() < 0.7 else {name: broken_bytes(data, random)}
        if random.random() < 0.8:  # sections as long as the file
            for part in document["parts"]:
                new = broken.get(part.get("file"), b"") if isinstance(part, dict) else b""
                if new and isinstance(part.get("sections"), list) and part["sections"]:
                    lengths = [s.get("bytes") for s in part["sections"]]
                    if all(isinstance(n, int) for n in lengths):
                        part["sections"][-1]["bytes"] = max(len(new) - sum(lengths[:-1]), 0)
        asset.write(broken, document)

    return Target("parts", prepare, asset.read)


def _lax(asset: BrokenAsset) -> Target:
    """Return a target with the same inputs that plays what can be read, as a player does."""
    made = _parts(asset)

    def read() -> None:
        for opened in Asset.growing(asset.folder):
            assert opened.missing is None or opened.missing.count("\n") == 0
            play(opened)
        assert all(line.isprintable() for line in page(asset.folder, opened.manifest, facts(opened)))

    return Target("parts as they come", made.prepare, read)


def parts_targets(asset: BrokenAsset) -> list[Target]:
    """Return all targets of the parts; they share one folder."""
    return [_parts(asset), _lax(asset), broken_manifest(asset), special_files(asset)]
