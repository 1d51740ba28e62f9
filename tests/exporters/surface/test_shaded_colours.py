"""Tests of colours of a ball whose features are linear in the place, against the head in closed form."""

from __future__ import annotations

import numpy as np
import pytest

from exporters.surface import shaded_colours as surface_colour
from exporters.surface.depth_views import depth_views
from exporters.surface.shaded_colours import surface_colours
from player.asset.asset import Asset
from tests.exporters.conftest import BALL_CENTRE, BALL_RADIUS
from tests.exporters.solids import WORLD_FROM_MODEL
from tests.player.conftest import head_arrays

SAMPLES = np.random.default_rng(3).normal(size=(200, 3))
DIRECTIONS = SAMPLES / np.linalg.norm(SAMPLES, axis=-1, keepdims=True)


def on_the_ball(asset: Asset) -> tuple[np.ndarray, np.ndarray]:
    """Return points on the ball and their normals, [n, 3] each, world frame."""
    matrix = np.array(WORLD_FROM_MODEL)
    points = (np.array(BALL_CENTRE) + DIRECTIONS * BALL_RADIUS) @ matrix[:3, :3].T + matrix[:3, 3]
    return points, DIRECTIONS @ matrix[:3, :3].T / asset.scale


def head(points: np.ndarray, dirs: np.ndarray) -> np.ndarray:
    """Return the colours of model points seen along model directions: sigmoid(features W + dirs V)."""
    w, v = head_arrays()
    features = np.concatenate([(points + 1) * 90 - 90, np.full((len(points), 1), 50)], axis=-1)
    return 1 / (1 + np.exp(-(features @ w + dirs @ v)))


def test_along_the_normal_without_views(ball_asset: Asset) -> None:
    points, normals = on_the_ball(ball_asset)
    rgb, known = surface_colours(ball_asset, points, normals, [])
    expected = head(np.array(BALL_CENTRE) + DIRECTIONS * BALL_RADIUS, -DIRECTIONS)
    assert known.all()
    # the colour is a mean over a voxel or two of depth: 2.5 codes a voxel, each about 0.02 of a logit
    assert np.abs(rgb - expected).max() < 0.06 and np.abs(rgb - expected).mean() < 0.02


def test_mean_of_the_cameras_that_see_it(ball_asset: Asset, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(surface_colour, "MAX_DIRECTIONS", 12)
    points, normals = on_the_ball(ball_asset)
    views = depth_views(ball_asset)
    rgb, known = surface_colours(ball_asset, points, normals, views)
    model = np.array(BALL_CENTRE) + DIRECTIONS * BALL_RADIUS
    total, weight = np.zeros((200, 3)), np.zeros((200, 1))
    for view in views:  # a ball hides only its own far side
        eye = np.linalg.inv(np.array(WORLD_FROM_MODEL)) @ [*view.camera.c2w[:3, 3], 1]
        towards = eye[:3] - model
        towards /= np.linalg.norm(towards, axis=-1, keepdims=True)
        cosines = np.maximum((towards * DIRECTIONS).sum(-1, keepdims=True), 0)
        total += cosines * head(model, -towards)
        weight += cosines
    assert known.all() and (weight > 0).mean() > 0.95
    clear = weight[:, 0] > 0.3
    apart = np.abs(rgb - total / np.maximum(weight, 1e-9))[clear]
    assert apart.max() < 0.06 and apart.mean() < 0.02


def test_beside_the_surface_and_far_from_it(ball_asset: Asset) -> None:
    points, normals = on_the_ball(ball_asset)
    voxel = 4 / 72
    on, _ = surface_colours(ball_asset, points, normals, [])
    for voxels in (-1.5, 1.5):
        beside, known = surface_colours(ball_asset, points + normals * voxels * voxel, normals, [])
        assert known.all() and np.abs(beside - on).max() < 0.08
    far, known = surface_colours(ball_asset, points + normals * 12 * voxel, normals, [])
    assert not known.any() and not far.any()
    none, known = surface_colours(ball_asset, points[:0], normals[:0], [])
    assert none.shape == (0, 3) and known.shape == (0,)


def test_no_more_cameras_than_wanted(ball_asset: Asset, monkeypatch: pytest.MonkeyPatch) -> None:
    """If one camera per point is allowed, the colours are that camera's, not a mean."""
    points, normals = on_the_ball(ball_asset)
    views = depth_views(ball_asset)
    monkeypatch.setattr(surface_colour, "MAX_DIRECTIONS", 1)
    one, _ = surface_colours(ball_asset, points, normals, views)
    alone, _ = surface_colours(ball_asset, points, normals, views[:1])
    seen = surface_colour.cosines_in_view(views[0], points, normals, 2 * 4 / 72) > 0
    np.testing.assert_allclose(one[seen], alone[seen], rtol=0, atol=1e-6)
    assert seen.sum() > 50
