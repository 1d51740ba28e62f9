"""The scene's box, for geometry with a known box."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from player.cameras.camera import Camera
from player.cameras.transforms import read_cameras
from vfr_bake.data.bounds import _dilated, scene_box
from vfr_bake.data.demo import demo_cameras
from vfr_bake.data.files.pictures import read_picture


def sphere_masks(cameras: list[Camera], centre: np.ndarray, radius: float) -> np.ndarray:
    """Return silhouettes [n, height, width] uint8 of a sphere, in closed form."""
    masks = []
    for camera in cameras:
        rays_o, rays_d = camera.rays()
        arm = centre - rays_o
        missed = np.linalg.norm(np.cross(arm, rays_d), axis=-1)
        masks.append(((missed < radius) * 255).astype(np.uint8).reshape(camera.height, camera.width))
    return np.stack(masks)


def test_cameras_alone_give_what_they_see():
    cameras = demo_cameras(32, 40)
    centre, half = scene_box(cameras)
    np.testing.assert_allclose(centre, [0.3, -0.2, 0.5 - 0.8 * 0.38], atol=1e-4)
    assert half == pytest.approx(3.4 * np.tan(np.deg2rad(19)), rel=1e-3)


def test_the_larger_field_of_view_counts():
    cameras = [Camera(c.name, c.c2w, 32, 64, c.fx, c.fy, 16.0, 32.0) for c in demo_cameras(32, 40)]
    assert scene_box(cameras)[1] == pytest.approx(2 * 3.4 * np.tan(np.deg2rad(19)), rel=1e-3)


@pytest.mark.parametrize("radius", [0.03, 0.3])
def test_a_spheres_silhouettes_give_its_box(radius: float):
    cameras = demo_cameras(96, 30)
    ball = np.array([0.55, -0.3, 0.1])
    centre, half = scene_box(cameras, sphere_masks(cameras, ball, radius))
    assert (np.abs(centre - ball) + radius < half).all()
    # There are two passes. The first one's cells are 1/32 of 1.19; block, growth and margin are at most 6
    # cells of the second.
    assert half < 1.3 * radius + 0.15


def test_an_empty_hull_keeps_the_first_box():
    cameras = demo_cameras(32, 10)
    first = scene_box(cameras)
    empty = scene_box(cameras, np.zeros((10, 32, 32), np.uint8))
    np.testing.assert_array_equal(first[0], empty[0])
    assert first[1] == empty[1]


def test_a_full_hull_keeps_the_first_box():
    cameras = demo_cameras(32, 10)
    assert scene_box(cameras)[1] == scene_box(cameras, np.full((10, 32, 32), 1, np.uint8))[1]


@pytest.mark.parametrize("n_left", [0, 1])
def test_pictures_that_were_cut_out_badly_do_not_crop_the_box(n_left: int):
    """Two pictures of 30 change nothing in which all of the ball was cut away, or half of it."""
    cameras = demo_cameras(96, 30)
    masks = sphere_masks(cameras, np.array([0.55, -0.3, 0.1]), 0.3)
    centre, half = scene_box(cameras, masks)
    for number in (3, 11):
        columns = np.flatnonzero(masks[number].any(axis=0))
        masks[number, :, columns[n_left * len(columns) // 2] :] = 0
    found_centre, found_half = scene_box(cameras, masks)
    np.testing.assert_allclose(found_centre, centre, atol=0.02)
    assert found_half == pytest.approx(half, abs=0.02)


def test_one_camera_that_stands_still():
    centre, half = scene_box(demo_cameras(8, 1) * 2)
    assert np.isfinite(centre).all() and half > 0


@pytest.mark.parametrize("step", [1, 3, 4])
def test_dilated_reaches_step_pixels(step: int):
    rng = np.random.default_rng(step)
    mask = rng.random((13, 10)) < 0.03
    mask[12, 9] = True
    grown = _dilated(mask, step)
    for row, column in np.argwhere(mask):
        for y in range(max(0, row - step), min(13, row + step + 1)):
            for x in range(max(0, column - step), min(10, column + step + 1)):
                assert grown[y // step, x // step]
    assert not _dilated(np.zeros((13, 10), bool), step).any()


def test_lego(lego_400: Path):
    cameras = read_cameras(lego_400 / "transforms_train.json", (400, 400))[::2]
    alphas = np.stack([read_picture(lego_400 / f"{c.name}.png")[..., 3] for c in cameras])
    centre, half = scene_box(cameras, alphas)
    low, high = np.array([-0.64, -1.15, -0.55]), np.array([0.64, 1.15, 1.04])  # the published model's box
    assert (centre - half < low).all() and (centre + half > high).all()
    assert half < 1.35  # by the cameras alone it is 1.45
    assert scene_box(cameras)[1] > 1.4
