"""Pictures to PNG files."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np

from player.errors import ShapeError
from player.files import write_bytes


def png_bytes(pixels: np.ndarray) -> bytes:
    """PNG of [h, w, 3] or [h, w, 4] uint8.

    >>> png_bytes(np.zeros((2, 3, 3), np.uint8))[:4]
    b'\\x89PNG'
    """
    from PIL import Image

    if pixels.ndim != 3 or pixels.shape[2] not in (3, 4) or pixels.dtype != np.uint8:
        raise ShapeError(
            f"pixels: expected [h, w, 3] or [h, w, 4] uint8, got {pixels.dtype} {list(pixels.shape)}"
        )
    buffer = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(pixels)).save(buffer, "PNG", compress_level=4)
    return buffer.getvalue()


def write_png(path: Path, pixels: np.ndarray) -> None:
    """Write a PNG; the name appears when the file is complete."""
    write_bytes(path, png_bytes(pixels))
