"""Which vertices of the two grids are stored; what is left out is empty."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest

from player.asset.bricks import unpack_vertices
from player.progress import silent
from vfr_bake.baking.cells import Resolutions, corners_of, occupied_cells, subdivided
from vfr_bake.baking.grids import (
    RAYS_DERIVED,
    _corners,
    evaluate_densities,
    head_sensitivity,
    latent_features,
    make_layout,
    unit_points,
)
from vfr_bake.kernels.latent_rows import PARTS
from vfr_bake.training.model_file import Model

COARSE = 40


@pytest.mark.parametrize(("n", "resolution"), [(4, 4), (4, 8), (5, 8), (7, 25), (8, 7)])
def test_a_finer_cell_belongs_to_the_cell_around_its_middle(n: int, resolution: int) -> None:
    cells = np.random.default_rng(n).random((n, n, n)) < 0.4
    fine = subdivided(cells, resolution)
    for index in np.ndindex(*fine.shape):
        middle = tuple(int((i + 0.5) / resolution * n) for i in index)
        assert fine[index] == cells[middle]


@pytest.mark.parametrize("resolution", [COARSE, 64, 100])
def test_densities_are_those_of_the_field_in_the_order_of_the_rows(model: Model, resolution: int) -> None:
    visible, step = occupied_cells(model, COARSE), model.occupancy.step
    layout = make_layout(visible, step, Resolutions(resolution, COARSE))
    assert (layout.densities.resolution, layout.features.resolution) == (resolution, COARSE)
    for vertices, cells in ((layout.densities, subdivided(visible, resolution)), (layout.features, visible)):
        assert len(vertices) == corners_of(cells).sum()
        assert corners_of(cells)[tuple(vertices.index.T)].all()
        assert (unpack_vertices(vertices.coords, vertices.masks) == vertices.index).all()
    codes = evaluate_densities(model, layout, silent)
    decoded = np.exp(layout.density_range[0] + np.diff(layout.density_range)[0] / 255 * codes) * step
    points = unit_points(layout.densities.index, resolution, contracted=False)
    wanted = np.exp(model.field.log_densities(points)) * step
    inside = (wanted > 2e-5) & (wanted < 20)
    np.testing.assert_allclose(decoded[inside], wanted[inside], rtol=0.031)  # half a code


def test_where_a_density_is_stored_there_are_features(model: Model) -> None:
    layout = make_layout(occupied_cells(model, COARSE), model.occupancy.step, Resolutions(64, COARSE))
    matrix = np.random.default_rng(0).normal(size=(3, model.field.config.n_channels))
    features = (latent_features(model, layout, matrix, silent) + 0.5) / PARTS  # they are rounded down
    points = unit_points(layout.features.index, COARSE, contracted=False)
    np.testing.assert_allclose(features, model.field.features(points) @ matrix.T, rtol=0, atol=0.51 / PARTS)
    stored, random = set(map(tuple, layout.features.index.tolist())), np.random.default_rng(0)
    places = layout.densities.index * (COARSE / 64)
    places += random.uniform(-0.3, 0.3, places.shape)
    low = np.clip(np.floor(places).astype(int), 0, COARSE - 1)
    found = np.stack(
        [[tuple(c) in stored for c in (low + corner).tolist()] for corner in np.ndindex(2, 2, 2)], axis=1
    )
    assert found.mean() > 7 / 8 and found.any(axis=1).all()


def test_vertices_are_put_in_order_slab_by_slab(monkeypatch: pytest.MonkeyPatch) -> None:
    """Vertices are sorted slab by slab: all at once, the 35 million of a room took 5 GB."""
    monkeypatch.setattr("vfr_bake.baking.grids.SIDE", 8)
    cells = np.random.default_rng(0).random((10, 10, 10)) < 0.6
    tracemalloc.start()
    try:
        vertices = _corners(cells, 110)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert len(vertices) > 700_000 and peak < 50 * len(vertices)
    assert (unpack_vertices(vertices.coords, vertices.masks) == vertices.index).all()
    monkeypatch.setattr("vfr_bake.baking.grids.SIDE", 64)
    for slabs, whole in zip(vars(vertices).values(), vars(_corners(cells, 110)).values(), strict=True):
        assert np.array_equal(slabs, whole)


def test_the_head_is_differentiated_at_a_few_rays_at_once(model: Model) -> None:
    random, n = np.random.default_rng(0), RAYS_DERIVED + 1000
    features = random.normal(size=(n, model.field.config.n_channels)).astype(np.float32)
    dirs = random.normal(size=(n, 3)).astype(np.float32)
    dirs /= np.linalg.norm(dirs, axis=1, keepdims=True)
    opacity = random.random(n).astype(np.float32)
    at_once: list[int] = []
    hook = model.field.head.register_forward_hook(lambda _, given, __: at_once.append(len(given[0])))
    together = head_sensitivity(model.field.head, features, dirs, opacity)
    hook.remove()
    assert at_once == [RAYS_DERIVED, 1000]
    parts = [
        len(features[part]) * head_sensitivity(model.field.head, features[part], dirs[part], opacity[part])
        for part in (slice(0, 500), slice(500, 4000), slice(4000, RAYS_DERIVED), slice(RAYS_DERIVED, n))
    ]
    np.testing.assert_allclose(together, sum(parts) / n, rtol=1e-3, atol=1e-6 * np.abs(together).max())
