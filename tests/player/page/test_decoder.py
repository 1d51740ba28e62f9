"""Tests of the page's decoder in a browser: the player's arrays bit for bit, and messages for broken data."""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import Browser

from player.app.option_types import DEMO
from player.asset.asset import Asset, GridArrays, write_asset
from player.asset.pyramid import Bricks, Pyramid, PyramidValues
from player.asset.version_3.unpacking import read_arrays
from player.cameras.views import asset_cameras
from player.errors import FormatError
from player.head.head import asset_head
from player.page import page
from player.page.gpu_memory import MOST_DECODING_BYTES, decoding_bytes, gpu_bytes
from player.page.scene_files import scene_files
from player.render import render
from tests.player.asset.test_asset import replace_file
from tests.player.asset.test_parts import MANIFEST, STEPS, cells, stored
from tests.player.conftest import cameras_bytes, head_bytes
from tests.player.page.decoder_page import decoded, decoder_page, expected, without_problem
from tests.player.page.render_page import RenderPage
from tests.version_3 import pack_codes, pack_masks

OLD = Path(__file__).parents[1] / "asset" / "version_3_1" / "asset"
Files = dict[str, bytes]


def write_levels(folder: Path, head: bytes) -> Path:
    """Write an asset of levels with different steps, with symbols of all sizes among them."""
    densities, features = (
        stored("densities", cells(4, 0.06), 1, STEPS),
        stored("features", cells(3, 0.09), 9, (2, 2, 1)),
    )
    write_asset(folder, MANIFEST, GridArrays(densities, features), head, b"ply\n", cameras_bytes())
    return folder


@pytest.fixture(scope="module")
def levels(tmp_path_factory: pytest.TempPathFactory) -> Asset:
    return Asset.open(write_levels(tmp_path_factory.mktemp("levels") / "asset", head_bytes(9)))


def run(browser: Browser, folder: Path, files: Files, before: str = "", cut: int | None = None) -> dict:
    """Return what a page with the data `files` finds; `cut`: how many bytes of the page are kept."""
    path = folder / "page.html"
    path.write_bytes(decoder_page(files, before)[:cut])
    return decoded(browser, path)


def check(browser: Browser, folder: Path, asset: Asset) -> dict:
    """Check that the asset's page finds what the player does, after the first part and at the end."""
    found = run(browser, folder, scene_files(asset))
    assert found["error"] is None
    first, last = found["scenes"][0], found["scenes"][-1]
    assert len(found["scenes"]) == (1 if len(asset.manifest.parts) < 2 else 2)
    assert last["problem"] is None and last["n_parts"] == max(len(asset.manifest.parts), 1)
    assert without_problem(last) == expected(asset)
    assert first["n_parts"] == 1 and without_problem(first) == expected(Asset.open(asset.folder, parts=1))
    assert found["progress"] == sorted(found["progress"]) and found["progress"][-1] == 1
    return found


def test_levels_are_decoded(chromium: Browser, levels: Asset, tmp_path: Path) -> None:
    assert len(levels.manifest.parts) > 2
    check(chromium, tmp_path, levels)


def test_a_page_has_the_parts_with_which_its_asset_was_opened(
    chromium: Browser, levels: Asset, tmp_path: Path
) -> None:
    for n_parts in (1, 2):
        files = scene_files(Asset.open(levels.folder, parts=n_parts))
        assert [name for name in files if name.startswith("part_")] == [
            f"part_{i}.bin" for i in range(n_parts)
        ]
        last = run(chromium, tmp_path, files)["scenes"][-1]
        assert last["problem"] is None and last["n_parts"] == n_parts
        assert without_problem(last) == expected(Asset.open(levels.folder, parts=n_parts))


def test_a_page_of_the_first_part_plays(chromium: Browser, tmp_path: Path) -> None:
    """What is drawn of an asset's first part, and the memory that it takes, are the player's."""
    asset = Asset.open(DEMO, parts=1)
    camera = asset_cameras(asset)[12].resized(60, 60)
    drawn = RenderPage(chromium, asset, tmp_path / "scene.html")
    picture = drawn.picture(camera, quality="exact")[..., :3].astype(int)
    assert (
        np.abs(picture - render(asset, camera, march="numpy").to_uint8()).max(axis=-1) <= 3
    ).mean() > 0.999
    assert drawn.page.evaluate("() => vfr.info.gpuBytes") == gpu_bytes(asset)
    drawn.close()


