"""Tests of the asset format: round trips, and every way to break it."""

from __future__ import annotations

import errno
import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from player.asset.asset import Asset, GridArrays, checksums, read_manifest, write_asset
from player.asset.manifest import FILES, MAX_BYTES, Manifest, manifest_bytes, parse_manifest
from player.asset.pyramid import Bricks, Pyramid, PyramidValues
from player.cameras.views import asset_cameras
from player.errors import FormatError, IntegrityError, OutputError, VersionError
from player.head.head import Head

SMALLEST = Manifest(
    generator="t",
    resolution=6,
    feature_resolution=6,
    step=0.1,
    density_range=(0, 1),
    n_channels=1,
    view_size=(1, 1),
)
"""The smallest manifest: only what has no default."""


def parts(asset: Asset) -> tuple[Manifest, GridArrays, bytes, bytes, bytes]:
    rest = (asset.path(name).read_bytes() for name in ("head.onnx", "mesh.ply", "cameras.json"))
    return (asset.manifest, asset.arrays, *rest)


def test_round_trip_is_byte_for_byte(asset: Asset, tmp_path: Path) -> None:
    write_asset(tmp_path / "copy", *parts(asset))
    again = Asset.open(tmp_path / "copy", verify=True)
    assert again.manifest == asset.manifest
    for name in (*FILES, "manifest.json"):
        assert (tmp_path / "copy" / name).read_bytes() == (asset.folder / name).read_bytes()
    for ours, theirs in zip(vars(asset.arrays).values(), vars(again.arrays).values(), strict=True):
        assert np.array_equal(ours.values[0], theirs.values[0])
        for name in ("coords", "masks"):
            one, other = (getattr(grid.pyramid.levels[0], name) for grid in (ours, theirs))
            assert np.array_equal(one, other)


def test_what_is_added_at_the_end_is_listed_and_a_failure_there_leaves_nothing(
    asset: Asset, tmp_path: Path
) -> None:
    def finish(folder: Path) -> dict[str, bytes]:
        assert folder != tmp_path / "a" and not (tmp_path / "a").exists()
        assert Asset.open(folder, verify=True).manifest.files.keys() == set(FILES)
        return {"report.json": b"{}"}

    def fail(folder: Path) -> dict[str, bytes]:
        raise OutputError("it plays black")

    write_asset(tmp_path / "a", *parts(asset), finish=finish)
    assert Asset.open(tmp_path / "a", verify=True).path("report.json").read_bytes() == b"{}"
    with pytest.raises(OutputError, match="it plays black"):
        write_asset(tmp_path / "b", *parts(asset), finish=fail)
    assert [path.name for path in tmp_path.iterdir()] == ["a"]


def test_files_that_no_player_reads_may_be_missing(asset: Asset, tmp_path: Path) -> None:
    """A report is for people and the mesh for other programs; whoever copies an asset may leave them out."""
    write_asset(tmp_path / "a", *parts(asset), finish=lambda _: {"report.json": b"{}", "notes.txt": b"n"})
    (tmp_path / "a" / "report.json").unlink()
    (tmp_path / "a" / "mesh.ply").unlink()
    (tmp_path / "a" / "notes.txt").write_text("other notes")
    opened = Asset.open(tmp_path / "a")
    assert opened.missing is None
    with pytest.raises(FormatError, match=r"mesh\.ply: no such file: expected a file of 4 bytes"):
        opened.read("mesh.ply")
    (tmp_path / "a" / "mesh.ply").write_bytes(b"ply\n")
    with pytest.raises(IntegrityError, match=r"notes\.txt: size"):
        Asset.open(tmp_path / "a", verify=True)


def test_an_asset_moves(broken_folder: Path, tmp_path: Path) -> None:
    broken_folder.rename(tmp_path / "elsewhere")
    assert Asset.open(tmp_path / "elsewhere", verify=True).path("mesh.ply").is_file()


def test_scale_and_world(asset: Asset) -> None:
    assert math.isclose(asset.scale, 2)
    assert asset.world_from_model[:3, 3].tolist() == [1, 2, 3]


def test_existing_folder_is_kept_without_force(asset: Asset, tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "manifest.json").write_text('{"format": "vfr-asset"}')
    with pytest.raises(OutputError, match="already exists: add --force"):
        write_asset(tmp_path / "out", *parts(asset))
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["manifest.json"]
    write_asset(tmp_path / "out", *parts(asset), force=True)
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == sorted([*FILES, "manifest.json"])


