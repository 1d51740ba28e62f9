"""Masks: pictures that are black where a photograph is to be ignored.

The folder `masks/` beside the photographs holds a PNG for each one that has a mask. It has the photograph's
name, with or without the photograph's own suffix (`IMG_1.png` as well as COLMAP's `IMG_1.jpg.png` for
`IMG_1.jpg`). Masked pixels are neither matched nor learned. In memory, a masked pixel is a transparent pixel
of a capture that says that it is masked.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from player.errors import DataError, FormatError
from vfr_bake.data.files.opening import SUFFIXES, open_photograph
from vfr_bake.data.files.orientation import as_stored, read_layout, turned_upright

FOLDER = "masks"
SEEN = 128
"""Level of a mask from which on a pixel counts as seen. Masks that a program has resampled or packed as JPEG
have greys. If no level is above 1, the mask is of labels, 0 and 1, and 1 is seen. What is transparent in a
mask counts as black."""


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
            if is_file(root / FOLDER / candidate):
                return root / FOLDER / candidate
    return None


def is_file(path: Path) -> bool:
    """Return whether `path` is a file; no file has a name that is too long.

    >>> is_file(Path("a" * 300))
    False
    """
    try:
        return path.is_file()
    except OSError:  # the name is too long; before Python 3.14 this raises
        return False


def stray_masks(root: Path, used: Collection[Path | None]) -> str | None:
    """Return a sentence on the pictures in the folder `masks/` of the data set in `root` that are masks of
    none of its pictures; None if there are none. `used`: masks that are known to belong to a picture.

    >>> stray_masks(Path("surely/not/there"), []) is None
    True
    """
    folder = root / FOLDER
    masks = sorted(path for path in folder.rglob("*") if _is_picture(path))
    strays = [path for path in masks if path not in used]
    pictures = {path.parent: _names_beside(root, path.parent.relative_to(folder)) for path in strays}
    # Where file names may be in small or capital letters alike, `a.PNG` is a mask, too.
    strays = [
        path
        for path in strays
        if path.stem not in pictures[path.parent] or not path.with_suffix(".png").is_file()
    ]
    if not strays:
        return None
    first = strays[0].relative_to(folder).as_posix()
    return (
        f"{len(strays)} of {len(masks)} masks belong to no picture ({first}): masks/NAME.png belongs to "
        "NAME.jpg"
    )


def _names_beside(root: Path, inside: Path) -> set[str]:
    """Return the names, with and without suffix, of the pictures whose masks are in the folder `inside` of
    `masks/`."""
    places = [place for place in (root / "images" / inside, root / inside) if place.is_dir()]
    found = [path for place in places for path in place.iterdir() if _is_picture(path)]
    return {name for path in found for name in (path.name, path.stem)}


def _is_picture(path: Path) -> bool:
    return path.suffix.lower() in SUFFIXES and path.name[0] != "." and path.is_file()


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
            seen = _seen(file)
    except FormatError as error:
        raise DataError(str(error)) from error
    if seen.shape != rgba.shape[:2]:
        seen = turned_upright(seen, layout.number) if upright else as_stored(seen, layout.number)
    masked = rgba.copy()
    masked[~seen, 3] = 0
    return masked


def _seen(mask: Image.Image) -> np.ndarray:
    """Return which pixels [height, width] of an opened mask count as seen."""
    levels = np.asarray(mask.convert("L"))
    if mask.mode == "P" and levels.max() < SEEN and np.asarray(mask).max() == 1:
        levels = np.asarray(mask)  # a palette may give the label 1 a dark colour
    if mask.has_transparency_data:
        levels = levels * (np.asarray(mask.convert("RGBA"))[..., 3] / 255)
    return levels >= (1 if levels.max() == 1 else SEEN)


def check_masks(name: str, masks: Sequence[Path]) -> None:
    """Raise DataError unless at least a hundredth of all pixels of the masks counts as seen."""
    n_seen = n_all = 0
    for path in masks:
        try:
            with open_photograph(path) as file:
                seen = _seen(file)
        except FormatError as error:
            raise DataError(str(error)) from error
        n_seen, n_all = n_seen + int(seen.sum()), n_all + seen.size
    _check_share(name, n_seen, n_all)


def check_masked(name: str, images: Sequence[np.ndarray]) -> None:
    """Raise DataError unless at least a hundredth of all pixels of the pictures, [height, width, 4] each, is
    opaque, that is, not masked."""
    n_seen = sum(int((image[..., 3] == 255).sum()) for image in images)
    _check_share(name, n_seen, sum(image.shape[0] * image.shape[1] for image in images))


def _check_share(name: str, n_seen: int, n_all: int) -> None:
    if n_seen < 0.01 * n_all:
        raise DataError(
            f"{name}: masks: expected some of the pictures to be seen, got {n_seen} of {n_all} pixels: a "
            "mask is white where its picture counts and black where it is ignored"
        )
