"""Tests of cameras: conventions against OpenCV, files against their formulas, and every error message."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from player.cameras.camera import Camera, focus_point, orbit
from player.cameras.rotations import OPENGL_FROM_OPENCV
from player.cameras.transforms import frame_names, read_cameras, write_cameras
from player.errors import FormatError
from player.files import json_files

POSE = np.array([[0.0, -0.6, 0.8, 3.0], [1, 0, 0, -2], [0, 0.8, 0.6, 1], [0, 0, 0, 1]])


def looking_at(eye: Any, target: Any, up: Any = (0, 0, 1), name: str = "a") -> Camera:
    back = np.subtract(eye, target) / np.linalg.norm(np.subtract(eye, target))
    right = np.cross(up, back) / np.linalg.norm(np.cross(up, back))
    c2w = np.eye(4)
    c2w[:3, :4] = np.stack([right, np.cross(back, right), back, np.asarray(eye, float)], axis=-1)
    return Camera(name, c2w, 8, 6, 9.0, 9.0, 4.0, 3.0)


def write(folder: Path, document: Any) -> Path:
    path = folder / "transforms.json"
    path.write_text(document if isinstance(document, str) else json.dumps(document))
    return path


def blender(**frame: Any) -> dict[str, Any]:
    return {
        "camera_angle_x": 0.8,
        "frames": [{"file_path": "./train/r_0", "transform_matrix": POSE.tolist(), **frame}],
    }


def test_rays_project_back_to_their_pixels_in_opencv():
    camera = Camera("a", POSE, width=7, height=5, fx=6.0, fy=8.0, cx=3.1, cy=2.7)
    rays_o, rays_d = camera.rays()
    points = rays_o + np.linspace(0.5, 4, 35)[:, None] * rays_d
    w2c = np.linalg.inv(POSE @ OPENGL_FROM_OPENCV)
    matrix = np.array(
        [[6.0, 0, 3.1 - 0.5], [0, 8, 2.7 - 0.5], [0, 0, 1]]
    )  # OpenCV: pixel centres at integers
    pixels, _ = cv2.projectPoints(
        points.astype(np.float64), cv2.Rodrigues(w2c[:3, :3])[0], w2c[:3, 3], matrix, None
    )
    columns, rows = np.meshgrid(np.arange(7), np.arange(5))
    expected = np.stack([columns.ravel(), rows.ravel()], axis=-1)
    np.testing.assert_allclose(pixels[:, 0], expected, atol=1e-4)  # float32 rays, 10 pixels


def test_the_turn_between_opengl_and_opencv_goes_both_ways():
    """Between OpenGL and OpenCV, right stays right, up becomes down and behind becomes ahead, both ways."""
    np.testing.assert_array_equal(OPENGL_FROM_OPENCV @ [1, 2, 3, 1], [1, -2, -3, 1])
    np.testing.assert_array_equal(POSE @ OPENGL_FROM_OPENCV @ OPENGL_FROM_OPENCV, POSE)


def test_a_camera_keeps_copies_and_plain_numbers():
    """A loop may move one matrix on and make a camera of it at each place; sizes and lenses may be numbers of
    numpy, and a matrix may be a list."""
    c2w, lens = np.eye(4, dtype=np.float32), np.float32([[9, 0, 4], [0, 8, 3], [0, 0, 1]])
    cameras = []
    for x in range(3):
        c2w[0, 3] = x
        size = np.int64(8), np.int32(6)
        cameras.append(Camera("a", c2w, *size, lens[0, 0], lens[1, 1], lens[0, 2], lens[1, 2]))
    assert [camera.c2w[0, 3] for camera in cameras] == [0, 1, 2]
    numbers = {key: value for key, value in vars(cameras[0]).items() if key != "c2w"}
    assert json.loads(json.dumps(numbers)) == {
        "name": "a", "width": 8, "height": 6, "fx": 9.0, "fy": 8.0, "cx": 4.0, "cy": 3.0
    }  # fmt: skip
    with pytest.raises(ValueError, match="read-only"):
        cameras[0].c2w[0, 3] = 5
    assert Camera("a", np.eye(4).tolist(), 8, 6, 9, 9, 4, 3).c2w.dtype == np.float64


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"c2w": [[1, 2], [3]]}, "a: c2w: expected 4 rows of 4 numbers, got"),
        ({"c2w": None}, "a: camera matrix: expected 4 rows of 4 numbers, got shape"),
        ({"width": 7.5}, "a: width: expected a whole number, got 7.5"),
        ({"height": float("nan")}, "a: height: expected a whole number, got nan"),
        ({"fx": "wide"}, "a: fx: expected a number, got wide"),
        ({"cx": None}, "a: cx: expected a number, got None"),
    ],
)
def test_what_is_no_camera_is_told(change: dict[str, Any], message: str):
    camera = Camera("a", POSE, 8, 6, 9.0, 9.0, 4.0, 3.0)
    with pytest.raises(FormatError, match=re.escape(message)):
        replace(camera, **change)


def test_blender_axes():
    _, rays_d = Camera("a", np.eye(4), 3, 3, 2.0, 2.0, 1.5, 1.5).rays()
    np.testing.assert_allclose(rays_d[4], [0, 0, -1], atol=1e-7)
    top_left = rays_d[0]
    assert top_left[0] < 0 < top_left[1] and top_left[2] < 0


def test_the_rays_through_some_pixels_are_those_of_all():
    camera = Camera("a", POSE, 7, 5, 6.0, 8.0, 3.1, 2.7)
    np.testing.assert_array_equal(camera.rays_through(np.arange(9, 20))[1], camera.rays()[1][9:20])


def test_cameras_are_equal_by_value():
    camera = Camera("a", POSE, 8, 6, 9.0, 7.0, 4.5, 2.5)
    assert camera == replace(camera) and len({camera, replace(camera, c2w=POSE.tolist())}) == 1
    moved = POSE.copy()
    moved[0, 3] += 1
    for other in (replace(camera, c2w=moved), replace(camera, fx=8.0), replace(camera, name="b"), "a"):
        assert camera != other


def test_resized_keeps_the_view():
    camera = Camera("a", POSE, 8, 6, 9.0, 7.0, 4.5, 2.5)
    small = camera.resized(4, 2)
    # A corner of a pixel of the larger grid, x = 6 or y = 3, is the corner x = 3 or y = 1 of the smaller one.
    np.testing.assert_allclose((6 - camera.cx) / camera.fx, (3 - small.cx) / small.fx)
    np.testing.assert_allclose((3 - camera.cy) / camera.fy, (1 - small.cy) / small.fy)
    assert (small.width, small.height) == (4, 2)


def test_fitted_keeps_the_shape_of_pixels_and_all_that_is_seen():
    camera = Camera("a", POSE, 8, 6, 9.0, 7.0, 4.5, 2.5)
    wide = camera.fitted(40, 12)
    assert (wide.width, wide.height, wide.fx, wide.fy) == (40, 12, 18.0, 14.0)
    # The corners of the camera's pixels, x = 0 and 8, are x = 12 and 28 of the wide one.
    np.testing.assert_allclose(
        (np.array([0, 8]) - camera.cx) / camera.fx, (np.array([12, 28]) - wide.cx) / wide.fx
    )
    np.testing.assert_allclose(
        (np.array([0, 6]) - camera.cy) / camera.fy, (np.array([0, 12]) - wide.cy) / wide.fy
    )
    assert camera.fitted(8, 18).fx == camera.fx
    for size in ((4, 3), (5, 4), (800, 600), (1000, 750), (1001, 751), (8, 6), (37, 28)):
        same = [
            (c.width, c.height, c.fx, c.fy, c.cx, c.cy) for c in (camera.fitted(*size), camera.resized(*size))
        ]
        assert same[0] == same[1], size


def test_transformed_moves_rays_with_the_world():
    camera = Camera("a", POSE, 3, 2, 4.0, 4.0, 1.5, 1.0)
    turn = cv2.Rodrigues(np.array([0.3, -0.5, 0.2]))[0]
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = 2.5 * turn, [1, 2, 3]
    rays_o, rays_d = camera.rays()
    moved_o, moved_d = camera.transformed(matrix).rays()
    np.testing.assert_allclose(moved_o, rays_o @ matrix[:3, :3].T + matrix[:3, 3], rtol=1e-5)
    np.testing.assert_allclose(moved_d, rays_d @ turn.T, atol=1e-6)


def test_blender_form(tmp_path: Path):
    (camera,) = read_cameras(write(tmp_path, blender()), (40, 30))
    focal = 20 / np.tan(0.4)
    assert (camera.name, camera.width, camera.height) == ("./train/r_0", 40, 30)
    np.testing.assert_allclose([camera.fx, camera.fy, camera.cx, camera.cy], [focal, focal, 20, 15])
    np.testing.assert_array_equal(camera.c2w, POSE)


def test_ngp_form_and_frame_level_wins(tmp_path: Path):
    document = blender(fl_y=60, cx=21.5, h=32)
    document.update(fl_x=50.0, fl_y=51.0, cx=20, cy=15, w=40.0, h=30.0, k1=0.1, aabb_scale=4)
    (camera,) = read_cameras(write(tmp_path, document), (7, 7))
    assert (camera.width, camera.height, camera.fx, camera.fy) == (40, 32, 50, 60)
    assert (camera.cx, camera.cy) == (21.5, 15)


def test_a_frames_angle_wins_over_the_tops_length(tmp_path: Path):
    document = blender(camera_angle_x=1.0)
    document.update(fl_x=50.0, fl_y=51.0)
    (camera,) = read_cameras(write(tmp_path, document), (40, 30))
    np.testing.assert_allclose([camera.fx, camera.fy], [20 / np.tan(0.5), 51])


@pytest.mark.parametrize(
    ("keys", "focal"),
    [
        ({"fl_x": 50}, (50, 50)),
        ({"fl_y": 50}, (50, 50)),
        ({"camera_angle_x": 1.0, "camera_angle_y": 0.5}, (20 / np.tan(0.5), 15 / np.tan(0.25))),
        ({"camera_angle_y": 0.5}, (15 / np.tan(0.25), 15 / np.tan(0.25))),
    ],
)
def test_forms_of_the_focal_length(tmp_path: Path, keys: dict[str, float], focal: tuple[float, float]):
    document = {**keys, "frames": blender()["frames"]}
    (camera,) = read_cameras(write(tmp_path, document), (40, 30))
    np.testing.assert_allclose([camera.fx, camera.fy], focal)


def test_three_rows_are_completed(tmp_path: Path):
    (camera,) = read_cameras(write(tmp_path, blender(transform_matrix=POSE[:3].tolist())), (4, 3))
    np.testing.assert_array_equal(camera.c2w, POSE)


def test_lego(lego_400: Path):
    cameras = read_cameras(lego_400 / "transforms_test.json", (400, 400))
    assert len(cameras) == 200 and cameras[0].name == "./test/r_0"
    assert cameras[0].fx == pytest.approx(555.5555, rel=1e-6)  # 200 / tan(0.3456), as published for lego
    assert frame_names(cameras)[-1] == "r_199"


def test_round_trip(tmp_path: Path):
    cameras = [
        Camera("images/0001.jpg", POSE, 40, 30, 50.1, 60.2, 20.3, 15.4),
        Camera("ä b", np.eye(4), 1, 2, 1 / 3, 1e-3, -5.0, 1e6),
    ]
    path = tmp_path / "t.json"
    path.write_bytes(write_cameras(cameras))
    for before, after in zip(cameras, read_cameras(path, (9, 9)), strict=True):
        np.testing.assert_array_equal(before.c2w, after.c2w)
        for key in ("name", "width", "height", "fx", "fy", "cx", "cy"):
            assert getattr(before, key) == getattr(after, key)


SKEWED = [[2, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
MIRRORED = [[-1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
BAD: list[tuple[str, Any, tuple[str, ...]]] = [
    ("not JSON", "{", ("expected JSON",)),
    ("binary", "\x00\x01", ("expected JSON",)),
    ("deep", "[" * 200_000, ("expected JSON",)),
    ("nan", '{"frames": [{"file_path": "a", "k": NaN}]}', ("NaN",)),
    ("infinity", '{"a": -Infinity}', ("-Infinity",)),
    ("list", [], ("expected a JSON object", "got []")),
    ("no frames", {"camera_angle_x": 1.0}, ("frames", "at least one", "got None")),
    ("empty frames", {"frames": []}, ("frames", "at least one", "got []")),
    ("frames not a list", {"frames": {"a": 1}}, ("frames", "expected a list")),
    ("frame not an object", {"frames": [3]}, ("frame 0", "expected an object", "got 3")),
    ("no path", {"frames": [{}]}, ("frame 0", "file_path", "got None")),
    ("path with a line's end", blender(file_path="a\nb"), ("frame 0", "file_path", "a b")),
    ("path with half a pair", blender(file_path="\ud800"), ("frame 0", "file_path", "ud800")),
    ("path too long", blender(file_path="a/" * 2049), ("file_path: expected at most 4096", "got 4098")),
    ("too many frames", {"frames": [{}] * 100_001}, ("frames: expected at most 100000, got 100001",)),
    ("no matrix", blender(transform_matrix=None), ("frame 0 (./train/r_0)", "4 rows of 4", "got None")),
    ("5 rows", blender(transform_matrix=[[0] * 4] * 5), ("4 rows of 4", "got 5 rows")),
    ("short row", blender(transform_matrix=[[1, 2, 3]] * 4), ("4 rows of 4", "row 0: [1, 2, 3]")),
    ("words in it", blender(transform_matrix=[[1, 2, 3, "x"]] * 4), ("row 0: [1, 2, 3, 'x']",)),
    ("truth in it", blender(transform_matrix=[[True, 0, 0, 0]] * 4), ("row 0: [True",)),
    ("huge whole number", blender(transform_matrix=[[10**400, 0, 0, 0]] * 4), ("row 0: [1000",)),
    ("infinite number", json.dumps(blender()).replace("3.0", "1e999"), ("row 0: [", "inf")),
    ("scaled", blender(transform_matrix=SKEWED), ("expected a rotation and a translation",)),
    ("mirrored", blender(transform_matrix=MIRRORED), ("expected a rotation and a translation",)),
    ("zero", blender(transform_matrix=[[0] * 4] * 4), ("expected a rotation and a translation",)),
    ("far away", blender(transform_matrix=[[1, 0, 0, 1e300], *SKEWED[1:]]), ("expected a rotation",)),
    ("focal 0", blender(fl_x=0), ("fx: expected a positive focal length, got 0",)),
    ("focal negative", blender(fl_x=5, fl_y=-1), ("fy: expected a positive focal length, got -1",)),
    ("focal a word", blender(fl_x="50"), ("fl_x: expected a finite number, got '50'",)),
    ("no focal", {"frames": blender()["frames"]}, ("focal length: expected fl_x or camera_angle_x",)),
    ("angle 0", blender(camera_angle_x=0), ("camera_angle_x: expected radians between 0 and pi, got 0",)),
    ("angle in degrees", blender(camera_angle_x=50), ("between 0 and pi, got 50",)),
    ("width 0", blender(w=0, h=3), ("w: expected 1 to 65536 whole pixels, got 0",)),
    ("width broken", blender(w=3.5, h=3), ("w: expected 1 to 65536 whole pixels, got 3.5",)),
    ("height huge", blender(w=3, h=1e9), ("h: expected 1 to 65536 whole pixels",)),
    ("cx a list", blender(cx=[1]), ("cx: expected a finite number, got [1]",)),
    ("fisheye", {**blender(), "camera_model": "OPENCV_FISHEYE"}, ("camera_model", "got OPENCV_FISHEYE")),
    ("fisheye flag", {**blender(), "is_fisheye": True}, ("is_fisheye",)),
]


@pytest.mark.parametrize(("document", "fragments"), [b[1:] for b in BAD], ids=[b[0] for b in BAD])
def test_every_message_is_one_line_that_names_file_and_fault(
    tmp_path: Path, document: Any, fragments: tuple[str, ...]
):
    path = write(tmp_path, document)
    with pytest.raises(FormatError) as caught:
        read_cameras(path, (40, 30))
    message = str(caught.value)
    assert message.startswith(str(path)) and len(message.splitlines()) == 1 and len(message) < 600
    for fragment in fragments:
        assert fragment in message


def test_the_good_document_of_the_bad_ones_is_good(tmp_path: Path):
    assert len(read_cameras(write(tmp_path, blender()), (40, 30))) == 1


def test_no_size_anywhere(tmp_path: Path):
    with pytest.raises(FormatError, match=r"frame 0 .*w, h: .*pass a size"):
        read_cameras(write(tmp_path, blender()))


def test_missing_file_and_folder_in_its_place(tmp_path: Path):
    with pytest.raises(FormatError, match=r"nowhere\.json: no such file: expected a transforms\.json"):
        read_cameras(tmp_path / "nowhere.json")
    with pytest.raises(FormatError, match=r"cannot read|no such file"):
        read_cameras(tmp_path)


def test_a_file_too_large_is_not_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    path = write(tmp_path, blender())
    monkeypatch.setattr(json_files, "MAX_FILE_BYTES", 10)
    with pytest.raises(FormatError, match="size: expected at most 10 bytes for a transforms"):
        read_cameras(path)


def test_utf8_with_a_byte_order_mark(tmp_path: Path):
    path = tmp_path / "t.json"
    path.write_bytes(b"\xef\xbb\xbf" + json.dumps(blender()).encode())
    assert len(read_cameras(path, (4, 3))) == 1


JSON = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats()
    | st.text(max_size=5)
    | st.sampled_from([10**400, -1, 0, 1e308, POSE.tolist(), POSE.tolist()[:3], SKEWED]),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=3), inner, max_size=3),
    max_leaves=6,
)
KEYS = ["transform_matrix", "fl_x", "fl_y", "camera_angle_x", "camera_angle_y", "w", "h", "cx", "cy"]
KEYS += ["file_path", "camera_model", "is_fisheye"]
FRAME = st.fixed_dictionaries({}, optional={key: JSON for key in KEYS}).map(
    lambda extra: {"file_path": "a", "transform_matrix": POSE.tolist(), **extra}
)
DOCUMENT = st.builds(
    lambda top, frames: {"camera_angle_x": 0.7, **top, "frames": frames},
    st.fixed_dictionaries({}, optional={key: JSON for key in KEYS}),
    st.lists(FRAME | JSON, max_size=3) | JSON,
)


@settings(max_examples=300, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(document=DOCUMENT | JSON)
def test_garbage_is_a_camera_or_a_format_error(tmp_path: Path, document: Any):
    path = write(tmp_path, document)
    try:
        cameras = read_cameras(path, (40, 30))
    except FormatError as error:
        assert str(error).startswith(str(path)) and len(str(error).splitlines()) == 1
    else:
        names = frame_names(cameras)
        assert len({name.casefold() for name in names}) == len(cameras) > 0
        assert json.loads(write_cameras(cameras))["frames"]


@given(data=st.binary(max_size=60))
@settings(max_examples=100, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_bytes_are_a_format_error(tmp_path: Path, data: bytes):
    path = tmp_path / "t.json"
    path.write_bytes(data)
    with pytest.raises(FormatError):
        read_cameras(path)


def named(*names: str) -> list[str]:
    return frame_names([Camera(name, np.eye(4), 1, 1, 1.0, 1.0, 0.5, 0.5) for name in names])


def test_frame_names():
    assert named("./test/r_0", "images/0001.jpg", "c:\\x\\y.PNG") == ["r_0", "0001", "y"]
    assert named("r_0.5") == ["r_0.5"]
    assert named("left/a.png", "right/a.png") == ["left_a", "right_a"]
    assert named("x/l/a", "x/r/a", "b") == ["l_a", "r_a", "b"]
    assert named("1/l/a", "2/l/a") == ["1_l_a", "2_l_a"]
    assert named("a", "a.png", "a.jpg") == ["a", "a_1", "a_2"]
    assert named("a", "a", "a_1") == ["a", "a_2", "a_1"]
    assert named("A", "a") == ["A", "a_1"]
    assert named("..", "../../etc/passwd", "") == ["frame", "passwd", "frame_1"]


def test_frame_names_of_deep_folders_and_of_many_equal_paths():
    """At most sixteen names of a path are used, and a number is not tried again for the next equal path."""
    deep = "a_" * 15 + "x"
    assert named("1/" + "a/" * 20 + "x", "2/" + "a/" * 20 + "x") == [deep, f"{deep}_1"]
    assert named(*["a"] * 30_000)[-1] == "a_29999"


@given(st.lists(st.text(alphabet="aA.1_/\\: ", max_size=7), min_size=1, max_size=12))
def test_frame_names_are_unique_and_safe(names: list[str]):
    stems = named(*names)
    assert len({stem.casefold() for stem in stems}) == len(names) == len(stems)
    for stem in stems:
        assert stem and ".." not in stem and not set(stem) & set('/\\:<>"|?*') and Path(stem).name == stem


def test_focus_of_cameras_that_look_at_a_point():
    target = np.array([5.0, -3.0, 2.0])
    angles = np.linspace(0, 5, 9)
    cameras = [looking_at(target + np.array([3 * np.cos(a), 3 * np.sin(a), a / 3]), target) for a in angles]
    # The point ahead has a weight of 1e-7, against eigenvalues of a third, in units of a spread of 3.
    np.testing.assert_allclose(focus_point(cameras), target, atol=1e-5)


def test_focus_of_parallel_axes_is_ahead():
    cameras = [looking_at([x, 0, 0], [x, 1, 0]) for x in (-1.0, 0.0, 1.0)]
    spread = np.sqrt(2 / 3)
    np.testing.assert_allclose(focus_point(cameras), [0, spread, 0], atol=1e-6)
    np.testing.assert_allclose(focus_point(cameras[:1]), [-1, 1, 0], atol=1e-6)


def test_focus_is_never_behind():
    cameras = [looking_at([x, 0, 0], [2 * x, 4, 0]) for x in (-1.0, 0.5, 1.0)]  # axes meet at y = -4
    assert focus_point(cameras)[1] > 0


def test_orbit_around_lego(lego_400: Path):
    cameras = read_cameras(lego_400 / "transforms_train.json", (400, 400))
    views = orbit(cameras, 8, size=(80, 40))
    eyes = np.stack([view.c2w[:3, 3] for view in views])
    # Lego's cameras are on a sphere of radius 4.03113 around the origin, z up.
    np.testing.assert_allclose(np.linalg.norm(eyes, axis=-1), 4.0311, atol=1e-3)
    elevations = [np.arcsin(c.c2w[2, 3] / 4.0311) for c in cameras]
    np.testing.assert_allclose(eyes[:, 2], 4.0311 * np.sin(np.median(elevations)), atol=0.05)
    for view, eye in zip(views, eyes, strict=True):
        np.testing.assert_allclose(-view.c2w[:3, 2], -eye / np.linalg.norm(eye), atol=1e-3)
        assert view.c2w[2, 1] > 0.1 and abs(view.c2w[2, 0]) < 0.02  # upright, level
        assert (view.width, view.height, view.cx, view.cy) == (80, 40, 40, 20)
        assert view.fx == view.fy == pytest.approx(cameras[0].fx * 40 / 400)
    steps = np.linalg.norm(np.roll(eyes, -1, axis=0) - eyes, axis=-1)
    np.testing.assert_allclose(steps, steps[0], rtol=1e-9)
    assert [view.name for view in views[:2]] == ["orbit_000", "orbit_001"]


def test_orbit_finds_up_when_all_cameras_look_down_from_one_side():
    cameras = [looking_at([3 + 0.3 * a, a, 3], [0, 0, 0]) for a in (-1.5, -0.5, 0.6, 1.4)]
    mean = np.mean([c.c2w[:3, 1] for c in cameras], axis=0)
    assert mean[2] / np.linalg.norm(mean) < 0.8  # the plain mean leans by 40 degrees
    for view in orbit(cameras, 5):
        assert abs(view.c2w[2, 0]) < 0.05
        assert view.c2w[2, 3] == pytest.approx(3, abs=0.3)


@pytest.mark.parametrize("target", [[0, 0, -1], [0, 0, 1], [1, 0, 0]])
def test_orbit_of_one_camera(target: list[float]):
    views = orbit([looking_at([0, 0, 0], target, up=(0, 1, 0))], 4)
    np.testing.assert_allclose(views[0].c2w, looking_at([0, 0, 0], target, up=(0, 1, 0)).c2w, atol=1e-6)
    assert len(views) == 4


def test_orbit_of_a_panorama_is_a_panorama():
    cameras = [looking_at([1, 2, 3], [1 + np.cos(a), 2 + np.sin(a), 3]) for a in (0, 2, 4)]
    for view in orbit(cameras, 3):
        np.testing.assert_allclose(view.c2w[:3, 3], [1, 2, 3], atol=1e-5)
        assert abs(view.c2w[2, 2]) < 1e-5


def test_names_of_a_long_orbit_sort():
    camera = looking_at([0, 0, 3], [0, 0, 0], up=(0, 1, 0))
    for n_frames, last in ((1000, "orbit_999"), (1001, "orbit_1000")):
        names = [view.name for view in orbit([camera], n_frames)]
        assert names == sorted(names) and names[-1] == last


def test_orbit_refuses_nothing():
    with pytest.raises(FormatError, match="at least one"):
        orbit([], 3)
    with pytest.raises(FormatError, match="at least 1, got 0"):
        orbit([looking_at([0, 0, 3], [0, 0, 0], up=(0, 1, 0))], 0)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"c2w": np.eye(3)}, r"a: camera matrix: expected 4 rows of 4 numbers, got shape \[3, 3\]"),
        ({"c2w": np.full((4, 4), np.nan)}, "a: camera matrix: expected a rotation"),
        ({"width": 0}, "a: size: expected at least 1x1, got 0x6"),
        ({"fx": float("nan")}, "a: fx: expected a positive focal length, got nan"),
        ({"cx": float("inf")}, "a: cx, cy: expected finite numbers, got inf"),
    ],
)
def test_a_camera_checks_itself(change: dict[str, Any], message: str):
    with pytest.raises(FormatError, match=message):
        replace(looking_at([0, 0, 3], [0, 0, 0], up=(0, 1, 0)), **change)
