"""Tests of pyramids against their definition, evaluated cell by cell, and of the field where levels meet."""

import itertools

import numpy as np
import pytest

from player.asset.bricks import pack_vertices, unpack_vertices
from player.asset.pyramid import (
    Bricks,
    Pyramid,
    predicted,
    symbols_of,
    values_of,
    whole_pyramid,
)

RESOLUTION = 50  # no multiple of a brick's 8 cells
CORNERS = list(itertools.product((0, 1), repeat=3))

Cell = tuple[int, ...]


def bricks(cells: set[Cell]) -> Bricks:
    coords, masks, _ = pack_vertices(np.array(sorted(cells)).reshape(-1, 3))
    return Bricks(coords, masks)


def cells_of(some: Bricks) -> set[Cell]:
    return set(map(tuple, unpack_vertices(some.coords, some.masks).tolist()))


def blob(random: np.random.Generator, n_cells: int, size: int, middle: np.ndarray) -> set[Cell]:
    """Return random cells around the place `middle`, which is 0..1 along each axis."""
    spread = np.rint(random.normal(0, size, (2000, 3)) + middle * n_cells).astype(int)
    return set(map(tuple, np.clip(spread, 0, n_cells - 1).tolist()))


@pytest.fixture(params=range(6), name="pyramid")
def some_pyramid(request) -> Pyramid:
    random = np.random.default_rng(request.param)
    n_levels = 1 + request.param % 4
    leaves = []
    here, there = random.uniform(size=(2, 3))
    for level in range(n_levels):
        n_cells = -(-RESOLUTION // 2**level)
        leaves.append(bricks(blob(random, n_cells, 3 + 3 * level, here) | blob(random, n_cells, 2, there)))
    return whole_pyramid(RESOLUTION, leaves)


class Reading:
    """The definition of a pyramid, evaluated cell by cell."""

    def __init__(self, pyramid: Pyramid) -> None:
        self._live = [cells_of(some) for some in pyramid.levels]
        self._bricks = [set(map(tuple, some.coords.tolist())) for some in pyramid.levels]

    def owner(self, level: int, cell: Cell) -> tuple[int, bool] | None:
        """Return the level from which a cell of `level` is read if finer levels are left out, and whether it
        is live; None if no level has a brick there."""
        for n in range(level, len(self._live)):
            at = tuple(c >> (n - level) for c in cell)
            if tuple(c >> 3 for c in at) in self._bricks[n]:
                return n, at in self._live[n]
        return None


def test_a_pyramid_is_whole(pyramid):
    for fine, coarse in itertools.pairwise(pyramid.levels):
        assert {tuple(c >> 1 for c in cell) for cell in cells_of(fine)} <= cells_of(coarse)
        octants = set(map(tuple, fine.coords.tolist()))
        children = {tuple(c >> 1 for c in cell) for cell in cells_of(fine)}
        for cell in cells_of(coarse):
            if tuple(c >> 2 for c in cell) in octants:
                assert cell in children


def test_what_the_leaves_show_is_shown():
    fine, coarse = {(0, 0, 0), (1, 9, 3)}, {(0, 0, 0), (7, 7, 7), (12, 3, 4)}
    pyramid = whole_pyramid(RESOLUTION, [bricks(fine), bricks(coarse)])
    assert cells_of(pyramid.levels[0]) == fine
    # (0, 0, 0) and (0, 4, 1) hold a finer cell; nothing finer is near the others
    assert cells_of(pyramid.levels[1]) == {(0, 0, 0), (0, 4, 1), (7, 7, 7), (12, 3, 4)}


def test_vertices_and_borders_are_those_of_the_definition(pyramid):
    reading = Reading(pyramid)
    for level, some in enumerate(pyramid.levels):
        vertices = pyramid.vertices[level]
        corners = {tuple(np.add(cell, c).tolist()) for cell in cells_of(some) for c in CORNERS}
        assert list(map(tuple, vertices.index.tolist())) == sorted(
            corners, key=lambda v: ([c >> 3 for c in v], [c & 7 for c in v])
        )
        n_cells = pyramid.cells_per_axis(level)
        for vertex, border in zip(vertices.index.tolist(), vertices.on_border, strict=True):
            expected = False
            for c in CORNERS:
                cell = tuple(np.subtract(vertex, c).tolist())
                if all(0 <= x < -(-n_cells // 8) * 8 for x in cell):
                    found = reading.owner(level, cell)
                    expected |= found is not None and found[0] > level and found[1]
            assert border == expected
        assert vertices.rows(vertices.index).tolist() == list(range(vertices.n))
        assert (vertices.rows(np.array([[-1, 0, 0], [500, 0, 0]])) == -1).all()


def values_at(pyramid: Pyramid, vertices, values, level: int, cell: Cell, place: np.ndarray) -> float:
    """Interpolate the value at a place of the box (in finest cells) within a cell of `level`."""
    fraction = place / 2**level - cell
    total = 0.0
    for c in CORNERS:
        row = vertices[level].rows(np.array([np.add(cell, c)]))[0]
        assert row >= 0
        total += np.prod(np.where(c, fraction, 1 - fraction)) * values[level][row, 0]
    return total


def test_the_field_is_continuous_where_levels_meet(pyramid):
    random = np.random.default_rng(7)
    vertices = pyramid.vertices
    symbols = [random.integers(-20, 20, (int((~v.on_border).sum()), 1)) for v in vertices]
    values = values_of(vertices, symbols, [3] * len(vertices), (-127, 127))
    met, reading = 0, Reading(pyramid)
    for level, some in enumerate(pyramid.levels[:-1]):
        for cell in sorted(cells_of(some)):
            for axis in [axis for axis in range(3) if cell[axis] & 7 == 7]:
                beside = tuple(np.add(cell, np.eye(3, dtype=int)[axis]).tolist())
                found = reading.owner(level, beside)
                if found is None or found[0] == level or not found[1]:
                    continue
                place = (np.array(cell) + random.uniform(size=3)) * 2**level
                place[axis] = beside[axis] * 2**level
                other = tuple(c >> (found[0] - level) for c in beside)
                here = values_at(pyramid, vertices, values, level, cell, place)
                there = values_at(pyramid, vertices, values, found[0], other, place)
                assert abs(here - there) <= 0.5 * (found[0] - level)  # each level rounds a code once
                met += 1
    assert met or len(vertices) == 1


def test_a_ramp_needs_no_symbols_on_finer_levels(pyramid):
    vertices = pyramid.vertices
    wanted = [(v.index @ [1, 2, -1])[:, None] * 2**level for level, v in enumerate(vertices)]
    symbols = symbols_of(vertices, wanted, [1] * len(vertices), (-1000, 1000))
    values = values_of(vertices, symbols, [1] * len(vertices), (-1000, 1000))
    assert all(np.array_equal(*both) for both in zip(values, wanted, strict=True))
    assert not any(some.any() for some in symbols[:-1])


def test_symbols_and_values_undo_each_other(pyramid):
    random = np.random.default_rng(3)
    vertices = pyramid.vertices
    wanted = [random.uniform(-150, 150, (v.n, 3)) for v in vertices]
    steps = [1, 4, 2, 8][: len(vertices)]
    symbols = symbols_of(vertices, wanted, steps, (-127, 127))
    values = values_of(vertices, symbols, steps, (-127, 127))
    for v, step, some, found in zip(vertices, steps, wanted, values, strict=True):
        stored = ~v.on_border
        assert np.abs(np.clip(some, -127, 127)[stored] - found[stored]).max(initial=0) <= step / 2


def test_predictions_are_means_of_the_coarser_corners(pyramid):
    random = np.random.default_rng(4)
    for level in range(len(pyramid.levels) - 1):
        fine, coarse = pyramid.vertices[level], pyramid.vertices[level + 1]
        values = random.integers(-127, 128, (coarse.n, 2)).astype(np.int16)
        found = predicted(fine, coarse, values)
        for row in random.choice(fine.n, 50):
            total = np.zeros(2, int)
            for up in CORNERS:
                at = (fine.index[row] + np.array(up)) >> 1
                total += values[coarse.rows(at[None])[0]]
            assert found[row].tolist() == ((total + 4) >> 3).tolist()
