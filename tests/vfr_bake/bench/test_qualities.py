"""Tests of the `high` and `fast` pictures that `vfr-bench` measures."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from vfr_bake.bench.frames import open_player
from vfr_bake.bench.timing import Dials
from vfr_bake.cli import bench_main


def changed_asset(asset: Path, folder: Path, **changes: object) -> Path:
    """Copy an asset, with changes of its manifest."""
    shutil.copytree(asset, folder)
    document = json.loads((folder / "manifest.json").read_text())
    (folder / "manifest.json").write_text(json.dumps(document | changes))
    return folder


def test_a_quality_is_measured_with_the_lookups_that_it_makes(
    shells_folder: Path, data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each asset's `high` and `fast` pictures are measured once, with its own k as the quality lowers it."""
    monkeypatch.setattr("vfr_bake.bench.trade.N_FIRST_PICTURES", 1)
    folders = [tmp_path / "five", tmp_path / "nine"]
    for folder, n_fetches, limits in zip(folders, (5, 9), ((0, 2), (8, 4)), strict=True):
        changed_asset(shells_folder, folder, n_fetches=n_fetches, quality_fetches=limits)
    out, quick = tmp_path / "t.json", ["--frames", "2", "--sizes", "24x20", "--threads", "1"]
    names = [str(folder) for folder in folders]
    assert bench_main([*names, "--data", str(data), "--samples", "1", *quick, "--json", str(out)]) == 0
    rows = [row for row in json.loads(out.read_text())["settings"] if row["quality"] != "exact"]
    assert [(row["asset"], row["quality"], row["n_fetches"]) for row in rows] == [
        (names[0], "high", 5), (names[0], "fast", 2), (names[1], "high", 8), (names[1], "fast", 4),
    ]  # fmt: skip
    assert [row["name"].rpartition(" k=")[2] for row in rows] == ["5 high", "2 fast", "8 high", "4 fast"]


def test_lookups_are_counted_as_the_quality_limits_them(shells_folder: Path, tmp_path: Path) -> None:
    asset = changed_asset(shells_folder, tmp_path / "asset", agreement=[0, 0], quality_fetches=[0, 2])
    answer = open_player(str(asset), str(shells_folder / "cameras.json"), "1", "0")
    asked = [Dials(2), Dials(5), Dials(5, "fast")]
    counts = [
        answer({"view": 0, "size": [48, 40], "rgb": None, **dials.request()})["fetches"] for dials in asked
    ]
    assert counts[2] <= counts[0] < counts[1]
