"""Read the pyramids of an asset from its parts, one part after another, within a memory budget.

The manifest states how many bricks and vertices each section holds. The memory that these take is compared
with the budget before a part is opened, and again, more exactly, once the live cells are known, whose corners
are the vertices. No more than that is ever decoded, whatever a file holds.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from operator import itemgetter
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np

from player.asset.bricks import bricks_per_axis, with_corners
from player.asset.folder import read_checked
from player.asset.manifest import NAME, Manifest
from player.asset.pyramid import NO_BRICKS, Pyramid, PyramidValues, values_of
from player.asset.sections import Grid, Part, Section
from player.asset.structure import decode_structure
from player.asset.symbols import LevelRows, decode_level, level_rows
from player.errors import FormatError
from player.files.memory import check_memory
from player.threads import default_threads

T = TypeVar("T")

LIMITS: dict[Grid, tuple[int, int]] = {"densities": (0, 255), "features": (-127, 127)}
"""The lowest and the highest code of each grid."""
DTYPES: dict[Grid, type[np.generic]] = {"densities": np.uint8, "features": np.int8}
GRIDS: tuple[Grid, Grid] = ("densities", "features")
MAX_THREADS = 8
"""The most sections that are decoded at a time: each takes memory of its own."""


class StoredSection(NamedTuple):
    """A section with its bytes."""

    section: Section
    data: bytes
    where: str
    """Names the file and the section in error messages."""


class PyramidReader:
    """One of the two pyramids, as far as its sections have been read.

    A level whose structure has not been read has no bricks, and a symbol that has not been read is 0.
    """

    def __init__(self, grid: Grid, manifest: Manifest) -> None:
        n_levels = manifest.n_levels[grid]
        self.n_channels = manifest.n_channels if grid == "features" else 1
        self._steps = manifest.feature_steps if grid == "features" else manifest.density_steps
        self._limits, self._dtype = LIMITS[grid], DTYPES[grid]
        self.pyramid = Pyramid(manifest.resolutions[grid], (NO_BRICKS,) * n_levels)
        self._symbols = [np.zeros((0, self.n_channels), np.int16)] * n_levels

    def read_structure(self, stored: StoredSection) -> None:
        """Decode a structure and add its level. Raises FormatError: the section breaks the format."""
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
        """Return the rows of a level whose structure has been read, and make room for its symbols; must be
        called before the symbols are read."""
        rows = level_rows(self.pyramid.vertices[level])
        if not len(self._symbols[level]):
            shape = (rows.neighbours.n, self.n_channels)
            self._symbols[level] = np.zeros(shape, np.int16, order="F")  # they are decoded by channel
        return rows

    def read_symbols(self, stored: StoredSection, rows: LevelRows) -> None:
        """Decode symbols and add them to their level; threads may do so for several sections at a time.

        Raises FormatError: the section breaks the format.
        """
        section, data, where = stored
        found = decode_level(data, rows, section.n_channels, where)
        self._symbols[section.level][:, section.first_channel : section.end_channel] = found

    def forget(self, section: Section) -> None:
        """Undo that a section was read or begun. The section added last must be forgotten first."""
        if section.kind == "structure":
            self.pyramid = self.pyramid.with_level(section.level, NO_BRICKS)
            self._symbols[section.level] = self._symbols[section.level][:0]
        else:
            self._symbols[section.level][:, section.first_channel : section.end_channel] = 0

    @property
    def n_symbol_bytes(self) -> int:
        """The most bytes that the symbols of the levels read so far can take."""
        n_vertices = sum(vertices.n for vertices in self.pyramid.vertices)
        return n_vertices * self.n_channels * np.dtype(np.int16).itemsize

    def values(self) -> PyramidValues:
        """Return the values that follow from the sections read so far."""
        vertices = self.pyramid.vertices
        values = values_of(vertices, self._symbols, self._steps, self._limits, self._dtype)
        return PyramidValues(self.pyramid, tuple(values))


class Counts(NamedTuple):
    """The sizes of a pyramid, summed over its levels, as far as they are known."""

    n_per_axis: int
    """Bricks along an axis of the finest level."""
    n_bricks: int
    n_vertex_bricks: int
    """Bricks of 8 x 8 x 8 vertices that have at least one vertex."""
    n_vertices: int
    n_channels: int
    n_held: int = 0
    """Bricks that hold a cell with a stored corner; counted for features only."""


def needed_bytes(n_packed: int, densities: Counts, features: Counts) -> int:
    """Return the most bytes of memory taken while `n_packed` bytes of parts are decoded into arrays and these
    are arranged in a grid.

    The bytes for each brick, vertex and table entry are those of the arrays in `player.asset` and of their
    temporaries. tests/player/asset/test_parts.py compares the sum with what numpy allocates.
    """
    d, f = densities, features
    decoding = n_packed + sum(
        6300 * grid.n_vertex_bricks + (30 + 5 * grid.n_channels) * grid.n_vertices for grid in (d, f)
    )
    kept = sum(
        70 * grid.n_bricks + 700 * grid.n_vertex_bricks + grid.n_channels * grid.n_vertices for grid in (d, f)
    )
    return max(decoding, kept + grid_bytes(d, f))


def grid_bytes(densities: Counts, features: Counts) -> int:
    """Return the most bytes that the tables of a grid and the temporaries of its building take."""
    d, f = densities, features
    tables = sum(17 * (grid.n_per_axis + 1) ** 3 for grid in (d, f))
    densities_built = 2500 * d.n_bricks
    features_built = 800 * d.n_bricks + 2560 * f.n_bricks + 8 * f.n_vertices + 5200 * f.n_held
    return tables + max(densities_built, features_built)


def _of_both(work: Callable[[Grid], T]) -> list[T]:
    """Return the results of `work` for the densities and for the features, computed at the same time."""
    with ThreadPoolExecutor(min(len(GRIDS), default_threads())) as pool:
        return list(pool.map(work, GRIDS))


class PartsReader:
    """The parts of an asset, read one after another."""

    def __init__(self, folder: Path, manifest: Manifest, allowed: int) -> None:
        """`allowed`: bytes of memory that may be taken."""
        self._folder, self._manifest, self._allowed = folder, manifest, allowed
        self._grids = {grid: PyramidReader(grid, manifest) for grid in GRIDS}
        self._parts: list[Part] = []
        """The parts that can be decoded one after another."""
        self._not_in_order: FormatError | None = None
        """Why no more of them can."""
        try:
            for part in manifest.parts_in_order(str(folder / NAME)):
                self._parts.append(part)
        except FormatError as error:
            self._not_in_order = error
        self.n_read = 0
        """Parts that have been read."""
        self._taken = 0
        """Bytes that the parts read before take; their picture may still be shown."""

    def read(self, n_parts: int) -> None:
        """Read further parts until `n_parts` are read, or one cannot be. The memory of the parts read before
        is counted too, because their picture may still be shown.

        Raises FormatError, IntegrityError: a part is missing, changed, not in its place or breaks the format;
        the parts before it have been read. ConfigError: the parts take more memory than is allowed.
        """
        parts = self._parts[self.n_read : n_parts]
        allowed = self._allowed - self._taken
        check_memory(self._stated_bytes(n_parts), allowed, str(self._folder))
        read: list[list[StoredSection]] = []
        error = self._not_in_order if n_parts > len(self._parts) else None
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
        """Undo the reading of parts; some of their sections may not have been begun."""
        for stored in reversed([stored for sections in read for stored in sections]):
            self._grids[stored.section.grid].forget(stored.section)

    def _read_structures(
        self, read: Sequence[Sequence[StoredSection]], error: FormatError | None
    ) -> tuple[int, FormatError | None]:
        """Decode the structures of parts, for both pyramids at the same time.

        Returns the number of parts before the first broken one, and that one's error. If none is broken, this
        is the number of all parts, and `error`.
        """

        def of_grid(grid: Grid) -> tuple[int, FormatError | None]:
            reader = self._grids[grid]
            for number, sections in enumerate(read):
                try:
                    for stored in sections:
                        if stored.section.grid == grid and stored.section.kind == "structure":
                            reader.read_structure(stored)
                    if grid == "features" and not reader.pyramid.levels[-1].masks.any():
                        file = self._folder / self._parts[self.n_read + number].file
                        raise FormatError(  # every sample with weight needs a feature
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

        Returns the number of parts before the first broken one, and its error, as `_read_structures`.
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
        """Read the sections of a part, and compare its file with the checksum."""
        path = self._folder / part.file
        data = read_checked(self._folder, part.file, self._manifest.files[part.file])
        first, found = 0, []
        for section in part.sections:
            end = first + section.bytes
            found.append(StoredSection(section, data[first:end], f"{path}: {section.name}"))
            first = end
        return found

    def values(self) -> list[PyramidValues]:
        """Return the values of the densities and of the features that follow from the parts read so far."""
        return _of_both(lambda grid: self._grids[grid].values())

    def _stated_bytes(self, n_parts: int) -> int:
        """Return the bytes that the first parts will take at least, by the numbers in the manifest; each
        brick of cells has at least one brick of vertices."""
        stored = [section for part in self._parts[:n_parts] for section in part.sections]
        counts = []
        for grid in GRIDS:
            structures = [s for s in stored if s.grid == grid and s.kind == "structure"]
            n_bricks = sum(section.n_bricks for section in structures)
            n_vertices = sum(section.n_vertices for section in structures)
            n_channels = self._grids[grid].n_channels
            counts.append(Counts(self._n_per_axis(grid), n_bricks, n_bricks, n_vertices, n_channels))
        return needed_bytes(self._n_packed(n_parts), *counts)

    def _exact_bytes(self, n_parts: int) -> int:
        """Return the bytes that the first parts take, now that their bricks are known."""
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
        return sum(part.bytes for part in self._parts[self.n_read : n_parts])

    def _n_per_axis(self, grid: Grid) -> int:
        return bricks_per_axis(self._manifest.resolutions[grid])
