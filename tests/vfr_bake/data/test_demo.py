"""The built-in scene: its geometry, alpha and distances are right, and its look depends on the view."""

from __future__ import annotations

import numpy as np
import pytest

from player.app.option_types import DEMO
from player.asset.asset import Asset
from player.cameras.camera import Camera
from player.render import render
from tests.vfr_bake.data.solids import AABB, signed_distance
from vfr_bake.data import demo as module
from vfr_bake.data import load_scene
from vfr_bake.data.demo import demo_cameras, demo_capture, demo_scene, demo_views, trace
from vfr_bake.data.demo_solids import (
    BALL_CENTRE,
    BALL_RADIUS,
    CENTRE,
    HOLE_ANGLE,
    HOLE_CENTRE,
    HOLE_RADIUS,
    SCALE,
    WIRE_RADIUS,
)


def looking(eye: np.ndarray, target: np.ndarray, size: int, degrees: float) -> Camera:
    back = (eye - target) / np.linalg.norm(eye - target)
    right = np.cross([0, 0, 1], back) / np.linalg.norm(np.cross([0, 0, 1], back))
    c2w = np.eye(4)
    c2w[:3, :4] = np.stack([right, np.cross(back, right), back, eye], axis=-1)
    focal = float(0.5 * size / np.tan(0.5 * np.deg2rad(degrees)))
    return Camera("look", c2w, size, size, focal, focal, size / 2, size / 2)


def test_distance_to_the_ball_is_that_of_a_sphere():
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(200, 3))
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    # Points near the ball's outer half, where no other part of the scene is as near.
    directions = directions[(directions[:, 0] < -0.2) & (directions[:, 2] > 0)]
    assert len(directions) > 30
    for distance in (0, 0.03, 0.06):
        points = BALL_CENTRE + (BALL_RADIUS + distance) * directions
        np.testing.assert_allclose(signed_distance(points), distance, atol=1e-12)


def test_distance_to_the_wire_and_through_the_hole():
    top = CENTRE + SCALE * np.array([0, 0.07, -0.6 + 0.86])
    np.testing.assert_allclose(signed_distance(top), -WIRE_RADIUS, atol=1e-12)
    np.testing.assert_allclose(signed_distance(top + np.array([0, 0, 0.3])), 0.3 - WIRE_RADIUS, atol=1e-12)
    assert AABB[1, 2] == pytest.approx(top[2] + WIRE_RADIUS)
    np.testing.assert_allclose(signed_distance(HOLE_CENTRE), HOLE_RADIUS, atol=1e-12)


def test_distance_is_a_distance():
    """The distance never changes by more than the way between two points, inside or outside."""
    rng = np.random.default_rng(1)
    a = rng.uniform(AABB[0] - 0.3, AABB[1] + 0.3, (4000, 3))
    b = a + rng.normal(scale=0.05, size=a.shape)
    assert (np.abs(signed_distance(a) - signed_distance(b)) <= np.linalg.norm(a - b, axis=-1) + 1e-12).all()


def test_outside_distance_is_exact():
    """From a point outside, the surface lies at the given distance down the gradient."""
    rng = np.random.default_rng(2)
    points = rng.uniform(AABB[0] - 0.2, AABB[1] + 0.2, (3000, 3))
    points = points[signed_distance(points) > 0.01]
    h = 1e-6
    offsets = np.eye(3) * h
    gradient = np.stack([signed_distance(points + o) - signed_distance(points - o) for o in offsets], axis=-1)
    gradient /= 2 * h
    length = np.linalg.norm(gradient, axis=-1)
    smooth = np.abs(length - 1) < 1e-3  # not between two solids that are equally near
    assert smooth.mean() > 0.98
    feet = points[smooth] - signed_distance(points[smooth])[:, None] * gradient[smooth]
    np.testing.assert_allclose(signed_distance(feet), 0, atol=1e-5)


def test_the_box_is_tight():
    rng = np.random.default_rng(3)
    low, high = AABB
    for axis in range(3):
        for side, outward in ((low, -1), (high, 1)):
            points = rng.uniform(low, high, (60_000, 3))
            points[:, axis] = side[axis] + outward * 1e-9
            assert (signed_distance(points) > 0).all()
            if axis == 2 and outward == 1:
                points = CENTRE + SCALE * np.array([[0, 0.07, 0]])
            points[:, axis] = side[axis] - outward * 2e-3
            assert (signed_distance(points) < 0).any()


