"""The pyramids of an asset out of its parts, one part after another, within a budget of memory.

What a section holds is stated by the manifest: so many bricks and vertices of a level. That is compared with
the budget before a part is opened, and again when the bricks are known, of which the vertices are the
corners. No more than that is ever decoded, whatever a file holds.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from pathlib import Path
from typing import NamedTuple

import numpy as np

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

LIMITS: dict[Grid, tuple[int, int]] = {"densities": (0, 255), "features": (-127, 127)}
"""The lowest and the highest code of a value."""
DTYPES: dict[Grid, type[np.generic]] = {"densities": np.uint8, "features": np.int8}


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
        none = Bricks(np.zeros((0, 3), np.uint16), np.zeros((0, 8), np.uint64))
        self.n_channels = manifest.n_channels if grid == "features" else 1
        self._steps = manifest.feature_steps if grid == "features" else manifest.density_steps
        self._limits, self._dtype = LIMITS[grid], DTYPES[grid]
        self.pyramid = Pyramid(manifest.resolutions[grid], (none,) * n_levels)
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
            self._symbols[level] = np.zeros((rows.neighbours.n, self.n_channels), np.int16)
        return rows

    def read_symbols(self, stored: StoredSection, rows: LevelRows) -> None:
        """Add symbols to a level; sections can be read at the same time. Raises FormatError: the section
        breaks the format."""
        section, data, where = stored
        own = LevelRows(Neighbours(rows.neighbours.rows), rows.classes)  # it keeps what belongs to a section
        found = decode_level(data, own, section.n_channels, where)
        self._symbols[section.level][:, section.first_channel : section.end_channel] = found

    def forget(self, section: Section) -> None:
        """Make the symbols of a section 0 again."""
        self._symbols[section.level][:, section.first_channel : section.end_channel] = 0

    def values(self) -> PyramidValues:
        """What is known so far."""
        vertices = self.pyramid.vertices
        values = values_of(vertices, self._symbols, self._steps, self._limits, self._dtype)
        return PyramidValues(self.pyramid, tuple(values))


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

    def read(self, n_parts: int) -> None:
        """Read on until `n_parts` are read, or one cannot be.

        Raises FormatError, IntegrityError: a part is not there, or another one, or breaks the format; those
        before it are read. ConfigError: it takes more memory than is allowed.
        """
        parts = self._manifest.parts[self.n_read : n_parts]
        check_memory(self._stated_bytes(parts), self._allowed, str(self._folder))
        read: list[list[StoredSection]] = []
        error: FormatError | None = None
        try:
            for part in parts:
                sections = self._sections(part)
                for stored in sections:
                    if stored.section.kind == "structure":
                        self._grids[stored.section.grid].read_structure(stored)
                if not self._grids["features"].pyramid.levels[-1].masks.any():  # every sample is given one
                    raise FormatError(
                        f"{self._folder / part.file}: expected a live cell of the features, got none"
                    )
                read.append(sections)
        except FormatError as found:
            error = found
        check_memory(self._exact_bytes(parts), self._allowed, str(self._folder))
        n_good, broken = self._read_symbols(read)
        self.n_read += n_good
        if broken is not None or error is not None:
            raise broken or error  # type: ignore[misc]

    def _read_symbols(self, read: Sequence[Sequence[StoredSection]]) -> tuple[int, FormatError | None]:
        """Decode the symbols of parts, several sections at a time. Of the first section that breaks the
        format, and of all behind it, nothing is kept.

        Returns how many parts are whole, and what is wrong with the next.
        """
        symbols = [
            (number, stored)
            for number, sections in enumerate(read)
            for stored in sections
            if stored.section.kind == "symbols"
        ]
        with ThreadPoolExecutor(min(MAX_THREADS, os.cpu_count() or 1)) as pool:
            levels = {(stored.section.grid, stored.section.level) for _, stored in symbols}
            rows = {key: pool.submit(self._grids[key[0]].rows_of, key[1]) for key in sorted(levels)}
            wait(rows.values())
            decoded = [
                pool.submit(
                    self._grids[stored.section.grid].read_symbols,
                    stored,
                    rows[stored.section.grid, stored.section.level].result(),
                )
                for _, stored in symbols
            ]
        for index, ((number, _), done) in enumerate(zip(symbols, decoded, strict=True)):
            error = done.exception()
            if error is None:
                continue
            if not isinstance(error, FormatError):
                raise error
            for _, stored in symbols[index:]:
                self._grids[stored.section.grid].forget(stored.section)
            return number, error
        return len(read), None

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

    def values(self, grid: Grid) -> PyramidValues:
        """What is known of a pyramid so far."""
        return self._grids[grid].values()

    def _stated_bytes(self, parts: Sequence[Part]) -> int:
        return 0

    def _exact_bytes(self, parts: Sequence[Part]) -> int:
        return 0
