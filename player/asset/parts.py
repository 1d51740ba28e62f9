"""The pyramids of an asset out of its parts, one part after another, within a budget of memory.

What a section holds is stated by the manifest: so many bricks and vertices of a level. That is compared with
the budget before a part is opened, and again when the bricks are known, of which the vertices are the
corners. No more than that is ever decoded, whatever a file holds.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from operator import itemgetter
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np

from player.asset.bricks import bricks_per_axis, with_corners
from player.asset.coder.lanes import Neighbours
from player.asset.folder import check_size, compare_sums
from player.asset.manifest import Manifest
from player.asset.pyramid import Bricks, Pyramid, PyramidValues, values_of
from player.asset.sections import Grid, Part, Section
from player.asset.structure import decode_structure
from player.asset.symbols import LevelRows, decode_level, level_rows
from player.errors import FormatError
from player.files.files import read_bytes
from player.files.memory import check_memory
from player.threads import default_threads

T = TypeVar("T")

LIMITS: dict[Grid, tuple[int, int]] = {"densities": (0, 255), "features": (-127, 127)}
"""The lowest and the highest code of a value."""
DTYPES: dict[Grid, type[np.generic]] = {"densities": np.uint8, "features": np.int8}


NONE = Bricks(np.zeros((0, 3), np.uint16), np.zeros((0, 8), np.uint64))
GRIDS: tuple[Grid, Grid] = ("densities", "features")
MAX_THREADS = 8
"""Sections that are decoded at a time at most: each takes memory of its own."""


class StoredSection(NamedTuple):
    """A section with its bytes."""

    section: Section
    data: bytes
    where: str
    """The file and the section, for messages."""


class PyramidReader:
    """One of the two pyramids, as far as its sections have been read.

    A level whose structure is not known has no bricks, and a symbol that is not known is 0.
    """

    def __init__(self, grid: Grid, manifest: Manifest) -> None:
        n_levels = manifest.n_levels[grid]
        self.n_channels = manifest.n_channels if grid == "features" else 1
        self._steps = manifest.feature_steps if grid == "features" else manifest.density_steps
        self._limits, self._dtype = LIMITS[grid], DTYPES[grid]
        self.pyramid = Pyramid(manifest.resolutions[grid], (NONE,) * n_levels)
        self._symbols = [np.zeros((0, self.n_channels), np.int16)] * n_levels

    def read_structure(self, stored: StoredSection) -> None:
        """Add a level. Raises FormatError: the section breaks the format."""
        section, data, where = stored
        level, levels = section.level, self.pyramid.levels
        coarser = levels[level + 1] if level + 1 < len(levels) else None
        n_cells = self.pyramid.cells_per_axis(level)
        bricks = decode_structure(data, n_cells, coarser, section.n_bricks, where)
        pyramid = self.pyramid.with_level(level, bricks)
        vertices = pyramid.vertices[level]
        if vertices.n != section.n_vertices:
            raise FormatError(f"{where}: n_vertices: expected {vertices.n}, got {section.n_vertices}")
        self.pyramid = pyramid

    def rows_of(self, level: int) -> LevelRows:
        """The rows of a level that is there; before its symbols are read, which it makes room for."""
        rows = level_rows(self.pyramid.vertices[level])
        if not len(self._symbols[level]):
            shape = (rows.neighbours.n, self.n_channels)
            self._symbols[level] = np.zeros(shape, np.int16, order="F")  # as they are decoded
        return rows

    def read_symbols(self, stored: StoredSection, rows: LevelRows) -> None:
        """Add symbols to a level; sections can be read at the same time. Raises FormatError: the section
        breaks the format."""
        section, data, where = stored
        own = LevelRows(Neighbours(rows.neighbours.rows), rows.classes)  # it keeps what belongs to a section
        found = decode_level(data, own, section.n_channels, where)
        self._symbols[section.level][:, section.first_channel : section.end_channel] = found

    def forget(self, section: Section) -> None:
        """Undo that a section was read, or that it was begun to be; the last one first."""
        if section.kind == "structure":
            self.pyramid = self.pyramid.with_level(section.level, NONE)
            self._symbols[section.level] = self._symbols[section.level][:0]
        else:
            self._symbols[section.level][:, section.first_channel : section.end_channel] = 0

    @property
    def n_symbol_bytes(self) -> int:
        """What the symbols of the levels that are there take."""
        n_vertices = sum(vertices.n for vertices in self.pyramid.vertices)
        return n_vertices * self.n_channels * np.dtype(np.int16).itemsize

    def values(self) -> PyramidValues:
        """What is known so far."""
        vertices = self.pyramid.vertices
        values = values_of(vertices, self._symbols, self._steps, self._limits, self._dtype)
        return PyramidValues(self.pyramid, tuple(values))


class Counts(NamedTuple):
    """How much there is in all levels of a pyramid, as far as it is known."""

    n_per_axis: int
    """Bricks along an axis of the finest level."""
    n_bricks: int
    n_vertex_bricks: int
    """Bricks of 8 x 8 x 8 vertices that have one."""
    n_vertices: int
    n_channels: int
    n_held: int = 0
    """Bricks that hold a cell with a stored corner, for features."""


def needed_bytes(n_packed: int, densities: Counts, features: Counts) -> int:
    """Most memory that is taken while `n_packed` bytes of parts become arrays and those a grid.

    Bytes a brick, a vertex, a cell of a table are those of the arrays in `player.asset` and of their
    temporaries; tests/player/asset/test_parts.py compares the sum with what numpy asks for.
    """
    d, f = densities, features
    decoding = n_packed + sum(
        6300 * grid.n_vertex_bricks + (30 + 5 * grid.n_channels) * grid.n_vertices for grid in (d, f)
    )
    kept = sum(
        70 * grid.n_bricks + 700 * grid.n_vertex_bricks + grid.n_channels * grid.n_vertices for grid in (d, f)
    )
    tables = sum(17 * (grid.n_per_axis + 1) ** 3 for grid in (d, f))
    densities_built = 2500 * d.n_bricks
    features_built = 800 * d.n_bricks + 2560 * f.n_bricks + 8 * f.n_vertices + 5200 * f.n_held
    return max(decoding, kept + tables + max(densities_built, features_built))


def _of_both(work: Callable[[Grid], T]) -> list[T]:
    """What `work` gives for the densities and for the features, at the same time."""
    with ThreadPoolExecutor(min(len(GRIDS), default_threads())) as pool:
        return list(pool.map(work, GRIDS))


class PartsReader:
    """The parts of an asset, read one after another."""

    def __init__(self, folder: Path, manifest: Manifest, allowed: int) -> None:
        """`allowed`: bytes of memory that may be taken."""
        self._folder, self._manifest, self._allowed = folder, manifest, allowed
        self._grids: dict[Grid, PyramidReader] = {
            "densities": PyramidReader("densities", manifest),
            "features": PyramidReader("features", manifest),
        }
        self.n_read = 0
        """Parts that have been read."""
        self._taken = 0
        """Bytes that the parts before took, which may still be shown."""

    def read(self, n_parts: int) -> None:
        """Read on until `n_parts` are read, or one cannot be. What was read before may still be shown: its
        memory counts.

        Raises FormatError, IntegrityError: a part is not there, or another one, or breaks the format; those
        before it are read. ConfigError: it takes more memory than is allowed.
        """
        parts = self._manifest.parts[self.n_read : n_parts]
        allowed = self._allowed - self._taken
        check_memory(self._stated_bytes(n_parts), allowed, str(self._folder))
        read: list[list[StoredSection]] = []
        error = None
        for part in parts:
            try:
                read.append(self._sections(part))
            except FormatError as found:
                error = found
                break
        n_whole, error = self._read_structures(read, error)
        self._forget(read[n_whole:])
        read = read[:n_whole]
        taken = self._exact_bytes(n_parts)
        if n_parts < len(self._manifest.parts):  # symbols are kept for the parts to come
            taken += sum(reader.n_symbol_bytes for reader in self._grids.values())
        check_memory(taken, allowed, str(self._folder))
        n_whole, error = self._read_symbols(read, error)
        self._forget(read[n_whole:])
        self.n_read += n_whole
        self._taken = taken
        if error is not None:
            raise error

    def _forget(self, read: Sequence[Sequence[StoredSection]]) -> None:
        """Undo what was read of parts, of which some sections may not have been begun."""
        for stored in reversed([stored for sections in read for stored in sections]):
            self._grids[stored.section.grid].forget(stored.section)

    def _read_structures(
        self, read: Sequence[Sequence[StoredSection]], error: FormatError | None
    ) -> tuple[int, FormatError | None]:
        """Decode the structures of parts, both pyramids' at the same time.

        Returns how many parts are whole, and what is wrong with the next: `error` if all of these are.
        """

        def of_grid(grid: Grid) -> tuple[int, FormatError | None]:
            reader = self._grids[grid]
            for number, sections in enumerate(read):
                try:
                    for stored in sections:
                        if stored.section.grid == grid and stored.section.kind == "structure":
                            reader.read_structure(stored)
                    if grid == "features" and not reader.pyramid.levels[-1].masks.any():
                        file = self._folder / self._manifest.parts[self.n_read + number].file
                        raise FormatError(  # every sample is given one
                            f"{file}: expected a live cell of the features, got none"
                        )
                except FormatError as found:
                    return number, found
            return len(read), error

        return min(_of_both(of_grid), key=itemgetter(0))

    def _read_symbols(
        self, read: Sequence[Sequence[StoredSection]], error: FormatError | None
    ) -> tuple[int, FormatError | None]:
        """Decode the symbols of parts, several sections at a time.

        Returns how many parts are whole, and what is wrong with the next: `error` if all of these are.
        """
        symbols = [
            (number, stored)
            for number, sections in enumerate(read)
            for stored in sections
            if stored.section.kind == "symbols"
        ]
        with ThreadPoolExecutor(min(MAX_THREADS, default_threads())) as pool:
            rows = {}
            for section in (stored.section for _, stored in symbols):
                if (section.grid, section.level) not in rows:
                    found = pool.submit(self._grids[section.grid].rows_of, section.level)
                    rows[section.grid, section.level] = found
            wait(rows.values())
            decoded = [
                pool.submit(
                    self._grids[stored.section.grid].read_symbols,
                    stored,
                    rows[stored.section.grid, stored.section.level].result(),
                )
                for _, stored in symbols
            ]
        for (number, _), done in zip(symbols, decoded, strict=True):
            try:
                done.result()
            except FormatError as found:
                return number, found
        return len(read), error

    def _sections(self, part: Part) -> list[StoredSection]:
        """The sections of a part, whose file is compared with its checksum."""
        path, entry = self._folder / part.file, self._manifest.files[part.file]
        check_size(self._folder, part.file, entry)
        data = read_bytes(path, "a part of an asset", entry.bytes, self._folder)
        compare_sums(path, entry, hashlib.sha256(data).hexdigest())
        first, found = 0, []
        for section in part.sections:
            end = first + section.bytes
            found.append(StoredSection(section, data[first:end], f"{path}: {section.name}"))
            first = end
        return found

    def values(self) -> list[PyramidValues]:
        """What is known of the densities and of the features so far."""
        return _of_both(lambda grid: self._grids[grid].values())

    def _stated_bytes(self, n_parts: int) -> int:
        """What the first parts will take by the numbers of the manifest: every brick has vertices."""
        stored = [section for part in self._manifest.parts[:n_parts] for section in part.sections]
        counts = []
        for grid in GRIDS:
            structures = [s for s in stored if s.grid == grid and s.kind == "structure"]
            n_bricks = sum(section.n_bricks for section in structures)
            n_vertices = sum(section.n_vertices for section in structures)
            n_channels = self._grids[grid].n_channels
            counts.append(Counts(self._n_per_axis(grid), n_bricks, n_bricks, n_vertices, n_channels))
        return needed_bytes(self._n_packed(n_parts), *counts)

    def _exact_bytes(self, n_parts: int) -> int:
        """What they take now that the bricks are known."""
        counts = []
        for grid in GRIDS:
            reader = self._grids[grid]
            pyramid, vertices = reader.pyramid, reader.pyramid.vertices
            n_held = 0
            if grid == "features":
                for level, some in enumerate(vertices):
                    n = bricks_per_axis(pyramid.cells_per_axis(level))
                    n_held += len(with_corners(some.bricks.coords, some.bricks.masks, n))
            counts.append(
                Counts(
                    self._n_per_axis(grid),
                    sum(len(bricks) for bricks in pyramid.levels),
                    sum(len(some.bricks) for some in vertices),
                    sum(some.n for some in vertices),
                    reader.n_channels,
                    n_held,
                )
            )
        return needed_bytes(self._n_packed(n_parts), *counts)

    def _n_packed(self, n_parts: int) -> int:
        return sum(part.bytes for part in self._manifest.parts[self.n_read : n_parts])

    def _n_per_axis(self, grid: Grid) -> int:
        return bricks_per_axis(self._manifest.resolutions[grid])
