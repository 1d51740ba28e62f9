"""What a bake learns from: rays through photographs, and training rays made of teacher rays. Teacher rays
that meet nothing are left out, and it is an error if none is left."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from player.asset.asset import Asset
from player.cameras.views import asset_cameras
from player.errors import TrainingError
from player.progress import silent
from player.render import Renderer
from tests.numerics.fog import FEATURE, fog
from vfr_bake.baking import distillation
from vfr_bake.baking.bake import bake
from vfr_bake.baking.distillation import Keeping, TeacherRays, collect_training_rays, photographed_rays
from vfr_bake.baking.grids import latent
from vfr_bake.config import BakeConfig
from vfr_bake.data.view_pixels import ViewPixels
from vfr_bake.rendering.render import head_colours, render_image, render_rays
from vfr_bake.training.captures.picture_colours import PictureColours
from vfr_bake.training.model_file import Model
from vfr_bake.training.scores.metrics import over_background

ALONG, PAST = (-3.0, 0.1, 0.2), (-3.0, 5.0, 0.2)
"""Origins of rays along x: of rays that meet the box, and of rays that pass it."""
DARKER = 0.2
"""Factor of the photographs' colours here, relative to those that the model has learned."""


def darker(pixels: ViewPixels) -> np.ndarray:
    return (pixels.rgba * np.array([DARKER, DARKER, DARKER, 1])).astype(np.uint8)


def teacher_rays(origins: list[tuple[float, float, float]]) -> TeacherRays:
    n = len(origins)
    rays_d = np.tile(np.float32([1, 0, 0]), (n, 1))
    colours = np.arange(3 * n, dtype=np.float32).reshape(n, 3)
    return TeacherRays(np.float32(origins), rays_d, colours, np.full(n, 0.5, np.float32))


@pytest.mark.parametrize("n_rays", [1, 5])
def test_rays_that_meet_nothing_teach_nothing(n_rays: int) -> None:
    with pytest.raises(TrainingError, match="shows nothing in any training view: train longer"):
        collect_training_rays(teacher_rays([PAST] * n_rays), fog(0.1), 0)


