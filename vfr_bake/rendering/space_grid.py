"""A density kept in a grid of contracted space: where on the rays of an unbounded scene matter lies, for the
price of a table lookup a step.

A moving average of what the field said at the samples that rays took and at random points, which rises at
once and falls slowly. What rays meet is gathered and changes the grid at updates alone, so that several
processes, each with its own rays, have the same grid. Letters as in `vfr_bake.kernels.space`.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from vfr_bake.field.field import VfrField
from vfr_bake.kernels import space as kernels
from vfr_bake.kernels.density import LIMITS
from vfr_bake.kernels.space import Found, Pace
from vfr_bake.rendering.compositing import RayFeatures, RaySamples, composited_features

RESOLUTION = 128
"""Cells per axis."""
STEP = 1 / 64
"""Longest step of a ray, radians: a cell at most where a ray is fastest."""
MASS, FLOOR = 1 / 8, 1 / 64
"""An opaque step has eight samples; where nothing is known yet, one sample stands for eight steps."""
MOST_SAMPLES = 48
"""Samples of a ray at most."""
FINER = 2
"""Pictures, and the second half of a training, take so many times the samples of its first half."""
MOST_DEPTH = 5.0
"""Optical depth of a step at most."""
THRESHOLD = 0.01
"""A step is dead if its optical depth is less."""
MEAN_SHARE = 0.2
"""Or less than this share of the mean over all cells, so that a fog everywhere does not count as empty."""
FALL = 0.5
"""Share by which a cell follows what was gathered there if that is less than it has."""
SHARE = 64
"""An update looks at one cell in so many, at random; the others are left to the rays that pass."""


class Intervals(NamedTuple):
    """What of a ray's angle its samples stand for."""

    angles: Tensor
    """[n_samples] phi, ascending along a ray."""
    widths: Tensor
    """[n_samples] radians."""


