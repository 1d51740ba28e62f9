"""Read the arrays of an asset of version 3 from its files, within a memory budget.

The memory of each step follows from what was read before, and is compared with the budget before the step is
taken. The manifest has the sizes of the files. The size of a file of coordinates gives the number of bricks,
each of which has a mask of 64 bytes. The set bits of the masks give the number of codes to unpack and of rows
of the grid to build. No more than that is ever unpacked, whatever a file holds.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from player.asset.bricks import bricks_per_axis, with_corners
from player.asset.check_bricks import check_inside, check_sorted
from player.asset.manifest import Manifest
from player.asset.parts import Counts, grid_bytes
from player.asset.pyramid import Bricks
from player.asset.single_level import VertexBricks
from player.asset.version_3.packing import unpack_codes, unpack_masks
from player.errors import FormatError
from player.files.files import read_bytes
from player.files.memory import check_memory

DENSITIES = ("brick_coords.npy", "brick_masks.bits", "density.codes")
FEATURES = ("feature_coords.npy", "feature_masks.bits", "features.codes")
"""The files of each grid: the coordinates of its bricks, their masks, and the codes."""

_HEADER = re.compile(
    rb"\x93NUMPY\x01\x00(..)"
    rb"\{'descr': '<u2', 'fortran_order': False, 'shape': \(([0-9]{1,9}), 3\), \} *\n",
    re.DOTALL,
)
_LONGEST_HEADER = 10 + 65535


def needed_bytes(n_packed: int, densities: Counts, features: Counts) -> int:
    """Return the most bytes of memory taken while `n_packed` bytes of files are unpacked into arrays and
    these are arranged in a grid. tests/player/asset/test_unpacking.py compares it with what numpy allocates.
    """
    n_bricks = densities.n_bricks + features.n_bricks
    n_codes = sum(grid.n_vertices * grid.n_channels for grid in (densities, features))
    unpacking = n_packed + 256 * n_bricks + 2 * n_codes
    return 70 * n_bricks + n_codes + max(unpacking, grid_bytes(densities, features))


def _most_packed(n_bytes: int) -> int:
    """Return a bound on the size of a zlib stream of `n_bytes`. Data that cannot be compressed takes about a
    thousandth more than its own size, and a few bytes take relatively more."""
    return n_bytes + n_bytes // 100 + 1000


class _Files:
    """The files of one of the two grids, which are read one after another. Each step returns as much as is
    then known of the grid's sizes."""

    def __init__(self, folder: Path, manifest: Manifest, names: tuple[str, str, str]) -> None:
        self._coords_path, self._masks_path, self._codes_path = (folder / name for name in names)
        self._n_bytes = manifest.files[names[0]].bytes
        self._of_features = names is FEATURES
        self._resolution = manifest.feature_resolution if self._of_features else manifest.resolution
        self._n_per_axis = bricks_per_axis(self._resolution)
        self._n_channels = manifest.n_channels if self._of_features else 1

    def check_size(self) -> Counts:
        """Raise FormatError if the file of coordinates is larger than that of any grid."""
        most = 6 * self._n_per_axis**3 + _LONGEST_HEADER
        if self._n_bytes > most:
            raise FormatError(
                f"{self._coords_path}: size: expected at most {most} bytes, got {self._n_bytes}"
            )
        return self._least(max(self._n_bytes - _LONGEST_HEADER, 0) // 6)

    def read_coords(self) -> Counts:
        self._coords = read_coords(_read(self._coords_path, self._n_bytes), str(self._coords_path))
        return self._least(len(self._coords))

    def _least(self, n_bricks: int) -> Counts:
        return Counts(self._n_per_axis, n_bricks, n_bricks, n_vertices=0, n_channels=0)

    def read_masks(self) -> Counts:
        coords, n = self._coords, len(self._coords)
        self._masks = masks = unpack_masks(
            _read(self._masks_path, _most_packed(64 * n)), n, str(self._masks_path)
        )
        check_sorted(coords, str(self._coords_path))
        check_inside(Bricks(coords, masks), self._resolution + 1, "vertices", str(self._coords_path))
        if self._of_features and not masks.any():  # every sample with weight needs a feature
            raise FormatError(f"{self._masks_path}: expected at least one stored vertex, got none")
        self._n_vertices = int(np.bitwise_count(masks).sum(dtype=np.int64))
        n_held = len(with_corners(coords, masks, self._n_per_axis)) if self._of_features else 0
        return Counts(self._n_per_axis, n, n, self._n_vertices, self._n_channels, n_held)

    def read_codes(self) -> VertexBricks:
        n, n_channels = self._n_vertices, self._n_channels
        data = _read(self._codes_path, _most_packed(n * n_channels))
        shape, dtype = ((n, n_channels), "i1") if self._of_features else ((n,), "u1")
        codes = unpack_codes(data, shape, dtype, str(self._codes_path))
        return VertexBricks(self._coords, self._masks, codes)


def _read(path: Path, most: int) -> bytes:
    return read_bytes(path, "an array", most, path.parent)


def read_arrays(folder: Path, manifest: Manifest, allowed: int) -> tuple[VertexBricks, VertexBricks]:
    """Read the densities and the features of an asset of version 3, in bricks of vertices as its files have
    them.

    `allowed`: bytes of memory that the asset may take.

    Raises FormatError: the files break the format. ConfigError: they take more memory than is allowed.
    """
    grids = [_Files(folder, manifest, names) for names in (DENSITIES, FEATURES)]

    def check(n_packed: int, counts: Iterable[Counts]) -> None:
        check_memory(needed_bytes(n_packed, *counts), allowed, str(folder))

    check(0, [grid.check_size() for grid in grids])
    n_packed = sum(manifest.files[name].bytes for name in (*DENSITIES, *FEATURES))
    check(n_packed, [grid.read_coords() for grid in grids])
    with ThreadPoolExecutor(len(grids)) as both:  # at the same time: unpacking releases the GIL
        check(n_packed, both.map(_Files.read_masks, grids))
        densities, features = both.map(_Files.read_codes, grids)
    return densities, features


def read_coords(data: bytes, where: str) -> np.ndarray:
    """Return the coordinates of bricks [n, 3] uint16 from a .npy file's bytes. Raises FormatError.

    The header must be exactly as numpy writes it. It is not read by numpy, which evaluates it as a Python
    literal.

    >>> import io
    >>> file = io.BytesIO()
    >>> np.save(file, np.array([[1, 2, 3]], np.uint16))
    >>> read_coords(file.getvalue(), "coords.npy").tolist()
    [[1, 2, 3]]
    """
    match = _HEADER.match(data)
    if match is None or match.end() != 10 + int.from_bytes(match[1], "little"):
        got = data[:10] if len(data) < 10 else data[10:90]
        raise FormatError(f"{where}: expected a numpy array of uint16 [n, 3] in C order, got {bytes(got)!r}")
    n_bricks, explained = int(match[2]), match.end() + 6 * int(match[2])
    if explained != len(data):
        raise FormatError(f"{where}: expected {explained} bytes as its header says, got {len(data)}")
    return np.frombuffer(data, "<u2", 3 * n_bricks, match.end()).reshape(-1, 3)
