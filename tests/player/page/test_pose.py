"""Tests of the page's camera mathematics by values, against Python's cameras and closed forms."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from playwright.sync_api import Browser, Page

from player.cameras.camera import Camera, focus_point, orbit, world_up
from player.cameras.views import read_views
from player.page.rest import rest_camera
from tests.player.conftest import look_at
from tests.player.page.viewer_page import opened, page_files, stub_loader

Call = Callable[..., Any]


@pytest.fixture(scope="module")
def page(chromium: Browser) -> Iterator[Page]:
    with opened(chromium, page_files(stub_loader([], fails="none")), wait=False) as found:
        yield found.page


@pytest.fixture(scope="module")
def call(page: Page) -> Call:
    """Return a caller of functions of the page's modules, by name and with arguments that JSON can hold."""

    def call(name: str, *arguments: Any, module: str = "viewer/pose.js") -> Any:
        return page.evaluate(
            "async ([module, name, given]) => (await import('./' + module))[name](...given)",
            [module, name, arguments],
        )

    return call


def cameras(eyes: np.ndarray, target: tuple[float, float, float]) -> list[Camera]:
    """Return level cameras of 64 x 48 pixels at places [n, 3] that look at a point."""
    return [
        Camera(f"./r_{i}", look_at(tuple(eye), target), 64, 48, 60.0, 61.0, 33.0, 23.0)
        for i, eye in enumerate(eyes.tolist())
    ]


def as_json(views: list[Camera]) -> list[dict[str, Any]]:
    return [
        {
            "name": v.name, "width": v.width, "height": v.height,
            "fx": v.fx, "fy": v.fy, "cx": v.cx, "cy": v.cy, "c2w": v.c2w.ravel().tolist(),
        }
        for v in views
    ]  # fmt: skip


def ring(n: int, first: float, last: float, height: float, radius: float = 4.0) -> np.ndarray:
    """Return places [n, 3] on an arc around (1, 2, 3), between two angles in degrees."""
    angles = np.deg2rad(np.linspace(first, last, n))
    return np.stack([1 + radius * np.cos(angles), 2 + radius * np.sin(angles), np.full(n, 3 + height)], -1)


RINGS = {
    "all around": ring(12, 0, 330, 2.0),
    "an arc in front": ring(9, 40, 120, 0.5),
    "across the seam of angles": ring(7, 150, 230, 1.0),
    "one camera": ring(1, 30, 30, 1.0),
    "from right above": np.array([[1.0, 2.001, 9.0]]),
}


@pytest.mark.parametrize("eyes", RINGS.values(), ids=RINGS)
def test_up_and_focus_are_those_of_the_player(call: Call, eyes: np.ndarray) -> None:
    views = cameras(eyes, (1, 2, 3))
    np.testing.assert_allclose(call("worldUp", as_json(views)), world_up(views), atol=1e-9)
    np.testing.assert_allclose(call("focusPoint", as_json(views)), focus_point(views), atol=1e-6)


