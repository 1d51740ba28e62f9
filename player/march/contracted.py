"""Rays through contracted space: a lattice on each ray that depends on the ray alone and reaches infinity.

Notation: (o, d) is a ray in the model frame, d of unit length; p is its point nearest to the origin, at t =
t_p; b = |p|; w = max(1, b). A position on the ray is given by an angle: t = t_p + w tan(phi), from phi_0 at t
= near to almost pi/2. The point there is (p cos(phi) + w d sin(phi)) / cos(phi). `player.march.contraction`
takes numerator and denominator apart, so that nothing is divided by a cosine that is nearly 0. s = phi -
phi_0, so that the middle of base step n is at s_n = (n + 1/2) dphi.

In contracted space a ray moves by at most MAX_SPEED per unit of phi: inside the unit ball by dt/dphi = w + (t
- t_p)^2 / w <= 2; far out the speed approaches sqrt(4 b^2 + w^2) / w <= sqrt(5). So pi / dphi steps lead from
anywhere to infinity. Where all cells within m cells of a position are empty, m / (MAX_SPEED dphi C) steps may
be skipped, with C cells per contracted unit.

A sample at phi that stands for m base steps covers the ray from phi - m dphi/2 to phi + m dphi/2. In model
units that is a length of w sin(m dphi) / (cos(phi - m dphi/2) cos(phi + m dphi/2)); both cosines are kept at
MIN_COS or above, which is where the lattice ends.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from player.asset.grid import SparseGrid
from player.march.box import ONE, SKIP_MARGIN
from player.march.contraction import contraction_scale, pull_back

MAX_SPEED = np.float32(5**0.5)
"""The most contracted units that a ray moves per unit of phi."""
MIN_COS = np.float32(1e-3)
"""Rays end where cos(phi) is this: a thousand times w, in model units, behind the point nearest to the
origin."""


class ContractedPath(NamedTuple):
    """The path of n rays through contracted space, in the notation at the top of the module;
    `player.march.path` describes the methods."""

    nearest: np.ndarray
    """[3, n] float32: p."""
    along: np.ndarray
    """[3, n] float32: w d."""
    t_nearest: np.ndarray
    """[n] float32: t_p."""
    width: np.ndarray
    """[n] float32: w."""
    cos: np.ndarray
    """[n] float32: cos(phi_0)."""
    sin: np.ndarray
    """[n] float32: sin(phi_0)."""
    length: np.ndarray
    """[n] float32: s where the ray ends."""
    cells: np.float32
    """Cells per contracted unit."""
    step: np.float32
    """dphi."""
    table: np.ndarray
    """[3, 2 n_steps] float32: what `lattice` returns for `step`."""

    @property
    def first(self) -> np.ndarray:
        return np.zeros(len(self.length), np.int32)

    def sample(self, i: np.ndarray, size: np.ndarray = ONE) -> np.ndarray:
        return self._at_sample(i, size)[0]

    def place(self, ray: np.ndarray, i: np.ndarray, size: np.ndarray = ONE) -> np.ndarray:
        return self._on_grid(ray, *self._turned(ray, *self._at_sample(i, size)[1:]))

    def jump(
        self, ray: np.ndarray, i: np.ndarray, g: np.ndarray, brick: np.ndarray, reach: np.ndarray
    ) -> np.ndarray:
        low, high = ((brick - reach) * 8).astype(np.float32), ((brick + reach + 1) * 8).astype(np.float32)
        free = np.minimum(g - low, high - g).min(axis=0) - SKIP_MARGIN
        fastest = MAX_SPEED * self.step * self.cells
        return i + np.maximum(np.floor(free / fastest), 0).astype(np.int32) + 1

    def way(self, ray: np.ndarray, i: np.ndarray, size: np.ndarray = ONE) -> np.ndarray:
        cos, sin = self._turned(ray, *self._at_sample(i, size)[1:])
        angle = size.astype(np.float32) * self.step
        half = angle * np.float32(0.5)
        a, b = cos * np.cos(half), sin * np.sin(half)
        return self.width[ray] * np.sin(angle) / (np.maximum(a + b, MIN_COS) * np.maximum(a - b, MIN_COS))

    def at(self, ray: np.ndarray, s: np.ndarray) -> np.ndarray:
        return self._on_grid(ray, *self._turned(ray, np.cos(s), np.sin(s)))

    def distances(self, ray: np.ndarray, s: np.ndarray) -> np.ndarray:
        cos, sin = self._turned(ray, np.cos(s), np.sin(s))
        return self.t_nearest[ray] + self.width[ray] * sin / np.maximum(cos, MIN_COS)

    def pulled_back(self, gradients: np.ndarray, ray: np.ndarray, s: np.ndarray) -> np.ndarray:
        cos, sin = self._turned(ray, np.cos(s), np.sin(s))
        return pull_back(gradients, self._direction(ray, cos, sin), cos)

    def _at_sample(self, i: np.ndarray, size: np.ndarray) -> np.ndarray:
        """Return s of samples, its cosine and its sine, [3, ...]."""
        return self.table.take(
            2 * i + (size - 1), axis=1, mode="clip"
        )  # the last entry is beyond the end of every ray

    def _turned(self, ray: np.ndarray, cos_s: np.ndarray, sin_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return cos and sin of phi, from those of s."""
        cos, sin = self.cos[ray], self.sin[ray]
        return cos * cos_s - sin * sin_s, sin * cos_s + cos * sin_s

    def _direction(self, ray: np.ndarray, cos: np.ndarray, sin: np.ndarray) -> np.ndarray:
        """Return v [3, ...]; the points at the angles phi are v / cos, model frame."""
        return cos * self.nearest.take(ray, axis=1) + sin * self.along.take(ray, axis=1)

    def _on_grid(self, ray: np.ndarray, cos: np.ndarray, sin: np.ndarray) -> np.ndarray:
        """Return grid coordinates [3, ...] (cells) of the points at the angles phi."""
        v = self._direction(ray, cos, sin)
        scale = contraction_scale(np.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2]), cos) * self.cells
        return v * scale + self.cells * np.float32(2)


