"""What a camera sees of a grid: the blocks of pixels that may meet a brick, and the rays of their pixels."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from player.asset.grid import SparseGrid
from player.cameras.camera import Camera
from player.march.bounds import BLOCK, block_bounds
from player.march.box import Bounds
from player.march.pixels import EVERY, Pixels, pixels_of_blocks, rays_of_pixels

FAR_AWAY = 64.0
"""Camera distance, in half diagonals of the box, beyond which rays start beside the box. If they started at
the camera, their float32 origins would be too coarse: at this distance by a sixteenth of a pixel in a picture
of 8192 pixels, at 1e8 units by more than the whole box."""


BlockBounds = Callable[[SparseGrid, Camera], tuple[np.ndarray, np.ndarray]]


class View(NamedTuple):
    """The part of the grid that a camera, in the model frame, may see."""

    grid: SparseGrid
    camera: Camera
    start: float
    """Distance along each ray, model units, that is known to be empty: 0 unless the camera is far away."""
    blocks: np.ndarray
    """[n] numbers of the blocks of pixels that may meet a brick."""
    near: np.ndarray
    far: np.ndarray
    """[rows, columns] float32 bounds of t for each block, measured from `start`."""

    @classmethod
    def of(cls, grid: SparseGrid, camera: Camera, bounds_of: BlockBounds = block_bounds) -> View:
        """Find what `camera` may see; `bounds_of` may be a faster function for the bounds."""
        if grid.contracted:  # all of space: every pixel may meet something, from the camera on
            shape = (-(-camera.height // BLOCK), -(-camera.width // BLOCK))
            every = np.arange(shape[0] * shape[1])
            return cls(
                grid, camera, 0.0, every, np.zeros(shape, np.float32), np.full(shape, np.inf, np.float32)
            )
        near, far = bounds_of(grid, camera)
        seen = far >= near
        size = grid.resolution / grid.cells_per_unit.astype(np.float64)
        radius = float(np.linalg.norm(size)) / 2
        distance = float(np.linalg.norm(camera.c2w[:3, 3] - (grid.aabb_min + size / 2)))
        start = distance - radius if distance > FAR_AWAY * radius else 0.0
        if start:  # this far away, the bounds would be as coarse as the origins
            near, far = np.where(seen, np.float32(0), near), np.where(seen, np.float32(np.inf), far)
        return cls(grid, camera, start, np.flatnonzero(seen), near, far)

    def pixels(self, blocks: np.ndarray, within: np.ndarray = EVERY) -> Pixels:
        """List the pixels `within` some blocks (see `pixels_of_blocks`)."""
        return pixels_of_blocks(self.camera, blocks, self.near.shape[1], within)

    def index(self, pixels: Pixels) -> np.ndarray:
        """Return the indices [n] int64 of some pixels in the picture's planes."""
        return pixels.rows * self.camera.width + pixels.columns

    def rays(
        self, pixels: Pixels, directions: Callable[..., np.ndarray] | None = None
    ) -> tuple[np.ndarray, np.ndarray, Bounds]:
        """Make the rays of pixels: their origins, directions and bounds. `directions` may be a faster
        function for the directions."""
        if directions is None or self.start:
            rays_o, rays_d = rays_of_pixels(self.camera, pixels.columns, pixels.rows, self.start)
        else:
            rays_d = directions(self.camera, pixels.columns, pixels.rows)
            rays_o = np.broadcast_to(self.camera.c2w[:3, 3].astype(np.float32), rays_d.shape)
        bounds = (self.near.reshape(-1)[pixels.blocks], self.far.reshape(-1)[pixels.blocks])
        return rays_o, rays_d, bounds
