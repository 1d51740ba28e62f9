"""Interpolation of pixels between four neighbours, compiled by numba; the readable twin is
`player.march.interpolation`, which gives the same bits."""

from __future__ import annotations

import numpy as np

from player.compiling import compiled, inlined
from player.march.interpolation import MarchStage
from player.march.pixels import Pixels, Planes
from player.scratch import check_scratch, scratch

F32 = np.float32


def interpolate(
    planes: Planes, size: tuple[int, int], pixels: Pixels, stage: MarchStage, transparent: bool
) -> np.ndarray:
    """Interpolate pixels as `player.march.interpolation.interpolate` does."""
    if not len(stage.neighbours):
        return np.arange(len(pixels.rows))
    rest = scratch(len(pixels.rows), np.int64)
    n_rest = _interpolate(
        planes, size, pixels.rows, pixels.columns, stage.neighbours, stage.agreement, transparent, rest
    )
    check_scratch(rest)
    return rest[:n_rest]


@compiled
def _interpolate(planes, size, rows, columns, neighbours, allowed, transparent, rest):
    width, height = size
    n_rest = 0
    for i in range(len(rows)):
        row, column = rows[i], columns[i]
        reach = max(abs(neighbours[0, 0]), abs(neighbours[0, 1]))
        inside = row >= reach and row + reach < height and column >= reach and column + reach < width
        if not (inside and _agree(planes, width, row, column, neighbours, allowed, transparent)):
            rest[n_rest] = i
            n_rest += 1
    return n_rest


@inlined
def _agree(planes, width, row, column, neighbours, allowed, transparent):
    """Write the mean of a pixel's four neighbours to it if they agree; returns whether they do."""
    a = (row + neighbours[0, 0]) * width + column + neighbours[0, 1]
    b = (row + neighbours[1, 0]) * width + column + neighbours[1, 1]
    c = (row + neighbours[2, 0]) * width + column + neighbours[2, 1]
    d = (row + neighbours[3, 0]) * width + column + neighbours[3, 1]
    least, most, opacity = _four(planes.opacity[a], planes.opacity[b], planes.opacity[c], planes.opacity[d])
    if not most - least <= allowed.opacity:
        return False
    nearest, farthest, depth = _four(planes.depth[a], planes.depth[b], planes.depth[c], planes.depth[d])
    if not (farthest - nearest <= allowed.depth * nearest or most <= allowed.opacity):
        return False
    for channel in range(3):
        low, high, _ = _four_colours(planes, a, b, c, d, channel, transparent)
        if not high - low <= allowed.colour:
            return False
    pixel = row * width + column
    for channel in range(3):
        _, _, colour = _four_colours(planes, a, b, c, d, channel, transparent)
        if transparent:
            colour = colour / opacity if opacity > F32(0.0) else F32(0.0)
        planes.rgb[pixel, channel] = colour
    planes.opacity[pixel] = opacity
    planes.depth[pixel] = depth if nearest > F32(0.0) else F32(0.0)
    return True


@inlined
def _four_colours(planes, a, b, c, d, channel, transparent):
    rgb = planes.rgb
    if transparent:
        opacity = planes.opacity
        return _four(
            rgb[a, channel] * opacity[a],
            rgb[b, channel] * opacity[b],
            rgb[c, channel] * opacity[c],
            rgb[d, channel] * opacity[d],
        )
    return _four(rgb[a, channel], rgb[b, channel], rgb[c, channel], rgb[d, channel])


@inlined
def _four(a, b, c, d):
    """Return the least of four numbers, the greatest, and their mean."""
    return min(min(a, b), min(c, d)), max(max(a, b), max(c, d)), ((a + b) + (c + d)) * F32(0.25)
