"""Tests of what `vfr-play --info` says of an asset."""

from __future__ import annotations

from dataclasses import replace

import pytest

from player.app.info import facts, page
from player.asset.asset import Asset


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
