"""A picture on a mesh: which texel lies where on the surface, its colour, and the padding around the charts.

Letters: (u, v) in 0..1 with the origin at the upper left corner of the picture, as in glTF; the texel in
row r and column c has its centre at u = (c + 1/2) / size, v = (r + 1/2) / size. A texel belongs to the face
whose triangle holds its centre; all others take the colour of the nearest one that has a face, so that
neither linear filtering nor smaller copies of the picture show what is between the charts.
"""

from __future__ import annotations

import io
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from exporters.extras import needs
from exporters.shapes.mesh import TriangleMesh
from player.errors import DataError, ShapeError

_AT_ONCE = 1 << 22  # candidate texels looked at together


@dataclass(frozen=True, eq=False)
class Texture:
    """A square picture and where a mesh's vertices are in it.

    Raises ShapeError: an array has another shape or type.

    >>> Texture(np.zeros((3, 2), np.float32), np.zeros((4, 4, 3), np.uint8)).image.shape
    (4, 4, 3)
    """

    uvs: np.ndarray
    """[n_vertices, 2] float32, 0..1, origin at the upper left."""
    image: np.ndarray
    """[size, size, 3] uint8, sRGB."""

    def __post_init__(self) -> None:
        if self.uvs.shape != (len(self.uvs), 2) or self.uvs.dtype != np.float32:
            raise ShapeError(f"texture: uvs: expected [n, 2] float32, got {self.uvs.shape} {self.uvs.dtype}")
        size = len(self.image)
        if self.image.shape != (size, size, 3) or self.image.dtype != np.uint8:
            raise ShapeError(
                f"texture: image: expected [size, size, 3] uint8, got {self.image.shape} {self.image.dtype}"
            )

    def png(self) -> bytes:
        """The picture as a PNG file; the same picture gives the same bytes."""
        from PIL import Image

        data = io.BytesIO()
        Image.fromarray(self.image).save(data, "PNG")
        return data.getvalue()


Colours = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]
"""(points [n, 3], normals [n, 3]) -> rgb [n, 3] in 0..1, and which points have one [n] bool."""


def paint(mesh: TriangleMesh, uvs: np.ndarray, size: int, colours: Colours) -> Texture:
    """The texture of a mesh that has been laid out.

    Args:
        mesh: as laid out.
        uvs: [n_vertices, 2], as `exporters.mesh.unwrap` returns them.
        size: texels along each side.
        colours: asked once, for the points under the centres of all covered texels.

    Raises:
        DataError: no texel is covered, or none has a colour.
        MissingExtraError: scipy is not installed.
    """
    texels, face, shares = covered_texels(uvs, mesh.faces, size)
    if not len(texels):
        raise DataError(f"--texture: expected a texel under some face at size {size}, got none")
    points, normals = mesh.at(face, shares)
    rgb, known = colours(points, normals)
    if not known.any():
        raise DataError(f"--texture: expected colours on the surface, got none at {len(points)} points")
    texels, rgb = texels[known], rgb[known]
    image = np.zeros((size * size, 3), np.uint8)
    image[texels] = np.rint(np.clip(rgb, 0, 1) * 255).astype(np.uint8)
    covered = np.zeros(size * size, bool)
    covered[texels] = True
    return Texture(uvs.astype(np.float32), padded(image.reshape(size, size, 3), covered.reshape(size, size)))


def covered_texels(
    uvs: np.ndarray, faces: np.ndarray, size: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Texels whose centre a face holds.

    Args:
        uvs: [n_vertices, 2], 0..1.
        faces: [n_faces, 3] integers.
        size: texels along each side.

    Returns:
        texels [n] int64, row * size + column, ascending, each once; face [n] int64, the first that holds its
        centre; shares [n, 3] float64 of the face's corners, of sum 1.

    >>> square = np.array([[0.0, 0], [1, 0], [0, 1], [1, 1]])
    >>> texels, face, shares = covered_texels(square, np.array([[0, 1, 2], [1, 3, 2]]), 2)
    >>> texels.tolist(), face.tolist()
    ([0, 1, 2, 3], [0, 0, 0, 1])
    """
    corners = np.asarray(uvs, np.float64)[faces] * size - 0.5  # texel centres are at whole numbers
    low = np.clip(np.ceil(corners.min(axis=1) - 1e-9), 0, size).astype(np.int64)
    high = np.clip(np.floor(corners.max(axis=1) + 1e-9), -1, size - 1).astype(np.int64)
    extent = np.maximum(high - low + 1, 0)
    n_candidates = extent[:, 0] * extent[:, 1]
    ends = np.cumsum(n_candidates)
    found = []
    start = 0
    while start < len(faces):
        base = ends[start - 1] if start else 0
        stop = max(int(np.searchsorted(ends, base + _AT_ONCE, side="right")), start + 1)
        found.append(_inside(corners, low, extent, np.arange(start, stop), size))
        start = stop
    if not found:
        none = np.zeros(0, np.int64)
        return none, none, np.zeros((0, 3))
    texels, face, shares = (np.concatenate(column) for column in zip(*found, strict=True))
    unique, first = np.unique(texels, return_index=True)
    return unique, face[first], shares[first]


def padded(image: np.ndarray, covered: np.ndarray) -> np.ndarray:
    """The picture [h, w, 3] with every texel that is not `covered` [h, w] coloured as the nearest that is."""
    with needs("--texture", "scipy"):
        from scipy.ndimage import distance_transform_edt
    nearest = np.asarray(distance_transform_edt(~covered, return_distances=False, return_indices=True))
    return np.ascontiguousarray(image[nearest[0], nearest[1]])


def _inside(
    corners: np.ndarray, low: np.ndarray, extent: np.ndarray, rows: np.ndarray, size: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    counts = extent[rows, 0] * extent[rows, 1]
    face = np.repeat(rows, counts)
    place = np.arange(len(face)) - np.repeat(np.cumsum(counts) - counts, counts)
    y, x = np.divmod(place, np.maximum(extent[face, 0], 1))
    column, row = low[face, 0] + x, low[face, 1] + y
    a, b, c = corners[face, 0], corners[face, 1], corners[face, 2]
    area = _cross(b - a, c - a)
    p = np.stack([column, row], axis=-1).astype(np.float64)
    flat = np.abs(area) < 1e-12
    safe = np.where(flat, 1, area)
    shares = np.stack([_cross(c - b, p - b), _cross(a - c, p - c), _cross(b - a, p - a)], axis=-1)
    shares /= safe[:, None]
    kept = (shares >= -1e-9).all(axis=-1) & ~flat
    return (row * size + column)[kept], face[kept], shares[kept]


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
