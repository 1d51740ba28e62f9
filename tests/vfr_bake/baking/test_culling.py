"""Which cells are stored. What is left out is measured by its sum along rays, not sample by sample."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from player.asset.asset import Asset
from player.progress import silent
from vfr_bake.baking import cells
from vfr_bake.baking.bake import bake
from vfr_bake.baking.cells import (
    FLOORS,
    CulledCells,
    MarkingGrid,
    _shown,
    beside,
    close_gaps,
    cull,
    mark_rest,
    occupied_cells,
    rays_of_views,
)
from vfr_bake.baking.held_out import HeldOut, expected_loss
from vfr_bake.config import BakeConfig
from vfr_bake.kernels.density import LIMITS
from vfr_bake.rendering.render import head_colours
from vfr_bake.training.model_file import Model


def marked_cells(model: Model, resolution: int, floors: Sequence[float]) -> np.ndarray:
    """Return the marks [resolution, resolution, resolution, n_floors] of rays that are marched for them
    alone."""
    marking = MarkingGrid(model.occupancy, resolution, floors)
    mark_rest(model, marking, silent)
    return marking.marks


def culled(
    model: Model, resolution: int, held_out: HeldOut, floor: float | None, most_db: float
) -> CulledCells:
    """Return the stored cells by such marks."""
    floors = cells.FLOORS if floor is None else (floor,)
    return cull(model, marked_cells(model, resolution, floors), held_out, floor, most_db)


def stored(model: Model, resolution: int, floor: float) -> np.ndarray:
    """Return the cells that a floor keeps, [resolution, resolution, resolution] bool."""
    marks = marked_cells(model, resolution, (floor,))
    weighty = close_gaps(marks[..., 0].view(bool))
    return weighty | beside(weighty) & occupied_cells(model, resolution)


def fog(model: Model, logit: float) -> Model:
    """Return `model` with one thin density everywhere, seen by the same cameras; its colours stay."""
    from copy import deepcopy

    field = deepcopy(model.field)
    with torch.no_grad():
        field.density.out.weight.fill_(0)
        field.density.out.bias.fill_(logit)
    sampler = type(model.occupancy)(16, model.occupancy.step, seed=0)
    sampler.set_occupied(np.ones((16,) * 3, bool))
    return Model(field, sampler, model.world_from_model, model.cameras, True, {}, {})


def test_gaps_of_one_cell_are_closed_and_nothing_grows() -> None:
    cells = np.zeros((12, 12, 12), bool)
    cells[5:8, 2:10, 2:10] = True
    full = cells.copy()
    random = np.random.default_rng(0)
    for _ in range(6):  # single holes, some of them at the rim
        cells[6, random.integers(3, 9), random.integers(3, 9)] = False
    assert np.array_equal(close_gaps(cells), full)
    corner = np.zeros((4, 4, 4), bool)
    corner[0, 0, 0] = True
    assert np.array_equal(close_gaps(corner), corner)


def test_cells_beside_those_that_weigh_something_are_stored_where_matter_may_be(model: Model) -> None:
    """Cells beside those with weight are stored where matter may be, so that refinement leaves no holes."""
    held, floor = occupied_cells(model, 64), 0.1
    weighty = close_gaps(marked_cells(model, 64, (floor,))[..., 0].view(bool))
    visible = culled(model, 64, HeldOut(model, 1), floor, 0.0).visible
    assert visible[weighty].all() and not (visible & ~weighty & ~held).any()
    for x, y, z in np.argwhere(held & ~visible)[::97]:
        around = [weighty[max(x - 1, 0) : x + 2, y, z], weighty[x, max(y - 1, 0) : y + 2, z]]
        assert not np.concatenate([*around, weighty[x, y, max(z - 1, 0) : z + 2]]).any()
    assert (visible & ~weighty).sum() > 100 and (held & ~visible).sum() > 100


def test_larger_pictures_take_no_more_rays_and_all_together_not_too_many(
    model: Model, monkeypatch: pytest.MonkeyPatch
) -> None:
    n_rays = rays_of_views(model, 64)
    large = replace(model, cameras=[camera.resized(6400, 6400) for camera in model.cameras])
    assert rays_of_views(large, 64) == pytest.approx(n_rays)
    marched: list[int] = []
    monkeypatch.setattr(
        "vfr_bake.baking.cells.render_and_mark", lambda rays_o, *_: marched.append(len(rays_o))
    )
    for most in (n_rays + 1, n_rays / 3):
        monkeypatch.setattr("vfr_bake.baking.cells.MOST_MARKING", most)
        marched.clear()
        marked_cells(model, 64, (0.01,))
        assert sum(marched) == pytest.approx(min(n_rays, most), rel=0.1), "views between stand elsewhere"
        assert rays_of_views(model, 64) == min(n_rays, most)


def test_a_low_floor_marks_more(model: Model) -> None:
    floors = (0.2, 0.01, 0.001)
    together = marked_cells(model, 64, floors)
    assert 0 < together[..., 0].sum() < together[..., 1].sum() < together[..., 2].sum()
    alone = marked_cells(model, 64, floors[1:2])
    assert np.array_equal(together[..., 1], alone[..., 0])


def test_a_camera_in_the_middle_of_the_box_takes_no_rays_from_the_others(model: Model) -> None:
    """A camera in the middle seems to meet every cell by itself, but sees few of them."""
    model = replace(model, witnesses=None)
    c2w = model.model_cameras()[0].c2w.copy()
    c2w[:3, 3] = 0.01
    middle = replace(model.model_cameras()[0], c2w=c2w).transformed(model.world_from_model)
    more = replace(model, cameras=[*model.cameras, middle])
    assert rays_of_views(more, 64) > 0.9 * rays_of_views(model, 64)
    n, n_more = (int(marked_cells(each, 64, (0.01,)).sum()) for each in (model, more))
    assert n_more > 0.98 * n


def test_rays_that_are_rendered_for_another_purpose_mark_cells(
    model: Model, monkeypatch: pytest.MonkeyPatch
) -> None:
    marking, floors = MarkingGrid(model.occupancy, 64, (0.01,)), (0.01,)
    rays = [camera.rays() for camera in model.model_cameras()]
    for rays_o, rays_d in rays:
        both = marking.composited_features(model.field, rays_o, rays_d)
        alone = model.occupancy.composited_features(model.field, rays_o, rays_d)
        for found, wanted in zip(both, alone, strict=True):
            np.testing.assert_allclose(found, wanted, rtol=1e-4, atol=1e-5)
    assert marking.n_rays == sum(len(rays_o) for rays_o, _ in rays)
    seen = marking.marks.copy()
    mark_rest(model, marking, silent)
    assert marking.n_rays == pytest.approx(rays_of_views(model, 64), rel=0.1), "only those that are missing"
    assert seen.any() and (marking.marks >= seen).all()
    found, every = (
        close_gaps(m[..., 0].view(bool)) for m in (marking.marks, marked_cells(model, 64, floors))
    )
    assert (found & every).sum() > 0.97 * every.sum()
    n_rays = marking.n_rays
    monkeypatch.setattr(cells, "MOST_MARKING", n_rays)
    mark_rest(model, marking, silent)
    assert marking.n_rays == n_rays, "no more are wanted"


def volume(folder: Path) -> float:
    """Return the volume of the live cells of all levels, in cells of the finest level."""
    grid = Asset.open(folder).grid
    live = np.unpackbits(grid.live).reshape(-1, 512).sum(axis=1)
    return float((live * 8.0**grid.slot_levels).sum())


def test_without_culling_more_is_stored(model: Model, tmp_path: Path) -> None:
    small: dict[str, Any] = {
        "resolution": 48,
        "feature_resolution": 48,
        "mesh_resolution": 16,
        "refine_steps": 0,
        "check_views": 1,
    }
    less = bake(model, tmp_path / "a", BakeConfig(weight_floor=0.02, **small), silent)
    everything = bake(model, tmp_path / "b", BakeConfig(no_cull=True, **small), silent)
    assert volume(tmp_path / "b") > 1.15 * volume(tmp_path / "a")
    assert "cells" in less.figures["left_out"] and "cells" not in everything.figures["left_out"]


def test_what_a_floor_loses_is_what_pictures_without_its_cells_lose(
    model: Model, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The loss of a floor is that in a float64 sum over the model's samples, less those below the floor."""
    model = replace(model, witnesses=None)
    held_out, floor = HeldOut(model, 1), 0.1
    monkeypatch.setattr("vfr_bake.rendering.sampling.LIMITS", LIMITS._replace(opaque_depth=np.float32(1e9)))
    found = culled(model, 96, held_out, floor, 0.0)
    visible = stored(model, 96, floor)
    assert np.array_equal(found.visible, visible)

    def loss(cells: np.ndarray) -> float:
        samples = model.occupancy.sample_all(model.field, held_out.rays_o, held_out.rays_d)
        with torch.no_grad():
            sigmas = model.field.density(samples.features).double().numpy()
        index = np.minimum((samples.points.numpy() * 96).astype(int), 95)
        optical = sigmas * samples.deltas.numpy() * cells[tuple(index.T)]
        features = np.zeros((len(held_out.rays_o), samples.features.shape[1]), np.float32)
        opacity = np.zeros(len(features), np.float32)
        for ray, start, count in zip(samples.rays, samples.starts, samples.counts, strict=True):
            part = slice(int(start), int(start + count))
            before = np.cumsum(optical[part]) - optical[part]
            weights = np.exp(-before) * -np.expm1(-optical[part])
            features[ray] = weights @ samples.features[part].double().numpy()
            opacity[ray] = weights.sum()
        met = opacity > 0
        rgb = (1 - opacity[:, None]) * held_out.background
        rgb[met] += opacity[met, None] * head_colours(model.field.head, features[met], held_out.rays_d[met])
        return expected_loss(float(np.mean((rgb - held_out.wanted) ** 2)), 30.0)

    expected = loss(visible) - loss(occupied_cells(model, 96))
    assert expected > 0.05, "a floor this high loses something"
    # Closed gaps may lie where the model has no samples, and a march stops at 99.9 %.
    assert found.lost[floor] == pytest.approx(expected, rel=0.05)


