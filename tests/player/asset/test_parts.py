"""Tests of assets in parts: whole ones come back, the first parts play alone, broken ones are reported."""

from __future__ import annotations

import hashlib
import json
import re
import shutil
import tracemalloc
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from player.app import cli
from player.asset.arranging import write_parts
from player.asset.asset import Asset, GridArrays, checksums, read_manifest, write_asset
from player.asset.bricks import pack_vertices
from player.asset.manifest import manifest_bytes, parse_manifest
from player.asset.parts import LIMITS, Counts, needed_bytes
from player.asset.pyramid import Bricks, Pyramid, PyramidValues, symbols_of, values_of, whole_pyramid
from player.errors import ConfigError, FormatError, IntegrityError
from player.render import Renderer
from tests.player.conftest import cameras_bytes, head_bytes
from tests.player.in_parts import MANIFEST, RESOLUTION, STEPS, cells, stored, write_in_parts
from tests.reliability.fuzz.targets import small_view

NONE = Bricks(np.zeros((0, 3), np.uint16), np.zeros((0, 8), np.uint64))


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_in_parts(tmp_path_factory.mktemp("parts") / "asset")


@pytest.fixture
def broken(whole: Path, tmp_path: Path) -> Path:
    """Return a copy of the asset that the test may break."""
    return Path(shutil.copytree(whole, tmp_path / "broken"))


def edit(folder: Path, change: Callable[[dict[str, Any]], object]) -> None:
    path = folder / "manifest.json"
    document = json.loads(path.read_text())
    change(document)
    path.write_text(json.dumps(document))


def vouch(folder: Path, file: str, data: bytes) -> None:
    """Replace a file by `data`, and put its size and checksum into the manifest."""
    (folder / file).write_bytes(data)
    entry = {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}
    edit(folder, lambda m: m["files"].update({file: entry}))


def same(one: PyramidValues, other: PyramidValues) -> bool:
    levels = zip(one.pyramid.levels, other.pyramid.levels, strict=True)
    values = zip(one.values, other.values, strict=True)
    return all(
        np.array_equal(a.masks, b.masks) and np.array_equal(a.coords, b.coords) for a, b in levels
    ) and all(a.dtype == b.dtype and np.array_equal(a, b) for a, b in values)


def test_every_value_comes_back_and_equal_assets_are_equal_files(whole: Path, tmp_path: Path) -> None:
    asset = Asset.open(whole, verify=True)
    assert same(asset.arrays.densities, stored("densities", cells(4, 0.06), 1, STEPS))
    assert same(asset.arrays.features, stored("features", cells(3, 0.09), 9, (2, 2, 1)))
    border = asset.arrays.densities.pyramid.vertices[0].on_border
    assert 0 < border.sum() < len(border)
    rest = (asset.read(name) for name in ("head.onnx", "mesh.ply", "cameras.json"))
    write_asset(tmp_path / "again", asset.manifest, asset.arrays, *rest)
    for path in whole.iterdir():
        assert (tmp_path / "again" / path.name).read_bytes() == path.read_bytes(), path.name


def test_parts_grow_and_share_what_they_hold(whole: Path) -> None:
    manifest = read_manifest(whole)
    n = len(manifest.parts)
    assert n >= 3
    last = None
    for number, asset in enumerate(Asset.growing(whole), start=1):
        assert (asset.n_parts, asset.missing) == (number, None)
        alone = Asset.open(whole, parts=number)
        assert same(alone.arrays.densities, asset.arrays.densities)
        assert same(alone.arrays.features, asset.arrays.features)
        with Renderer(asset, 1, "numpy") as renderer:
            frame = renderer.render(small_view())
        assert frame.opacity.max() > 0.5
        last = asset
    assert last is not None and last.n_parts == n
    assert same(last.arrays.features, Asset.open(whole).arrays.features)
    with pytest.raises(ConfigError, match="parts: expected at least 1, got 0"):
        Asset.open(whole, parts=0)
    assert Asset.open(whole, parts=99).n_parts == n


