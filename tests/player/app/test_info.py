"""Tests of what `vfr-play --info` says of an asset."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from player.app.info import facts, page
from player.app.parts_info import what_it_adds
from player.asset.asset import Asset
from player.asset.sections import Part, Section
from tests.player.in_parts import write_in_parts


@pytest.mark.parametrize(
    ("agreement", "fetches", "said"),
    [
        (
            (14.0, 22.5),
            (0, 3),
            "high leaves out pixels whose neighbours differ by at most 14 of 255 levels; "
            "fast leaves out pixels whose neighbours differ by at most 22.5 of 255 levels and more than 3 "
            "fetches a ray",
        ),
        ((0.0, 0.0), None, "high leaves out nothing; fast leaves out nothing"),
    ],
)
def test_what_qualities_leave_out_is_told(
    agreement: tuple[float, ...], fetches: tuple[int, ...] | None, said: str, asset: Asset
) -> None:
    manifest = replace(asset.manifest, agreement=agreement, quality_fetches=fetches)
    known = facts(replace(asset, manifest=manifest))
    assert (known["agreement"], known["quality_fetches"]) == (agreement, fetches)
    (line,) = [line for line in page(asset.folder, manifest, known) if line.startswith("  qualities ")]
    assert line.removeprefix("  qualities").strip() == said


def lines_of_parts(asset: Asset, provenance: dict[str, Any]) -> list[str]:
    manifest = replace(asset.manifest, provenance=provenance)
    known = facts(replace(asset, manifest=manifest))
    return [line for line in page(asset.folder, manifest, known) if "of the bytes" in line]


def test_each_part_says_how_many_bytes_are_read_and_what_they_show(tmp_path: Path) -> None:
    asset = Asset.open(write_in_parts(tmp_path / "asset"))
    parts, files = asset.manifest.parts, asset.manifest.files
    baked: list[Any] = [{"bytes": part.bytes, "loss_db": 6.25 / (i + 1)} for i, part in enumerate(parts[:-1])]
    lines = lines_of_parts(asset, {"baked": {"parts": baked}})
    read, total = files["head.onnx"].bytes + files["cameras.json"].bytes, sum(f.bytes for f in files.values())
    for number, (part, line) in enumerate(zip(parts, lines, strict=True)):
        read += part.bytes
        loss = 6.25 / (number + 1) if number + 1 < len(parts) else 0
        assert f"first {read / total:.0%} of the bytes, {loss:.1f} dB below the whole: " in line
    assert "first 100% of the bytes" in lines[-1], "all but a mesh of 4 bytes"


@pytest.mark.parametrize("change", [{"bytes": 1}, {"loss_db": float("inf")}, {"loss_db": 10**400}, None])
def test_losses_that_are_not_those_of_the_parts_are_not_told(
    change: dict[str, Any] | None, tmp_path: Path
) -> None:
    """An asset that was converted has other parts than those that the bake measured."""
    asset = Asset.open(write_in_parts(tmp_path / "asset"))
    baked: list[Any] = [{"bytes": part.bytes, "loss_db": 1.0} for part in asset.manifest.parts[:-1]]
    assert "dB" in lines_of_parts(asset, {"baked": {"parts": baked}})[0]
    wrong = [baked[0] | change if change is not None else 1.0, *baked[1:]]
    for odd in ({"parts": wrong}, {"parts": 1}, {}, 1):
        lines = lines_of_parts(asset, {"baked": odd})
        assert len(lines) == len(asset.manifest.parts) and not any("dB" in line for line in lines)


def test_levels_that_a_part_leaves_out_are_not_told() -> None:
    levels = [Section("densities", level, 9, "symbols", n_channels=1) for level in (3, 1)]
    assert what_it_adds(Part("part_0.bin", tuple(levels))) == "densities: levels 3, 1"
