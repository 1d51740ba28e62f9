"""Tests of bricks and cells of pyramids as bytes, and of what a level stores at its vertices."""

from __future__ import annotations

import struct
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from player.asset.bricks import pack_vertices, stored_bits, unpack_vertices
from player.asset.coder import coder
from player.asset.coder.lanes import Neighbours
from player.asset.pyramid import Bricks, Pyramid, coarser, whole_pyramid
from player.asset.structure import (
    MUST,
    N_CLASSES,
    _Children,
    _octants,
    _parents,
    decode_structure,
    encode_structure,
)
from player.asset.symbols import N_CLASSES as N_PARITIES
from player.asset.symbols import decode_level, encode_level, level_rows
from player.errors import FormatError, ShapeError
from tests.player.asset.coder.oracle import Oracle


def bricks_of(cells: np.ndarray) -> Bricks:
    coords, masks, _ = pack_vertices(cells)
    return Bricks(coords, masks)


def sphere(resolution: int, radius: float, n_levels: int) -> Pyramid:
    """Return a pyramid of a spherical shell that gets finer along x; its levels end at brick borders."""
    leaves = []
    for level in range(n_levels):
        n = -(-resolution // (1 << level))
        cells = np.argwhere(np.ones((n, n, n), bool))
        away = np.linalg.norm((cells + 0.5) / n * 2 - 1, axis=1)
        cells = cells[np.abs(away - radius) < 2.0 / n + 0.02]
        where = (cells >> 3) * (8 << level) / resolution
        low, high = 1 - (level + 1) / n_levels, 1 - level / n_levels
        leaves.append(bricks_of(cells[(where[:, 0] >= low - 0.2 * level) & (where[:, 0] < high + 0.1)]))
    return whole_pyramid(resolution, leaves)


PYRAMIDS = {
    "one cell": Pyramid(1, (bricks_of(np.array([[0, 0, 0]])),)),
    "a corner": Pyramid(9, (bricks_of(np.array([[8, 8, 8]])),)),
    "full": Pyramid(16, (bricks_of(np.argwhere(np.ones((16,) * 3))),)),
    "a level without bricks": Pyramid(
        32, (bricks_of(np.zeros((0, 3), int)), bricks_of(np.array([[3, 4, 5], [9, 9, 9]])))
    ),
    "a shell of one level": sphere(50, 0.7, 1),
    "a shell of three": sphere(75, 0.7, 3),
}


def decoded(pyramid: Pyramid, packed: list[bytes]) -> list[Bricks]:
    found: list[Bricks] = []
    for level in reversed(range(len(packed))):
        parent = found[-1] if found else None
        n = len(pyramid.levels[level])
        found.append(decode_structure(packed[level], pyramid.cells_per_axis(level), parent, n, "here"))
    return found[::-1]


def test_the_shell_has_bricks_on_each_level() -> None:
    assert all(len(bricks) > 8 for bricks in PYRAMIDS["a shell of three"].levels)


@pytest.mark.parametrize("name", PYRAMIDS)
def test_structure_is_what_it_was(name: str) -> None:
    pyramid = PYRAMIDS[name]
    packed = [encode_structure(pyramid, level) for level in range(len(pyramid.levels))]
    for found, level in zip(decoded(pyramid, packed), pyramid.levels, strict=True):
        assert np.array_equal(found.coords, level.coords) and found.coords.dtype == np.uint16
        assert np.array_equal(found.masks, level.masks) and found.masks.dtype == np.uint64


@given(st.integers(2, 40), st.floats(0.001, 0.9), st.integers(0, 100), st.integers(1, 3))
@settings(max_examples=30, deadline=None)
def test_any_structure(resolution: int, share: float, seed: int, n_levels: int) -> None:
    random = np.random.default_rng(seed)
    cells = random.integers(0, resolution, (max(int(share * resolution**3), 1), 3))
    levels = [bricks_of(np.unique(cells, axis=0))]
    for _ in range(n_levels - 1):
        levels.append(coarser(levels[-1]))
    pyramid = Pyramid(resolution, tuple(levels))
    packed = [encode_structure(pyramid, level) for level in range(n_levels)]
    for found, level in zip(decoded(pyramid, packed), levels, strict=True):
        assert np.array_equal(found.coords, level.coords) and np.array_equal(found.masks, level.masks)


def test_structure_takes_few_bytes() -> None:
    """A structure takes less than 2.5 bits per live cell of the coarser level, which has eight children."""
    cells = np.argwhere(np.ones((120,) * 3))
    away = np.linalg.norm((cells + 0.5) / 60 - 1, axis=1)
    fine = bricks_of(cells[np.abs(away - 0.7) < 0.03])
    pyramid = Pyramid(120, (fine, coarser(fine)))
    n_parents = int(stored_bits(pyramid.levels[1].masks).sum())
    assert n_parents > 5000
    assert 8 * len(encode_structure(pyramid, 0)) < 2.5 * n_parents


def test_classes_count_what_is_known() -> None:
    """Classes count the neighbours that are known to be live or dead, as a search in a dense array does."""
    pyramid = PYRAMIDS["a shell of three"]
    fine, coarse = pyramid.levels[0], pyramid.levels[1]
    octants = _octants(coarse)
    refined = fine.find(octants.coords) >= 0
    parents = _parents(octants, refined)
    n = pyramid.cells_per_axis(1)
    dense = np.full((2 * n + 34,) * 3, 0, int)  # 0 dead, 1 live, 2 not known yet
    for coords, live, is_refined in zip(octants.coords, octants.live, refined, strict=True):
        for local in np.argwhere(live):
            x, y, z = 8 * coords + 2 * local + 1
            dense[x : x + 2, y : y + 2, z : z + 2] = 2 if is_refined else 1
    position = octants.coords[refined][parents.octant] * 4
    position = position + np.stack([parents.local >> 4, (parents.local >> 2) & 3, parents.local & 3], axis=-1)
    known = _Children(parents)
    random = np.random.default_rng(0)
    for child in range(8):
        at = 2 * position + [child >> 2, (child >> 1) & 1, child & 1] + 1
        expected = []
        for x, y, z in at.tolist():
            faces = [int(dense[x + dx, y + dy, z + dz]) for dx, dy, dz in FACES]
            expected.append(7 * faces.count(1) + faces.count(0))
        if child == 7:
            for row, (x, y, z) in enumerate(at.tolist()):
                if not (dense[x - 1 : x + 1, y - 1 : y + 1, z - 1 : z + 1] == 1).any():
                    expected[row] = MUST
        found = known.classes(child)
        assert found.tolist() == expected and found.max() < N_CLASSES
        live = random.random(len(at)) < 0.3
        known.tell(child, live)
        dense[tuple(at.T)] = live


FACES = [(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)]


def oracle_bricks(pyramid: Pyramid, level: int, data: bytes) -> set[tuple[int, ...]]:
    """Decode the live cells of a level one symbol at a time, by the text of `docs/format.md`."""
    parts, at = [], 0
    while at < len(data):
        (length,) = struct.unpack_from("<I", data, at)
        parts.append(data[at + 4 : at + 4 + length])
        at += 4 + length
    if level + 1 < len(pyramid.levels):
        live = cells_of(pyramid.levels[level + 1])
        octants = sorted({tuple(i >> 2 for i in cell) for cell in live})
        flags = oracle_section(parts[0], octants, 1, 1, lambda *_: 0)[0]
        bricks = [octant for octant, flag in zip(octants, flags, strict=True) if flag]
        return oracle_children(parts[1], live, bricks)
    live = {(0, 0, 0)}
    for part in parts:
        live = oracle_children(part, live, sorted({tuple(i >> 2 for i in cell) for cell in live}))
    return live


def cells_of(bricks: Bricks) -> set[tuple[int, ...]]:
    return set(map(tuple, unpack_vertices(bricks.coords, bricks.masks).tolist()))


def oracle_section(
    data: bytes, places: list, n_channels: int, n_classes: int, of: Callable[[int, tuple, list], int]
) -> list[list[int]]:
    """Decode the channels of a section whose rows are at `places`.

    `of` gives a symbol's class from the channel, the place, and the channels decoded so far.
    """
    number = {place: row for row, place in enumerate(places)}
    rows = [[number.get((x, y, z - 1), -1) for x, y, z in places]]
    rows += [[number.get((x, y - 1, z), -1) for x, y, z in places]]
    rows += [[number.get((x - 1, y, z), -1) for x, y, z in places]]
    read = Oracle(data, Neighbours(np.array(rows, np.int32)), n_channels, n_classes)
    found: list[list[int]] = []
    for channel in range(n_channels):
        found.append(read.channel(channel, [of(channel, place, found) for place in places]))
    assert not read.words and not read.beyond and set(read.states) == {65536}
    return found


def oracle_children(data: bytes, live: set, bricks: list) -> set[tuple[int, ...]]:
    """Decode the live children of the live cells in octants that have a brick."""
    refined = set(bricks)
    parents = [cell for cell in live if tuple(i >> 2 for i in cell) in refined]
    parents.sort(key=lambda cell: (tuple(i >> 2 for i in cell), tuple(i & 3 for i in cell)))
    number = {place: row for row, place in enumerate(parents)}

    def status(cell: tuple[int, ...], found: list[list[int]]) -> int | None:
        x, y, z = cell
        parent, child = (x >> 1, y >> 1, z >> 1), 4 * (x & 1) + 2 * (y & 1) + (z & 1)
        if parent not in live:
            return 0
        if parent not in number:
            return 1
        return found[child][number[parent]] if child < len(found) else None

    def class_of(channel: int, place: tuple[int, ...], found: list[list[int]]) -> int:
        if channel == 7 and not any(found[other][number[place]] for other in range(7)):
            return 49
        x, y, z = (2 * i + (channel >> shift & 1) for i, shift in zip(place, (2, 1, 0), strict=True))
        known = [status((x + dx, y + dy, z + dz), found) for dx, dy, dz in FACES]
        return 7 * known.count(1) + known.count(0)

    flags = oracle_section(data, parents, 8, 50, class_of)
    return {
        tuple(2 * i + (child >> shift & 1) for i, shift in zip(parent, (2, 1, 0), strict=True))
        for child in range(8)
        for parent, flag in zip(parents, flags[child], strict=True)
        if flag
    }


@pytest.mark.parametrize("name", ["a corner", "a shell of three"])
def test_structure_is_as_it_is_specified(name: str) -> None:
    pyramid = PYRAMIDS[name]
    for level, bricks in enumerate(pyramid.levels):
        assert oracle_bricks(pyramid, level, encode_structure(pyramid, level)) == cells_of(bricks)


def test_what_is_no_pyramid_is_not_encoded() -> None:
    fine = bricks_of(np.array([[0, 0, 0]]))
    two = bricks_of(np.array([[0, 0, 0], [1, 0, 0]]))
    other = bricks_of(np.array([[20, 0, 0]]))
    none = bricks_of(np.zeros((0, 3), int))
    for levels in ((fine, two), (two, other), (bricks_of(np.array([[0, 0, 0], [2, 0, 0]])), fine)):
        with pytest.raises(ShapeError, match="a pyramid: expected"):
            encode_structure(Pyramid(64, levels), 0)
    with pytest.raises(ShapeError, match="a pyramid: expected a live cell"):
        encode_structure(Pyramid(64, (none,)), 0)


def test_another_number_of_bricks_is_refused() -> None:
    pyramid = PYRAMIDS["a shell of three"]
    for level, parent in ((2, None), (1, pyramid.levels[2])):
        data = encode_structure(pyramid, level)
        n = len(pyramid.levels[level])
        for other in (0, n - 1, n + 1):
            with pytest.raises(FormatError, match=f"here: expected {other} bricks"):
                decode_structure(data, pyramid.cells_per_axis(level), parent, other, "here")


def test_cells_outside_are_refused() -> None:
    pyramid = Pyramid(9, (bricks_of(np.array([[0, 0, 0], [8, 3, 0]])),))
    data = encode_structure(Pyramid(10, pyramid.levels), 0)
    assert len(decode_structure(data, 9, None, 2, "here")) == 2
    outside = encode_structure(Pyramid(10, (bricks_of(np.array([[0, 0, 0], [9, 3, 0]])),)), 0)
    with pytest.raises(FormatError, match="here: expected cells below 9, got one at 9"):
        decode_structure(outside, 9, None, 2, "here")


def test_symbols_of_another_kind_are_refused() -> None:
    """Intact sections with symbols other than 0 and 1, or with a parent without children, are refused."""
    parent = bricks_of(np.array([[0, 0, 0], [4, 0, 0]]))
    octants = _octants(parent)
    from player.asset.structure import _neighbours, _octant_rows

    def sections(refine: list[int], children: np.ndarray) -> bytes:
        parents = _parents(octants, np.array(refine) == 1)
        known, classes = _Children(parents), []
        for child in range(8):
            classes.append(known.classes(child))
            known.tell(child, children[:, child] == 1)
        parts = (
            coder.encode(np.array(refine)[:, None], *_octant_rows(octants)),
            coder.encode(children, _neighbours(parents), classes, N_CLASSES),
        )
        return b"".join(struct.pack("<I", len(part)) + part for part in parts)

    one = np.zeros((1, 8), np.int16)
    one[0, 2] = 1
    assert len(decode_structure(sections([1, 0], one), 20, parent, 1, "here")) == 1
    for refine, children, said in (
        ([1, 2], one, "bricks: expected 0 or 1"),
        ([1, -200], one, "bricks: expected 0 or 1"),
        ([1, 0], -one, "cells: expected 0 or 1"),
        ([1, 0], 100 * one, "cells: expected 0 or 1"),
        ([1, 0], 0 * one, "cells: expected a live child"),
    ):
        with pytest.raises(FormatError, match=f"here: {said}"):
            decode_structure(sections(refine, children), 20, parent, 1, "here")


SHELL = PYRAMIDS["a shell of three"]
PACKED = [encode_structure(SHELL, level) for level in range(3)]


@given(
    st.integers(0, 2),
    st.lists(st.tuples(st.floats(0, 1, exclude_max=True), st.integers(1, 255)), max_size=4),
    st.integers(0, 300),
    st.binary(max_size=10),
)
@settings(max_examples=150, deadline=None)
def test_broken_structure(level: int, changes: list[tuple[float, int]], cut: int, more: bytes) -> None:
    data = bytearray(PACKED[level])
    for at, by in changes:
        data[int(at * len(data))] ^= by
    data = bytes(data[: len(data) - cut] if cut < 100 else data) + more
    parent = SHELL.levels[level + 1] if level < 2 else None
    n = len(SHELL.levels[level])
    try:
        found = decode_structure(data, SHELL.cells_per_axis(level), parent, n, "here")
    except FormatError as error:
        assert str(error).startswith("here: ")
    else:
        assert np.array_equal(found.masks, SHELL.levels[level].masks)


# ------------------------------------------------------------------------------------------------- vertices


def test_rows_and_their_neighbours() -> None:
    for vertices in SHELL.vertices:
        rows = level_rows(vertices)
        index = vertices.index[~vertices.on_border]
        number = {tuple(place): row for row, place in enumerate(index.tolist())}
        for axis, found in zip((2, 1, 0), rows.neighbours.rows, strict=True):
            before = index - np.eye(3, dtype=int)[axis]
            assert found.tolist() == [number.get(tuple(place), -1) for place in before.tolist()]
        assert rows.classes.tolist() == (index & 1).sum(axis=1).tolist()
        assert rows.classes.max() < N_PARITIES
    assert SHELL.vertices[0].on_border.any()


@pytest.mark.parametrize("n_channels", [0, 1, 3])
def test_symbols_of_a_level(n_channels: int) -> None:
    random = np.random.default_rng(0)
    for vertices in SHELL.vertices:
        rows = level_rows(vertices)
        symbols = np.rint(random.laplace(0, 1, (rows.neighbours.n, n_channels))).astype(np.int16)
        data = encode_level(symbols, rows)
        assert np.array_equal(decode_level(data, rows, n_channels, "here"), symbols)
        if n_channels:
            with pytest.raises(FormatError, match="here: "):
                decode_level(data, rows, n_channels + 1, "here")