def test_a_section_that_is_not_there_means_symbols_of_0(whole: Path) -> None:
    """With the first part alone, levels without structure are empty, and channels without symbols are 0 on
    the coarsest level."""
    grown = list(Asset.growing(whole))
    first, last = grown[0].arrays.features, grown[-1].arrays.features
    sections = [s for s in grown[0].manifest.parts[0].sections if s.grid == "features"]
    for level in range(3):
        known = [s.end_channel for s in sections if s.level == level and s.kind == "symbols"]
        n = max(known, default=0)
        structure = any(s.level == level and s.kind == "structure" for s in sections)
        assert len(first.values[level]) == (len(last.values[level]) if structure else 0)
        if structure and level == 2:
            assert np.array_equal(first.values[2][:, :n], last.values[2][:, :n])
            assert not first.values[2][:, n:].any()


def cut(folder: Path, file: str) -> None:
    (folder / file).write_bytes((folder / file).read_bytes()[:-1])


def changed(folder: Path, file: str) -> None:
    data = (folder / file).read_bytes()
    (folder / file).write_bytes(data[:-1] + bytes([data[-1] ^ 1]))


def swapped(folder: Path, file: str) -> None:
    other = "part_2.bin" if file == "part_1.bin" else "part_1.bin"
    shutil.copyfile(folder / other, folder / file)


def endless(folder: Path, file: str) -> None:
    """Make the file a sparse terabyte: it takes no room on the disk, but would not fit into memory."""
    with (folder / file).open("r+b") as data:
        data.truncate(1 << 40)


def a_folder(folder: Path, file: str) -> None:
    (folder / file).unlink()
    (folder / file).mkdir()


def missing(folder: Path, file: str) -> None:
    (folder / file).unlink()


BROKEN = [missing, cut, changed, swapped, endless, a_folder]