def test_one_level_is_decoded(chromium: Browser, asset: Asset, tmp_path: Path) -> None:
    found = check(chromium, tmp_path, asset)
    for got, camera in zip(found["cameras"], asset_cameras(asset), strict=True):
        assert got["name"] == camera.name and got["width"] == camera.width and got["cy"] == camera.cy
        assert np.array_equal(np.reshape(got["c2w"], (4, 4)), camera.c2w)


def test_an_asset_of_version_3_is_decoded(chromium: Browser, tmp_path: Path) -> None:
    check(chromium, tmp_path, Asset.open(OLD))


def test_an_asset_of_version_3_whose_features_form_no_cell_is_refused(tmp_path: Path) -> None:
    folder = Path(shutil.copytree(OLD, tmp_path / "old"))
    n = len(read_arrays(folder, Asset.open(folder).manifest, 1 << 40)[1].coords)
    one_each = np.zeros((n, 8), np.uint64)
    one_each[:, 0] = 1
    replace_file(folder, "feature_masks.bits", pack_masks(one_each))
    n_channels = Asset.open(OLD).manifest.n_channels
    replace_file(folder, "features.codes", pack_codes(np.zeros((n, n_channels), np.int8)))
    with pytest.raises(FormatError, match="features: expected at least one live cell, got none"):
        page(Asset.open(folder))


