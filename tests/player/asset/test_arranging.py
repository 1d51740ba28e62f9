"""Tests of how an asset's sections are arranged in parts."""

from __future__ import annotations

from pathlib import Path

import pytest

from player.asset.arranging import OTHERS, SHARES, channel_groups
from player.asset.asset import Asset, GridArrays, read_manifest, write_asset
from player.asset.sections import MAX_CHANNELS, MAX_SECTIONS, Grid, Part, Section, in_order, part_name
from player.errors import FormatError
from tests.player.conftest import cameras_bytes, head_bytes
from tests.player.in_parts import MANIFEST, STEPS, cells, stored

N_BEFORE = len(head_bytes(9)) + len(cameras_bytes())


@pytest.fixture(scope="module")
def arrays() -> GridArrays:
    return GridArrays(
        stored("densities", cells(4, 0.06), 1, STEPS), stored("features", cells(3, 0.09), 9, (2, 2, 1))
    )


def written(
    arrays: GridArrays, folder: Path, mesh: bytes | None, later: bytes | None = None
) -> list[list[Section]]:
    """Write an asset whose mesh is known at first, or comes `later`; return the sections of its parts."""
    finish = None if later is None else lambda _: {"mesh.ply": later}
    write_asset(folder, MANIFEST, arrays, head_bytes(9), mesh, cameras_bytes(), finish=finish)
    Asset.open(folder, verify=True)
    return [list(part.sections) for part in read_manifest(folder).parts]


def can_follow(section: Section, before: list[Section]) -> bool:
    """Return whether a section can be decoded after those before it."""
    parts = [Part(part_name(0), (*before, section))]
    n_levels: dict[Grid, int] = {"densities": 4, "features": 3}
    try:
        list(in_order("here", parts, {"densities": 45, "features": 45}, n_levels, 9))
    except FormatError:
        return False
    return True


@pytest.mark.parametrize("n_mesh", [0, 20_000, 60_000])
def test_a_part_takes_all_that_fits_into_its_share_of_all_bytes(
    n_mesh: int, arrays: GridArrays, tmp_path: Path
) -> None:
    mesh = bytes(n_mesh)
    parts = written(arrays, tmp_path / "asset", mesh)
    every = [section for part in parts for section in part]
    total = N_BEFORE + sum(section.bytes for section in every) + len(mesh)
    n_sections = 0
    for part in parts[:-1]:
        n_sections += len(part)
        before, others = every[:n_sections], every[n_sections:]
        n_read = N_BEFORE + sum(section.bytes for section in before)
        most = next(share for share in SHARES if n_read <= share * total) * total
        fit = [s for s in others if can_follow(s, before) and n_read + s.bytes <= most]
        assert not fit, f"after {part[-1].name}: expected in this part what still fits"


def test_parts_are_the_same_if_the_mesh_is_made_later(arrays: GridArrays, tmp_path: Path) -> None:
    without = written(arrays, tmp_path / "without", b"")
    n_bytes = N_BEFORE + sum(section.bytes for part in without for section in part)
    mesh = bytes(n_bytes // OTHERS)
    parts = written(arrays, tmp_path / "later", None, mesh)
    assert parts == written(arrays, tmp_path / "known", mesh)
    assert parts != without


@pytest.mark.parametrize("n_channels", [1, 2, 3, 24, 65, MAX_CHANNELS])
def test_groups_of_channels_are_few_enough(n_channels: int) -> None:
    n_sections = 0
    for level in range(8):
        groups = channel_groups(n_channels, level)
        assert groups == sorted(set(groups)) and (groups[0], groups[-1]) == (0, n_channels)
        n_sections += len(groups)
    assert n_sections + 16 <= MAX_SECTIONS