def test_traced_distance_is_that_of_the_closed_form():
    camera = looking(BALL_CENTRE + np.array([-2.0, -1.2, 0.8]), BALL_CENTRE, 33, 9)
    rgba, distance = trace(camera)
    rays_o, rays_d = camera.rays()
    arm = BALL_CENTRE - rays_o.astype(np.float64)
    along = (arm * rays_d).sum(axis=-1)
    missed = (arm**2).sum(axis=-1) - along**2
    inner = missed < (0.95 * BALL_RADIUS) ** 2
    expected = along[inner] - np.sqrt(BALL_RADIUS**2 - missed[inner])
    assert inner.sum() > 500
    # The march ends within 1e-4 of the surface, in units of 0.8, seen at most at 72 degrees (cosine 0.3).
    np.testing.assert_allclose(distance.ravel()[inner], expected, atol=1e-4 * SCALE / 0.3)
    assert (rgba[..., 3].ravel()[inner] == 1).all()


def test_every_hit_is_on_the_surface_and_every_miss_is_a_miss():
    for camera in demo_cameras(48, 7):
        _, distance = trace(camera)
        rays_o, rays_d = (r.astype(np.float64) for r in camera.rays())
        hit = np.isfinite(distance.ravel())
        points = rays_o[hit] + distance.ravel()[hit, None] * rays_d[hit]
        assert np.abs(signed_distance(points)).max() < 2e-4
        # Walk along each ray by the distance function, in float64: before the hit nothing is touched.
        t = np.full(len(rays_o), 1.0)
        nearest = np.full(len(rays_o), np.inf)
        for _ in range(80):
            h = signed_distance(rays_o + t[:, None] * rays_d)
            before = np.where(hit, t < distance.ravel() - 5e-3, t < 6)
            nearest = np.where(before, np.minimum(nearest, h), nearest)
            t = t + np.maximum(h, 1e-4)
        assert (nearest[hit] > -2e-4).all()  # the walk's own shortest step, and float32
        assert (nearest[~hit] > -1e-3).all() and (nearest[~hit] < 1e-4).mean() < 0.01


def test_one_sees_through_the_hole():
    axis = np.array([-np.sin(HOLE_ANGLE), np.cos(HOLE_ANGLE), 0])
    _, distance = trace(looking(HOLE_CENTRE + 2.5 * axis + np.array([0, 0, 0.4]), HOLE_CENTRE, 61, 20))
    rim, _ = trace(looking(HOLE_CENTRE + 2.5 * axis, HOLE_CENTRE + np.array([0, 0, 1.3 * HOLE_RADIUS]), 5, 1))
    assert rim[2, 2, 3] == 1
    assert distance[30, 30] > 2.5 + 0.1  # beyond the slab
    far = looking(
        HOLE_CENTRE + 2.5 * axis + np.array([0, 0, -0.02]), HOLE_CENTRE + np.array([0, 0, 0.02]), 61, 20
    )
    alpha = trace(far)[0][..., 3]
    assert alpha[20:41, 20:41].min() == 0  # nothing is behind the hole there


def test_the_wire_is_thin_and_seen():
    # Near its right foot, with nothing behind it, the wire leans by 10 degrees.
    along = 0.86 * np.cos(np.deg2rad(10))
    place = [along * np.cos(-0.06), 0.07 + along * np.sin(-0.06), -0.6 + 0.86 * np.sin(np.deg2rad(10))]
    place = CENTRE + SCALE * np.array(place)
    np.testing.assert_allclose(signed_distance(place), -WIRE_RADIUS, atol=1e-12)
    camera = looking(place + np.array([0, -3, 0]), place, 64, 10)
    alpha = trace(camera)[0][32, 24:40, 3]
    pixels = 2 * WIRE_RADIUS / 3 * camera.fx / np.cos(np.deg2rad(10))
    assert alpha.sum() == pytest.approx(pixels, abs=0.5)  # coverage in quarters at both edges
    assert ((alpha > 0) & (alpha < 1)).any()


def test_the_highlight_moves_with_the_view():
    """The ball's brightest point is another one from another side, which it would not be on a matt ball."""
    brightest = []
    for side in (-0.8, 0.8):
        camera = looking(
            BALL_CENTRE + np.array([2.2 * np.sin(side), -2.2 * np.cos(side), 1.1]), BALL_CENTRE, 64, 14
        )
        rgba, distance = trace(camera)
        rays_o, rays_d = camera.rays()
        points = rays_o + np.where(np.isfinite(distance), distance, 0).ravel()[:, None] * rays_d
        on_ball = np.abs(np.linalg.norm(points - BALL_CENTRE, axis=-1) - BALL_RADIUS) < 1e-3
        value = np.where(on_ball, rgba[..., :3].sum(axis=-1).ravel(), -1)
        assert value.max() > 2.2  # nearly white, on a red ball
        assert np.median(value[on_ball]) < 1.2
        best = value >= np.quantile(value[on_ball], 0.99)
        brightest.append(points[best].mean(axis=0))
    assert np.linalg.norm(brightest[0] - brightest[1]) > 0.4 * BALL_RADIUS


