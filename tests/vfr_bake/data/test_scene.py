"""The model frame, [-1, 1]³, in which everything works, and the way back to the world."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest

from player.cameras.camera import Camera
from player.errors import DataError, ShapeError
from vfr_bake.config import SceneKind
from vfr_bake.data.bounds import scene_box
from vfr_bake.data.demo import demo_cameras, demo_views
from vfr_bake.data.scene import NEAR_CAMERA, NEAR_QUANTILE, NEAR_SHARE, WHITE, _near, build_scene
from vfr_bake.data.store.capture import Capture, PosedImages
from vfr_bake.data.store.working import WorkingSize


def test_rays_are_the_same_rays_in_both_frames():
    train, test = demo_views(24, 10, 2)
    scene = build_scene(Capture("a", train, test))
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
    one, two = build_scene(Capture("a", train, test)), build_scene(Capture("a", *scaled))
    for a, b in zip(one.train.cameras, two.train.cameras, strict=True):
        np.testing.assert_allclose(a.c2w, b.c2w, atol=1e-5)  # float32 hull grids may differ by rounding
    np.testing.assert_allclose(
        two.world_from_model, similarity @ one.world_from_model, rtol=1e-5, atol=1e-5 * scale
    )


@pytest.mark.parametrize("kind", ["object", "unbounded"])
def test_a_small_scene_far_from_the_origin_of_its_world(kind: SceneKind):
    """Positions of georeferenced captures have a northing of millions of metres."""
    train, test = demo_views(24, 10, 2)
    place = np.eye(4)
    place[:3, 3] = [480_000, 5_400_000, 120]
    far = PosedImages([camera.transformed(place) for camera in train.cameras], train.images)
    here, there = (build_scene(Capture("a", views, test), kind) for views in (train, far))
    for a, b in zip(here.train.cameras, there.train.cameras, strict=True):
        np.testing.assert_allclose(a.c2w, b.c2w, atol=1e-5)
    np.testing.assert_allclose(there.world_from_model, place @ here.world_from_model, rtol=0, atol=1e-5)


def test_too_few_views():
    train, test = demo_views(8, 1, 1)
    with pytest.raises(DataError, match="a: training views: expected at least 2, got 1"):
        build_scene(Capture("a", train, test))


def test_pictures_must_fit_their_cameras():
    cameras = demo_cameras(8, 2)
    good = [np.zeros((8, 8, 4), np.uint8)] * 2
    assert PosedImages(cameras, good).images is good
    with pytest.raises(ShapeError, match="images: expected 2, one a camera, got 1"):
        PosedImages(cameras, good[:1])
    for bad in (good[0][..., :3], good[0].astype(np.float32), good[0][0]):
        with pytest.raises(ShapeError, match=r"image: expected \[height, width, 4\] uint8"):
            PosedImages(cameras, [good[0], bad])
    with pytest.raises(ShapeError, match="camera: expected 8x8 pixels as its picture has, got 9x8"):
        PosedImages([cameras[0], replace(cameras[1], width=9)], good)


def opaque(views: PosedImages, colour: list[int] | None) -> PosedImages:
    """Return the views over a colour, or over a sky full of detail if there is none."""
    random = np.random.default_rng(0)
    images = []
    for image in views.images:
        sky = random.integers(0, 255, image.shape, np.uint8) if colour is None else np.array([*colour, 255])
        images.append(
            np.where(image[..., 3:] > 0, image, sky).astype(np.uint8) | np.array([0, 0, 0, 255], np.uint8)
        )
    return PosedImages(views.cameras, images)


def test_the_kind_of_scene_is_seen_and_can_be_overruled():
    train, test = demo_views(24, 10, 2)
    assert not build_scene(Capture("alpha", train, test)).unbounded
    for colour in ([0, 0, 0], [51, 102, 204], [255, 255, 255]):
        scene = build_scene(Capture("plain", opaque(train, colour), opaque(test, colour)))
        assert not scene.unbounded and scene.background == pytest.approx([level / 255 for level in colour])
    assert build_scene(Capture("alpha", opaque(train, [0, 0, 0]), test), "unbounded").background == WHITE
    around = Capture("around", opaque(train, None), opaque(test, None))
    assert build_scene(around).unbounded and build_scene(around, "object").background == WHITE
    assert not build_scene(around, "object").unbounded
    assert build_scene(Capture("alpha", train, test), "unbounded").unbounded


def test_an_object_whose_pictures_show_its_surroundings_is_told_of():
    """Its pictures have to be transparent, masked or of one colour around it."""
    train, test = demo_views(24, 10, 2)
    around = opaque(train, None)
    for views, masked, kind, n_lines in (
        (around, False, "object", 1),
        (around, False, "auto", 0),
        (train, True, "object", 0),
        (opaque(train, [51, 102, 204]), False, "object", 0),
        (train, False, "object", 0),
    ):
        said: list[str] = []
        build_scene(Capture("a", views, test, masked=masked), kind, said.append)
        assert len(said) == n_lines and all("trained in front of white" in text for text in said)


@pytest.mark.parametrize("colour", [None, [51, 102, 204]])
def test_masked_borders_say_nothing_of_the_background(colour: list[int] | None):
    """What is masked may have any colour, and is black once pictures have been made smaller. The background
    is the colour of the other pixels of the borders, if these are at least half of all."""
    train, test = demo_views(24, 10, 2)
    views = opaque(train, colour)
    for image in views.images:
        image[:10] = 0
    scene = build_scene(Capture("a", views, test, masked=True))
    assert scene.unbounded == (colour is None)
    assert scene.background == (WHITE if colour is None else pytest.approx([0.2, 0.4, 0.8]))
    for image in views.images:
        image[:2] = image[-2:] = image[:, :2] = image[:, -2:] = 0
    assert build_scene(Capture("a", views, test, masked=True)).unbounded


def test_a_dark_photograph_has_no_plain_background():
    """The border of pictures by night is within a few levels of black, and that of rendered ones is black."""
    train, test = demo_views(24, 10, 2)
    random = np.random.default_rng(0)
    for brightest, unbounded in ((0, False), (6, True)):
        dark = opaque(train, [0, 0, 0])
        for image in dark.images:
            noise = random.integers(0, brightest + 1, image[..., :3].shape, np.uint8)
            image[..., :3] = np.maximum(image[..., :3], noise)
        assert build_scene(Capture("dark", dark, test)).unbounded == unbounded
        assert max(build_scene(Capture("dark", dark, test), "object").background) < 0.03


def test_a_few_transparent_pixels_do_not_make_an_object():
    train, test = demo_views(24, 10, 2)
    around = opaque(train, None)
    for n_transparent, unbounded in ((1, True), (4, True), (5, False)):
        images = [image.copy() for image in around.images]
        for image in images[:n_transparent]:
            image[3, 4, 3] = 0
        capture = Capture("a", PosedImages(around.cameras, images), opaque(test, None))
        scene = build_scene(capture)
        assert scene.unbounded == scene.masked == unbounded != scene.has_alpha
        assert build_scene(capture, "object").has_alpha
    over_white = opaque(train, [255, 255, 255])
    over_white.images[0][3, 4, 3] = 0
    assert not build_scene(Capture("plain", over_white, test)).unbounded, "its border shows that it is one"


def test_pictures_that_are_transparent_everywhere_are_refused():
    train, test = demo_views(8, 4, 1)
    nothing = PosedImages(train.cameras, [image * np.array([1, 1, 1, 0], np.uint8) for image in train.images])
    with pytest.raises(
        DataError, match="a: training views: expected something to be seen, got pictures that"
    ):
        build_scene(Capture("a", nothing, test))
    one = PosedImages(train.cameras, [*nothing.images[:3], train.images[3]])
    assert build_scene(Capture("a", one, test)).has_alpha


def test_silhouettes_keep_no_picture_in_memory(monkeypatch: pytest.MonkeyPatch):
    """Pictures on the disk are read one by one, of which only the silhouettes are kept."""
    train, test = demo_views(8, 4, 1)
    bases = []

    def boxed(cameras: list[Camera], silhouettes: list[np.ndarray]) -> tuple[np.ndarray, float]:
        bases.extend(silhouette.base for silhouette in silhouettes)
        return scene_box(cameras, silhouettes)

    monkeypatch.setattr("vfr_bake.data.scene.scene_box", boxed)
    build_scene(Capture("a", train, test))
    assert bases == [None] * 4


def test_an_unbounded_scene_has_its_cameras_in_the_unit_ball():
    train, test = demo_views(24, 10, 2)
    scene = build_scene(Capture("a", train, test), "unbounded")
    distances = [np.linalg.norm(camera.c2w[:3, 3]) for camera in scene.train.cameras]
    assert 0.9 < max(distances) < 1.2
    assert scene.near == NEAR_CAMERA
    eye = train.cameras[0].c2w
    points = np.stack([eye[:3, 3] - eye[:3, 2] * depth for depth in (0.2, 0.3)])
    near = build_scene(Capture("a", train, test, points=points), "unbounded").near
    assert 0.05 < near * scene.world_from_model[0, 0] < 0.2  # half of the least depths, 0.2 and 0.3


@pytest.mark.parametrize("n_views", [3, 8, 10, 11, 30])
def test_one_camera_that_strayed_does_not_shrink_the_rest(n_views: int):
    train, test = demo_views(8, n_views, 1)
    unit = build_scene(Capture("a", train, test), "unbounded").world_from_model[0, 0]
    pose = train.cameras[0].c2w.copy()
    pose[:3, 3] += 50 * unit * pose[:3, 2]  # along its axis, so that it looks at the same point
    strayed = PosedImages([replace(train.cameras[0], c2w=pose), *train.cameras[1:]], train.images)
    found = build_scene(Capture("a", strayed, test), "unbounded").world_from_model[0, 0]
    assert 0.8 * unit < found < 1.25 * unit


def test_a_camera_that_is_twice_as_far_away_did_not_stray():
    train, test = demo_views(8, 3, 1)
    unit = build_scene(Capture("a", train, test), "unbounded").world_from_model[0, 0]
    pose = train.cameras[0].c2w.copy()
    pose[:3, 3] += unit * pose[:3, 2]
    views = PosedImages([replace(train.cameras[0], c2w=pose), *train.cameras[1:]], train.images)
    assert build_scene(Capture("a", views, test), "unbounded").world_from_model[0, 0] > 1.5 * unit


def test_three_cameras_at_the_centre_and_one_outside_have_a_ball():
    train, test = demo_views(8, 4, 1)
    poses = [np.eye(4) for _ in train.cameras]
    poses[0][2, 3] = 3.0
    for pose, angle in zip(poses[1:], (-0.7, 0.0, 0.7), strict=True):
        pose[0, 0] = pose[2, 2] = np.cos(angle)
        pose[0, 2], pose[2, 0] = np.sin(angle), -np.sin(angle)
    turned = [replace(camera, c2w=pose) for camera, pose in zip(train.cameras, poses, strict=True)]
    scene = build_scene(Capture("a", PosedImages(turned, train.images), test), "unbounded")
    assert max(np.linalg.norm(c.c2w[:3, 3]) for c in scene.train.cameras) < 10


def test_many_points_take_little_memory_and_tell_the_same():
    cameras = demo_cameras(8, 100)
    points = np.random.default_rng(0).uniform(-1, 1, (50_000, 3))
    depths = [(camera.c2w[:3, 3] - points) @ camera.c2w[:3, 2] for camera in cameras]
    expected = NEAR_SHARE * float(np.quantile(np.concatenate(depths), NEAR_QUANTILE)) / 50
    tracemalloc.start()
    found = _near(cameras, points, 50.0)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert found == pytest.approx(expected, rel=0.02) and 0 < expected < 4 * NEAR_CAMERA
    assert peak < 30e6, "all depths, of 8 bytes each, take 40 MB"


def test_views_from_one_place_tell_no_depth():
    train, test = demo_views(8, 4, 1)
    same = PosedImages([replace(c, c2w=train.cameras[0].c2w) for c in train.cameras], train.images)
    with pytest.raises(DataError, match="all 4 are taken from one place"):
        build_scene(Capture("a", same, test))


def test_parallel_views_still_have_a_frame():
    train, test = demo_views(8, 4, 1)
    cameras = []
    for index, camera in enumerate(train.cameras):
        c2w = np.eye(4)
        c2w[0, 3] = index
        cameras.append(replace(camera, c2w=c2w))
    scene = build_scene(Capture("a", PosedImages(cameras, train.images), test), "unbounded")
    assert np.isfinite(scene.world_from_model).all()
    assert max(np.linalg.norm(c.c2w[:3, 3]) for c in scene.train.cameras) < 2


def test_downscaled_pictures_show_the_same_through_the_same_lens():
    train, _ = demo_views(25, 3, 1)
    smaller = WorkingSize(downscale=2).of(train)
    camera, image = smaller.cameras[0], smaller.images[0]
    assert (camera.width, camera.height) == (12, 12) == image.shape[:2]
    assert camera.fx == train.cameras[0].fx / 2 and camera.cx == train.cameras[0].cx / 2
    block = train.images[0][4:6, 6:8].reshape(-1, 4).astype(float)
    alpha = block[:, 3].mean()
    rgb = (block[:, :3] * block[:, 3:]).sum(axis=0) / max(block[:, 3].sum(), 1)
    np.testing.assert_allclose(image[2, 3], [*rgb, alpha], atol=1)
    with pytest.raises(DataError, match="downscale: expected at most 25, got 26"):
        WorkingSize(downscale=26).of(train)
