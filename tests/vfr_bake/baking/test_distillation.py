"""Training rays out of teacher rays: those that meet nothing are left out, and none at all is an error."""

from __future__ import annotations

import numpy as np
import pytest

from player.errors import TrainingError
from tests.numerics.fog import FEATURE, fog
from vfr_bake.baking.distillation import TeacherRays, collect_training_rays

ALONG, PAST = (-3.0, 0.1, 0.2), (-3.0, 5.0, 0.2)
"""Where rays along x begin that meet the box, and that pass it."""


def teacher_rays(origins: list[tuple[float, float, float]]) -> TeacherRays:
    n = len(origins)
    rays_d = np.tile(np.float32([1, 0, 0]), (n, 1))
    colours = np.arange(3 * n, dtype=np.float32).reshape(n, 3)
    return TeacherRays(np.float32(origins), rays_d, colours, colours, np.full(n, 0.5, np.float32))


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
    assert len(training_rays) == 3 and np.array_equal(training_rays.colours, rays.colours[[1, 4, 5]])
    counts = np.diff(training_rays.starts)
    assert (counts == n_fetches).all() if n_fetches else (counts > 60).all()
    composed = training_rays.composed(grid.features.astype(np.float32))
    np.testing.assert_allclose(composed[:, 0], FEATURE * training_rays.opacity, rtol=1e-5)
    one = collect_training_rays(teacher_rays([ALONG]), grid, n_fetches)
    assert len(one) == 1 and np.array_equal(one.composed(grid.features.astype(np.float32)), composed[:1])
