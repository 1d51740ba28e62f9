"""Read the arrays of an asset of version 3 from its files, within a memory budget.

The memory of each step follows from what was read before, and is compared with the budget before the step is
taken. The manifest has the sizes of the files. The size of a file of coordinates gives the number of bricks,
each of which has a mask of 64 bytes. The set bits of the masks give the number of codes to unpack and of rows
of the grid to build. No more than that is ever unpacked, whatever a file holds.
"""

from __future__ import annotations

import re
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from player.asset.bricks import bricks_per_axis, with_corners
from player.asset.check_bricks import check_inside, check_sorted
from player.asset.manifest import Manifest
from player.asset.parts import Counts, grid_bytes
from player.asset.pyramid import Bricks, PyramidValues
from player.asset.single_level import VertexBricks, from_vertices
from player.asset.version_3.packing import unpack_codes, unpack_masks
from player.errors import FormatError
from player.files.files import read_bytes
from player.files.memory import check_memory

PLACES = {
    "brick_coords": "brick_coords.npy",
    "brick_masks": "brick_masks.bits",
    "density": "density.codes",
    "feature_coords": "feature_coords.npy",
    "feature_masks": "feature_masks.bits",
    "features": "features.codes",
}
"""The file of each array."""

Names = tuple[str, str, str]
DENSITIES: Names = ("brick_coords", "brick_masks", "density")
FEATURES: Names = ("feature_coords", "feature_masks", "features")

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


def _least(n_per_axis: int, n_bricks: int) -> Counts:
    """Return the counts of a grid of which only the number of bricks is known."""
    return Counts(n_per_axis, n_bricks, n_bricks, n_vertices=0, n_channels=0)


def _check_coords_files(folder: Path, manifest: Manifest, allowed: int) -> None:
    """Check the sizes of the files of coordinates before they are read.

    Raises FormatError: more bricks than a grid can have. ConfigError: the bricks take more memory than is
    allowed.
    """
    for names, n_per_axis in _per_axis(manifest):
        name, most = PLACES[names[0]], 6 * n_per_axis**3 + _LONGEST_HEADER
        if manifest.files[name].bytes > most:
            raise FormatError(
                f"{folder / name}: size: expected at most {most} bytes, got {manifest.files[name].bytes}"
            )
    least = [_least(n, _n_bricks(manifest, names)) for names, n in _per_axis(manifest)]
    check_memory(needed_bytes(0, *least), allowed, str(folder))


def _per_axis(manifest: Manifest) -> list[tuple[Names, int]]:
    return [
        (DENSITIES, bricks_per_axis(manifest.resolution)),
        (FEATURES, bricks_per_axis(manifest.feature_resolution)),
    ]


def _n_bricks(manifest: Manifest, names: Names) -> int:
    """Return the least number of bricks that a grid can have, by the size of the file of coordinates."""
    return max(manifest.files[PLACES[names[0]]].bytes - _LONGEST_HEADER, 0) // 6


def _most_packed(n_bytes: int) -> int:
    """Return a bound on the size of a zlib stream of `n_bytes`. Data that cannot be compressed takes about a
    thousandth more than its own size, and a few bytes take relatively more."""
    return n_bytes + n_bytes // 100 + 1000


def read_version_3(folder: Path, manifest: Manifest, allowed: int) -> tuple[PyramidValues, PyramidValues]:
    """Read the densities and the features of an asset of version 3 as pyramids of one level. Arguments and
    errors are those of `read_arrays`."""
    densities, features = read_arrays(folder, manifest, allowed)
    return (
        from_vertices(densities, manifest.resolution),
        from_vertices(features, manifest.feature_resolution),
    )


def read_arrays(folder: Path, manifest: Manifest, allowed: int) -> tuple[VertexBricks, VertexBricks]:
    """Read the densities and the features of an asset of version 3, in bricks of vertices as its files have
    them.

    `allowed`: bytes of memory that the asset may take.

    Raises FormatError: the files break the format. ConfigError: they take more memory than is allowed.
    """

    _check_coords_files(folder, manifest, allowed)

    def read(name: str, most: int) -> bytes:
        return read_bytes(folder / PLACES[name], "an array", most, folder)

    def masks(names: Names, coords: np.ndarray, n_per_axis: int) -> tuple[np.ndarray, Counts]:
        found = unpack_masks(
            read(names[1], _most_packed(64 * len(coords))), len(coords), str(folder / PLACES[names[1]])
        )
        of_features = names is FEATURES
        resolution = manifest.feature_resolution if of_features else manifest.resolution
        check_sorted(coords, str(folder / PLACES[names[0]]))
        check_inside(Bricks(coords, found), resolution + 1, "vertices", str(folder / PLACES[names[0]]))
        if of_features and not found.any():  # every sample with weight needs a feature
            raise FormatError(f"{folder / PLACES[names[1]]}: expected at least one stored vertex, got none")
        n_vertices = int(np.bitwise_count(found).sum(dtype=np.int64))
        n_held = len(with_corners(coords, found, n_per_axis)) if of_features else 0
        n_channels = manifest.n_channels if of_features else 1
        return found, Counts(n_per_axis, len(coords), len(coords), n_vertices, n_channels, n_held)

    def codes(names: Names, counts: Counts) -> np.ndarray:
        of_features = names is FEATURES
        shape = (counts.n_vertices, counts.n_channels) if of_features else (counts.n_vertices,)
        data = read(names[2], _most_packed(counts.n_vertices * counts.n_channels))
        return unpack_codes(data, shape, "i1" if of_features else "u1", str(folder / PLACES[names[2]]))

    (_, n_dense), (_, n_coarse) = _per_axis(manifest)
    coords, coarse = (
        read_coords(read(names[0], manifest.files[PLACES[names[0]]].bytes), str(folder / PLACES[names[0]]))
        for names in (DENSITIES, FEATURES)
    )
    n_packed = sum(manifest.files[name].bytes for name in PLACES.values())
    least = needed_bytes(n_packed, _least(n_dense, len(coords)), _least(n_coarse, len(coarse)))
    check_memory(least, allowed, str(folder))
    with ThreadPoolExecutor(1) as other:  # both grids at the same time: unpacking releases the GIL
        later = other.submit(masks, FEATURES, coarse, n_coarse)
        found, dense_counts = masks(DENSITIES, coords, n_dense)
        coarse_found, coarse_counts = later.result()
        check_memory(needed_bytes(n_packed, dense_counts, coarse_counts), allowed, str(folder))
        features = other.submit(codes, FEATURES, coarse_counts)
        density = codes(DENSITIES, dense_counts)
        return VertexBricks(coords, found, density), VertexBricks(coarse, coarse_found, features.result())


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
