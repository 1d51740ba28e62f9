"""8-bit pictures, and PNG and WebP files of them, whose metadata can say what was rendered."""

from __future__ import annotations

import io
import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from player.errors import FormatError, OutputError, ShapeError, VfrError
from player.files.files import open_file, write_bytes

if TYPE_CHECKING:
    from PIL import Image

KEY = "vfr-play"
"""Name of the entry in a picture's metadata that says what was rendered (`player.app.frame_files`)."""

MOST_WEBP_SIDE = 16383
"""Most pixels along a side of a WebP file."""

BAND = 1 << 16
"""Values that are rounded at a time: the arrays between take no memory to speak of, and stay in cache."""


def to_8_bit(values: np.ndarray, out: np.ndarray | None = None) -> np.ndarray:
    """Convert values in [0, 1] to uint8, rounded to nearest; others are clipped.

    `out`: the array of that shape to write into; a new one if None.

    >>> to_8_bit(np.array([0.0, 0.5, 1.0, 7.0])).tolist()
    [0, 128, 255, 255]
    """
    levels = np.empty(values.shape, np.uint8) if out is None else out
    n_rows = max(BAND * len(values) // max(values.size, 1), 1)
    for first in range(0, len(values), n_rows):
        rows = slice(first, first + n_rows)
        levels[rows] = np.floor(np.clip(values[rows], 0, 1) * 255 + 0.5)
    return levels


def png_bytes(pixels: np.ndarray, key: str | None = None) -> bytes:
    """Encode [h, w, 3] or [h, w, 4] uint8 as PNG; `key` is stored in it as text.

    >>> png_bytes(np.zeros((2, 3, 3), np.uint8))[:4]
    b'\\x89PNG'
    """
    from PIL.PngImagePlugin import PngInfo

    info = PngInfo()
    if key is not None:
        info.add_text(KEY, key)
    return _encode(pixels, "PNG", compress_level=4, pnginfo=info)


def webp_bytes(pixels: np.ndarray, key: str | None = None) -> bytes:
    """Encode [h, w, 3] or [h, w, 4] uint8 as lossless WebP; `key` is stored in its XMP.

    Raises OutputError: more than MOST_WEBP_SIDE pixels a side.

    >>> webp_bytes(np.zeros((2, 3, 3), np.uint8))[8:12]
    b'WEBP'
    """
    if max(pixels.shape[:2]) > MOST_WEBP_SIDE:
        raise OutputError(
            f"WebP: expected at most {MOST_WEBP_SIDE} pixels a side, "
            f"got {pixels.shape[1]}x{pixels.shape[0]}: write PNG"
        )
    # exact: keeps the colours where alpha is 0. method 2: takes a quarter of the time for 2 % more bytes.
    return _encode(
        pixels, "WEBP", lossless=True, exact=True, method=2, xmp=f"{KEY}={key}".encode() if key else b""
    )


ENCODERS = {".png": png_bytes, ".webp": webp_bytes}


FORMATS = ("PNG", "JPEG", "WEBP", "TIFF", "BMP")
"""Formats that a picture may have, whatever its name is: for others Pillow might start Ghostscript."""
MAX_FILE_BYTES = 1 << 30
"""The most bytes of a picture's file: 178 million pixels, the most that Pillow opens, of six bytes each."""


_WARNINGS = threading.Lock()


@contextmanager
def open_picture(path: Path, formats: tuple[str, ...] = FORMATS) -> Iterator[Image.Image]:
    """Yield a picture file opened by Pillow.

    `formats`: Pillow's names of the formats that it may have. Raises FormatError: no such file, not a regular
    one, too large, or not a picture that can be read to its end, when it is opened or in the block.
    """
    from PIL import Image, UnidentifiedImageError

    with open_file(path, "a picture", MAX_FILE_BYTES) as file:
        try:
            # Pillow warns of half as many pixels as it refuses. Large cameras take such pictures. Only one
            # thread at a time may change what is warned of.
            with _WARNINGS, warnings.catch_warnings():
                warnings.simplefilter("ignore", Image.DecompressionBombWarning)
                opened = Image.open(file, formats=formats)
            with opened as picture:
                yield picture
        except UnidentifiedImageError:
            expected = " or ".join(filter(None, (", ".join(formats[:-1]), formats[-1])))
            raise FormatError(f"{path}: picture: expected {expected}, got something else") from None
        except (
            *(OSError, ValueError, SyntaxError, TypeError, Image.DecompressionBombError),
            *(RuntimeError, EOFError),  # from the decoders of AVIF and HEIC
            MemoryError,  # a chunk may claim to have gigabytes, which Pillow allocates at once
        ) as error:
            if isinstance(error, VfrError):
                raise
            reason = (str(error).splitlines() or [type(error).__name__])[0]
            raise FormatError(f"{path}: picture: cannot be read to its end: {reason}") from error


def read_key(path: Path, size: tuple[int, int] | None = None) -> str | None:
    """Return the key that a picture of `size` (width, height; None: any) was written with; None if it has
    none, or if there is no whole picture of that size."""
    try:
        with open_picture(path) as picture:
            if size is not None and picture.size != size:
                return None
            picture.load()
            text = picture.info.get(KEY)
            xmp = picture.info.get("xmp")
    except FormatError:
        return None
    if isinstance(text, str):
        return text
    if isinstance(xmp, bytes) and xmp.startswith(KEY.encode() + b"="):
        return xmp.decode(errors="replace").partition("=")[2]
    return None


def write_png(path: Path, pixels: np.ndarray) -> None:
    """Write a PNG file, which appears under its name when it is complete."""
    write_bytes(path, png_bytes(pixels))


def _encode(pixels: np.ndarray, form: str, **options: object) -> bytes:
    from PIL import Image

    if pixels.ndim != 3 or pixels.shape[2] not in (3, 4) or pixels.dtype != np.uint8:
        raise ShapeError(
            f"pixels: expected [h, w, 3] or [h, w, 4] uint8, got {pixels.dtype} {list(pixels.shape)}"
        )
    buffer = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(pixels)).save(buffer, form, **options)
    return buffer.getvalue()