class SpaceGrid:
    """Says where to look a field up along the rays of an unbounded scene.

    `near`: how near to a camera matter may begin, model units. `densities` [n, n, n] float32, a model unit.

    >>> SpaceGrid(near=0.1, seed=0).densities.shape
    (128, 128, 128)
    """

    def __init__(self, near: float, seed: int) -> None:
        self.near = near
        self.densities = np.zeros((RESOLUTION,) * 3, np.float32)
        self.threshold = 0.0
        """Optical depth below which a step is dead."""
        self.n_updates = 0
        self.gathered = np.zeros((2, *self.densities.shape), np.float32)
        """[2, n, n, n]: sums of the densities that were met since the last update, and how many they were."""
        self._random = np.random.default_rng(seed)
        self._cells = _cells_of_the_ball()
        self._largest = _most_densities(self._cells)

    def march(
        self, field: VfrField, rays_o: Tensor, rays_d: Tensor, jitter: Tensor, finer: int = 1
    ) -> tuple[RaySamples, np.ndarray, Intervals]:
        """The samples of all rays [n_rays, 3], the densities [n_samples] that the march met there, and what
        of the rays they stand for; `jitter` [n_rays] in [0, 1). `finer`: so many times as many samples."""
        n_rays, n = len(rays_o), finer * MOST_SAMPLES
        numbers = np.empty((5, n_rays * n), np.float32)
        points = np.empty((n_rays * n, 3), np.float32)
        features = np.empty((n_rays * n, field.config.n_channels), np.float32)
        found = Found(numbers[0], numbers[1], points, features, numbers[2], numbers[3], numbers[4])
        counts = np.empty(n_rays, np.int64)
        pace = Pace(*map(np.float32, (self.near, STEP, self.threshold, MOST_DEPTH, MASS / finer, FLOOR)))
        kernels.march_space(
            rays_o.numpy(), rays_d.numpy(), jitter.numpy(), pace, self.densities, field.arrays(), LIMITS, n,
            counts, found,
        )  # fmt: skip
        kept = np.flatnonzero(np.arange(n) < counts[:, None])
        t_mid, deltas, packed_points, packed, sigmas, angles, widths = (array[kept] for array in found)
        samples = RaySamples(
            t_mid=torch.from_numpy(t_mid),
            deltas=torch.from_numpy(deltas),
            points=torch.from_numpy(packed_points),
            features=torch.from_numpy(packed),
            rays=torch.arange(n_rays),
            starts=torch.from_numpy(np.cumsum(counts) - counts),
            counts=torch.from_numpy(counts),
            sigmas=torch.from_numpy(sigmas),
        )
        return samples, sigmas, Intervals(torch.from_numpy(angles), torch.from_numpy(widths))

    def sample_all(self, field: VfrField, rays_o: np.ndarray, rays_d: np.ndarray) -> RaySamples:
        """The samples of all rays [n_rays, 3], FINER times as many as in training, without jitter."""
        middle = torch.full((len(rays_o),), 0.5)
        rays = torch.from_numpy(rays_o), torch.from_numpy(rays_d)
        return self.march(field, *rays, middle, FINER)[0]

    def composited_features(self, field: VfrField, rays_o: np.ndarray, rays_d: np.ndarray) -> RayFeatures:
        """Composite the field's features along rays `rays_o`, `rays_d` [n_rays, 3], at every sample."""
        return composited_features(self.sample_all, field, rays_o, rays_d)

    def update(self, field: VfrField) -> None:
        """Look at the field at one random point of each of a share of the cells; the first time, of all."""
        n_cells = len(self._cells)
        if self.n_updates == 0:
            which = np.arange(n_cells)
        else:
            first = np.arange(0, n_cells, SHARE)
            which = np.minimum(first + self._random.integers(0, SHARE, len(first)), n_cells - 1)
        corners = np.stack(np.unravel_index(self._cells[which], self.densities.shape), axis=-1)
        points = ((corners + self._random.random((len(which), 3))) / RESOLUTION).astype(np.float32)
        self.observe(points, np.exp(field.log_densities(points)))
        kernels.settle(*self.gathered, np.float32(FALL), self.densities)
        self.n_updates += 1
        depths = self.densities.reshape(-1)[self._cells] * (MOST_DEPTH / self._largest)
        self.threshold = min(THRESHOLD, MEAN_SHARE * float(depths.mean()))

    def observe(self, points: np.ndarray, sigmas: np.ndarray) -> None:
        """Gather the densities [n_points] that rays met at `points` [n_points, 3] of the unit cube."""
        kernels.gather(points, np.minimum(sigmas, _most_density(points)), *self.gathered)

    def state(self) -> dict[str, Any]:
        """All that the next update depends on, in tensors and plain values."""
        return {
            "densities": torch.from_numpy(self.densities),
            "gathered": torch.from_numpy(self.gathered),
            "threshold": self.threshold,
            "n_updates": self.n_updates,
            "random": self._random.bit_generator.state,
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from what `state` returned."""
        self.densities[:] = state["densities"].numpy()
        self.gathered[:] = state["gathered"].numpy()
        self.threshold, self.n_updates = state["threshold"], state["n_updates"]
        self._random.bit_generator.state = state["random"]


def steps_around(samples: RaySamples, rays_o: np.ndarray, rays_d: np.ndarray) -> np.ndarray:
    """[n_samples] lengths, model units, of what surely belongs to each of the `samples` of the rays [n_rays,
    3]: their deltas, but no more than the step around them, for what a sample stands for need not lie around
    it."""
    counts, t = samples.counts.numpy(), samples.t_mid.numpy()
    t_p = -(rays_o * rays_d).sum(axis=-1)
    width = np.maximum(1, np.linalg.norm(rays_o + t_p[:, None] * rays_d, axis=-1))
    t_p, width = np.repeat(t_p, counts), np.repeat(width, counts)
    # dt / dphi = w / cos(phi)^2; the last steps reach to infinity.
    steps = np.minimum(STEP * (width + (t - t_p) ** 2 / width), t)
    return np.minimum(samples.deltas.numpy(), steps).astype(np.float32)


def _cells_of_the_ball() -> np.ndarray:
    """The numbers of the cells whose middle lies in contracted space, the ball in the unit cube."""
    x = (np.arange(RESOLUTION) + 0.5) / RESOLUTION - 0.5
    inside = x[:, None, None] ** 2 + x[:, None] ** 2 + x**2 < 0.25
    return np.flatnonzero(inside)


def _most_densities(cells: np.ndarray) -> np.ndarray:
    corners = np.stack(np.unravel_index(cells, (RESOLUTION,) * 3), axis=-1)
    return _most_density(((corners + 0.5) / RESOLUTION).astype(np.float32))


def _most_density(points: np.ndarray) -> np.ndarray:
    """[n] density at which a step through `points` [n, 3] of the unit cube has MOST_DEPTH: more says nothing
    more. A step there is about STEP (1 + r^2) / 2 long at the distance r from the origin, and no less."""
    contracted = 4 * np.sqrt(((points - np.float32(0.5)) ** 2).sum(axis=-1))
    r = np.where(contracted < 1, contracted, 1 / np.maximum(2 - contracted, np.float32(1e-3)))
    return (MOST_DEPTH / (STEP * np.maximum(1, r * r))).astype(np.float32)
