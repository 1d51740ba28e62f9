"""The pixels with the largest errors, and the samples that their rays meet."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from player.asset.asset import Asset
from player.cameras.camera import Camera
from player.march.march import sample_rays

N_WORST = 10
"""Number of pixels that are listed."""
APART = 8
"""Least distance in pixels between two listed pixels of one view, along x or y, so that one
wire does not take them all."""
N_WEIGHTS = 6
"""Number of the heaviest samples of a ray that are listed."""


@dataclass(frozen=True)
class WorstPixel:
    """One pixel and its ray."""

    view: str
    column: int
    row: int
    error: float
    """Largest difference of the three colour channels, 0 to 1."""
    wanted: tuple[float, ...]
    played: tuple[float, ...]
    n_density_samples: int
    """Number of density samples with weight."""
    opacity: float
    weights: tuple[tuple[float, float], ...]
    """(t in world units, weight) of the heaviest samples, heaviest first."""


def worst_pixels(
    asset: Asset, cameras: Sequence[Camera], wanted: Sequence[np.ndarray], played: Sequence[np.ndarray]
) -> list[WorstPixel]:
    """Return the N_WORST pixels of all views, worst first.

    `cameras` are in the world frame. The pictures `wanted` and `played`, [h, w, 3] in [0, 1],
    have the cameras' sizes.
    """
    places = []
    for view, (a, b) in enumerate(zip(wanted, played, strict=True)):
        error = np.abs(a.astype(np.float64) - b).max(axis=2)
        places += [(float(error[y, x]), view, x, y) for x, y in _peaks(error)]
    places.sort(key=lambda place: -place[0])
    found = []
    for error, view, x, y in places[:N_WORST]:
        n, opacity, weights = _ray(asset, cameras[view], x, y)
        a, b = wanted[view][y, x], played[view][y, x]
        colours = tuple(map(float, a)), tuple(map(float, b))
        found.append(WorstPixel(cameras[view].name, x, y, error, *colours, n, opacity, weights))
    return found


def _peaks(error: np.ndarray) -> list[tuple[int, int]]:
    """Return the worst pixels (x, y) of one view that are APART from each other, at most N_WORST."""
    left = error.copy()
    peaks = []
    for _ in range(N_WORST):
        y, x = map(int, np.unravel_index(np.argmax(left), left.shape))
        if left[y, x] < 0:
            break
        peaks.append((x, y))
        left[max(y - APART, 0) : y + APART + 1, max(x - APART, 0) : x + APART + 1] = -1
    return peaks


def _ray(asset: Asset, camera: Camera, x: int, y: int) -> tuple[int, float, tuple[tuple[float, float], ...]]:
    """Return the number of samples with weight, the opacity, and the heaviest samples of one pixel's ray."""
    index = np.array([y * camera.width + x])
    rays_o, rays_d = camera.transformed(np.linalg.inv(asset.world_from_model)).rays_through(index)
    path, samples, _, tau, _ = sample_rays(asset.grid, rays_o, rays_d)
    heaviest = np.argsort(-samples.weights, kind="stable")[:N_WEIGHTS]
    t = path.distances(samples.ray[heaviest], samples.s[heaviest]) * asset.scale
    weights = tuple(zip(t.tolist(), samples.weights[heaviest].tolist(), strict=True))
    return len(samples.s), float(-np.expm1(-tau[0])), weights
