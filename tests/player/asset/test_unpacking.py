"""Tests of the memory that an asset of version 3 takes: the estimate that is compared with the budget,
against numpy's allocations."""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from player.asset.asset import Asset
from player.asset.bricks import bricks_per_axis, pack_vertices, with_corners
from player.asset.manifest import Manifest, parse_manifest
from player.asset.parts import Counts
from player.asset.single_level import VertexBricks
from player.asset.version_3.unpacking import DENSITIES, FEATURES, needed_bytes, read_arrays
from player.errors import ConfigError, FormatError
from player.files.memory import _group_limits, allowed_bytes
from tests.player.conftest import cameras_bytes, head_bytes
from tests.version_3 import write_version_3

Vertices = Callable[[np.random.Generator], np.ndarray]


def lattice(n: int, every: int) -> np.ndarray:
    axis = np.arange(0, n, every)
    return np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)


def cells_of(lowest: np.ndarray) -> np.ndarray:
    """Return the eight corners of each of the cells [n, 3]."""
    return (lowest[:, None] + np.argwhere(np.ones((2, 2, 2)))).reshape(-1, 3)


def written(folder: Path, resolution: int, densities: np.ndarray, features: np.ndarray, n: int) -> Path:
    """Write an asset of exactly these vertices, whether or not they are corners of live cells."""
    random = np.random.default_rng(0)
    manifest = Manifest(
        generator="tests", resolution=resolution, feature_resolution=resolution, step=0.1,
        density_range=(-2, 6), n_channels=n, view_size=(48, 40),
    )  # fmt: skip
    codes = random.integers(0, 256, len(densities)).astype(np.uint8)
    values = random.integers(-128, 128, (len(features), n)).astype(np.int8)
    stored = (
        VertexBricks(*pack_vertices(densities)[:2], codes),
        VertexBricks(*pack_vertices(features)[:2], values),
    )
    files = {"head.onnx": head_bytes(n), "mesh.ply": b"ply\n", "cameras.json": cameras_bytes()}
    return write_version_3(folder, manifest, *stored, files)


CASES: dict[str, tuple[int, np.ndarray, np.ndarray, int]] = {
    "full": (96, lattice(97, 1), lattice(97, 1), 4),
    "one cell a brick of densities": (255, cells_of(lattice(249, 8)), lattice(9, 1), 4),
    "one cell a brick of features": (255, lattice(9, 1), cells_of(lattice(249, 8)), 4),
    "many channels": (64, lattice(9, 1), lattice(65, 1), 64),
    "nearly empty, fine": (1000, lattice(9, 1), lattice(9, 1), 4),
}


@pytest.mark.parametrize("name", CASES)
def test_what_is_needed_is_what_is_taken(name: str, tmp_path: Path) -> None:
    folder = written(tmp_path / "asset", *CASES[name])
    m = Asset.open(folder).manifest
    arrays = read_arrays(folder, m, 1 << 40)
    counts = []
    for coords, masks, codes in arrays:
        n = bricks_per_axis(m.resolution)
        held = len(with_corners(coords, masks, n))
        n_channels = codes.size // len(codes)
        counts.append(Counts(n, len(coords), len(coords), len(codes), n_channels, held))
    n_packed = sum(m.files[file].bytes for file in (*DENSITIES, *FEATURES))
    needed = needed_bytes(n_packed, *counts)
    del arrays, coords, masks, codes
    tracemalloc.start()
    asset = Asset.open(folder)
    asset.grid  # noqa: B018
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    slack = 1e6  # small objects that are no arrays
    assert peak <= needed + slack, f"{peak / needed:.2f}"
    # bricks without a live cell, known only when the grid is built, take less than half of the estimate
    assert needed <= 2.5 * peak + slack, f"{peak / needed:.2f}"
    with pytest.raises(ConfigError, match=r"asset: memory: expected at most .*--max-memory"):
        Asset.open(folder, max_memory=(needed - 1) / 1e9)
    Asset.open(folder, max_memory=(needed + 1) / 1e9)


def test_allowed_by_default(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("player.files.memory._machine_bytes", lambda: 8 << 30)
    monkeypatch.setattr("player.files.memory._limits", lambda: [])
    assert allowed_bytes() == 4 << 30
    monkeypatch.setattr("player.files.memory._limits", lambda: [1 << 30, 6 << 30])
    assert allowed_bytes() == 1 << 29
    assert allowed_bytes(2.5) == 2_500_000_000
    for bad in (0, -1, float("nan"), float("inf")):
        with pytest.raises(ConfigError, match="max_memory: expected gigabytes"):
            allowed_bytes(bad)


def test_limits_of_control_groups(tmp_path: Path) -> None:
    groups, root = tmp_path / "cgroup", tmp_path / "fs"
    for folder, text in (("a/b", "max\n"), ("a", "1000\n"), ("other", "5\n")):
        (root / folder).mkdir(parents=True, exist_ok=True)
        (root / folder / "memory.max").write_text(text)
    (root / "memory" / "c").mkdir(parents=True)
    (root / "memory" / "c" / "memory.limit_in_bytes").write_text("2000\n")
    groups.write_text("0::/a/b\n5:cpu,memory:/c\n3:cpu:/other\n")
    assert sorted(_group_limits(groups, root)) == [1000, 2000]
    assert _group_limits(tmp_path / "none", root) == []


def test_a_manifest_of_too_many_values(broken_folder: Path) -> None:
    data = (broken_folder / "manifest.json").read_bytes()
    many = data.replace(b'"psnr": 30.5', b'"psnr": [' + b"[]," * (1 << 20) + b"[]]")
    assert len(many) < 16 << 20
    with pytest.raises(FormatError, match="expected at most 1048576 values"):
        parse_manifest(many, "manifest.json")
    twice = data.replace(b'"psnr": 30.5', b'"psnr": 30.5, "psnr": 40')
    with pytest.raises(FormatError, match="expected JSON, got something else: a key that is there twice"):
        parse_manifest(twice, "manifest.json")
