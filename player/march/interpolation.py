"""Which pixels are marched, and what the others become: the reuse of neighbours in one picture.

A picture of quality `exact` marches every pixel. Any other marches a lattice of pixels first, which are
`spacing` apart in both directions, and fills it up in stages. The new pixels of a stage are in the middle of
squares of four known ones: of upright squares first, then of the diamonds that these leave, and so on at half
the spacing.

    o . o      o . o      o e o
    . . .  ->  . c .  ->  e c e      o known first, c of the next stage, e of the one after it
    o . o      o . o      o e o

Where the four agree, the pixel becomes their mean; where they do not, or where fewer than four are in the
picture, it is marched. Four agree if nothing differs by more than `Agreement` allows: colour over what is
behind it, opacity and depth. What lies between the pixels of the lattice, and is met by none of them, is not
seen. So that an upright or level line between them leaves a trace, an object's pictures march the diagonal of
each block, too: it meets every row and column.

A pixel depends on nothing but pixels of earlier stages, so that a picture depends neither on threads nor on
tasks nor on the picture before it.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Literal, NamedTuple

import numpy as np

from player.march.march import MAX_TAU
from player.march.pixels import EVERY, Pixels, Planes

Quality = Literal["exact", "high", "fast"]

OPAQUE_DEPTH: dict[Quality, np.float32] = {
    "exact": MAX_TAU,
    "high": np.float32(np.log(25)),
    "fast": np.float32(np.log(10)),
}
"""The optical depth at which the rays of a picture stop (`player.march.march.march`)."""
OF_FIRST_HALVING = 0.6
"""Share of the levels by which pixels may differ that are four apart."""


class Agreement(NamedTuple):
    """By how much four pixels may differ of which a fifth becomes the mean."""

    colour: np.float32
    """In each channel, 0..1, over what is behind; over black if that is transparent."""
    opacity: np.float32
    depth: np.float32
    """As a share of the nearest one's depth. Pixels that are all fainter than `opacity` may lie anywhere."""


class Stage(NamedTuple):
    """Pixels that are found at the same time."""

    within: np.ndarray
    """[m, 2] int64 row and column of these pixels in each block."""
    neighbours: np.ndarray
    """[4, 2] int64 rows and columns from a pixel to those it may become the mean of; [0, 2] where all pixels
    are marched."""
    agreement: Agreement


_NOTHING = Agreement(np.float32(0), np.float32(0), np.float32(0))
_NONE = np.zeros((0, 2), np.int64)


@lru_cache(maxsize=64)
def stages(levels: float, contracted: bool = False) -> tuple[Stage, ...]:
    """The stages of a picture, in their order.

    Args:
        levels: by how many 8-bit levels four pixels may differ of which another becomes the mean; with 0, as
            in exact pictures, all pixels are marched. Those of the first halving of a wide lattice must be
            nearer.
        contracted: whether it shows all of space. The pictures of a capture are smooth over several pixels,
            and a lattice of every fourth pays. An object's seldom are: of a wider lattice than every second
            pixel's, rays that lie far apart cost more time than there are fewer of them.

    >>> [len(stage.within) for stage in stages(0)], [len(stage.within) for stage in stages(40)]
    ([64], [20, 12, 32])
    >>> [len(stage.within) for stage in stages(40, contracted=True)]
    [4, 4, 8, 16, 32]
    """
    if not levels:
        return (Stage(EVERY, _NONE, _NOTHING),)
    if contracted:
        return _pattern(4, (_agreement(OF_FIRST_HALVING * levels), _agreement(levels)))
    return _pattern(2, (_agreement(levels),), probed=True)


def _pattern(spacing: int, agreements: tuple[Agreement, ...], probed: bool = False) -> tuple[Stage, ...]:
    """The stages from a lattice of a `spacing`, a power of two up to BLOCK; the agreements are those of each
    halving of it. `probed`: whether pixels on the diagonals of blocks are marched with the lattice."""
    row, column = EVERY.T
    probes = (row == column) & probed
    lattice = (row % spacing == 0) & (column % spacing == 0)
    found = [Stage(EVERY[lattice | probes], _NONE, _NOTHING)]
    for agreement in agreements:
        half = spacing // 2
        middle = (row % spacing == half) & (column % spacing == half) & ~probes
        between = (row % half == 0) & (column % half == 0) & ((row + column) % spacing == half)
        square = half * np.array([(-1, -1), (-1, 1), (1, -1), (1, 1)])
        diamond = half * np.array([(-1, 0), (0, -1), (0, 1), (1, 0)])
        found += [Stage(EVERY[middle], square, agreement), Stage(EVERY[between], diamond, agreement)]
        spacing = half
    return tuple(found)


def _agreement(levels: float) -> Agreement:
    """Colours and opacities within so many 8-bit levels."""
    return Agreement(np.float32(levels / 255), np.float32(levels / 255), np.float32(0.1))


def interpolate(
    planes: Planes, size: tuple[int, int], pixels: Pixels, stage: Stage, transparent: bool
) -> np.ndarray:
    """Write what becomes the mean of its neighbours into the planes of a picture.

    Args:
        planes: of the whole picture.
        size: its width and height.
        pixels: those of a stage.
        stage: which one it is.
        transparent: whether colours in `planes` are straight, with nothing behind them.

    Returns:
        [n_rest] int64 which of `pixels` are to be marched.
    """
    if not len(stage.neighbours):
        return np.arange(len(pixels.rows))
    width, height = size
    rows, columns = (
        axis[:, None] + step for axis, step in zip(pixels[1::-1], stage.neighbours.T, strict=True)
    )
    inside = ((rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)).all(axis=1)
    index = (np.where(inside[:, None], rows, 0) * width + np.where(inside[:, None], columns, 0)).T
    opacity, depth, rgb = planes.opacity[index], planes.depth[index], planes.rgb[index]
    if transparent:
        rgb = rgb * opacity[..., None]
    allowed = stage.agreement
    known = inside & (_spread(rgb).max(axis=-1) <= allowed.colour) & (_spread(opacity) <= allowed.opacity)
    nearest = depth.min(axis=0)
    known &= (_spread(depth) <= allowed.depth * nearest) | (opacity.max(axis=0) <= allowed.opacity)
    at = (pixels.rows * width + pixels.columns)[known]
    mean = _mean(opacity[:, known])
    colour = _mean(rgb[:, known])
    if transparent:
        colour = np.where(mean[:, None] > 0, colour / np.where(mean > 0, mean, 1)[:, None], 0)
    planes.rgb[at], planes.opacity[at] = colour, mean
    planes.depth[at] = np.where(nearest[known] > 0, _mean(depth[:, known]), 0)
    return np.flatnonzero(~known)


def _spread(values: np.ndarray) -> np.ndarray:
    """Between the least and the greatest of four [4, ...]."""
    return values.max(axis=0) - values.min(axis=0)


def _mean(values: np.ndarray) -> np.ndarray:
    """The mean of four [4, ...]."""
    return ((values[0] + values[1]) + (values[2] + values[3])) * np.float32(0.25)
