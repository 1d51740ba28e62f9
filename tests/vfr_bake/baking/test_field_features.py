"""The field's own features, composed along rays without being stored."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from player.render import choose_march
from vfr_bake.baking.cells import Resolutions, occupied_cells
from vfr_bake.baking.distillation import FIELD_RAYS_AT_ONCE, with_field_features
from vfr_bake.baking.grids import evaluate_densities, make_layout, unit_points
from vfr_bake.training.model_file import Model


def quiet(done: int, of: int) -> None: ...


def test_they_are_those_of_a_grid_that_holds_them_all(model: Model, monkeypatch: pytest.MonkeyPatch) -> None:
    layout = make_layout(occupied_cells(model, 40), model.occupancy.step, Resolutions(64, 40))
    every = model.field.features(unit_points(layout.features.index, 40, contracted=False))
    grid = layout.grid(evaluate_densities(model, layout, quiet), np.zeros((len(every), 1), np.int16))
    rays_o, rays_d = model.model_cameras()[0].rays()
    march = choose_march("numba")[1].march
    wanted = march(replace(grid, features=every), rays_o, rays_d, 0)
    assert len(wanted.hits) > 100
    monkeypatch.setattr("vfr_bake.baking.distillation.FIELD_RAYS_AT_ONCE", len(wanted.hits) // 3)
    assert len(wanted.hits) // 3 < FIELD_RAYS_AT_ONCE, "in several parts"
    played = march(grid, rays_o, rays_d, 0)
    composed = with_field_features(model, layout, grid, rays_o, rays_d, played)
    assert np.array_equal(composed.hits, wanted.hits) and np.array_equal(composed.opacity, wanted.opacity)
    np.testing.assert_allclose(composed.features, wanted.features, rtol=0, atol=2e-4)
