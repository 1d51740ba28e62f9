"""Training rays out of teacher rays: those that meet nothing are left out, and none at all is an error."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest

from player.errors import TrainingError
from tests.numerics.fog import FEATURE, fog
from vfr_bake.baking.distillation import TeacherRays, collect_training_rays
from vfr_bake.baking.grids import latent

ALONG, PAST = (-3.0, 0.1, 0.2), (-3.0, 5.0, 0.2)
"""Where rays along x begin that meet the box, and that pass it."""


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
    """In their order, however many rays are looked at together; the fog's one feature composes to its own
    value times the opacity."""
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


def test_the_samples_of_all_rays_are_not_held(monkeypatch: pytest.MonkeyPatch) -> None:
    """Rays through fog have hundreds: theirs would take more memory than the grid."""
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