def enter_space(grid: SparseGrid, rays_o: np.ndarray, rays_d: np.ndarray) -> ContractedPath:
    """Make the path of rays [n, 3] (model frame, unit directions) from where they begin, `grid.near` from
    their origins, to where they end."""
    o, d = rays_o.astype(np.float64), rays_d.astype(np.float64)
    t_nearest = -np.sum(o * d, axis=-1)
    nearest = o + t_nearest[:, None] * d
    width = np.maximum(1.0, np.linalg.norm(nearest, axis=-1))
    start = np.arctan2(grid.near - t_nearest, width)
    return ContractedPath(
        nearest=np.ascontiguousarray(nearest.T, np.float32),
        along=np.ascontiguousarray((width[:, None] * d).T, np.float32),
        t_nearest=t_nearest.astype(np.float32),
        width=width.astype(np.float32),
        cos=np.cos(start).astype(np.float32),
        sin=np.sin(start).astype(np.float32),
        length=(np.arccos(float(MIN_COS)) - start).astype(np.float32),
        cells=grid.cells_per_unit[0],
        step=grid.step,
        table=lattice(float(grid.step)),
    )


@lru_cache(maxsize=4)
def lattice(step: float) -> np.ndarray:
    """Return s and its cos and sin, [3, 2 n_steps] float32, at the middle and the end of every base step that
    a ray can have, and of one more step, which is beyond the end of every ray.

    >>> lattice(1.0)[0].tolist()
    [0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0, 4.5, 5.0]
    """
    s = (np.arange(1, 2 * int(np.pi / step) + 5) * 0.5).astype(np.float32) * np.float32(step)
    found = np.stack([s, np.cos(s.astype(np.float64)), np.sin(s.astype(np.float64))]).astype(np.float32)
    found.flags.writeable = False  # every caller gets the same array
    return found