@pytest.mark.parametrize("n_fetches", [0, 1, 4])
@pytest.mark.parametrize("at_once", [1, 2, 100])
def test_training_rays_are_those_that_meet_something(
    n_fetches: int, at_once: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Training rays are the teacher rays that meet something, in order, however many are marched at once. The
    fog's one feature composes to its own value times the opacity."""
    monkeypatch.setattr("vfr_bake.baking.distillation.RAYS_AT_ONCE", at_once)
    rays = teacher_rays([PAST, ALONG, PAST, PAST, ALONG, ALONG])
    grid = fog(0.1)
    training_rays = collect_training_rays(rays, grid, n_fetches)
    assert len(training_rays) == 3
    assert np.array_equal(training_rays.teacher.colours, rays.colours[[1, 4, 5]])
    fetches = training_rays.fetches(np.array([2, 0, 2, 1]))
    counts = np.diff(fetches.starts)
    assert len(counts) == 4 and ((counts == n_fetches).all() if n_fetches else (counts > 60).all())
    composed, opacity = training_rays.composed(latent(grid.features))
    np.testing.assert_allclose(composed[:, 0], FEATURE * opacity, rtol=1e-5)
    assert np.array_equal(fetches.opacity, opacity[[2, 0, 2, 1]])
    one = collect_training_rays(teacher_rays([ALONG]), grid, n_fetches)
    assert len(one) == 1 and np.array_equal(one.composed(latent(grid.features))[0], composed[:1])


@pytest.mark.parametrize("n_fetches", [0, 4])
def test_kept_fetches_are_those_that_are_found_anew(n_fetches: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Kept fetches give all rays the same fetches as new ones, in any order; too many are not kept."""
    monkeypatch.setattr("vfr_bake.baking.distillation.RAYS_AT_ONCE", 2)
    grid, rays = fog(0.1), teacher_rays([ALONG, (-0.5, 0.3, 0.2), PAST, ALONG])  # the second begins inside
    densities = None if n_fetches else grid.rows
    names = ["starts", "weights", "opacity"] if n_fetches else ["starts", "lengths"]
    collect = partial(collect_training_rays, rays, grid, n_fetches, densities)
    anew, kept, some = collect(), collect(Keeping(10**6, 1e9)), np.array([2, 0, 1, 1])
    assert anew.kept is None and kept.kept is not None
    assert np.array_equal(kept.teacher.rays_o, anew.teacher.rays_o)
    n = len(kept.kept.numbers)
    assert n == 12 if n_fetches else n > 3 * 60
    expected, found = anew.fetches(some), kept.fetches(some)
    for name in names:
        assert np.array_equal(getattr(found, name), getattr(expected, name))
    for name in ("features", "densities"):
        for a, b in zip(getattr(found, name), getattr(expected, name), strict=True):
            assert np.array_equal(a, b)
    few = collect(Keeping(16 * n - 1, 1e9))
    assert few.kept is None and len(few) == 3
    assert kept.some(2).kept is None


@pytest.mark.parametrize(("n_bytes", "seconds"), [(10**7, 49.0), (10**7, 51.0), (10**4, 1e9)])
def test_fetches_are_not_kept_where_that_takes_too_long_or_too_much(
    n_bytes: int, seconds: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whether 50 batches, each of which takes a second, are kept is judged after the first eight of them."""
    now = 0.0

    def player_fetches(*given: Any) -> Any:
        nonlocal now
        now += 1 if now else 100  # the first batch compiles code
        return found(*given)

    found = distillation.player_fetches
    monkeypatch.setattr(distillation, "RAYS_AT_ONCE", 1)
    monkeypatch.setattr(distillation, "time", SimpleNamespace(monotonic=lambda: now))
    monkeypatch.setattr(distillation, "player_fetches", player_fetches)
    rays = collect_training_rays(teacher_rays([ALONG] * 50), fog(0.1), 0, None, Keeping(n_bytes, seconds))
    assert (rays.kept is not None) == (seconds == 51) and len(rays) == 50
    assert now == 99 + (50 if seconds == 51 else 8)


def test_the_samples_of_all_rays_are_not_held(monkeypatch: pytest.MonkeyPatch) -> None:
    """Samples of all rays are not held at once: rays through fog have hundreds, more memory than the grid."""
    monkeypatch.setattr("vfr_bake.baking.distillation.RAYS_AT_ONCE", 100)
    monkeypatch.setattr("player.compiled.samples.MOST_AT_ONCE", 1)
    rays, grid = teacher_rays([ALONG] * 3000), fog(0.1)
    collect_training_rays(rays.some(100), grid, 0).composed(latent(grid.features))  # compiles
    tracemalloc.start()
    try:
        held = collect_training_rays(rays, grid, 0)
        composed, _ = held.composed(latent(grid.features))
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert len(composed) == 3000 and held.fetches(np.arange(10)).starts[-1] > 10 * 60
    assert peak < 3000 * 60 * 20, "20 bytes for each of more than 60 samples a ray"


def test_some_rays_are_spread_evenly() -> None:
    rays = teacher_rays([ALONG] * 10)
    assert rays.some(4).colours[:, 0].tolist() == [0, 6, 15, 21]
    assert rays.some(10) is rays and rays.some(99) is rays


def test_an_asset_shows_what_the_photographs_show(model: Model, tmp_path: Path) -> None:
    """An asset shows the photographs' colours, which are darker here than what the model has learned."""
    assert model.witnesses is not None and model.training_pixels is not None
    other = replace(
        model,
        witnesses=replace(model.witnesses, rgba=darker(model.witnesses)),
        training_pixels=replace(model.training_pixels, rgba=darker(model.training_pixels)),
    )
    config = BakeConfig(resolution=48, feature_resolution=32, mesh_resolution=16, refine_steps=200)
    result = bake(other, tmp_path / "asset", replace(config, check_views=1), lambda stage, done, of: None)
    # It gains 0.9 or 2.5 dB, by the number of threads that trained the model; of the former 0.2 dB without
    # learning from these photographs.
    assert result.loss.db < -0.5, "it shows less error than the model does"
    with Renderer(Asset.open(tmp_path / "asset")) as renderer:
        played = renderer.render(asset_cameras(renderer.asset)[0], background=(0.0, 0.0, 0.0)).rgb
    shown = render_image(model.field, model.sampler, model.model_cameras()[0], np.zeros(3))
    assert (1 + DARKER) / 2 - 0.1 < played.sum() / shown.sum() < 0.9, "their mean, and the model"


def test_photographed_rays_show_the_mean_of_photographs_and_model(model: Model) -> None:
    pixels = model.training_pixels
    assert pixels is not None
    rays = photographed_rays(model, 10**9, silent)
    shown = pixels.rgba / 255
    views, rows = pixels.views(), pixels.of_views()
    for view in (0, int(views[-1])):
        camera = model.cameras[view].transformed(np.linalg.inv(model.world_from_model))
        origins, directions = camera.rays_through(rows[view])
        features, opacity = model.sampler.composited_features(model.field, origins, directions)
        colours = head_colours(model.field.head, features, directions) * opacity[:, None]
        of_view = views == view
        np.testing.assert_allclose(rays.rays_o[of_view], origins, atol=1e-6)
        np.testing.assert_allclose(rays.rays_d[of_view], directions, atol=1e-6)
        np.testing.assert_allclose(rays.opacity[of_view], (opacity + shown[of_view, 3]) / 2, atol=1e-5)
        photographed = shown[of_view, :3] * shown[of_view, 3:]
        np.testing.assert_allclose(rays.colours[of_view], (colours + photographed) / 2, atol=1e-4)
    assert len(photographed_rays(model, 100, silent).opacity) == 100


def test_opaque_photographs_of_an_object_do_not_make_its_background_opaque(model: Model) -> None:
    pixels = model.training_pixels
    assert pixels is not None
    over_white = over_background(pixels.rgba, np.ones(3))
    rgba = np.full_like(pixels.rgba, 255)
    rgba[:, :3] = (255 * over_white).round()
    opaque = replace(model, has_alpha=False, training_pixels=replace(pixels, rgba=rgba))
    rays = photographed_rays(opaque, 10**9, silent)
    colours, opacity = render_rays(model.field, model.sampler, rays.rays_o, rays.rays_d)
    np.testing.assert_array_equal(rays.opacity, opacity)
    assert ((rays.colours >= 0) & (rays.colours <= opacity[:, None])).all()
    empty = opacity == 0
    assert empty.any() and (rays.colours[empty] == 0).all()
    behind = 1 - opacity[:, None]
    photographed = rgba[:, :3] / 255 - behind
    possible = ((photographed >= 0) & (photographed <= opacity[:, None])).all(axis=1) & (opacity > 0.5)
    assert possible.sum() > 1000
    np.testing.assert_allclose(
        (rays.colours + behind)[possible], (colours + behind + rgba[:, :3] / 255)[possible] / 2, atol=1e-5
    )


def test_photographs_of_another_exposure_show_what_the_field_has(model: Model) -> None:
    assert model.training_pixels is not None
    n = len(model.training_pixels.counts)
    exposure = PictureColours(np.full((n, 3), 0.5, np.float32), np.zeros((n, 3), np.float32))
    dim = replace(
        model.training_pixels, rgba=(model.training_pixels.rgba * [0.5, 0.5, 0.5, 1]).astype(np.uint8)
    )
    rays, expected = (
        photographed_rays(replace(model, training_pixels=dim, exposure=exposure), 10**9, silent),
        photographed_rays(model, 10**9, silent),
    )
    np.testing.assert_allclose(rays.colours, expected.colours, atol=2.01 / 255)


def test_a_model_without_training_pixels_has_no_photographed_rays(model: Model) -> None:
    assert len(photographed_rays(replace(model, training_pixels=None), 100, silent).opacity) == 0
