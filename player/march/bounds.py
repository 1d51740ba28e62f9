"""Bounds for each block of pixels: whether its rays can meet a live cell at all, and between which distances.

The picture is cut into blocks of BLOCK x BLOCK pixels. Every brick in which rays look for live cells is
projected into the picture. A block keeps the least and the greatest distance of the bricks whose projections
touch it. No rays are made for a block without bricks; all other rays start at their block's near bound. The
bounds are conservative, so that pictures do not depend on them.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from player.asset.bricks import BRICK
from player.asset.grid import SparseGrid
from player.cameras.camera import Camera

BLOCK = 8
"""Pixels along each edge of a block: smaller blocks fit the outline better and cost more to project."""

MARGIN_PX = 0.01
"""Pixels by which projections are grown: far more than the rounding of float64."""

MOST_PAIRS = 1 << 20
"""Pairs of a brick and a block under it that are listed at a time: about 50 MB of arrays."""


class CameraBricks(NamedTuple):
    """n bricks of one size in camera coordinates: x points right, y up, and the camera looks along -z."""

    firsts: np.ndarray
    """[n, 3] float64, the lowest corner of each brick."""
    steps: np.ndarray
    """[3, 3] float64: the edges of a brick along the x, y and z axes of the grid, one edge a row."""
    units: tuple[float, float]
    """Model units per unit of camera coordinates, along the direction with the fewest and along that with the
    most. Both are 1 but for the error of the camera's rotation, which is checked to a thousandth."""


def seen_bricks(grid: SparseGrid, camera: Camera) -> CameraBricks:
    """Return the bricks in which rays look for live cells, as `camera` sees them; it is in the model
    frame."""
    edge = BRICK / grid.cells_per_unit.astype(np.float64)
    w2c = np.linalg.inv(camera.c2w)
    steps = (w2c[:3, :3] * edge).T
    most, _, least = np.linalg.svd(camera.c2w[:3, :3], compute_uv=False)
    firsts = grid.places @ steps + (w2c[:3, :3] @ grid.aabb_min + w2c[:3, 3])
    return CameraBricks(firsts, steps, (float(least), float(most)))


def block_bounds(grid: SparseGrid, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Find bounds of t for the rays of each block of the picture.

    Args:
        grid: the sparse grid.
        camera: in the model frame.

    Returns:
        near: [rows, columns] float32, model units; inf for a block that no brick projects into.
        far: [rows, columns] float32, model units; -inf for such a block.
    """
    shape = (-(-camera.height // BLOCK), -(-camera.width // BLOCK))
    near, far = np.full(shape, np.inf, np.float32), np.full(shape, -np.inf, np.float32)
    first, steps, (least, most) = seen_bricks(grid, camera)
    radius = float(np.linalg.norm(steps)) / 2
    distance = np.linalg.norm(first + steps.sum(axis=0) / 2, axis=1)
    starts, ends = np.maximum(distance - radius * 1.001, 0) * least, (distance + radius * 1.001) * most
    corners = np.array(list(np.ndindex(2, 2, 2))) @ steps
    depths = -(first[:, 2] + corners[:, 2, None])  # [8, n]
    ahead, behind = (depths > 1e-6 * radius).all(axis=0), (depths < 0).all(axis=0)
    around = np.flatnonzero(~ahead & ~behind)
    if len(around):  # the camera is in or beside these bricks: they may be anywhere in the picture
        near[:], far[:] = starts[around].min(), ends[around].max()
    shown = np.flatnonzero(ahead)
    x = camera.cx + camera.fx * (first[shown, 0] + corners[:, 0, None]) / depths[:, shown]
    y = camera.cy - camera.fy * (first[shown, 1] + corners[:, 1, None]) / depths[:, shown]
    left, right = _range(x, shape[1])
    top, bottom = _range(y, shape[0])
    group = np.cumsum((right - left) * (bottom - top)) // MOST_PAIRS
    for some in np.split(np.arange(len(shown)), np.flatnonzero(np.diff(group)) + 1):
        box = left[some], right[some], top[some], bottom[some]
        _spread(box, starts[shown[some]], ends[shown[some]], near, far)
    return near, far


def _range(x: np.ndarray, n_blocks: int) -> tuple[np.ndarray, np.ndarray]:
    """Find the blocks along one axis of the picture whose pixel centres can lie between the least and the
    greatest of eight coordinates, `x` [8, n] pixels. Returns the first such block [n] and the one after the
    last [n]."""
    low = np.floor((x.min(axis=0) - 0.5 - MARGIN_PX) / BLOCK)
    high = np.floor((x.max(axis=0) - 0.5 + MARGIN_PX) / BLOCK) + 1
    return np.clip(low, 0, n_blocks).astype(np.int64), np.clip(high, 0, n_blocks).astype(np.int64)


def _spread(
    box: tuple[np.ndarray, ...], starts: np.ndarray, ends: np.ndarray, near: np.ndarray, far: np.ndarray
) -> None:
    """Widen the bounds `near` and `far` of blocks by the `starts` and `ends` of the n bricks that cover them;
    `box` is the left, right, top and bottom block [n] of each brick."""
    left, right, top, bottom = box
    wide = np.maximum(right - left, 0)
    counts = wide * np.maximum(bottom - top, 0)
    owner = np.repeat(np.arange(len(counts)), counts)
    place = np.arange(counts.sum()) - (np.cumsum(counts) - counts)[owner]
    rows, columns = np.divmod(place, np.maximum(wide, 1)[owner])
    index = (top[owner] + rows) * near.shape[1] + left[owner] + columns
    np.minimum.at(near.reshape(-1), index, starts.astype(np.float32)[owner])
    np.maximum.at(far.reshape(-1), index, ends.astype(np.float32)[owner])
