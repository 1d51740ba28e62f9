"""The frame that everything works in: [-1, 1]³, and back."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from player.errors import DataError, ShapeError
from vfr_bake.data.demo import demo_cameras, demo_views
from vfr_bake.data.scene import PosedImages, build_scene


def test_rays_are_the_same_rays_in_both_frames():
    train, test = demo_views(24, 10, 2)
    scene = build_scene("a", train, test)
    for views, moved in ((train, scene.train), (test, scene.test)):
        for before, after in zip(views.cameras, moved.cameras, strict=True):
            origin, direction = before.rays()
            model_origin, model_direction = after.rays()
            back = model_origin @ scene.world_from_model[:3, :3].T + scene.world_from_model[:3, 3]
            np.testing.assert_allclose(back, origin, atol=1e-5)
            np.testing.assert_allclose(model_direction, direction, atol=1e-6)
    np.testing.assert_array_equal(scene.train.images, train.images)


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e4])
def test_the_model_frame_does_not_know_the_unit(scale: float):
    train, test = demo_views(24, 10, 2)
    similarity = np.diag([scale, scale, scale, 1.0])
    similarity[:3, 3] = [5 * scale, -3, 100]
    scaled = [
        PosedImages([c.transformed(similarity) for c in views.cameras], views.images)
        for views in (train, test)
    ]
    one, two = build_scene("a", train, test), build_scene("a", *scaled)
    for a, b in zip(one.train.cameras, two.train.cameras, strict=True):
        np.testing.assert_allclose(a.c2w, b.c2w, atol=1e-5)  # float32 hull grids may differ by their rounding
    np.testing.assert_allclose(
        two.world_from_model, similarity @ one.world_from_model, rtol=1e-5, atol=1e-5 * scale
    )


def test_too_few_views():
    train, test = demo_views(8, 1, 1)
    with pytest.raises(DataError, match="a: training views: expected at least 2, got 1"):
        build_scene("a", train, test)


def test_pictures_must_fit_their_cameras():
    cameras = demo_cameras(8, 2)
    good = np.zeros((2, 8, 8, 4), np.uint8)
    assert PosedImages(cameras, good).images is good
    for bad in (good[:1], good[..., :3], good.astype(np.float32), good[0]):
        with pytest.raises(ShapeError, match=r"images: expected \[2, height, width, 4\] uint8"):
            PosedImages(cameras, bad)
    with pytest.raises(ShapeError, match="camera: expected 8x8 pixels as its picture has, got 9x8"):
        PosedImages([cameras[0], replace(cameras[1], width=9)], good)
