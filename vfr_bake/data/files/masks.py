"""Masks: pictures that are black where a photograph is to be ignored.

The folder `masks/` beside the photographs holds a PNG for each one that has a mask. It has the photograph's
name, with or without the photograph's own suffix (`IMG_1.png` as well as COLMAP's `IMG_1.jpg.png` for
`IMG_1.jpg`). Masked pixels are neither matched nor learned. In memory, a masked pixel is a transparent pixel
of a capture that says that it is masked.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from player.errors import DataError, FormatError
from vfr_bake.data.files.opening import open_photograph
from vfr_bake.data.files.orientation import as_stored, read_layout, turned_upright

FOLDER = "masks"
SEEN = 128
"""Level of a mask from which on a pixel counts as seen. Masks that a program has resampled or packed as JPEG
have greys."""


def mask_of(root: Path, picture: str) -> Path | None:
    """Return the mask of a picture of the data set in the folder `root`; None if it has none.

    `picture`: the name of its file, relative to `root` or to `root/images`.

    >>> mask_of(Path("surely/not/there"), "images/IMG_1.jpg") is None
    True
    """
    name = Path(picture)
    if name.is_absolute() or ".." in name.parts:
        return None
    places = [name]
    if name.parts[:1] == ("images",) and len(name.parts) > 1:
        places.append(Path(*name.parts[1:]))
    for place in places:
        for candidate in (place.with_suffix(".png"), place.with_name(place.name + ".png")):
            if (root / FOLDER / candidate).is_file():
                return root / FOLDER / candidate
    return None


def apply_mask(rgba: np.ndarray, picture: Path, mask: Path, upright: bool) -> np.ndarray:
    """Return the picture, [height, width, 4] uint8, transparent where its mask is black.

    `upright`: whether the picture was turned upright. A mask may be drawn on the picture as one sees it or on
    the pixels as stored; if these differ in size, the size of the mask decides. Raises DataError: the mask
    has another size, or is no picture.
    """
    try:
        with open_photograph(mask) as file:
            layout = read_layout(picture)
            if file.size not in (layout.size, layout.upright_size):
                width, height = layout.upright_size if upright else layout.size
                raise DataError(
                    f"{mask}: mask: expected {width}x{height} pixels as {picture.name} has, got "
                    f"{file.size[0]}x{file.size[1]}: save it in the size of its picture, or remove it"
                )
            seen = np.asarray(file.convert("L")) >= SEEN
    except FormatError as error:
        raise DataError(str(error)) from error
    if seen.shape != rgba.shape[:2]:
        seen = turned_upright(seen, layout.number) if upright else as_stored(seen, layout.number)
    masked = rgba.copy()
    masked[~seen, 3] = 0
    return masked


def check_masked(name: str, images: Sequence[np.ndarray]) -> None:
    """Raise DataError unless at least a hundredth of all pixels of the pictures, [height, width, 4] each, is
    opaque, that is, not masked."""
    n_seen = sum(int((image[..., 3] == 255).sum()) for image in images)
    n_all = sum(image.shape[0] * image.shape[1] for image in images)
    if n_seen < 0.01 * n_all:
        raise DataError(
            f"{name}: masks: expected some of the pictures to be seen, got {n_seen} of {n_all} pixels: a "
            "mask is white where its picture counts and black where it is ignored"
        )
