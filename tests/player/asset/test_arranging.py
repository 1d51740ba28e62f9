"""Tests of how an asset's sections are cut into parts."""

from __future__ import annotations

from itertools import accumulate
from pathlib import Path

from player.asset.arranging import OTHERS, SHARES
from player.asset.asset import Asset, GridArrays, read_manifest, write_asset
from player.asset.sections import Section
from tests.player.conftest import cameras_bytes, head_bytes
from tests.player.in_parts import MANIFEST, STEPS, cells, stored


def written(folder: Path, mesh: bytes | None, later: bytes | None = None) -> list[list[Section]]:
    """Write an asset whose mesh is known at first, or comes `later`; return the sections of its parts."""
    arrays = GridArrays(
        stored("densities", cells(4, 0.06), 1, STEPS), stored("features", cells(3, 0.09), 9, (2, 2, 1))
    )
    finish = None if later is None else lambda _: {"mesh.ply": later}
    write_asset(folder, MANIFEST, arrays, head_bytes(9), mesh, cameras_bytes(), finish=finish)
    Asset.open(folder, verify=True)
    return [list(part.sections) for part in read_manifest(folder).parts]


def test_parts_end_at_shares_of_all_bytes_also_if_the_mesh_is_made_later(tmp_path: Path) -> None:
    n_before = len(head_bytes(9)) + len(cameras_bytes())
    without = written(tmp_path / "without", b"")
    ends = list(accumulate((s.bytes for part in without for s in part), initial=n_before))[1:]
    mesh = bytes(ends[-1] // OTHERS)
    parts = written(tmp_path / "later", None, mesh)
    assert parts == written(tmp_path / "known", mesh)
    assert parts != without
    total = ends[-1] + len(mesh)
    n_read = list(accumulate(map(len, parts)))
    for n in n_read[:-1]:
        share = next(share for share in SHARES if ends[n - 1] <= share * total)
        assert ends[n] > share * total, "one more section would have fitted into the part"
    assert [s.bytes for part in parts for s in part] == [s.bytes for part in without for s in part]
