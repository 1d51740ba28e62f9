"""The pyramids of an asset out of its parts, one part after another, within a budget of memory.

What a section holds is stated by the manifest: so many bricks and vertices of a level. That is compared with
the budget before a part is opened, and again when the bricks are known, of which the vertices are the
corners. No more than that is ever decoded, whatever a file holds.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

import numpy as np

from player.asset.check_bricks import check_level
from player.asset.folder import check_size, compare_sums
from player.asset.manifest import Manifest
from player.asset.pyramid import Bricks, Pyramid, PyramidValues, values_of
from player.asset.sections import Grid, Part, Section
from player.asset.standin import decode_structure
from player.asset.symbols import LevelRows, decode_level, level_rows
from player.errors import FormatError
from player.files.files import read_bytes
from player.files.memory import check_memory

LIMITS: dict[Grid, tuple[int, int]] = {"densities": (0, 255), "features": (-127, 127)}
"""The lowest and the highest code of a value."""
DTYPES: dict[Grid, type[np.generic]] = {"densities": np.uint8, "features": np.int8}


class StoredSection(NamedTuple):
    """A section with its bytes."""

    section: Section
    data: memoryview
    where: str
    """The file and the section, for messages."""


class PyramidReader:
    """One of the two pyramids, as far as its sections have been read.

    A level whose structure is not known has no bricks, and a symbol that is not known is 0.
    """

    def __init__(self, grid: Grid, manifest: Manifest) -> None:
        n_levels = manifest.n_levels[grid]
        none = Bricks(np.zeros((0, 3), np.uint16), np.zeros((0, 8), np.uint64))
        self._n_channels = manifest.n_channels if grid == "features" else 1
        self._steps = manifest.feature_steps if grid == "features" else manifest.density_steps
        self._limits, self._dtype = LIMITS[grid], DTYPES[grid]
        self.pyramid = Pyramid(manifest.resolutions[grid], (none,) * n_levels)
        self._rows: dict[int, LevelRows] = {}
        self._symbols = [np.zeros((0, self._n_channels), np.int16)] * n_levels

    def read_structures(self, sections: Iterable[StoredSection]) -> None:
        """Add levels. Raises FormatError: a section breaks the format."""
        for section, data, where in sections:
            if section.kind == "structure":
                self._read_structure(section, data, where)

    def read_symbols(self, sections: Iterable[StoredSection]) -> None:
        """Add symbols of levels that are there. Raises FormatError: a section breaks the format."""
        for section, data, where in sections:
            if section.kind == "symbols":
                self._read_symbols(section, data, where)
        self._rows.clear()

    def _read_structure(self, section: Section, data: memoryview, where: str) -> None:
        level = section.level
        levels = self.pyramid.levels
        coarser = levels[level + 1] if level + 1 < len(levels) else None
        n_cells = self.pyramid.cells_per_axis(level)
        bricks = decode_structure(data, section.n_bricks, coarser, n_cells, where)
        check_level(bricks, coarser, n_cells, where)
        self.pyramid = self.pyramid.with_level(level, bricks)
        vertices = self.pyramid.vertices[level]
        if vertices.n != section.n_vertices:
            raise FormatError(f"{where}: n_vertices: expected {vertices.n}, got {section.n_vertices}")

    def _read_symbols(self, section: Section, data: memoryview, where: str) -> None:
        level = section.level
        if level not in self._rows:
            self._rows[level] = level_rows(self.pyramid.vertices[level])
        rows = self._rows[level]
        found = decode_level(data, rows, section.n_channels, where)
        if not len(self._symbols[level]):
            self._symbols[level] = np.zeros((rows.neighbours.n, self._n_channels), np.int16)
        self._symbols[level][:, section.first_channel : section.end_channel] = found

    def values(self) -> PyramidValues:
        """What is known so far."""
        values = values_of(self.pyramid.vertices, self._symbols, self._steps, self._limits)
        return PyramidValues(self.pyramid, tuple(level.astype(self._dtype) for level in values))


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

    def read(self) -> None:
        """Read the next part.

        Raises FormatError, IntegrityError: it is not there, or another one, or breaks the format; what has
        been read of it stays. ConfigError: it takes more memory than is allowed.
        """
        part = self._manifest.parts[self.n_read]
        data = memoryview(self._bytes(part))
        sections: dict[Grid, list[StoredSection]] = {"densities": [], "features": []}
        first = 0
        for section in part.sections:
            where = f"{self._folder / part.file}: {section.name}"
            stored = StoredSection(section, data[first : first + section.bytes], where)
            sections[section.grid].append(stored)
            first += section.bytes
        with ThreadPoolExecutor(1) as other:  # both at a time: what decodes leaves the interpreter to others
            densities, features = (self._grids[grid] for grid in ("densities", "features"))
            later = other.submit(features.read_structures, sections["features"])
            densities.read_structures(sections["densities"])
            later.result()
            self._check_memory()
            later = other.submit(features.read_symbols, sections["features"])
            densities.read_symbols(sections["densities"])
            later.result()
        if not self._grids["features"].pyramid.levels[-1].masks.any():  # every sample is given a feature
            raise FormatError(
                f"{self._folder / part.file}: expected at least one live cell of the features, got none"
            )
        self.n_read += 1

    def _check_memory(self) -> None:
        check_memory(0, self._allowed, str(self._folder))

    def _bytes(self, part: Part) -> bytes:
        """The content of the part's file, compared with its checksum."""
        path, entry = self._folder / part.file, self._manifest.files[part.file]
        check_size(self._folder, part.file, entry)
        data = read_bytes(path, "a part of an asset", entry.bytes, self._folder)
        compare_sums(path, entry, hashlib.sha256(data).hexdigest())
        return data

    def values(self, grid: Grid) -> PyramidValues:
        """What is known of a pyramid so far."""
        return self._grids[grid].values()