def test_full_disk_leaves_nothing(asset: Asset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("pathlib.Path.write_bytes", full)
    with pytest.raises(OutputError, match=r"out: cannot write: No space left on device"):
        write_asset(tmp_path / "out", *parts(asset))
    assert list(tmp_path.iterdir()) == []


def test_no_such_folder(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match=r"nowhere: expected the folder of an asset, got nothing"):
        Asset.open(tmp_path / "nowhere")
    with pytest.raises(FormatError, match=r"not an asset: expected manifest\.json in it, got none"):
        Asset.open(tmp_path)
    (tmp_path / "file").write_text("")
    with pytest.raises(FormatError, match=r"file: expected the folder of an asset, got a file"):
        Asset.open(tmp_path / "file")


@pytest.mark.parametrize("name", FILES)
def test_missing_cut_and_changed_files_are_named(name: str, broken_folder: Path) -> None:
    path = broken_folder / name
    data = path.read_bytes()
    changed = bytearray(data)
    changed[-1] ^= 1
    path.write_bytes(bytes(changed))
    with pytest.raises(IntegrityError, match=rf"{name}: sha256: expected [0-9a-f]{{16}}\.\.\., got"):
        Asset.open(broken_folder, verify=True)
    failed = [n for n, error in checksums(broken_folder, read_manifest(broken_folder)) if error]
    assert failed == [name]
    path.write_bytes(data[:-1])
    unread = name == "mesh.ply"  # nothing but a verification looks at it
    with pytest.raises(
        IntegrityError, match=rf"{name}: size: expected {len(data)} bytes, got {len(data) - 1}"
    ):
        Asset.open(broken_folder, verify=unread)
    path.unlink()
    with pytest.raises(FormatError, match=rf"{name}: no such file: expected a file of {len(data)} bytes"):
        Asset.open(broken_folder, verify=unread)


@pytest.mark.parametrize("name", ["head.onnx", "cameras.json"])
def test_a_file_of_another_bake_is_not_read(name: str, broken_folder: Path) -> None:
    """As an interrupted copy over an older asset leaves it, or a bake into the folder of an open one: another
    file of the same size."""
    before = Asset.open(broken_folder)
    data = (broken_folder / name).read_bytes()
    (broken_folder / name).write_bytes(data[:-1] + bytes([data[-1] ^ 1]))
    reads = {"head.onnx": Head.of, "cameras.json": asset_cameras}
    for asset in (before, Asset.open(broken_folder)):
        with pytest.raises(IntegrityError, match=rf"{name}: sha256: expected [0-9a-f]{{16}}\.\.\., got"):
            reads[name](asset)


def test_an_asset_is_read_after_the_current_folder_has_changed(
    broken_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(broken_folder.parent)
    asset = Asset.open(broken_folder.name)
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    assert len(asset_cameras(asset)) == 5 and asset.path("mesh.ply").read_bytes() == b"ply\n"


def replace_file(folder: Path, name: str, data: bytes) -> None:
    """Put `data` in place of a file and tell the manifest its size."""
    (folder / name).write_bytes(data)
    edit(folder, lambda m: m["files"][name].update(bytes=len(data)))


def edit(folder: Path, change: Callable[[dict[str, Any]], object]) -> None:
    path = folder / "manifest.json"
    document = json.loads(path.read_text())
    change(document)
    path.write_text(json.dumps(document))


def test_cells_beyond_the_grid_are_not_written() -> None:
    beyond = Bricks(np.zeros((1, 3), np.uint16), np.full((1, 8), 2**7, np.uint64))
    pyramid = Pyramid(SMALLEST.resolution, (beyond,))
    codes = np.zeros((pyramid.vertices[0].n, 1))
    arrays = GridArrays(*(PyramidValues(pyramid, (codes.astype(kind),)) for kind in (np.uint8, np.int8)))
    with pytest.raises(FormatError, match="densities, level 0: expected cells below 6, got one at 7"):
        arrays.check(SMALLEST)


BAD_MANIFESTS: list[tuple[dict[str, Any], str]] = [
    ({"format": "other"}, 'format: expected "vfr-asset", got'),
    ({"resolution": True}, r"resolution: expected an integer in 1\.\.2048, got True"),
    ({"resolution": 64.0}, "resolution: expected an integer"),
    ({"resolution": 0}, "resolution: expected an integer"),
    ({"resolution": 10**400}, "resolution: expected an integer"),
    ({"step": -1}, "step: expected a number"),
    ({"step": False}, "step: expected a number"),
    ({"step": "1"}, "step: expected a number"),
    ({"step": 1e-8}, "step: expected at most 65536 steps"),
    ({"aabb": [[1, 1, 1], [-1, -1, -1]]}, "aabb: expected lower corner below upper"),
    ({"aabb": [[1, 1], [2, 2]]}, "aabb: expected 3 numbers"),
    (
        {"world_from_model": [[2, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]},
        "world_from_model: expected a rot",
    ),
    (
        {"world_from_model": [[-1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]},
        "world_from_model: expected",
    ),
    ({"density_range": [1, 1]}, "density_range: expected low < high"),
    ({"density_range": [0, 1000]}, "density_range: expected a number"),
    ({"background": [0, 0, 2]}, "background: expected a number"),
    ({"colour_space": "linear"}, "colour_space: expected one of"),
    ({"view_size": [800]}, "view_size: expected 2 integers"),
    ({"generator": 3}, "generator: expected text"),
    ({"provenance": []}, "provenance: expected an object"),
    ({"files": {"../x": {"bytes": 1, "sha256": "0" * 64}}}, "files: expected plain file names"),
    ({"files": {"/etc/passwd": {"bytes": 1, "sha256": "0" * 64}}}, "files: expected plain file names"),
    ({"files": {"C:x": {"bytes": 1, "sha256": "0" * 64}}}, "files: expected plain file names"),
    ({"files": {"..": {"bytes": 1, "sha256": "0" * 64}}}, "files: expected plain file names"),
    ({"files": {"a": {"bytes": -1, "sha256": "0" * 64}}}, "bytes: expected an integer"),
    ({"files": {"a": {"bytes": 1, "sha256": "xyz"}}}, "sha256: expected 64"),
    ({"files": {"a": {"bytes": 1}}}, "expected bytes and sha256"),
    ({"files": {}}, r"files: expected head\.onnx"),
    ({"surprise": 1}, "surprise: expected no such key"),
    ({"version": "1.0"}, "version: expected 2 integers"),
]


@pytest.mark.parametrize(("change", "message"), BAD_MANIFESTS)
def test_bad_manifest(change: dict[str, Any], message: str, asset: Asset) -> None:
    document = json.loads(manifest_bytes(asset.manifest)) | change
    with pytest.raises(FormatError, match=message) as caught:
        parse_manifest(json.dumps(document).encode(), "m.json")
    assert "\n" not in str(caught.value)


def keys_of_a_manifest() -> list[str]:
    return [key for key in json.loads(manifest_bytes(SMALLEST)) if key not in ("format", "agreement")]


@pytest.mark.parametrize("key", keys_of_a_manifest())
def test_missing_key(key: str, asset: Asset) -> None:
    document = json.loads(manifest_bytes(asset.manifest))
    del document[key]
    with pytest.raises(FormatError, match=key):
        parse_manifest(json.dumps(document).encode(), "m.json")


def test_agreement_may_be_absent(asset: Asset) -> None:
    document = json.loads(manifest_bytes(replace(asset.manifest, agreement=(3.5, 9))))
    assert parse_manifest(json.dumps(document).encode(), "m.json").agreement == (3.5, 9.0)
    for wrong in ([3.5], [3.5, 256], [-1, 3], "20", None):
        with pytest.raises(FormatError, match="agreement: expected"):
            parse_manifest(json.dumps(document | {"agreement": wrong}).encode(), "m.json")
    del document["agreement"]
    assert parse_manifest(json.dumps(document).encode(), "m.json").agreement == (20.0, 40.0)
    space = {"contracted": True, "aabb": [[-2.0] * 3, [2.0] * 3]}
    assert parse_manifest(json.dumps(document | space).encode(), "m.json").agreement == (14.0, 28.0)


def test_fetches_of_qualities_may_be_absent(asset: Asset) -> None:
    document = json.loads(manifest_bytes(replace(asset.manifest, quality_fetches=(3, 0))))
    parsed = parse_manifest(json.dumps(document).encode(), "m.json")
    assert parsed.quality_fetches == (3, 0)
    for wrong in ([3], [3, 1025], [-1, 3], [3, 1.5], None):
        with pytest.raises(FormatError, match="quality_fetches: expected"):
            parse_manifest(json.dumps(document | {"quality_fetches": wrong}).encode(), "m.json")
    del document["quality_fetches"]
    parsed = parse_manifest(json.dumps(document).encode(), "m.json")
    assert parsed.quality_fetches is None and b"quality_fetches" not in manifest_bytes(parsed)


def test_versions(asset: Asset) -> None:
    document = json.loads(manifest_bytes(asset.manifest))
    newer = document | {"version": [4, 7], "surprise": 1}
    assert parse_manifest(json.dumps(newer).encode(), "m.json") == replace(asset.manifest, version=(4, 7))
    newer["parts"] = [
        part | {"more": 1, "sections": [section | {"n_rows": -1} for section in part["sections"]]}
        for part in document["parts"]
    ]
    newer["files"] = {name: entry | {"more": 1} for name, entry in document["files"].items()}
    assert parse_manifest(json.dumps(newer).encode(), "m.json") == replace(asset.manifest, version=(4, 7))
    with pytest.raises(FormatError, match=r"parts: 0: expected an object with file and sections, got"):
        parse_manifest(json.dumps(document | {"parts": newer["parts"]}).encode(), "m.json")
    for version, fix in (([5, 0], "install a newer vfr-bake"), ([2, 1], "bake the asset again")):
        with pytest.raises(
            VersionError, match=rf"m\.json: version: expected 3\.x or 4\.x, got {version[0]}.*{fix}"
        ):
            parse_manifest(json.dumps(document | {"version": version}).encode(), "m.json")


def test_rays_begin_at_the_camera_in_a_box(asset: Asset) -> None:
    with pytest.raises(FormatError, match=r"near: expected 0 unless contracted, got 0\.2"):
        replace(asset.manifest, near=0.2)


def test_contracted_space_has_one_box(asset: Asset) -> None:
    space = ((-2, -2, -2), (2, 2, 2))
    assert replace(asset.manifest, contracted=True, aabb=space).contracted
    with pytest.raises(FormatError, match=r"aabb: expected .* where contracted"):
        replace(asset.manifest, contracted=True)


@pytest.mark.parametrize("text", ["NaN", "Infinity", "-Infinity", "1e999"])
def test_nan_and_infinity_are_refused_both_ways(text: str, asset: Asset) -> None:
    data = manifest_bytes(asset.manifest).replace(b"30.5", text.encode())
    with pytest.raises(FormatError, match="is not a number of JSON"):
        parse_manifest(data, "m.json")
    with pytest.raises(FormatError, match="expected finite JSON values"):
        manifest_bytes(replace(asset.manifest, provenance={"psnr": float(text)}))


def test_a_number_of_a_million_digits_is_refused_in_one_short_line(asset: Asset) -> None:
    data = manifest_bytes(asset.manifest).replace(b"30.5", b"9" * 1_000_000 + b".0")
    with pytest.raises(FormatError, match="is not a number of JSON") as caught:
        parse_manifest(data, "m.json")
    assert len(str(caught.value)) < 200


@pytest.mark.parametrize("data", [b"", b"[]", b"{", b"\xff\xfe", b"[" * 100_000, b" " * (MAX_BYTES + 1)])
def test_not_a_manifest(data: bytes) -> None:
    with pytest.raises(FormatError, match=r"m\.json: "):
        parse_manifest(data, "m.json")


def test_golden_manifest() -> None:
    manifest = replace(SMALLEST, feature_resolution=4, step=0.5, view_size=(4, 3), n_fetches=0)
    text = manifest_bytes(manifest).decode()
    assert "".join(text.split()) == (
        '{"aabb":[[-1.0,-1.0,-1.0],[1.0,1.0,1.0]],"agreement":[20.0,40.0],"background":[1.0,1.0,1.0],"colour_space":"srgb",'
        '"contracted":false,"density_range":[0.0,1.0],"density_steps":[1],"feature_resolution":4,"feature_steps":[1],"files":{},"format":"vfr-asset","generator":"t","level_steps":[1],"n_channels":1,"n_fetches":0,"near":0.0,"parts":[],'
        '"provenance":{},"resolution":6,"step":0.5,"version":[4,0],"view_size":[4,3],'
        '"world_from_model":[[1.0,0.0,0.0,0.0],[0.0,1.0,0.0,0.0],[0.0,0.0,1.0,0.0],[0.0,0.0,0.0,1.0]]}'
    )


def test_path_of_an_unknown_file(asset: Asset) -> None:
    with pytest.raises(FormatError, match=r"expected one of .*got \.\./x"):
        asset.path("../x")