def test_the_highest_floor_that_loses_little_is_taken(model: Model, monkeypatch: pytest.MonkeyPatch) -> None:
    floors = (0.6, 0.3, 0.1, 0.01)  # any of FLOORS would lose next to nothing in so small a model
    monkeypatch.setattr("vfr_bake.baking.cells.FLOORS", floors)
    held_out = HeldOut(replace(model, witnesses=None), 1)
    losses = {floor: culled(model, 64, held_out, floor, 0.0).lost[floor] for floor in floors}
    assert losses[0.6] > 0.1 > losses[0.01]
    for floor, loss in losses.items():
        allowed = loss + 0.001 * abs(loss) + 1e-9
        chosen = culled(model, 64, held_out, None, allowed)
        assert losses[chosen.floor] <= allowed and chosen.floor >= floor
        assert f"{chosen.floor:g}" in chosen.report()


def test_with_witnesses_a_floor_must_not_lose_more_even_by_chance(model: Model) -> None:
    """The first floor is taken whose loss is below the limit by more than its standard error."""
    held_out = HeldOut(model, 1)
    everything = culled(model, 64, held_out, None, -9.0)
    assert everything.floor == 0 and list(everything.lost) == list(FLOORS), "no floor gains 9 dB"
    every = _shown(model, held_out, occupied_cells(model, 64))
    loss = held_out.lost(every, _shown(model, held_out, stored(model, 64, FLOORS[0])))
    assert loss.spread and everything.lost[FLOORS[0]] == loss.db
    for most_db, taken in ((loss.most + 1e-6, True), (loss.most - 1e-6, False)):
        chosen = culled(model, 64, held_out, None, most_db)
        assert (chosen.floor == FLOORS[0]) == taken, "between the loss and one standard error above it"


def test_a_fog_is_stored_where_every_sample_weighs_little(model: Model, tmp_path: Path) -> None:
    """A fog is stored: each sample weighs less than any floor, but their sum along a ray is the picture."""
    thin = fog(model, -2)
    small: dict[str, Any] = {
        "resolution": 32,
        "feature_resolution": 32,
        "mesh_resolution": 16,
        "check_views": 1,
    }
    result = bake(thin, tmp_path / "asset", BakeConfig(preset="fidelity", refine_steps=0, **small), silent)
    assert result.figures["psnr_to_full_model"] > 35
    assert volume(tmp_path / "asset") > 0.99 * 32**3, "all but corners that no ray meets"
    assert result.figures["mesh_faces"] == 0, "an even fog has no surface"


def test_where_every_floor_loses_too_much_nothing_is_left_out(
    model: Model, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("vfr_bake.baking.cells.FLOORS", (0.9, 0.5))
    found = culled(model, 48, HeldOut(model, 1), None, 0.001)
    assert found.floor == 0 and found.report().startswith("none") and found.lost
    assert np.array_equal(found.visible, occupied_cells(model, 48))
