"""Which test views can be scored: those of the scene that was trained on, in which something is seen."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from player.errors import DataError
from tests.vfr_bake.training.captures.altered import settings
from vfr_bake.data.demo import demo_scene
from vfr_bake.data.scene import Scene
from vfr_bake.data.store.capture import PosedImages
from vfr_bake.evaluation import quick_psnr, render_views
from vfr_bake.training.model_file import Model, trained_model
from vfr_bake.training.scores.views import Learned, check_cameras, scored_views, seen_views
from vfr_bake.training.trainer import Trainer


@pytest.fixture(scope="module")
def scene() -> Scene:
    return demo_scene(size=24, n_train=12, n_test=5)


@pytest.fixture(scope="module")
def model(scene: Scene) -> Model:
    """A model that has not learned anything."""
    return trained_model(Trainer(scene, settings()), scene, {})


def learned(scene: Scene) -> Learned:
    cameras = [camera.transformed(scene.world_from_model) for camera in scene.train.cameras]
    return Learned("model.pt", cameras, scene.world_from_model)


def changed(scene: Scene, number: int, **changes: object) -> Scene:
    """Return the scene with another camera of one training view."""
    cameras = list(scene.train.cameras)
    cameras[number] = replace(cameras[number], **changes)  # type: ignore[arg-type]
    return replace(scene, train=PosedImages(cameras, scene.train.images))


def moved(scene: Scene, distance: float, number: int = 3) -> Scene:
    c2w = scene.train.cameras[number].c2w.copy()
    c2w[0, 3] += distance
    return changed(scene, number, c2w=c2w)


def turned(scene: Scene) -> Scene:
    c2w = scene.train.cameras[0].c2w.copy()
    c2w[:3, 0], c2w[:3, 1] = c2w[:3, 1].copy(), -c2w[:3, 0]
    return changed(scene, 0, c2w=c2w)


def masked(views: PosedImages, *numbers: int, columns: slice = slice(None)) -> PosedImages:
    images = [np.array(image) for image in views.images]
    for image in images:
        image[..., 3] = 255
    for number in numbers:
        images[number][:, columns, 3] = 0
    return PosedImages(views.cameras, images)


def test_the_cameras_of_the_training_are_accepted(scene: Scene) -> None:
    views, lines = scored_views(scene, "demo", False, [learned(scene)])
    assert lines == [] and [camera.name for camera in views.cameras] == [c.name for c in scene.test.cameras]
    world = scene.test.cameras[0].transformed(scene.world_from_model)
    assert np.allclose(views.cameras[0].c2w, world.c2w)
    check_cameras(moved(scene, 1e-4), "demo", learned(scene))
    smaller = demo_scene(size=12, n_train=12, n_test=5)
    check_cameras(smaller, "demo", learned(scene))
    other = learned(scene)
    renamed = other._replace(cameras=[replace(c, name=f"other/{c.name}") for c in other.cameras])
    check_cameras(moved(scene, 5.0), "demo", renamed)


@pytest.mark.parametrize(
    "change",
    [
        lambda scene: moved(scene, 0.01),
        turned,
        lambda scene: changed(scene, 3, fx=1.1 * scene.train.cameras[3].fx),
        lambda scene: replace(scene, world_from_model=2 * np.diag([1, 1, 1, 0.5]) @ scene.world_from_model),
    ],
    ids=["moved", "turned", "zoomed", "another world"],
)
def test_other_cameras_are_refused(change, scene: Scene) -> None:
    with pytest.raises(DataError, match=r"^demo: cameras: expected those that model\.pt was trained with"):
        scored_views(change(scene), "demo", False, [learned(scene)])


def test_test_views_that_were_trained_on_are_told_of(scene: Scene) -> None:
    known = replace(scene, test=scene.train.some(range(2)))
    views, lines = scored_views(known, "demo", False, [learned(scene)])
    assert len(views.cameras) == 2 and len(lines) == 1
    assert re.match(r"warning: 2 of 2 test views were trained on \(\S+, \S+\): ", lines[0])


def test_views_that_are_masked_are_left_out(scene: Scene, model: Model) -> None:
    """A view of which nothing is seen would have no error at all, and make the mean PSNR infinite."""
    names = [camera.name for camera in scene.test.cameras]
    test = masked(scene.test, 0, 2)
    hidden = replace(scene, test=test, masked=True)
    views, lines = scored_views(hidden, "demo", False, [])
    assert [camera.name for camera in views.cameras] == [names[i] for i in (1, 3, 4)]
    assert lines == [f"test views that are masked, and so not scored: 2 ({names[0]}, {names[2]})"]
    assert len(seen_views(test, False, False)[0].cameras) == 5
    scores, told = quick_psnr(model, hidden, 10, np.inf, lambda *_: None)
    assert len(scores) == 3 and max(scores) < 60 and told == lines
    with pytest.raises(DataError, match="in which something is seen, got 5 that are masked"):
        scored_views(replace(hidden, test=masked(scene.test, *range(5))), "demo", False, [])
    assert quick_psnr(model, replace(hidden, test=masked(scene.test, *range(5))), 3, 0.0, print)[0] == []


@pytest.mark.parametrize("columns", [slice(0, 12), slice(12, None)])
def test_an_exposure_needs_both_halves(columns: slice, scene: Scene) -> None:
    test = masked(scene.test, 1, columns=columns)
    assert [len(seen_views(test, True, exposure)[0].cameras) for exposure in (False, True)] == [5, 4]


def test_as_many_views_are_scored_as_there_is_time_for(scene: Scene, model: Model) -> None:
    told = []
    (first,), lines = quick_psnr(model, scene, 3, -1.0, lambda *counts: told.append(counts))
    assert told == [(1, 3)] and len(lines) == 1 and lines[0].startswith("scored 1 of 3 test views, because ")
    every = [view.score().psnr for view in render_views(model, scene.test)]
    assert first == every[0]
    assert quick_psnr(model, scene, 3, np.inf, print) == ([every[i] for i in (0, 4, 2)], [])