@pytest.mark.parametrize("do", BROKEN)
def test_a_later_part_that_is_broken_is_told_and_the_others_play(
    do: Callable[[Path, str], None], broken: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    n = len(read_manifest(broken).parts)
    do(broken, "part_1.bin")
    asset = Asset.open(broken)
    assert asset.n_parts == 1 and asset.missing is not None and "\n" not in asset.missing
    assert asset.missing.startswith(f"{broken / 'part_1.bin'}: ")
    assert asset.missing.endswith(f"shown as the first 1 of {n} parts have it")
    assert same(asset.arrays.features, Asset.open(broken, parts=1).arrays.features)
    assert [grown.n_parts for grown in Asset.growing(broken)] == [1, 1]
    assert [name for name, error in checksums(broken, asset.manifest) if error] == ["part_1.bin"]
    with pytest.raises(FormatError, match=r"part_1\.bin"):
        Asset.open(broken, verify=True)
    assert cli.main([str(broken), "--info"]) == 0
    said = capsys.readouterr().err
    assert said == f"vfr-play: warning: {asset.missing}\n"


def exchange_parts(m: dict[str, Any]) -> None:
    m["parts"][1], m["parts"][2] = m["parts"][2], m["parts"][1]


def exchange_sections(m: dict[str, Any]) -> None:
    one, other = m["parts"][1], m["parts"][2]
    one["sections"], other["sections"] = other["sections"], one["sections"]


def lengthen(m: dict[str, Any]) -> None:
    m["parts"][1]["sections"][-1]["bytes"] += 1


def repeat(m: dict[str, Any]) -> None:
    m["parts"].insert(1, m["parts"][0])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (exchange_parts, r"parts: 1: file: expected part_1\.bin, got part_2\.bin"),
        (exchange_sections, "parts: 1: .* expected .* before it"),
        (lengthen, r"files: part_1\.bin: bytes: expected"),
        (repeat, r"parts: 1: file: expected part_1\.bin, got part_0\.bin"),
    ],
)
def test_what_comes_before_a_part_that_is_not_in_its_place_plays(
    change: Callable[[dict[str, Any]], None], message: str, broken: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    wanted = Asset.open(broken, parts=1)
    edit(broken, change)
    asset = Asset.open(broken)
    assert asset.n_parts == 1 and asset.missing is not None and "\n" not in asset.missing
    assert re.search(rf"broken.manifest\.json: {message}.*: shown as the first 1 of \d parts", asset.missing)
    assert same(asset.arrays.features, wanted.arrays.features)
    assert [grown.n_parts for grown in Asset.growing(broken)] == [1, 1]
    with pytest.raises(FormatError, match=message):
        Asset.open(broken, verify=True)
    assert cli.main([str(broken), "--info"]) == 0
    assert capsys.readouterr().err == f"vfr-play: warning: {asset.missing}\n"


@pytest.mark.parametrize("do", BROKEN)
def test_the_first_part_has_to_be_there(do: Callable[[Path, str], None], broken: Path) -> None:
    do(broken, "part_0.bin")
    with pytest.raises(FormatError, match=r"part_0\.bin: ") as caught:
        Asset.open(broken)
    assert "\n" not in str(caught.value)


def test_the_part_of_another_bake_is_told(broken: Path, tmp_path: Path) -> None:
    """A part of another bake is noticed by its checksum alone: it is intact and has the same name."""
    asset = Asset.open(broken)
    values = tuple(np.maximum(level, 0) for level in asset.arrays.features.values)
    manifest = replace(asset.manifest, feature_steps=(1,) * 3)
    features = values_of(
        asset.arrays.features.pyramid.vertices,
        symbols_of(asset.arrays.features.pyramid.vertices, values, (1,) * 3, LIMITS["features"]),
        (1,) * 3, LIMITS["features"], np.int8,
    )  # fmt: skip
    arrays = replace(asset.arrays, features=PyramidValues(asset.arrays.features.pyramid, tuple(features)))
    rest = (asset.read(name) for name in ("head.onnx", "mesh.ply", "cameras.json"))
    write_asset(tmp_path / "other", manifest, arrays, *rest)
    shutil.copyfile(tmp_path / "other" / "part_1.bin", broken / "part_1.bin")
    shown = Asset.open(broken)
    assert shown.n_parts == 1 and shown.missing is not None and "\n" not in shown.missing
    assert shown.missing.startswith(f"{broken / 'part_1.bin'}: ")


def test_an_asset_that_grows_counts_what_is_still_shown(whole: Path) -> None:
    """The memory of an asset that is still shown counts, and that of the symbols that later parts add to:
    each fits within the limit, but not two of them."""
    least = next(gb for gb in np.arange(0.001, 0.1, 0.0001) if _opens(whole, float(gb)))
    assert len(list(Asset.growing(whole, max_memory=3 * float(least)))) == len(read_manifest(whole).parts)
    grown = []
    with pytest.raises(ConfigError, match=r"memory: expected at most .* allow more by --max-memory"):
        for asset in Asset.growing(whole, max_memory=float(least)):
            grown.append(asset.n_parts)
    assert grown and grown[0] == 1, "what there is room for was shown"


def _opens(folder: Path, gigabytes: float) -> bool:
    try:
        Asset.open(folder, max_memory=gigabytes)
    except ConfigError:
        return False
    return True


def test_a_vouched_part_that_breaks_the_format_leaves_those_before_it(broken: Path) -> None:
    manifest = read_manifest(broken)
    last = manifest.parts[-1]
    wanted = Asset.open(broken, parts=len(manifest.parts) - 1)
    data = bytearray((broken / last.file).read_bytes())
    data[-len(data) // 3 :] = bytes(len(data) // 3 + 1)[: len(data[-len(data) // 3 :])]
    vouch(broken, last.file, bytes(data))
    asset = Asset.open(broken)
    assert asset.n_parts == len(manifest.parts) - 1 and asset.missing is not None
    assert ", level " in asset.missing
    assert same(asset.arrays.features, wanted.arrays.features)
    with pytest.raises(FormatError, match=", level "):
        Asset.open(broken, verify=True)


@pytest.mark.parametrize("grids", [("densities", "features"), ("features", "densities")])
def test_of_two_broken_structures_the_first_is_told(
    grids: tuple[str, str], whole: Path, broken: Path
) -> None:
    """The first of two broken structures is reported, though both pyramids are decoded at the same time and
    one goes on after the other has failed."""
    document = json.loads((broken / "manifest.json").read_text())
    later = structures({"parts": document["parts"][1:]})
    some = [next(section for section in later if section["grid"] == grid) for grid in grids]
    parts: list[dict[str, Any]] = [
        {"file": f"part_{number}.bin", "sections": [s]} for number, s in enumerate(some, 1)
    ]
    edit(broken, lambda m: m["parts"].__setitem__(slice(1, None), parts))
    edit(broken, lambda m: m["files"].pop("part_3.bin"))
    for part, section in zip(parts, some, strict=True):
        vouch(broken, part["file"], bytes(section["bytes"]))
    asset, wanted = Asset.open(broken), Asset.open(whole, parts=1)
    assert asset.n_parts == 1 and asset.missing is not None
    assert f"part_1.bin: {grids[0]}, level {some[0]['level']}, structure: " in asset.missing
    assert same(asset.arrays.densities, wanted.arrays.densities)
    assert same(asset.arrays.features, wanted.arrays.features)
    assert [grown.n_parts for grown in Asset.growing(broken)] == [1, 1]


def structures(document: dict[str, Any]) -> list[dict[str, Any]]:
    return [s for part in document["parts"] for s in part["sections"] if s["kind"] == "structure"]


def swap(sections: list[dict[str, Any]]) -> None:
    sections[0], sections[1] = sections[1], sections[0]


TWICE = {"level": 3, "n_bricks": 1, "n_vertices": 8}
"""Fields that fit a structure of the densities on the coarsest level alone; given to all, they repeat it."""
LIES: list[tuple[Callable[[dict[str, Any]], object], str]] = [
    (lambda m: m["parts"].clear(), "parts: expected at least one"),
    (lambda m: m["parts"][0].update(file="part_1.bin"), r"parts: 0: file: expected part_0\.bin"),
    (lambda m: m["parts"][0].update(file="../part_0.bin"), r"file: expected part_0\.bin"),
    (lambda m: m["parts"][0]["sections"].clear(), "sections: expected a list of 1 to 1024"),
    (lambda m: m["parts"][0]["sections"].pop(), "part_0.bin: bytes: expected"),
    (lambda m: swap(m["parts"][0]["sections"]), "expected the structure of the level before it"),
    (lambda m: m["parts"][0]["sections"].reverse(), "expected"),
    (lambda m: m["parts"].reverse(), "file: expected"),
    (lambda m: structures(m)[0].update(level=8), r"level: expected an integer in 0\.\.7"),
    (lambda m: structures(m)[0].update(level=5), "expected a level below"),
    (lambda m: structures(m)[0].update(bytes=-1), "bytes: expected an integer"),
    (lambda m: structures(m)[0].update(n_bricks=2.0), "n_bricks: expected an integer"),
    (lambda m: structures(m)[0].update(n_bricks=10**6), "n_bricks: expected at most"),
    (lambda m: structures(m)[0].update(n_vertices=0), "n_vertices: expected 8 to"),
    (lambda m: structures(m)[0].update(n_vertices=2**30), "n_vertices: expected 8 to"),
    (lambda m: structures(m)[0].update(kind="values"), 'of kind "structure" or "symbols"'),
    (lambda m: structures(m)[0].update(grid="colours"), 'grid: expected "densities" or "features"'),
    (lambda m: structures(m)[0].pop("n_bricks"), "expected the keys"),
    (lambda m: m["parts"][0]["sections"][-1].update(n_channels=99), "expected channels below"),
    (lambda m: [s.update(TWICE) for s in structures(m) if s["grid"] == "densities"], "each structure once"),
    (lambda m: m.update(level_steps=[1]), "level_steps: expected 4, as many as density_steps, got 1"),
    (lambda m: m.update(level_steps=[1, 2, 1, 1]), "powers of two that do not fall"),
    (lambda m: m.update(level_steps=[1, 2, 3, 4]), "powers of two that do not fall"),
    (
        lambda m: m.update(contracted=True, aabb=[[-2.0] * 3, [2.0] * 3], level_steps=[1, 1, 2, 128]),
        "level_steps: expected less than pi in all where contracted, got 128 steps of 0.03",
    ),
    (lambda m: m.update(feature_steps=[]), "feature_steps: expected 1 to 8 integers"),
    (lambda m: m.update(feature_steps=[256, 1, 1]), r"feature_steps: expected an integer in 1\.\.255"),
    (lambda m: m["files"].pop("part_1.bin"), r"files: expected part_1\.bin"),
    (lambda m: m.update(parts=[m["parts"][0]] * 65), "at most 64 parts"),
]  # fmt: skip


@pytest.mark.parametrize(("lie", "message"), LIES)
def test_manifests_that_lie_are_refused(
    lie: Callable[[dict[str, Any]], object], message: str, whole: Path
) -> None:
    document = json.loads((whole / "manifest.json").read_text())
    lie(document)
    with pytest.raises(FormatError, match=message) as caught:
        parse_manifest(json.dumps(document).encode(), "m.json")
    assert "\n" not in str(caught.value)


def test_counts_that_the_sections_do_not_have_are_refused(broken: Path) -> None:
    for key in ("n_bricks", "n_vertices"):
        for by in (-1, 1):

            def change(m: dict[str, Any], key: str = key, by: int = by) -> None:
                section = next(s for s in structures(m) if s["level"] == 2)
                section[key] += by

            kept = (broken / "manifest.json").read_bytes()
            edit(broken, change)
            with pytest.raises(FormatError, match="level 2, structure: "):
                Asset.open(broken)
            (broken / "manifest.json").write_bytes(kept)


def test_values_that_the_steps_do_not_reach_are_not_written(whole: Path, tmp_path: Path) -> None:
    asset = Asset.open(whole)
    values = [level.copy() for level in asset.arrays.features.values]
    values[2][3, 4] ^= 1
    arrays = replace(asset.arrays, features=PyramidValues(asset.arrays.features.pyramid, tuple(values)))
    rest = [asset.read(name) for name in ("head.onnx", "mesh.ply", "cameras.json")]
    with pytest.raises(FormatError, match=r"features, level [01]: expected values .* steps of 2"):
        write_asset(tmp_path / "new", asset.manifest, arrays, *rest)
    other = replace(asset.manifest, feature_steps=(1, 1, 1))
    values[0][asset.arrays.features.pyramid.vertices[0].on_border] ^= 1
    arrays = replace(asset.arrays, features=PyramidValues(asset.arrays.features.pyramid, tuple(values)))
    with pytest.raises(FormatError, match="on the border"):
        write_asset(tmp_path / "new", other, arrays, *rest)
    assert not (tmp_path / "new").exists()


def test_pyramids_that_are_not_whole_are_not_written(whole: Path) -> None:
    asset = Asset.open(whole)
    d = asset.arrays.densities
    for level, message in (
        (1, "level 0: expected a live cell in each"),
        (3, "level 2: expected a live cell in each"),
    ):
        levels = list(d.pyramid.levels)
        levels[level] = Bricks(levels[level].coords[1:], levels[level].masks[1:])
        pyramid = Pyramid(RESOLUTION, tuple(levels))
        arrays = replace(asset.arrays, densities=PyramidValues(pyramid, d.values))
        with pytest.raises(FormatError, match=message):
            arrays.check(asset.manifest)


def test_manifests_come_back(whole: Path) -> None:
    manifest = read_manifest(whole)
    assert parse_manifest(manifest_bytes(manifest), "m") == manifest


def lattice(n: int, every: int, first: int = 0) -> np.ndarray:
    axis = np.arange(first, n, every)
    return np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)


MEMORY: dict[str, tuple[int, np.ndarray, np.ndarray, int]] = {
    "full": (96, lattice(96, 1), lattice(96, 1), 4),
    "one cell a brick of densities": (256, lattice(256, 8), lattice(8, 1), 4),
    "one cell a brick of features": (256, lattice(8, 1), lattice(256, 8), 4),
    "cells at the ends of bricks": (256, lattice(240, 8, 7), lattice(240, 8, 7), 4),
    "many channels": (64, lattice(8, 1), lattice(64, 1), 64),
    "nearly empty, fine": (1000, lattice(8, 1), lattice(8, 1), 4),
}  # fmt: skip


@pytest.mark.parametrize("name", MEMORY)
def test_what_is_needed_is_what_is_taken(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    resolution, dense, coarse, n_channels = MEMORY[name]
    random = np.random.default_rng(0)
    both = []
    for vertices, n, low, high, kind in (
        (dense, 1, 0, 256, np.uint8),
        (coarse, n_channels, -127, 128, np.int8),
    ):
        coords, masks, _ = pack_vertices(vertices)
        pyramid = whole_pyramid(resolution, [Bricks(coords, masks), NONE, NONE])
        values = [random.integers(low, high, (v.n, n)).astype(kind) for v in pyramid.vertices]
        both.append(PyramidValues(pyramid, tuple(values)))
    manifest = replace(
        MANIFEST, resolution=resolution, feature_resolution=resolution, n_channels=n_channels,
        level_steps=(1,) * 3, density_steps=(1,) * 3, feature_steps=(1,) * 3,
    )  # fmt: skip
    write_asset(
        tmp_path / "a", manifest, GridArrays(*both), head_bytes(n_channels), b"ply\n", cameras_bytes()
    )
    seen: list[int] = []

    def noted(n_packed: int, densities: Counts, features: Counts) -> int:
        seen.append(needed_bytes(n_packed, densities, features))
        return seen[-1]

    monkeypatch.setattr("player.asset.parts.needed_bytes", noted)
    Asset.open(tmp_path / "a").grid  # noqa: B018  (compiles)
    tracemalloc.start()
    Asset.open(tmp_path / "a").grid  # noqa: B018
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    stated, exact = seen[-2:]
    slack = 4e6  # small objects that are no arrays
    assert stated <= exact
    assert peak <= exact + slack, f"{peak / exact:.2f}"
    assert exact <= 2.5 * peak + slack, f"{peak / exact:.2f}"
    with pytest.raises(ConfigError, match=r"a: memory: expected at most .*--max-memory"):
        Asset.open(tmp_path / "a", max_memory=(exact - 1) / 1e9)
    Asset.open(tmp_path / "a", max_memory=(exact + 1) / 1e9)


def test_what_a_manifest_asks_for_is_refused_before_a_part_is_opened(broken: Path) -> None:
    for part in broken.glob("part_*"):
        part.write_bytes(b"")
    edit(broken, lambda m: [m["files"][part["file"]].update(bytes=0) for part in m["parts"]])
    edit(broken, lambda m: [s.update(bytes=0) for part in m["parts"] for s in part["sections"]])
    with pytest.raises(ConfigError, match="memory: expected at most"):
        Asset.open(broken, max_memory=1e-3)
    with pytest.raises(IntegrityError, match="sha256"):
        Asset.open(broken)


def test_an_asset_is_written_in_little_more_than_it_takes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Writing takes less than 9.5 times the memory of the values. (Symbols of all vertices at once, in
    float64, took 2.3 GB beside 0.14 GB of values.)"""
    monkeypatch.setattr("player.asset.pyramid._ROWS_AT_ONCE", 1 << 14)
    random, n_channels = np.random.default_rng(0), 16
    coords, masks, _ = pack_vertices(np.argwhere(random.random((88,) * 3) < 0.6))
    pyramid = whole_pyramid(88, [Bricks(coords, masks), NONE])
    steps, vertices = (1, 1), pyramid.vertices
    symbols = [random.integers(-3, 4, (np.count_nonzero(~v.on_border), n_channels)) for v in vertices]
    features = PyramidValues(pyramid, tuple(values_of(vertices, symbols, steps, LIMITS["features"], np.int8)))
    densities = PyramidValues(pyramid, tuple(np.zeros((v.n, 1), np.uint8) for v in vertices))
    manifest = replace(
        MANIFEST, level_steps=steps, density_steps=steps, feature_steps=steps, n_channels=n_channels
    )
    del symbols
    tracemalloc.start()
    try:
        write_parts(densities, features, manifest, 0, 0)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 9.5 * sum(of_level.nbytes for of_level in features.values)
