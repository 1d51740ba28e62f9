"""The orientation of pictures, as EXIF has it, and the turning of pictures by it.

A camera that is held upright stores the rows of its sensor as always, so that the picture lies on its side.
EXIF's orientation (CIPA DC-008, 4.6.4; 1 to 8) says how it is to be turned for looking at. Pictures whose
cameras are estimated are turned *upright*. Cameras that come with a data set were found by programs that read
the pixels *as stored*, so those pictures are not turned.

Some decoders turn the pixels by themselves: that of HEIC, because a box of the file does what EXIF does
elsewhere, and Pillow's decoder of TIFF.
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from vfr_bake.data.files.opening import exif_of, open_photograph

if TYPE_CHECKING:
    from PIL import Image

TAG = 0x0112
INVERSE = {6: 8, 8: 6}
"""The two orientations that are each other's inverse. Every other orientation is its own inverse."""


class PictureHeader(NamedTuple):
    """The size and the orientation of a picture file."""

    width: int
    height: int
    """Pixels, as stored."""
    number: int
    """EXIF's orientation of the stored pixels, from 1 (no turn) to 8."""
    turned: bool
    """Whether the decoder turns the pixels upright by itself."""
    boxed: bool
    """Whether the turn is part of the file format, so that all programs read the picture upright."""

    @property
    def size(self) -> tuple[int, int]:
        """Width and height as stored."""
        return self.width, self.height

    @property
    def upright_size(self) -> tuple[int, int]:
        """Width and height once the picture is turned upright.

        >>> PictureHeader(40, 30, 6, False, False).upright_size
        (30, 40)
        """
        return (self.height, self.width) if self.number >= 5 else (self.width, self.height)


def layout_of(picture: Image.Image) -> PictureHeader:
    """Return the layout of an opened picture, without decoding its pixels."""
    turned = picture.format in ("HEIF", "TIFF")
    if picture.format == "HEIF":
        number = picture.info.get("original_orientation")  # the entry in EXIF is reset to 1
    else:
        try:
            number = exif_of(picture).get(TAG)
        except (SyntaxError, ValueError, TypeError, KeyError, IndexError, OSError, struct.error):
            number = None  # damaged EXIF is as good as none
    number = number if isinstance(number, int) and 1 <= number <= 8 else 1
    width, height = picture.size
    if turned and number >= 5:
        width, height = height, width
    return PictureHeader(width, height, number, turned, picture.format == "HEIF")


def read_layout(path: Path) -> PictureHeader:
    """Return the layout of a picture file, without decoding it. Raises FormatError."""
    with open_photograph(path) as picture:
        return layout_of(picture)


def is_taken_upright(layout: PictureHeader, size: tuple[float, float] | None) -> bool:
    """Return whether a camera that comes with a data set belongs to the picture upright, and not to the
    pixels as stored.

    `size`: (width, height) of the camera's picture if the data set has it; the picture may have been made
    smaller or larger since. It decides if the turn exchanges width and height and these differ. In all other
    cases the pixels are taken as stored, except those of HEIC, which are upright, because no program reads
    them otherwise.

    >>> is_taken_upright(PictureHeader(40, 30, 6, False, False), (30, 40))
    True
    >>> is_taken_upright(PictureHeader(40, 30, 6, False, False), None)
    False
    """
    if size is None or layout.number < 5 or min(size) <= 0:
        return layout.boxed
    stored = abs(np.log(size[0] / size[1]) - np.log(layout.width / layout.height))
    upright = abs(np.log(size[0] / size[1]) - np.log(layout.height / layout.width))
    return layout.boxed if stored == upright else bool(upright < stored)


def turned_upright(pixels: np.ndarray, number: int) -> np.ndarray:
    """Return stored pixels [height, width, ...] turned as EXIF's orientation `number` asks for.

    >>> turned_upright(np.array([[1, 2, 3], [4, 5, 6]]), 6).tolist()  # by a quarter, clockwise
    [[4, 1], [5, 2], [6, 3]]
    """
    if number >= 5:
        pixels = pixels.swapaxes(0, 1)
    if number in (3, 4, 7, 8):
        pixels = pixels[::-1]
    if number in (2, 3, 6, 7):
        pixels = pixels[:, ::-1]
    return np.ascontiguousarray(pixels)


def as_stored(pixels: np.ndarray, number: int) -> np.ndarray:
    """Undo `turned_upright`: return upright pixels as they are stored.

    >>> as_stored(np.array([[4, 1], [5, 2], [6, 3]]), 6).tolist()
    [[1, 2, 3], [4, 5, 6]]
    """
    return turned_upright(pixels, INVERSE.get(number, number))