def test_edges_are_smooth_and_the_rest_is_right(monkeypatch: pytest.MonkeyPatch):
    """Sampling only rough pixels 2 x 2 times gives what sampling all of them gives, but for smooth detail."""
    camera = demo_cameras(40, 9)[5]
    some = trace(camera)[0]
    monkeypatch.setattr(module, "_rough", lambda rgba: np.ones(rgba.shape[:2], bool))
    everything = trace(camera)[0]
    assert np.sqrt(np.mean((some - everything) ** 2)) < 0.01
    alphas = np.unique(everything[..., 3])
    assert set(alphas.tolist()) == {0, 0.25, 0.5, 0.75, 1}


def test_chunks_of_rays_do_not_show(monkeypatch: pytest.MonkeyPatch):
    camera = demo_cameras(24, 3)[1]
    whole, distance = trace(camera)
    monkeypatch.setattr(module, "_RAYS_AT_ONCE", 101)
    parts, part_distance = trace(camera)
    np.testing.assert_allclose(whole, parts, atol=1e-5)
    np.testing.assert_allclose(distance, part_distance, atol=1e-5)


def test_cameras_see_all_of_it_and_some_from_below():
    cameras = demo_cameras(64, 64)
    corners = np.stack(np.meshgrid(*AABB.T, indexing="ij"), axis=-1).reshape(-1, 3)
    below = 0
    for camera in cameras:
        local = (corners - camera.c2w[:3, 3]) @ camera.c2w[:3, :3]
        column = camera.cx - camera.fx * local[:, 0] / local[:, 2]
        row = camera.cy + camera.fy * local[:, 1] / local[:, 2]
        spill = max(-column.min(), column.max() - 64, -row.min(), row.max() - 64)
        assert spill < 5  # only a corner of the box, which is empty
        below += camera.c2w[2, 3] < AABB[0, 2]
    assert 2 <= below <= 16
    for camera in cameras[::9]:
        alpha = trace(camera.resized(48, 48))[0][..., 3]
        assert alpha[0].max() == alpha[-1].max() == alpha[:, 0].max() == alpha[:, -1].max() == 0
        assert alpha.mean() > 0.12


def test_it_is_the_same_every_time_and_reports_progress():
    calls: list[tuple[int, int]] = []
    train, test = demo_views(12, 5, 2, lambda done, n: calls.append((done, n)))
    again, _ = demo_views(12, 5, 2)
    np.testing.assert_array_equal(train.images, again.images)
    assert calls == [(i, 7) for i in range(1, 8)]
    assert {c.name for c in test.cameras} == {"./test/r_0", "./test/r_1"}
    assert not any(np.allclose(a.c2w, b.c2w) for a in train.cameras for b in test.cameras)


def test_the_scene_box_holds_the_scene_closely():
    scene = demo_scene(size=64, n_train=32, n_test=2)
    world = scene.world_from_model
    half, centre = world[0, 0], world[:3, 3]
    np.testing.assert_array_equal(world[:3, :3], np.eye(3) * half)
    assert (centre - half < AABB[0]).all() and (centre + half > AABB[1]).all()
    assert half < 1.25 * (AABB[1] - AABB[0]).max() / 2
    assert scene.has_alpha and scene.name == "demo"


def test_the_word_demo_loads_it(monkeypatch: pytest.MonkeyPatch):
    small = demo_capture(size=16, n_train=4, n_test=1)
    monkeypatch.setattr("vfr_bake.data.demo_capture", lambda progress: small)
    assert load_scene("demo").name == "demo"


def test_the_asset_that_comes_with_the_player_shows_it():
    """The demo asset shows a view between its training views; a pixel off is 26 dB, an empty picture 10."""
    camera = demo_cameras(256, 16, phase=0.5)[6]
    asset = Asset.open(DEMO)
    rgba, _ = trace(camera)
    truth = rgba[..., :3] * rgba[..., 3:] + np.array(asset.manifest.background) * (1 - rgba[..., 3:])
    error = np.mean((render(asset, camera, march="numpy").rgb - truth) ** 2)
    assert -10 * np.log10(error) > 31
