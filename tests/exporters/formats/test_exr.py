"""Tests of EXR pictures: OpenEXR and OpenImageIO read every channel, and what the numbers mean."""

from __future__ import annotations

import json
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import OpenEXR
import OpenImageIO
import pytest

from exporters import cli
from exporters.formats.exr import check_channels, exr_channels, exr_header, write_exr
from player.asset.asset import Asset
from player.cameras.camera import Camera
from player.cameras.transforms import read_cameras
from player.errors import MissingExtraError, OutputError, ParityError, ShapeError
from player.march.march import MIN_OPACITY
from player.render import Frame, Renderer
from tests.reference import srgb_from_linear

SRGB_TO_XYZ = [[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]
"""The matrix from linear sRGB to XYZ, as IEC 61966-2-1 has it, to four digits."""
LAYERS = [
    *("R", "G", "B", "A", "Z", "distance.V", "position.X", "position.Y", "position.Z"),
    *("normal.X", "normal.Y", "normal.Z", "opacity.V", "samples.V"),
    *(f"features.{k:02d}" for k in range(4)),
]


@pytest.fixture(scope="module")
def camera(opened: Asset) -> Camera:
    return read_cameras(opened.path("cameras.json"), (48, 40))[1]


@pytest.fixture(scope="module")
def frame(opened: Asset, camera: Camera) -> Frame:
    with Renderer(opened, 2) as renderer:
        return renderer.render(camera, background="transparent", layers=True)


@pytest.mark.parametrize("half", [False, True])
def test_two_readers_agree_on_every_channel(half: bool, frame: Frame, camera: Camera, tmp_path: Path) -> None:
    channels = exr_channels(frame, camera, half)
    assert sorted(channels) == sorted(LAYERS)
    path = tmp_path / "a.exr"
    write_exr(path, channels, exr_header(camera))
    with OpenEXR.File(str(path), separate_channels=True) as file:
        ours = {name: channel.pixels.copy() for name, channel in file.channels().items()}
        assert file.header()["compression"] == OpenEXR.ZIP_COMPRESSION
    image = OpenImageIO.ImageInput.open(str(path))
    spec = image.spec()
    pixels = image.read_image(format="float")
    assert spec.channelnames[:5] == ("R", "G", "B", "A", "Z") and sorted(spec.channelnames) == sorted(LAYERS)
    for index, name in enumerate(spec.channelnames):
        expected = channels[name]
        assert np.array_equal(ours[name], expected) and ours[name].dtype == expected.dtype, name
        assert np.array_equal(pixels[..., index], expected.astype(np.float32)), name
        is_place = name[0] in "Zdp" or name == "samples.V"
        assert expected.dtype == (np.float16 if half and not is_place else np.float32), name
    assert spec.getattribute("vfr.depth").startswith("mean by compositing weight")
    assert spec.getattribute("vfr.colourSpace").startswith("linear light")
    image.close()


def test_what_the_channels_mean(frame: Frame, camera: Camera, opened: Asset) -> None:
    channels = exr_channels(frame, camera)
    met = frame.opacity > MIN_OPACITY
    assert 100 < met.sum() < met.size - 100
    a = channels["A"]
    assert np.array_equal(a, frame.opacity) and np.array_equal(a, channels["opacity.V"])
    for index, name in enumerate("RGB"):  # premultiplied and linear: undo both
        np.testing.assert_allclose(
            srgb_from_linear(channels[name][met] / a[met]), frame.rgb[met][:, index], rtol=0, atol=1e-5
        )
        assert not channels[name][~met].any()
    position = np.stack([channels[f"position.{axis}"] for axis in "XYZ"], axis=-1)
    apart = position - camera.c2w[:3, 3]
    np.testing.assert_allclose(np.linalg.norm(apart, axis=-1)[met], channels["distance.V"][met], rtol=1e-5)
    np.testing.assert_allclose((apart @ -camera.c2w[:3, 2])[met], channels["Z"][met], rtol=1e-5)
    assert np.isposinf(channels["Z"][~met]).all() and np.isposinf(channels["distance.V"][~met]).all()
    assert not position[~met].any()
    # the player's distances, in world units: the asset's ball has its middle at (1, 2, 3) and a radius of 2
    assert np.array_equal(channels["distance.V"][met], frame.depth[met])
    assert np.linalg.norm(position[met] - [1, 2, 3], axis=-1).max() < 2 * 1.1
    assert np.array_equal(channels["samples.V"], frame.n_density_samples)


def test_header_projects_positions_onto_their_pixels(frame: Frame, camera: Camera, tmp_path: Path) -> None:
    """The header's matrices project positions onto their pixels, by OpenEXR's convention: row vectors, and
    (0, 0) is the upper left corner, (1, 1) the lower right one. Its camera space is left-handed: x right, y
    up, z ahead."""
    channels = exr_channels(frame, camera)
    path = tmp_path / "a.exr"
    write_exr(path, channels, exr_header(camera))
    with OpenEXR.File(str(path)) as file:
        header = dict(file.header())
    met = frame.opacity > MIN_OPACITY
    rows, columns = np.nonzero(met)
    position = np.stack([channels[f"position.{axis}"][met] for axis in "XYZ"], axis=-1)
    ndc = np.c_[position, np.ones(len(position))] @ header["worldToNDC"]
    np.testing.assert_allclose(ndc[:, 0] / ndc[:, 3] * 48, columns + 0.5, rtol=0, atol=1e-3)
    np.testing.assert_allclose(ndc[:, 1] / ndc[:, 3] * 40, rows + 0.5, rtol=0, atol=1e-3)
    local = np.c_[position, np.ones(len(position))] @ header["worldToCamera"]
    np.testing.assert_allclose(local[:, 2], channels["Z"][met], rtol=1e-5)
    x, y = (local[:, k] / local[:, 2] for k in range(2))
    np.testing.assert_allclose(camera.cx + camera.fx * x, columns + 0.5, rtol=0, atol=1e-3)
    np.testing.assert_allclose(camera.cy - camera.fy * y, rows + 0.5, rtol=0, atol=1e-3)
    assert np.array_equal(header["vfr.cameraToWorld"], camera.c2w)
    assert header["vfr.intrinsics"][0].tolist() == [camera.fx, 0, camera.cx]


def test_the_screen_window_is_the_picture(frame: Frame, camera: Camera, tmp_path: Path) -> None:
    """The screen window lies on the plane z = 1 of a camera that looks along +z with x to the left and y up:
    its corners are the directions through the corners of the picture."""
    camera = replace(camera, cx=camera.cx + 3, cy=camera.cy + 5)
    path = tmp_path / "a.exr"
    write_exr(path, exr_channels(frame, camera), exr_header(camera))
    with OpenEXR.File(str(path)) as file:
        header = dict(file.header())
    width, (x, y) = header["screenWindowWidth"], header["screenWindowCenter"]
    height = width * 40 / 48  # the pixels are square
    left, right = x + width / 2, x - width / 2
    upper, lower = y + height / 2, y - height / 2
    edges = [camera.cx / camera.fx, (camera.cx - 48) / camera.fx]
    np.testing.assert_allclose([left, right], edges, rtol=0, atol=1e-6)
    edges = [camera.cy / camera.fy, (camera.cy - 40) / camera.fy]
    np.testing.assert_allclose([upper, lower], edges, rtol=0, atol=1e-6)


def test_folder_of_pictures(shells_asset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    target = tmp_path / "frames"
    arguments = [
        str(shells_asset),
        f"{target}/",
        "--format",
        "exr",
        "--views",
        "1:3",
        "--half",
        "--size",
        "24x20",
    ]
    assert cli.main(arguments) == 0
    assert capsys.readouterr().out.startswith(f"{target}: 2 pictures, 18 channels, ")
    files = {path.name: path.read_bytes() for path in target.iterdir()}
    assert sorted(files) == ["r_1.exr", "r_2.exr"]
    with OpenEXR.File(str(target / "r_1.exr"), separate_channels=True) as file:
        red = file.channels()["R"].pixels
    assert red.shape == (20, 24) and red.dtype == np.float16
    assert cli.main([*arguments, "--force"]) == 0
    assert {path.name: path.read_bytes() for path in target.iterdir()} == files  # the same bytes again
    assert sorted(path.name for path in tmp_path.iterdir()) == ["frames"]


def test_cameras_of_a_file(shells_asset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    given = tmp_path / "transforms.json"
    given.write_text(json.dumps({**json.loads((shells_asset / "cameras.json").read_text()), "k1": 0.1}))
    target = tmp_path / "frames"
    target.mkdir()  # empty: nothing is lost
    arguments = [str(shells_asset), str(target), "--format", "exr", "--views", "4", "--size", "9x7"]
    assert cli.main([*arguments, "--cameras", str(given)]) == 0
    assert f"{given}: lens distortion of 5 of 5 cameras is ignored" in capsys.readouterr().out
    assert [path.name for path in target.iterdir()] == ["r_4.exr"]
    wide = tmp_path / "wide"
    assert cli.main([str(shells_asset), str(wide), "--format", "exr", "--views", "4", "--size", "48x20"]) == 0
    camera = read_cameras(given)[4]
    with OpenEXR.File(str(wide / "r_4.exr"), separate_channels=True) as file:
        lens = file.header()["vfr.intrinsics"]
    assert lens[0].tolist() == [camera.fx / 2, 0, camera.cx / 2 + 12], "nothing is stretched"


def test_no_places_where_float32_cannot_hold_them(shells_asset: Path, tmp_path: Path) -> None:
    """In the coordinates of a map, pictures have the same layers but `position`, and no float32 matrix."""
    asset = shutil.copytree(shells_asset, tmp_path / "far")
    manifest = json.loads((asset / "manifest.json").read_text())
    cameras = json.loads((asset / "cameras.json").read_text())
    for matrix in [manifest["world_from_model"], *(each["transform_matrix"] for each in cameras["frames"])]:
        matrix[0][3] += 4.5e6
    (asset / "manifest.json").write_text(json.dumps(manifest))
    (tmp_path / "far.json").write_text(json.dumps(cameras))
    more = ["--format", "exr", "--views", "1", "--size", "24x20", "--cameras"]
    assert cli.main([str(asset), str(tmp_path / "a"), *more, str(tmp_path / "far.json")]) == 0
    with OpenEXR.File(str(tmp_path / "a" / "r_1.exr"), separate_channels=True) as file:
        assert sorted(file.channels()) == sorted(name for name in LAYERS if not name.startswith("position"))
        header = dict(file.header())
    assert not {"worldToCamera", "worldToNDC"} & set(header)
    assert header["vfr.cameraToWorld"][0, 3] == cameras["frames"][1]["transform_matrix"][0][3]


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["--views", "7:9"], "--views: expected at least one view, got none"),
        (["--cameras", "none.json"], "none.json: no such file"),
        (["--size", "9000x9000"], "size: expected at most"),
        (
            ["--size", "1000x800", "--max-memory", "0.2"],
            "frames: a picture: memory: expected at most 0.2 GB, got 0.21 GB or more",
        ),
        (["--frame", "gltf"], "--frame does nothing for exr"),
    ],
)
def test_bad_pictures(
    more: list[str], message: str, shells_asset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main([str(shells_asset), str(tmp_path / "frames"), "--format", "exr", *more]) == 1
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_parity_names_the_worst_pixel(frame: Frame, camera: Camera) -> None:
    channels = exr_channels(frame, camera)
    check_channels(Path("a.exr"), channels, channels)
    wrong = {**channels, "G": channels["G"].copy()}
    wrong["G"][3, 4] += 0.5
    wrong["G"][5, 6] += 0.1
    with pytest.raises(
        ParityError, match=r"a\.exr: G: expected .* at row 3, column 4, the worst of 2 pixels"
    ):
        check_channels(Path("a.exr"), channels, wrong)
    with pytest.raises(ParityError, match="channels: expected"):
        check_channels(Path("a.exr"), channels, {"R": channels["R"]})
    with pytest.raises(ParityError, match="Z: expected float32"):
        check_channels(Path("a.exr"), channels, {**channels, "Z": channels["Z"].astype(np.float16)})
    wrong = {**channels, "Z": np.where(np.isinf(channels["Z"]), np.float32(np.nan), channels["Z"])}
    with pytest.raises(ParityError, match="Z: expected inf, got nan"):
        check_channels(Path("a.exr"), channels, wrong)


def test_what_a_full_disk_and_no_openexr_say(
    frame: Frame, camera: Camera, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    channels, header = exr_channels(frame, camera), exr_header(camera)
    with pytest.raises(OutputError, match="cannot write"):
        write_exr(tmp_path / "no" / "a.exr", channels, header)
    with pytest.raises(ShapeError, match="over no background and with layers"):
        exr_channels(
            Frame(frame.rgb, frame.opacity, frame.depth, frame.n_density_samples, "transparent"), camera
        )
    monkeypatch.setitem(sys.modules, "OpenEXR", None)
    with pytest.raises(MissingExtraError, match=r"needs OpenEXR: pip install 'vfr-bake\[export\]'"):
        write_exr(tmp_path / "a.exr", channels, header)


def test_the_primaries_are_those_of_srgb(camera: Camera) -> None:
    """The header's chromaticities give the standard's matrix from linear sRGB to XYZ."""
    xy = np.array(exr_header(camera)["chromaticities"]).reshape(4, 2)
    xyz = np.stack([xy[:, 0], xy[:, 1], 1 - xy.sum(axis=1)], axis=0) / xy[:, 1]
    scales = np.linalg.solve(xyz[:, :3], xyz[:, 3])
    np.testing.assert_allclose(xyz[:, :3] * scales, SRGB_TO_XYZ, rtol=0, atol=6e-5)
