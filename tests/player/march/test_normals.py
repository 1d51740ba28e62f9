"""Tests of composited normals against a naive loop and a sphere's closed form, and of their frame."""

from __future__ import annotations

import numpy as np
import pytest

from player.asset.asset import Asset
from player.cameras.camera import Camera
from player.cameras.transforms import read_cameras
from player.march.normals import code_gradient, composited_normals
from player.render import Renderer
from tests.player.conftest import RESOLUTION
from tests.player.march.oracle_march import Scene, enter, interpolate, march_ray


@pytest.fixture
def camera(asset: Asset) -> Camera:
    return read_cameras(asset.path("cameras.json"))[1]


def naive_gradient(scene: Scene, g: np.ndarray) -> np.ndarray:
    """Return the gradient of the code: along each axis, the difference between the cell's two faces, since
    trilinear interpolation is linear along an axis."""
    cell = [min(max(int(np.floor(x)), 0), scene.resolution - 1) for x in g]
    slopes = []
    for axis in range(3):
        ends = []
        for side in (0, 1):
            at = np.array(g, np.float64)
            at[axis] = cell[axis] + side
            ends.append(float(interpolate(scene, at, scene.codes)[0]))
        slopes.append(ends[1] - ends[0])
    return np.array(slopes)


def test_normals_are_the_naive_loop(asset: Asset, scene: Scene, camera: Camera) -> None:
    rays_o, rays_d = camera.transformed(np.linalg.inv(asset.world_from_model)).rays()
    normals = composited_normals(asset.grid, rays_o, rays_d)
    met = 0
    for pixel in range(0, len(rays_o), 61):
        _, _, e, d = enter(scene, rays_o[pixel], rays_d[pixel])
        total = np.zeros(3)
        for s, weight in march_ray(scene, rays_o[pixel], rays_d[pixel], 0).samples:
            total -= weight * naive_gradient(scene, e + np.float32(s) * d)
        length = np.linalg.norm(total)
        if length > 0.1:  # where gradients cancel, rounding picks the direction
            np.testing.assert_allclose(normals[pixel], total / length, rtol=0, atol=2e-4)
            met += 1
        elif length == 0:
            assert not normals[pixel].any()
    assert met > 10


def test_a_sphere_has_radial_normals(asset: Asset) -> None:
    """The gradient, a voxel outside the peak of the outer shell, is radial to a degree or so in most cells. A
    few cells have a corner on the other side of the peak."""
    directions = np.random.default_rng(0).normal(size=(500, 3))
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    radius = 0.99 + 1.0 * 2 / RESOLUTION
    inside = (np.abs(directions * radius) < 1 - 2 / RESOLUTION).all(axis=-1)
    g = ((directions[inside] * radius + 1) * RESOLUTION / 2).T.astype(np.float32)
    gradient = -code_gradient(asset.grid, g)
    cosines = (gradient * directions[inside].T).sum(axis=0) / np.linalg.norm(gradient, axis=0)
    degrees = np.rad2deg(np.arccos(np.clip(cosines, -1, 1)))
    assert inside.sum() > 100 and np.median(degrees) < 2 and degrees.max() < 8


def test_layers_are_in_the_world_and_do_not_change_the_picture(asset: Asset, camera: Camera) -> None:
    with Renderer(asset, 2) as renderer:
        plain, frame = renderer.render(camera), renderer.render(camera, layers=True)
        again = renderer.render(camera.resized(48, 40), layers=True)
    assert plain.features is None
    # computed only now, after the renderer was closed
    assert plain.normals.tobytes() == frame.normals.tobytes()
    assert frame.rgb.tobytes() == plain.rgb.tobytes() and frame.depth.tobytes() == plain.depth.tobytes()
    assert frame.features is not None
    assert again.normals.tobytes() == frame.normals.tobytes()
    rays_o, rays_d = camera.transformed(np.linalg.inv(asset.world_from_model)).rays()
    model = composited_normals(asset.grid, rays_o, rays_d).reshape(40, 48, 3)
    turned = np.stack([-model[..., 1], model[..., 0], model[..., 2]], axis=-1)  # the asset's quarter turn
    assert (np.abs(frame.normals - turned).max(axis=-1) < 1e-3).mean() > 0.99
    length = np.linalg.norm(frame.normals, axis=-1)
    assert (np.isclose(length, 1, atol=1e-5) | (length == 0)).all()
    hit = frame.opacity > 1 / 512
    assert frame.features.shape == (40, 48, 4) and not frame.features[~hit].any()
    # the fourth feature is 50 everywhere: what is composited is 50 times the opacity
    np.testing.assert_allclose(frame.features[hit][:, 3], 50 * frame.opacity[hit], rtol=1e-4)


def test_no_rays_and_only_misses(asset: Asset) -> None:
    none = np.zeros((0, 3), np.float32)
    assert composited_normals(asset.grid, none, none).shape == (0, 3)
    away = np.tile(np.float32([[0, 0, 1]]), (3, 1))
    assert not composited_normals(asset.grid, away * 5, away).any()
