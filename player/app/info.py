"""The content of an asset in words and as numbers, for `vfr-play --info`."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from player.app.parts_info import parts_facts
from player.asset.asset import Asset
from player.asset.manifest import Manifest
from player.asset.pyramid import PyramidValues
from player.cameras.views import asset_cameras
from player.head.head import asset_head
from player.march.contracted import MAX_SPEED
from player.terminal import command_line, printable

CONTENT = {
    "features.codes": "what the head is given",
    "density.codes": "where there is something",
    "brick_masks.bits": "which densities are stored",
    "brick_coords.npy": "where their bricks are",
    "feature_masks.bits": "which features are stored",
    "feature_coords.npy": "where their bricks are",
    "head.onnx": "features to colour",
    "mesh.ply": "the surface, for other programs",
    "cameras.json": "the training cameras",
}


def facts(asset: Asset) -> dict[str, Any]:
    """Return the facts that `vfr-play --info --json` writes."""
    m = asset.manifest
    return {
        "bytes": {name: entry.bytes for name, entry in sorted(m.files.items())},
        "bytes_total": sum(entry.bytes for entry in m.files.values()),
        "n_bricks": sum(len(bricks) for bricks in asset.arrays.densities.pyramid.levels),
        "n_vertices": int(asset.arrays.densities.first_rows[-1]),
        "n_feature_vertices": int(asset.arrays.features.first_rows[-1]),
        "n_parts": len(m.parts),
        "n_parts_read": asset.n_parts,
        "missing": asset.missing,
        "parts": parts_facts(m),
        "levels": {grid: _levels(getattr(asset.arrays, grid)) for grid in ("densities", "features")},
        "head_parameters": asset_head(asset).n_parameters,
        "n_cameras": len(asset_cameras(asset)),
        "world_box": _world_box(asset),
        "world_units_per_model_unit": asset.scale,
        **{field.name: getattr(m, field.name) for field in fields(m) if field.name not in ("parts", "files")},
    }


def page(folder: Path, m: Manifest, known: dict[str, Any]) -> list[str]:
    """Return the lines of a page for people. They have no control characters, whatever the manifest holds.

    `known`: the result of `facts`.
    """
    low, high = known["world_box"]
    scale = known["world_units_per_model_unit"]
    total = known["bytes_total"]
    size = " x ".join(f"{b - a:.4g}" for a, b in zip(low, high, strict=True))
    share = known["n_vertices"] / (m.resolution + 1) ** 3
    lines = [
        f"{folder}: {_megabytes(total)}, {known['n_cameras']} training views of "
        f"{m.view_size[0]}x{m.view_size[1]}",
        f"vfr-asset {m.version[0]}.{m.version[1]}, written by {m.generator}",
        *_section("files", [
            (name, f"{_megabytes(n):>9}  {_bar(n / max(total, 1))}  {CONTENT.get(name, '')}")
            for name, n in sorted(known["bytes"].items(), key=lambda item: -item[1])
        ]),
        *_section("parts, each of which makes the picture sharper", [
            (part["file"], f"{_megabytes(part['bytes']):>9}  {_up_to(part)}{part['adds']}")
            for part in known["parts"]
        ]),
        *_section("scene", [
            ("inner region" if m.contracted else "world box",
             f"{size} units, from {_numbers(low)} to {_numbers(high)}"),
            *([("around it", "the rest of space, contracted"),
               ("shown", f"{m.near * scale:.3g} units before a camera and beyond")] if m.contracted else []),
            ("world units", f"{scale:.5g} in a model unit"),
            ("colours", f"{m.colour_space}, over {_numbers(m.background)}"),
        ]),
        *_section("how it is rendered", [
            ("grid", f"{m.resolution} cells per axis, {known['n_vertices']:,} vertices stored "
             f"({share:.2%}) in {known['n_bricks']:,} bricks of 8 x 8 x 8"),
            ("features", f"{m.feature_resolution} cells per axis, {known['n_feature_vertices']:,} vertices "
             f"of {m.n_channels} channels of 8 bits, fetched "
             f"{f'at {m.n_fetches} places a ray' if m.n_fetches else 'at every sample'}"),
            *([("levels", _level_sentence(known["levels"]))] if m.parts else []),
            ("step", _step(m, scale)),
            ("head", f"{known['head_parameters']:,} parameters, once a pixel"),
            ("qualities", _quality_sentence(m)),
        ]),
    ]  # fmt: skip
    lines += _section("provenance", list(_flat(m.provenance)))
    command = command_line("vfr-play", str(folder))
    lines += _section("to look at it", [
        ("in a browser", command),
        ("pictures", f"{command} --orbit 60 --output frames/"),
    ])  # fmt: skip
    return [printable(line) for line in lines]


def _up_to(part: dict[str, Any]) -> str:
    """Describe what is read up to the end of a part, and how good its picture is."""
    loss = part["loss_db"]
    below = "" if loss is None else f", {loss:.1f} dB below the whole"
    return f"first {part['share_read']:.0%} of the bytes{below}: "


def _section(title: str, rows: list[tuple[str, str]]) -> list[str]:
    if not rows:
        return []
    width = max(len(key) for key, _ in rows)
    return ["", title, *(f"  {key:<{width}}  {value}" for key, value in rows)]


def _flat(values: dict[str, Any], above: str = "") -> Iterator[tuple[str, str]]:
    """Yield names and values of nested objects, a pair for each value; the names of inner objects are joined
    by dots."""
    for key, value in sorted(values.items()):
        name = f"{above}{key}"
        if isinstance(value, dict) and value:
            yield from _flat(value, f"{name}.")
        else:
            text = f"{value:,.5g}" if isinstance(value, float) else json.dumps(value)
            yield name, text if len(text) < 90 else f"{text[:87]}..."


def _numbers(values: Sequence[float]) -> str:
    return ", ".join(f"{value:.4g}" for value in values)


def _megabytes(n_bytes: int) -> str:
    return f"{n_bytes / 1e6:.1f} MB" if n_bytes >= 1e5 else f"{n_bytes / 1e3:.1f} kB"


def _bar(share: float) -> str:
    return ("#" * round(20 * share)).ljust(20, ".")


def _step(m: Manifest, scale: float) -> str:
    edge = max(high - low for low, high in zip(*m.aabb, strict=True))
    cells = m.step * m.resolution / edge
    if m.contracted:
        return f"an angle of {m.step:.5g}, {cells * MAX_SPEED:.2g} of a cell at most"
    return f"{m.step * scale:.5g} world units, {cells:.2g} of a cell"


def _levels(stored: PyramidValues) -> list[dict[str, int]]:
    """Count what has been read of each level, the finest first."""
    levels = zip(stored.pyramid.levels, stored.values, strict=True)
    return [{"n_bricks": len(bricks), "n_vertices": len(values)} for bricks, values in levels]


def _level_sentence(levels: dict[str, list[dict[str, int]]]) -> str:
    words = []
    for grid, found in levels.items():
        n = [level["n_vertices"] for level in found]
        words.append(f"{len(found)} of {grid} ({', '.join(f'{count:,}' for count in n)} vertices)")
    return "; ".join(words)


def _quality_sentence(m: Manifest) -> str:
    """Say what `high` and `fast` pictures of the training size leave out, compared with exact ones."""
    words = []
    for name, levels, fetches in zip(("high", "fast"), m.agreement, m.quality_fetches or (0, 0), strict=True):
        left_out = [
            *([f"pixels whose neighbours differ by at most {levels:g} of 255 levels"] if levels else []),
            *([f"more than {fetches} fetches a ray"] if fetches else []),
        ]
        words.append(f"{name} leaves out {' and '.join(left_out) or 'nothing'}")
    return "; ".join(words)


def _world_box(asset: Asset) -> list[list[float]]:
    """Return the least and the greatest world coordinates of the box's corners.

    In contracted space, this is the box of the cube around the unit ball, the region that is not contracted.
    """
    box = np.array(asset.manifest.aabb) / (2 if asset.manifest.contracted else 1)
    corners = np.array([[box[i, 0], box[j, 1], box[k, 2], 1] for i, j, k in np.ndindex(2, 2, 2)])
    world = (corners @ asset.world_from_model.T)[:, :3]
    return [world.min(axis=0).tolist(), world.max(axis=0).tolist()]
