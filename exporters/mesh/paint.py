"""Painting of the texture of a mesh that has been laid out.

Letters as in `exporters.shapes.texture`. A texel belongs to the face whose triangle contains its centre.
Every texel without a face takes the colour of the nearest coloured texel, so that neither linear filtering
nor mipmaps show the gaps between the charts.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np

from exporters.extras import needs
from exporters.shapes.colour import KnownColours
from exporters.shapes.mesh import TriangleMesh
from exporters.shapes.texture import Texture
from player.errors import DataError
from player.files.images import to_8_bit
from player.progress import Progress, silent

_COLOURED = 1 << 20  # texels of the picture that are coloured at a time, so that memory is bounded
_TESTED = 1 << 22  # candidate texels tested at a time

ColourPoints = Callable[[np.ndarray, np.ndarray, Progress], KnownColours]
"""A function that returns the colours of points [n, 3] with unit normals [n, 3], and reports its progress."""


class CoveredTexels(NamedTuple):
    """Texels whose centre lies in a face."""

    texels: np.ndarray
    """[n] int64, row * size + column."""
    faces: np.ndarray
    """[n] int64, the face that contains the centre."""
    shares: np.ndarray
    """[n, 3] float64, the weights of the face's corners there (barycentric coordinates), of sum 1."""


def paint(
    mesh: TriangleMesh, uvs: np.ndarray, size: int, colours: ColourPoints, progress: Progress = silent
) -> Texture:
    """Paint the texture of a mesh that has been laid out.

    Args:
        mesh: the mesh that `exporters.mesh.unwrap` returns.
        uvs: [n_vertices, 2], returned with it.
        size: texels along each side.
        colours: called with the points under the centres of the covered texels, for one band of rows of the
            picture after another.
        progress: called with (done, of) as `colours` reports its progress.

    Raises:
        DataError: no texel is covered, or none has a colour.
        MissingExtraError: scipy is not installed.
    """
    image = np.zeros((size, size, 3), np.uint8)
    covered = np.zeros((size, size), bool)
    n_rows = max(_COLOURED // size, 1)
    bands = [range(start, min(start + n_rows, size)) for start in range(0, size, n_rows)]
    n_texels = 0
    for number, rows in enumerate(bands):
        texels, faces, shares = covered_texels(uvs, mesh.faces, size, rows)
        rgb, known = colours(*mesh.at(faces, shares), partial(_report_band, progress, number, len(bands)))
        image.reshape(-1, 3)[texels[known]] = to_8_bit(rgb[known])
        covered.reshape(-1)[texels[known]] = True
        n_texels += len(texels)
    if not n_texels:
        raise DataError(f"--texture: expected a texel under some face at size {size}, got none")
    if not covered.any():
        raise DataError(f"--texture: expected colours on the surface, got none at {n_texels} points")
    return Texture(uvs.astype(np.float32), padded(image, covered))


def _report_band(progress: Progress, number: int, n_bands: int, done: int, of: int) -> None:
    """Report that `done` of `of` parts of the band with this number are done, as a share of all bands."""
    progress(number * of + done, n_bands * of)


def covered_texels(uvs: np.ndarray, faces: np.ndarray, size: int, rows: range | None = None) -> CoveredTexels:
    """Return the texels that the faces of a mesh cover, ascending, each once, with the first face that
    contains its centre.

    Args:
        uvs: [n_vertices, 2], 0..1.
        faces: [n_faces, 3] integers.
        size: texels along each side.
        rows: consecutive rows of the picture whose texels are returned; None is all rows.

    >>> square = np.array([[0.0, 0], [1, 0], [0, 1], [1, 1]])
    >>> covered = covered_texels(square, np.array([[0, 1, 2], [1, 3, 2]]), 2)
    >>> covered.texels.tolist(), covered.faces.tolist()
    ([0, 1, 2, 3], [0, 0, 0, 1])
    """
    rows = range(size) if rows is None else rows
    first, last = np.array([0, rows.start]), np.array([size, rows.stop]) - 1  # column and row
    corners = np.asarray(uvs, np.float64)[faces] * size - 0.5  # texel centres are at whole numbers
    low = np.clip(np.ceil(corners.min(axis=1) - 1e-9), first, last + 1).astype(np.int64)
    high = np.clip(np.floor(corners.max(axis=1) + 1e-9), first - 1, last).astype(np.int64)
    extent = np.maximum(high - low + 1, 0)
    ends = np.cumsum(extent[:, 0] * extent[:, 1])
    found = [CoveredTexels(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 3)))]
    start = 0
    while start < len(faces):
        base = ends[start - 1] if start else 0
        stop = max(int(np.searchsorted(ends, base + _TESTED, side="right")), start + 1)
        found.append(_inside(corners, low, extent, np.arange(start, stop), size))
        start = stop
    texels, face, shares = (np.concatenate(column) for column in zip(*found, strict=True))
    unique, chosen = np.unique(texels, return_index=True)
    return CoveredTexels(unique, face[chosen], shares[chosen])


def padded(image: np.ndarray, covered: np.ndarray) -> np.ndarray:
    """Return the picture [h, w, 3] in which every texel that is not `covered` [h, w] has the colour of the
    nearest one that is."""
    with needs("--texture", "scipy"):
        from scipy.ndimage import distance_transform_edt
    nearest = np.asarray(distance_transform_edt(~covered, return_distances=False, return_indices=True))
    return np.ascontiguousarray(image[nearest[0], nearest[1]])


def _inside(
    corners: np.ndarray, low: np.ndarray, extent: np.ndarray, faces: np.ndarray, size: int
) -> CoveredTexels:
    """Return the texels whose centres the faces numbered `faces` contain, out of all texels in the bounding
    boxes of these faces.

    `corners` [n_faces, 3, 2] are in texels. The bounding boxes begin at `low` [n_faces, 2] and have `extent`
    [n_faces, 2] texels.
    """
    counts = extent[faces, 0] * extent[faces, 1]
    face = np.repeat(faces, counts)
    place = np.arange(len(face)) - np.repeat(np.cumsum(counts) - counts, counts)
    y, x = np.divmod(place, np.maximum(extent[face, 0], 1))
    column, row = low[face, 0] + x, low[face, 1] + y
    a, b, c = corners[face, 0], corners[face, 1], corners[face, 2]
    area = _cross(b - a, c - a)
    p = np.stack([column, row], axis=-1).astype(np.float64)
    flat = np.abs(area) < 1e-12
    shares = np.stack([_cross(c - b, p - b), _cross(a - c, p - c), _cross(b - a, p - a)], axis=-1)
    shares /= np.where(flat, 1, area)[:, None]
    kept = (shares >= -1e-9).all(axis=-1) & ~flat
    return CoveredTexels((row * size + column)[kept], face[kept], shares[kept])


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
