"""A square texture, and the places of a mesh's vertices in it.

Letters: (u, v) in 0..1 with the origin at the upper left corner of the picture, as in glTF; the texel in row
r and column c has its centre at u = (c + 1/2) / size, v = (r + 1/2) / size.
"""

from __future__ import annotations

import io
from dataclasses import dataclass

import numpy as np

from player.errors import ShapeError


@dataclass(frozen=True, eq=False)
class Texture:
    """A square picture, and the places of a mesh's vertices in it.

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
        """Return the picture as the content of a PNG file; the same picture gives the same bytes."""
        from PIL import Image

        data = io.BytesIO()
        Image.fromarray(self.image).save(data, "PNG")
        return data.getvalue()