@pytest.mark.parametrize("eyes", RINGS.values(), ids=RINGS)
def test_the_first_view_is_level_and_in_the_middle(call: Call, eyes: np.ndarray) -> None:
    views = cameras(eyes, (1, 2, 3))
    rest = call("restOf", as_json(views))
    view = call("viewOf", rest["frame"], rest["pose"], 64, 48)
    c2w, focus, up = np.reshape(view["c2w"], (4, 4)), focus_point(views), world_up(views)
    assert abs(c2w[:3, 0] @ up) < 1e-9 and c2w[:3, 1] @ up >= 0, "up is up"
    radius = np.median(np.linalg.norm(eyes - focus, axis=-1))
    np.testing.assert_allclose(c2w[:3, 3] - radius * c2w[:3, 2], focus, atol=1e-9)
    beside = orbit(views, 1)[0].c2w
    assert c2w[:3, 2] @ up == pytest.approx(beside[:3, 2] @ up, abs=1e-9), "the elevation of Python's orbit"
    if len(eyes) == 12:
        np.testing.assert_allclose(c2w, beside, atol=1e-9)
    elif len(eyes) > 1:
        middle = eyes[len(eyes) // 2]
        np.testing.assert_allclose(c2w[:3, 3], middle, atol=0.05)


def around(angles: list[float], elevation: float = 0.4) -> list[Camera]:
    """Return cameras that look at (1, 2, 3) from angles in degrees around it."""
    found = []
    for i, angle in enumerate(np.deg2rad(angles).tolist()):
        eye = np.array([np.cos(angle), np.sin(angle), np.tan(elevation)]) * 3 + [1, 2, 3]
        pose = look_at(tuple(eye.tolist()), (1.0, 2.0, 3.0))
        found.append(Camera(f"{i}", pose, 60, 40, 50.0, 52.0, 31.0, 19.0))
    return found


def test_the_poster_is_seen_from_the_middle_of_the_cameras() -> None:
    rest = rest_camera(around([10, 20, 60, 70]))
    (wanted,) = around([40])
    assert np.allclose(rest.c2w, wanted.c2w, atol=2e-3)  # up leans a little towards the cameras' own
    assert (rest.width, rest.fx, rest.cx, rest.cy) == (60, 50.0, 30.0, 20.0)
    all_around = around([30, 120, 210, 300])
    assert np.allclose(rest_camera(all_around).c2w, all_around[0].c2w, atol=1e-4)


@pytest.mark.parametrize(
    "views", [around([10, 20, 60, 70]), around([0, 90, 180, 270]), around([200], 1.3)], ids=len
)
def test_the_poster_shows_what_the_viewer_begins_with(call: Call, views: list[Camera]) -> None:
    check_first_view(call, views)


def check_first_view(call: Call, views: list[Camera]) -> tuple[dict[str, Any], Camera]:
    """Check that the viewer begins with the poster's view; return what it begins with and that view."""
    found, camera = call("restOf", as_json(views)), rest_camera(views)
    view = call("viewOf", found["frame"], found["pose"], camera.width, camera.height)
    np.testing.assert_allclose(np.reshape(view["c2w"], (4, 4)), camera.c2w, atol=1e-6)
    for key in ("fx", "fy", "cx", "cy"):
        assert view[key] == pytest.approx(getattr(camera, key))
    return found, camera


def test_the_first_view_of_an_object_and_of_a_capture(call: Call, lego_400: Path, fox: Path) -> None:
    """The first view is the poster's; for a capture it is among the cameras, in front of what they see."""
    for path in (lego_400 / "transforms_train.json", fox / "transforms.json"):
        views = read_views(path, (400, 400))
        found, camera = check_first_view(call, views)
        places = np.stack([view.c2w[:3, 3] for view in views])
        apart = np.linalg.norm(places - camera.c2w[:3, 3], axis=-1) / found["frame"]["radius"]
        assert apart.min() < 0.25 and abs(camera.c2w[:3, 0] @ world_up(views)) < 1e-6
        looked = np.stack([-view.c2w[:3, 2] for view in views])
        if path.parent == fox:
            assert (looked @ -camera.c2w[:3, 2]).min() > 0.5, "all of them stand on one side"
        else:
            assert np.linalg.norm(found["pose"]["target"]) < 0.01 and camera.c2w[2, 3] > 1


def test_poses_hold_training_views_exactly(call: Call) -> None:
    """Poses hold training views exactly, also those that are tilted or look straight down."""
    random = np.random.default_rng(3)
    views = cameras(RINGS["all around"], (1, 2, 3))
    for number, view in enumerate(views[::2]):
        angle = random.uniform(-3, 3)
        turn = np.eye(4)
        turn[:2, :2] = [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]
        views[2 * number] = replace(view, c2w=view.c2w @ turn)
    down = np.eye(4)
    down[:3, 3] = 1, 2, 7
    views += [Camera("./down", down, 64, 48, 60.0, 61.0, 33.0, 23.0)]
    rest = call("restOf", as_json(views))
    focus = rest["pose"]["target"]
    for camera, given in zip(views, as_json(views), strict=True):
        pose = call("poseOf", rest["frame"], given, focus)
        view = call("viewOf", rest["frame"], pose, 64, 48)
        np.testing.assert_allclose(np.reshape(view["c2w"], (4, 4)), camera.c2w, atol=1e-9)
        for key in ("fx", "fy", "cx", "cy"):
            assert view[key] == pytest.approx(getattr(camera, key), rel=1e-12)
        wide = call(
            "viewOf", rest["frame"], pose, 200, 96
        )  # twice as high, and wider: the same picture in the middle
        assert wide["fx"] == pytest.approx(120) and wide["cx"] == pytest.approx(102)
        assert wide["cy"] == pytest.approx(46)


@pytest.fixture(scope="module")
def rest(call: Call) -> dict[str, Any]:
    return call("restOf", as_json(cameras(RINGS["an arc in front"], (1, 2, 3))))


def matrix(call: Call, rest: dict[str, Any], pose: dict[str, Any]) -> np.ndarray:
    return np.reshape(call("cameraOf", rest["frame"], pose), (4, 4))


def test_an_orbit_keeps_target_distance_and_level(call: Call, rest: dict[str, Any]) -> None:
    pose = rest["pose"]
    turned = call("orbited", pose, 0.5, 0.2)
    before, after = matrix(call, rest, pose), matrix(call, rest, turned)
    assert turned["target"] == pose["target"] and turned["distance"] == pose["distance"]
    target = np.array(pose["target"])
    np.testing.assert_allclose(after[:3, 3] - pose["distance"] * after[:3, 2], target, atol=1e-12)
    up = np.array(rest["frame"]["axes"][2])
    assert abs(after[:3, 0] @ up) < 1e-12
    angle = math.asin(after[:3, 2] @ up) - math.asin(before[:3, 2] @ up)
    assert angle == pytest.approx(0.2)
    assert call("orbited", pose, 0, 50)["elevation"] < math.pi / 2, "never over the top"
    assert call("orbited", pose, 0, -50)["elevation"] > -math.pi / 2
    crooked = {**pose, "roll": 1.0}
    rolls = [call("orbited", crooked, angle, 0)["roll"] for angle in (0, 0.5, 3)]
    assert rolls[0] == 1 and 1 > rolls[1] > rolls[2] > 0 and rolls[2] < 0.01, "it comes level as it turns"


def test_looking_around_keeps_the_place(call: Call, rest: dict[str, Any]) -> None:
    before = matrix(call, rest, rest["pose"])
    after = matrix(call, rest, call("looked", rest["frame"], rest["pose"], 0.3, 0.1))
    np.testing.assert_allclose(after[:3, 3], before[:3, 3], atol=1e-12)
    assert after[:3, 2] @ before[:3, 0] > 0.2, "to the left: the back turns to the right"
    assert after[:3, 2] @ before[:3, 1] < -0.05, "upwards: the back turns down"


def test_moves_go_along_the_cameras_axes(call: Call, rest: dict[str, Any]) -> None:
    before = matrix(call, rest, rest["pose"])
    after = matrix(call, rest, call("moved", rest["frame"], rest["pose"], 1, 2, 3))
    np.testing.assert_allclose(after[:3, :3], before[:3, :3], atol=1e-12)
    np.testing.assert_allclose(after[:3, 3] - before[:3, 3], before[:3, :3] @ [1, 2, -3], atol=1e-12)


def test_zoom_has_ends(call: Call, rest: dict[str, Any]) -> None:
    radius = rest["frame"]["radius"]
    near, nearest, far = (
        call("zoomed", rest["frame"], rest["pose"], factor)["distance"] for factor in (0.5, 1e-9, 1e9)
    )
    assert near == pytest.approx(rest["pose"]["distance"] / 2)
    assert 0 < nearest < radius / 100 and radius * 100 < far < math.inf


def test_a_point_of_a_view_and_the_aim_at_it(call: Call, rest: dict[str, Any]) -> None:
    view = call("viewOf", rest["frame"], rest["pose"], 64, 48)
    camera = Camera(
        "", np.reshape(view["c2w"], (4, 4)), 64, 48, view["fx"], view["fy"], view["cx"], view["cy"]
    )
    rays_o, rays_d = camera.rays()
    point = call("pointAt", view, 10.5, 20.5, 2.5)
    np.testing.assert_allclose(point, rays_o[0] + 2.5 * rays_d[20 * 64 + 10], atol=1e-5)
    aimed = call("aimed", rest["frame"], rest["pose"], point)
    after = matrix(call, rest, aimed)
    assert aimed["target"] == point and aimed["distance"] == pytest.approx(2.5)
    np.testing.assert_allclose(after[:3, 3], camera.c2w[:3, 3], atol=1e-9)
    np.testing.assert_allclose(-after[:3, 2], rays_d[20 * 64 + 10], atol=1e-6)


def test_a_flight_begins_and_ends_where_it_should_and_goes_the_shorter_way(
    call: Call, rest: dict[str, Any]
) -> None:
    one = {**rest["pose"], "azimuth": 3.0, "distance": 1.0}
    two = {
        **rest["pose"],
        "azimuth": -3.0,
        "distance": 4.0,
        "target": [5, 6, 7],
        "elevation": 0.7,
        "roll": 0.4,
    }
    for share, end in ((0, one), (1, two)):
        found = call("between", one, two, share)
        assert call("difference", found, end) < 1e-9
    half = call("between", one, two, 0.5)
    assert abs(half["azimuth"]) == pytest.approx(math.pi) and half["distance"] == pytest.approx(2)
    assert call("difference", one, two) > 1
    assert call("difference", one, {**one, "azimuth": 3 - 2 * math.pi}) < 1e-9


# --- sizes and options ---


def test_sizes_fit_a_window(call: Call) -> None:
    assert call("fitted", 800, 600, 120_000, module="viewer/pace.js") == [400, 300]
    assert call("fitted", 800, 600, 1e9, module="viewer/pace.js") == [800, 600]
    assert call("fitted", 1, 1, 0, module="viewer/pace.js") == [1, 1]


PACED = """([rate, n, width, height, ticksASecond]) => import("./viewer/pace.js").then(({ Pace }) => {
  const pace = new Pace(), sizes = [];
  for (let i = 0; i < n; i++) {
    const [w, h] = pace.moving(width, height), exact = 0.003 + w * h / rate;
    const ticks = Math.ceil(exact * ticksASecond);
    pace.measured(w * h, ticks / ticksASecond, ticks === 1);
    sizes.push([w * h, exact]);
  }
  return [sizes, pace.sharp(width, height), pace.whole(width, height), pace.stutters];
})"""


@pytest.mark.parametrize(("ticks_a_second", "most_seconds"), [(60, 1 / 30), (50, 1.2 / 30)])
def test_pictures_are_as_large_as_thirty_a_second_allow(
    page: Page, ticks_a_second: int, most_seconds: float
) -> None:
    """Pictures that a slow screen shows at the next tick become larger until one takes a tick more."""
    for rate in (3e5, 1e6, 1e7, 1e10):
        sizes, sharp, whole, stutters = page.evaluate(PACED, [rate, 60, 1600, 1200, ticks_a_second])
        for pixels, seconds in sizes[40:]:
            assert seconds <= most_seconds + 1e-9 or pixels < 1.1 * 96 * 72
        assert sizes[-1][0] >= min(0.3 * rate / 30, 1600 * 1200), "and not smaller than needed"
        assert not stutters
        assert sizes[-1][0] <= np.prod(sharp) <= np.prod(whole) <= 1600 * 1200
        assert rate < 1e6 or whole == [1600, 1200]
    assert page.evaluate(PACED, [2e4, 30, 1600, 1200, 60])[3], "a device that is far too slow"


def test_a_still_picture_has_as_many_pixels_as_the_manual_says(page: Page) -> None:
    manual = (Path(__file__).parents[3] / "docs" / "page.md").read_text(encoding="utf-8")
    (millions,) = re.findall(r"every pixel of the screen, but at most ([\d.]+) million pixels", manual)
    for width, height in ((3840, 2160), (6016, 3384)):
        whole = page.evaluate(PACED, [1e10, 60, width, height, 60])[2]
        assert np.prod(whole) == pytest.approx(float(millions) * 1e6, rel=1e-2)


HASHES: dict[str, dict[str, Any]] = {
    "": {},
    "#view=12": {"view": 12},
    "#view=-1&view=x": {},
    "#quality=exact": {"quality": "exact"},
    "#quality=best": {},
    "#noui&turn": {"noui": True, "turn": True},
    "#turn=off&noui=0": {"turn": False, "noui": False},
    "#background=white": {"background": [1, 1, 1]},
    "#background=transparent": {"background": "transparent"},
    "#background=255,0,51": {"background": [1, 0, 0.2]},
    "#background=256,0,0": {},
    "#background=constructor": {},
    "#view=3&quality=fast&noui&turn&background=black": {
        "view": 3, "quality": "fast", "noui": True, "turn": True, "background": [0, 0, 0],
    },
    "#<script>&%&%zz=&&": {},
}  # fmt: skip


@pytest.mark.parametrize("text", HASHES)
def test_options_of_an_address(call: Call, text: str) -> None:
    found = {
        key: value for key, value in call("optionsOf", text, module="hash.js").items() if value is not None
    }
    assert found == HASHES[text]


@pytest.mark.parametrize("contracted", [False, True])
def test_rays_of_a_camera_far_away_are_exact_near_the_scene(call: Call, contracted: bool) -> None:
    """In float32, in which shaders compute, a ray passes the scene where it does in exact numbers."""
    camera = Camera("", look_at((800.0, 500.0, 300.0), (0.0, 0.0, 0.0)), 64, 48, 4e4, 4e4, 32.0, 24.0)
    manifest = {
        "world_from_model": np.eye(4).tolist(), "aabb": [[-2.0] * 3, [2.0] * 3], "contracted": contracted,
    }  # fmt: skip
    rays = {
        name: np.asarray(x, np.float32)
        for name, x in call("raysOf", *as_json([camera]), manifest, module="drawing/camera.js").items()
    }
    eye = camera.c2w[:3, 3]
    for place in ((0.5, 0.5), (31.5, 24.5), (7.5, 40.5), (63.5, 47.5)):
        x, y = np.array(place, np.float32) - rays["uPixel"]
        beside = x * rays["uAcross"] + y * rays["uDown"]
        more = 2 * (rays["uCentre"] @ beside) + beside @ beside
        norm = np.sqrt(1 + more)
        turned = (beside - rays["uCentre"] * (more / (norm + 1))) / norm
        origin, direction = rays["uOrigin"] + rays["uStart"] * turned, rays["uCentre"] + turned
        nearest = origin - (origin @ direction) * direction
        exact = camera.c2w[:3, :3] @ [(place[0] - 32) / 4e4, (24 - place[1]) / 4e4, -1]
        exact /= np.linalg.norm(exact)
        np.testing.assert_allclose(nearest, eye - (eye @ exact) * exact, atol=3e-6)
