"""Tests of views from files: nerfstudio's paths, COLMAP in both forms, and the messages for broken ones."""

from __future__ import annotations

import json
import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp

from exporters.formats.colmap import colmap_files
from exporters.shapes.mesh import TriangleMesh
from player.cameras.camera import Camera
from player.cameras.keyframes import camera_on_path, smooth_path
from player.cameras.nerfstudio import write_camera_path
from player.cameras.transforms import read_cameras
from player.cameras.views import frame_rate, read_views
from player.errors import DataError, FormatError

POSE = np.array([[0.0, -0.6, 0.8, 3.0], [1, 0, 0, -2], [0, 0.8, 0.6, 1], [0, 0, 0, 1]])


def path_document(**frame: Any) -> dict[str, Any]:
    """Return a camera path as nerfstudio 1.1 writes it, without the fields that are never read."""
    return {
        "camera_type": "perspective", "render_height": 1080, "render_width": 1920, "fps": 24, "seconds": 4.0,
        "smoothness_value": 0.5, "is_cycle": False, "crop": None,
        "camera_path": [{"camera_to_world": POSE.reshape(-1).tolist(), "fov": 50, **frame}] * 2,
    }  # fmt: skip


def write(folder: Path, document: Any, name: str = "camera_path.json") -> Path:
    path = folder / name
    path.write_text(document if isinstance(document, str) else json.dumps(document))
    return path


def test_a_nerfstudio_path(tmp_path: Path) -> None:
    path = write(tmp_path, path_document())
    cameras = read_views(path)
    assert len(cameras) == 2 and (cameras[0].width, cameras[0].height) == (1920, 1080)
    focal = 540 / math.tan(math.radians(25))  # nerfstudio's three_js_perspective_camera_focal_length
    assert [cameras[0].fx, cameras[0].fy, cameras[0].cx, cameras[0].cy] == [focal, focal, 960, 540]
    np.testing.assert_array_equal(cameras[0].c2w, POSE)
    assert frame_rate(path) == 24
    assert frame_rate(write(tmp_path, path_document() | {"fps": None}, "b.json")) is None


def test_nerfstudios_placement_of_the_scene_is_undone(tmp_path: Path) -> None:
    """nerfstudio's placement is undone: pose' = transform @ pose, and then its place times scale."""
    turn = Rotation.from_rotvec([0.3, -0.5, 0.2]).as_matrix()
    transform = np.concatenate([turn, [[1.0], [2.0], [3.0]]], axis=1)
    placed = np.eye(4)
    placed[:3] = transform @ POSE
    placed[:3, 3] *= 0.25
    path = write(tmp_path, path_document(camera_to_world=placed.reshape(-1).tolist()))
    write(tmp_path, {"transform": transform.tolist(), "scale": 0.25}, "dataparser_transforms.json")
    np.testing.assert_allclose(read_views(path)[0].c2w, POSE, atol=1e-12)
    for broken in ({"scale": 1}, {"transform": transform.tolist(), "scale": 0}, [],
                   {"transform": transform.tolist(), "scale": 5e-324},
                   {"transform": transform.tolist(), "scale": 1e300},
                   {"transform": (2 * transform).tolist(), "scale": 1}):  # fmt: skip
        write(tmp_path, broken, "dataparser_transforms.json")
        with pytest.raises(FormatError, match=r"dataparser_transforms\.json: "):
            read_views(path)


def test_what_nerfstudio_had_done_to_the_cameras_before_is_not_undone(tmp_path: Path) -> None:
    """What `ns-process-data` did to COLMAP's frame before it wrote transforms.json is kept. nerfstudio's
    placement includes it: transform = orientation @ applied_transform, scale times applied_scale."""
    turn = Rotation.from_rotvec([0.3, -0.5, 0.2]).as_matrix()
    orientation = np.concatenate([turn, [[1.0], [2.0], [3.0]]], axis=1)
    applied = np.array([[0.0, 1, 0, 0.5], [1, 0, 0, 0], [0, 0, -1, 0]])
    placed = np.eye(4)
    placed[:3] = orientation @ POSE  # POSE is as transforms.json has it
    placed[:3, 3] *= 0.25
    path = write(tmp_path, path_document(camera_to_world=placed.reshape(-1).tolist()))
    whole = orientation @ np.concatenate([applied, [[0, 0, 0, 1]]])
    write(tmp_path, {"transform": whole.tolist(), "scale": 0.25 * 3}, "dataparser_transforms.json")
    data = {"frames": [], "applied_transform": applied.tolist(), "applied_scale": 3.0}
    write(tmp_path, data, "transforms.json")
    np.testing.assert_allclose(read_views(path)[0].c2w, POSE, atol=1e-12)
    for broken in ({"applied_transform": [1]}, {"applied_scale": 0}, {"applied_scale": 1e-300}, []):
        write(tmp_path, broken, "transforms.json")
        with pytest.raises(FormatError, match=r"transforms\.json: "):
            read_views(path)


