"""Interpolation of pixels between marched neighbours of the same picture.

A picture of quality `exact` marches every pixel. Any other quality first marches a lattice of pixels that are
`spacing` apart in both directions, then fills the picture up in stages. Each new pixel of a stage is in the
middle of a square of four known pixels: of upright squares first, then of the diamonds that these leave, and
so on at half the spacing.

    o . o      o . o      o e o
    . . .  ->  . c .  ->  e c e      o known first, c of the next stage, e of the one after it
    o . o      o . o      o e o

Where the four known pixels agree, the new pixel becomes their mean. Where they do not, or where some of them
are outside the picture, it is marched. Four pixels agree if their colours (over what is behind), opacities
and depths differ by no more than `Agreement` allows. A detail between the pixels of the lattice that none of
them meets is missed. To catch vertical and horizontal lines between them, pictures of an object also march
the diagonal of each block, which meets every row and column.

A pixel depends only on pixels of earlier stages. So a picture does not depend on threads, on tasks or on the
picture before it.
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
"""The optical depth at which rays stop, for pictures of each quality (`player.march.march.march`). The
renderer raises it for pictures that are smaller than those of training."""
OF_FIRST_HALVING = 0.6
"""Factor on the levels by which pixels may differ, in the first halving of a lattice of every fourth
pixel."""


class Agreement(NamedTuple):
    """Limits on the differences between four pixels whose mean another pixel may become."""

    colour: np.float32
    """Largest difference in each channel, 0..1, of colours over the background; over black if it is
    transparent."""
    opacity: np.float32
    depth: np.float32
    """Largest difference of depths, as a share of the nearest pixel's depth. Pixels that are all fainter than
    `opacity` may be at any depths."""


class MarchStage(NamedTuple):
    """One stage of a picture: pixels that are found at the same time."""

    within: np.ndarray
    """[m, 2] int64 row and column of these pixels in each block."""
    neighbours: np.ndarray
    """[4, 2] int64 offsets (row, column) from a pixel to the four whose mean it may become; [0, 2] where all
    pixels are marched."""
    agreement: Agreement


_NOTHING = Agreement(np.float32(0), np.float32(0), np.float32(0))
_NONE = np.zeros((0, 2), np.int64)


@lru_cache(maxsize=64)
def stages(levels: float, contracted: bool = False) -> tuple[MarchStage, ...]:
    """Return the stages of a picture, in their order.

    Args:
        levels: 8-bit levels by which four pixels may differ for another to become their mean. With 0, as in
            exact pictures, all pixels are marched. In the first halving of a wide lattice the limit is lower.
        contracted: whether the picture shows all of space. Pictures of a capture are smooth over several
            pixels, so that a lattice of every fourth pixel pays. An object's seldom are: with a lattice wider
            than every second pixel, the rays share so little that they cost more time than their smaller
            number saves.

    >>> [len(stage.within) for stage in stages(0)], [len(stage.within) for stage in stages(40)]
    ([64], [20, 12, 32])
    >>> [len(stage.within) for stage in stages(40, contracted=True)]
    [4, 4, 8, 16, 32]
    """
    if not levels:
        return (MarchStage(EVERY, _NONE, _NOTHING),)
    if contracted:
        return _pattern(4, (_agreement(OF_FIRST_HALVING * levels), _agreement(levels)))
    return _pattern(2, (_agreement(levels),), probed=True)


def _pattern(spacing: int, agreements: tuple[Agreement, ...], probed: bool = False) -> tuple[MarchStage, ...]:
    """Return the stages that begin with a lattice of `spacing` pixels, a power of two up to BLOCK.
    `agreements`: the limits in each halving of the spacing. `probed`: whether pixels on the diagonals of
    blocks are marched with the lattice."""
    row, column = EVERY.T
    probes = (row == column) & probed
    lattice = (row % spacing == 0) & (column % spacing == 0)
    found = [MarchStage(EVERY[lattice | probes], _NONE, _NOTHING)]
    for agreement in agreements:
        half = spacing // 2
        middle = (row % spacing == half) & (column % spacing == half) & ~probes
        between = (row % half == 0) & (column % half == 0) & ((row + column) % spacing == half)
        square = half * np.array([(-1, -1), (-1, 1), (1, -1), (1, 1)])
        diamond = half * np.array([(-1, 0), (0, -1), (0, 1), (1, 0)])
        found += [
            MarchStage(EVERY[middle], square, agreement),
            MarchStage(EVERY[between], diamond, agreement),
        ]
        spacing = half
    return tuple(found)


def _agreement(levels: float) -> Agreement:
    """Return limits of so many 8-bit levels on colours and opacities, and of a tenth on depths."""
    return Agreement(np.float32(levels / 255), np.float32(levels / 255), np.float32(0.1))


def interpolate(
    planes: Planes, size: tuple[int, int], pixels: Pixels, stage: MarchStage, transparent: bool
) -> np.ndarray:
    """Interpolate the pixels of a stage whose neighbours agree, and write them into the planes of a picture.

    Args:
        planes: arrays of the whole picture.
        size: width and height of the picture.
        pixels: the pixels of the stage that are to be found.
        stage: the stage that they belong to.
        transparent: whether there is no background, and colours in `planes` are straight (not multiplied by
            opacity).

    Returns:
        [n_rest] int64, indices of those of `pixels` that are to be marched.
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
    red, green, blue = _spread(rgb).T  # three columns: several times as fast as .max(axis=-1)
    widest = np.maximum(np.maximum(red, green), blue)
    known = inside & (widest <= allowed.colour) & (_spread(opacity) <= allowed.opacity)
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
    """Return the difference between the greatest and the least of four values [4, ...]."""
    return values.max(axis=0) - values.min(axis=0)


def _mean(values: np.ndarray) -> np.ndarray:
    """Return the mean of four values [4, ...]."""
    return ((values[0] + values[1]) + (values[2] + values[3])) * np.float32(0.25)