def test_large_symbols_an_empty_and_a_full_grid(chromium: Browser, tmp_path: Path) -> None:
    """Noise of all values in every cell, densities without a brick, and a grid of one cell are decoded."""
    random = np.random.default_rng(3)
    for resolution in (1, 17):
        n = -(-resolution // 8)
        coords = np.indices((n,) * 3).reshape(3, -1).T.astype(np.uint16)
        inside = [
            (np.indices((8, 8, 8)).reshape(3, -1).T + 8 * brick.astype(int) < resolution).all(axis=1)
            for brick in coords
        ]
        masks = np.packbits(inside, axis=1, bitorder="little").view("<u8").astype(np.uint64)
        full = Pyramid(resolution, (Bricks(coords, masks),))
        features = random.integers(-127, 128, (full.vertices[0].n, 3)).astype(np.int8)
        none = Bricks(np.zeros((0, 3), np.uint16), np.zeros((0, 8), np.uint64))
        densities = {
            "full": PyramidValues(full, (random.integers(0, 256, (len(features), 1)).astype(np.uint8),)),
            "empty": PyramidValues(Pyramid(resolution, (none,)), (np.zeros((0, 1), np.uint8),)),
        }
        manifest = replace(
            MANIFEST, resolution=resolution, feature_resolution=resolution, n_channels=3, level_steps=(1,),
            density_steps=(1,), feature_steps=(1,),
        )  # fmt: skip
        for name, density in densities.items():
            arrays = GridArrays(density, PyramidValues(full, (features,)))
            folder = tmp_path / f"{name}_{resolution}"
            write_asset(folder, manifest, arrays, head_bytes(3), b"ply\n", cameras_bytes())
            check(chromium, tmp_path, Asset.open(folder))


def test_it_decodes_where_workers_or_checksums_are_not_to_be_had(
    chromium: Browser, levels: Asset, tmp_path: Path
) -> None:
    files = scene_files(levels)
    no_worker = 'globalThis.Worker = function () { throw new Error("no"); };\n'
    no_checksums = (
        'globalThis.subtle = crypto.subtle;\nObject.defineProperty(globalThis, "crypto", { value: {} });\n'
    )
    for before in (no_worker, no_checksums):
        found = run(chromium, tmp_path, files, before)
        assert found["error"] is None and without_problem(found["scenes"][-1]) == expected(levels)


BREAKS = """
import { loadScene } from "./loader.js";

const pause = setTimeout;
let nPauses = 0; // the decoder pauses after each channel
globalThis.setTimeout = (go) => (nPauses++, pause(go));
globalThis.found = (async () => {
  const told = [];
  for await (const _ of loadScene((progress) => told.push(progress))) break;
  const before = told.length;
  while (nPauses < N_CHANNELS) await new Promise((go) => { pause(go); });
  return [before, told.length];
})();
"""


def test_no_progress_is_told_once_nobody_wants_the_scene(
    chromium: Browser, levels: Asset, tmp_path: Path
) -> None:
    """Where there are no workers, the page goes on decoding the part that it has begun."""
    sections = levels.manifest.parts[0].sections
    n_channels = sum(section.n_channels for section in sections if section.kind == "symbols")
    path, main = tmp_path / "page.html", BREAKS.replace("N_CHANNELS", str(n_channels))
    path.write_bytes(decoder_page(scene_files(levels), "globalThis.Worker = undefined;\n", main=main))
    before, behind = decoded(chromium, path)
    assert before == behind


def test_the_head_is_what_the_player_reads(chromium: Browser, tmp_path: Path, levels: Asset) -> None:
    arrays = asset_head(levels)
    head = check(chromium, tmp_path, levels)["head"]
    assert head["n_channels"] == 9 and head["sh_degree"] == arrays.form.sh_degree
    for name in ("to_sh", "harmonics", "bottleneck", "output"):
        layer, got = getattr(arrays, name), head[name]
        for key in ("weight", "bias"):
            values = list(got[key].values()) if isinstance(got[key], dict) else got[key]
            assert np.array_equal(np.array(values, np.float32), getattr(layer, key).reshape(-1)), (name, key)
        assert (got["n_in"], got["n_out"]) == layer.weight.shape


def set_bytes(files: Files, name: str, data: bytes) -> Files:
    """Return the files with other content in one, whose size and checksum are put into the manifest."""
    manifest = json.loads(files["manifest.json"])
    manifest["files"][name] = {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}
    return {**files, name: data, "manifest.json": json.dumps(manifest).encode()}


def test_what_is_broken_is_told(chromium: Browser, levels: Asset, tmp_path: Path) -> None:
    files = scene_files(levels)
    page = decoder_page(files)

    def end_of(name: str) -> int:
        return page.index(b'data-file="%s"' % name.encode()) + 40

    def problem(files: Files, cut: int | None = None) -> str:
        found = run(chromium, tmp_path, files, cut=cut)
        assert (found["error"] is None) == bool(found["scenes"])
        return found["error"] or found["scenes"][-1]["problem"]

    assert "manifest.json: expected" in problem(files, end_of("manifest.json") + 300)
    assert "cameras.json: expected" in problem(files, end_of("cameras.json"))
    assert "part_0.bin: expected it in the page" in problem(files, end_of("part_0.bin") - 60)
    assert "part_0.bin: expected" in problem(files, end_of("part_0.bin") + 100)
    for name in ("head.bin", "part_0.bin"):
        changed = bytearray(files[name])
        changed[-1] ^= 1
        assert f"{name}: sha256" in problem({**files, name: bytes(changed)})
        assert f"{name}: expected" in problem({**files, name: files[name][:-1] + b"more than there was"})


def test_parts_before_a_broken_one_are_shown(chromium: Browser, levels: Asset, tmp_path: Path) -> None:
    files = scene_files(levels)
    name = "part_2.bin"
    damaged = bytearray(files[name])
    damaged[len(damaged) // 2] ^= 255
    found = run(chromium, tmp_path, {**files, name: bytes(damaged)})
    last = found["scenes"][-1]
    assert "part_2.bin: sha256" in last["problem"] and "the first 2 of" in last["problem"]
    assert last["n_parts"] == 2 and without_problem(last) == expected(Asset.open(levels.folder, parts=2))
    found = run(chromium, tmp_path, set_bytes(files, name, bytes(damaged)))
    last = found["scenes"][-1]  # it breaks while it is decoded: what was shown stays
    assert last["problem"].startswith("part_2.bin: ") and last["n_parts"] == 1


REFUSES = """
const Own = Int8Array;
globalThis.Int8Array = class Int8Array extends Own {
  constructor(...given) {
    if (given[0] >= MOST) throw RangeError("Array buffer allocation failed");
    super(...given);
  }
};
"""


@pytest.mark.parametrize("worker", ["", "globalThis.Worker = undefined;\n"], ids=["worker", "no worker"])
def test_parts_before_one_that_does_not_fit_into_memory_are_shown(
    chromium: Browser, levels: Asset, tmp_path: Path, worker: str
) -> None:
    """A device that refuses memory for the features of all levels shows those of the coarser ones."""
    n_parts = len(levels.manifest.parts)
    rows = [Asset.open(levels.folder, parts=n).arrays.features.first_rows[-1] for n in range(1, n_parts + 1)]
    n_before = int(np.searchsorted(rows, rows[-1]))
    assert 0 < n_before
    before = REFUSES.replace("MOST", str(12 * rows[-1])) + worker
    found = run(chromium, tmp_path, scene_files(levels), before)
    last = found["scenes"][-1]
    assert found["error"] is None
    wanted = f"Array buffer allocation failed: shown as the first {n_before} of {n_parts} parts have it"
    assert last["problem"] == wanted
    assert last["n_parts"] == 1 and without_problem(last) == expected(Asset.open(levels.folder, parts=1))


def with_last_section_apart(folder: Path, to: Path) -> Path:
    """Copy an asset so that its last section, symbols of a level whose structure is in an earlier part, is a
    part of its own; return the new folder."""
    shutil.copytree(folder, to)
    manifest = json.loads((to / "manifest.json").read_text())
    part = manifest["parts"][-1]
    section = part["sections"].pop()
    assert part["sections"] and section["kind"] == "symbols"
    data, n_before = (to / part["file"]).read_bytes(), sum(some["bytes"] for some in part["sections"])
    name = f"part_{len(manifest['parts'])}.bin"
    manifest["parts"].append({"file": name, "sections": [section]})
    for file, content in ((part["file"], data[:n_before]), (name, data[n_before:])):
        (to / file).write_bytes(content)
        manifest["files"][file] = {"bytes": len(content), "sha256": hashlib.sha256(content).hexdigest()}
    (to / "manifest.json").write_text(json.dumps(manifest))
    return to


def test_all_parts_before_a_broken_last_one_are_shown(
    chromium: Browser, levels: Asset, tmp_path: Path
) -> None:
    """The grid of the whole scene is asked for before the last part turns out to be broken."""
    asset = Asset.open(with_last_section_apart(levels.folder, tmp_path / "asset"))
    files, n_before = scene_files(asset), len(asset.manifest.parts) - 1
    name = asset.manifest.parts[-1].file
    damaged = bytearray(files[name])
    damaged[0] ^= 255
    found = run(chromium, tmp_path, {**files, name: bytes(damaged)})
    assert found["error"] is None
    last = found["scenes"][-1]
    assert f"{name}: sha256" in last["problem"] and last["n_parts"] == n_before
    assert without_problem(last) == expected(Asset.open(asset.folder, parts=n_before))


SECTIONS: list[tuple[str, Callable[[bytearray], object]]] = [
    ("a header", lambda data: data.__setitem__(slice(0, 4), b"\xff\xff\xff\xff")),
    ("a byte", lambda data: data.__setitem__(len(data) // 3, data[len(data) // 3] ^ 64)),
    ("zeros", lambda data: data.__setitem__(slice(0, None), bytes(len(data)))),
]


@pytest.mark.parametrize("change", [change for _, change in SECTIONS], ids=[name for name, _ in SECTIONS])
def test_every_damage_of_a_first_part_is_one_message(
    chromium: Browser, levels: Asset, tmp_path: Path, change: Callable[[bytearray], object]
) -> None:
    """Each damage gives one message. Checksums fit, so that the decoder itself has to find the damage."""
    files = scene_files(levels)
    data = bytearray(files["part_0.bin"])
    change(data)
    found = run(chromium, tmp_path, set_bytes(files, "part_0.bin", bytes(data)))
    assert found["error"].startswith("part_0.bin: ") and not found["scenes"]


def test_numbers_that_take_too_much_memory_are_refused(
    chromium: Browser, levels: Asset, tmp_path: Path
) -> None:
    files = scene_files(levels)
    manifest = json.loads(files["manifest.json"])
    for part in manifest["parts"]:
        for section in part["sections"]:
            if section["kind"] == "structure":
                section["n_vertices"] *= 1 << 20
                section["n_bricks"] *= 1 << 20
    found = run(chromium, tmp_path, {**files, "manifest.json": json.dumps(manifest).encode()})
    needed, most = decoding_bytes(levels) << 20, MOST_DECODING_BYTES // 10**6
    assert f"takes {-(-needed // 10**6)} MB of memory: expected at most {most} MB" in found["error"]