def test_our_own_path_comes_back(tmp_path: Path) -> None:
    camera = Camera("a", POSE, 64, 48, 70.0, 70.0, 32.0, 24.0)
    path = tmp_path / "p.json"
    path.write_bytes(write_camera_path([camera] * 3, 30))
    for read in read_views(path):
        np.testing.assert_allclose(read.c2w, POSE)
        assert (read.width, read.height, read.cx, read.cy) == (64, 48, 32, 24)
        assert read.fx == pytest.approx(70) and read.fy == pytest.approx(70)
    assert frame_rate(path) == 30


BAD_PATHS: list[tuple[Any, str]] = [
    (path_document(fov=0), "frame 0: fov: expected degrees between 0 and 180, got 0"),
    (path_document(fov=180), "frame 0: fov: expected degrees between 0 and 180, got 180"),
    (path_document(fov=None), "frame 0: fov: expected degrees"),
    (path_document(camera_to_world=[0] * 16), "frame 0: camera matrix: expected a rotation"),
    (path_document(camera_to_world=[1, 2]), "frame 0: camera_to_world: expected 16 finite numbers"),
    (path_document(camera_to_world="x" * 16), "frame 0: camera_to_world: expected 16 finite numbers"),
    (path_document() | {"render_width": 0}, "render_width: expected 1 to 65536 whole pixels, got 0"),
    (path_document() | {"render_height": 1e9}, "render_height: expected 1 to 65536 whole pixels"),
    (path_document() | {"camera_type": "fisheye"}, "camera_type: expected perspective, got fisheye"),
    (path_document() | {"camera_path": []}, "camera_path: expected a list of at least one frame"),
    (path_document() | {"camera_path": [3] * 100_001}, "camera_path: expected at most 100000 frames, got"),
    (path_document() | {"camera_path": [3]}, "frame 0: expected an object, got 3"),
    ('{"camera_path": NaN}', "expected JSON, got NaN"),
]


@pytest.mark.parametrize("fps", [0, 0.0009, 1001, -30, "30"])
def test_a_frame_rate_that_no_video_has(fps: Any, tmp_path: Path) -> None:
    with pytest.raises(FormatError, match=f"fps: expected 0.001 to 1000 frames a second, got {fps}"):
        frame_rate(write(tmp_path, path_document() | {"fps": fps}))
    assert frame_rate(write(tmp_path, path_document() | {"fps": 0.001})) == 0.001


@pytest.mark.parametrize(("document", "message"), BAD_PATHS)
def test_broken_paths_name_file_and_frame(document: Any, message: str, tmp_path: Path) -> None:
    path = write(tmp_path, document)
    with pytest.raises(FormatError) as caught:
        read_views(path)
    assert str(caught.value).startswith(f"{path}: {message}") and "\n" not in str(caught.value)


def test_one_broken_frame_of_many_is_named(tmp_path: Path) -> None:
    document = path_document()
    document["camera_path"] = [dict(frame) for frame in document["camera_path"] * 5]
    document["camera_path"][7]["fov"] = -1
    with pytest.raises(FormatError, match="frame 7: fov: expected degrees between 0 and 180, got -1"):
        read_views(write(tmp_path, document))
    with pytest.raises(FormatError, match=r"fps: expected 0\.001 to 1000 frames a second, got 0"):
        frame_rate(write(tmp_path, path_document() | {"fps": 0}))


VALUES = st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=3) | st.just([1.0] * 16)


@settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    top=st.dictionaries(
        st.sampled_from([*path_document()]), VALUES | st.lists(VALUES, max_size=3), max_size=3
    ),
    frame=st.dictionaries(st.sampled_from(["camera_to_world", "fov"]), VALUES, max_size=2),
)
@example(top={}, frame={"fov": 5e-324})  # half of it is 0
def test_garbage_is_cameras_or_a_format_error(tmp_path: Path, top: Any, frame: Any) -> None:
    path = write(tmp_path, json.dumps(path_document(**frame) | top))
    try:
        assert read_views(path)
        frame_rate(path)
    except FormatError as error:
        assert str(error).startswith(str(path)) and "\n" not in str(error)


# --- COLMAP ---


@pytest.fixture
def model(shells_folder: Path, tmp_path: Path) -> Path:
    """Write the asset's cameras as a COLMAP model in text form, and return its folder."""
    cameras = read_cameras(shells_folder / "cameras.json")
    none = np.zeros((0, 3))
    empty = TriangleMesh(none, np.zeros((0, 3), np.int32), none, np.zeros((0, 4), np.uint8))
    folder = tmp_path / "scene" / "sparse" / "0"
    folder.mkdir(parents=True)
    for name, data in colmap_files(cameras, empty).items():
        (folder / name).write_bytes(data)
    pycolmap.Reconstruction(str(folder)).write_text(str(folder))
    for path in folder.glob("*.bin"):
        path.unlink()
    return folder


@pytest.mark.parametrize("form", ["text", "binary"])
@pytest.mark.parametrize("place", ["model", "scene", "file"])
def test_colmap_views(form: str, place: str, model: Path, shells_folder: Path) -> None:
    suffix = "txt"
    if form == "binary":
        pycolmap.Reconstruction(str(model)).write_binary(str(model))
        suffix = "bin"
        for path in model.glob("*.txt"):
            path.unlink()
    where = {"model": model, "scene": model.parent.parent, "file": model / f"images.{suffix}"}[place]
    views = read_views(where)
    for read, camera in zip(views, read_cameras(shells_folder / "cameras.json"), strict=True):
        assert read.name == camera.name.removeprefix("./") + ".png"
        np.testing.assert_allclose(read.c2w, camera.c2w, atol=1e-9)
        for key in ("width", "height", "fx", "fy", "cx", "cy"):
            assert getattr(read, key) == pytest.approx(getattr(camera, key))
    assert frame_rate(where) is None


@pytest.mark.parametrize("suffix", ["bin", "txt"])
def test_colmap_s_lens_distortion_is_named(suffix: str, model: Path) -> None:
    said: list[str] = []
    read_views(model, say=said.append)
    assert not said
    text = (model / "cameras.txt").read_text()
    (model / "cameras.txt").write_text(re.sub(r"PINHOLE (.*)", r"OPENCV \1 0 0 0 0.001", text))
    if suffix == "bin":
        pycolmap.Reconstruction(str(model)).write_binary(str(model))
    n_views = len(read_views(model, say=said.append))
    assert said == [f"{model}: lens distortion of {n_views} of {n_views} cameras is ignored"]


@pytest.mark.parametrize("key", ["k1", "k2", "k3", "k4", "p1", "p2"])
def test_lens_distortion_of_a_transforms_json_is_named(key: str, tmp_path: Path) -> None:
    """A coefficient at the top is that of every frame without its own; 0 is none."""
    frame = {"file_path": "a", "transform_matrix": np.eye(4).tolist()}
    document = {"w": 8, "h": 6, "fl_x": 9, "frames": [frame, {**frame, key: 0}, {**frame, key: -0.1}]}
    said: list[str] = []
    read_views(write(tmp_path, json.dumps(document)), say=said.append)
    assert said == [f"{tmp_path / 'camera_path.json'}: lens distortion of 1 of 3 cameras is ignored"]
    path = write(tmp_path, json.dumps({**document, key: 0.1}))
    read_views(path, say=said.append)
    assert said[1:] == [f"{path}: lens distortion of 2 of 3 cameras is ignored"]


def test_real_colmap(can: Path) -> None:
    views, reference = read_views(can), pycolmap.Reconstruction(str(can / "sparse" / "0"))
    assert len(views) == 71 and [view.name for view in views] == sorted(view.name for view in views)
    centres = {image.name: image.projection_center() for image in reference.images.values()}
    for view in views:
        np.testing.assert_allclose(view.c2w[:3, 3], centres[view.name], atol=1e-9)


@pytest.mark.parametrize(
    ("name", "old", "new", "message"),
    [
        ("images.txt", " 1 test/r_0", " 9 test/r_0", "camera 9 is not in cameras.txt"),
        ("images.txt", "1 test/r_0", "", "expected number, pose, camera and name"),
        ("images.txt", None, "# nothing\n", "images.txt: expected at least one picture, got none"),
        ("cameras.txt", "PINHOLE 48", "PINHOLE -48", "size: expected 1 to 2^20, got -48x40"),
        ("cameras.txt", "PINHOLE 48", "PINHOLE x", "expected finite numbers"),
        ("cameras.txt", " 40 ", " 40 1.0 ", "expected number, model, size and parameters"),
        ("cameras.txt", "PINHOLE", "FISHEYE", "model: expected SIMPLE_PINHOLE"),
        ("cameras.txt", None, b"\xff\xfe", "cannot read"),
    ],
)
def test_broken_colmap_text(name: str, old: Any, new: Any, message: str, model: Path) -> None:
    path = model / name
    if isinstance(new, bytes):
        path.write_bytes(new)
    else:
        path.write_text(new if old is None else path.read_text().replace(old, new, 1))
    with pytest.raises((FormatError, DataError)) as caught:
        read_views(model)
    assert message in str(caught.value) and "\n" not in str(caught.value)
    path.unlink()
    with pytest.raises(FormatError, match=r"no such file|got a folder without"):
        read_views(model)


def test_a_folder_without_a_model(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match=r"expected a transforms\.json, a camera_path\.json or the folder"):
        read_views(tmp_path)
    with pytest.raises(FormatError, match=r"nowhere: no such file: expected a transforms\.json"):
        read_views(tmp_path / "nowhere")
    with pytest.raises(FormatError, match="expected a file"):
        read_views("/dev/null")


# --- paths through views ---


def test_a_smooth_path_meets_its_views_and_turns_evenly() -> None:
    rng = np.random.default_rng(0)
    views = []
    for index, turn in enumerate(Rotation.random(4, rng=rng)):
        c2w = np.eye(4)
        c2w[:3, :3], c2w[:3, 3] = turn.as_matrix(), rng.normal(size=3)
        views.append(Camera(str(index), c2w, 8, 6, 9.0 + index, 9.0 + index, 4.0, 3.0))
    views[2] = views[2].resized(16, 12)  # the same view in a larger window
    path = smooth_path(views, 10)
    assert len(path) == 31
    for index, view in enumerate(views):
        np.testing.assert_allclose(path[10 * index].c2w, view.c2w, atol=1e-12)
        assert path[10 * index].fy / 6 == pytest.approx(view.fy / view.height)
    steps = Slerp([0, 10], Rotation.from_matrix([views[0].c2w[:3, :3], views[1].c2w[:3, :3]]))
    for step in range(11):
        np.testing.assert_allclose(path[step].c2w[:3, :3], steps(step).as_matrix(), atol=1e-12)
    # Catmull-Rom: the path's direction at a view is that from its predecessor to its successor
    before, after = camera_on_path(views, 0, 1 - 1e-4), camera_on_path(views, 1, 1e-4)
    ahead = after.c2w[:3, 3] - before.c2w[:3, 3]
    chord = views[2].c2w[:3, 3] - views[0].c2w[:3, 3]
    assert ahead @ chord / np.linalg.norm(ahead) / np.linalg.norm(chord) > 0.9999


def test_a_path_through_equal_views_stands_still() -> None:
    camera = Camera("a", POSE, 8, 6, 9.0, 9.0, 4.0, 3.0)
    turned = replace(camera, c2w=POSE @ np.diag([-1.0, 1, -1, 1]))  # half a turn: either way is the short one
    for step in smooth_path([camera, camera, turned], 4):
        assert np.isfinite(step.c2w).all()
        np.testing.assert_allclose(step.c2w[:3, 3], POSE[:3, 3])
