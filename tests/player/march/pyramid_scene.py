"""Pyramids as plain dictionaries, and the march through them as a naive loop: the definitions, evaluated
cell by cell in float64. Only the cell of a place is found in float32, as `player.march.march` says."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np

from player.asset.bricks import pack_vertices, unpack_vertices
from player.asset.grid import SparseGrid, build_grid
from player.asset.pyramid import Bricks, Pyramid, PyramidValues, symbols_of, values_of, whole_pyramid
from player.march.contracted import MIN_COS
from player.march.path import path_of
from tests.player.march.oracle_march import bins

Cell = tuple[int, ...]
CORNERS = list(itertools.product((0, 1), repeat=3))


def bricks_of(cells: np.ndarray) -> Bricks:
    """Return the bricks of live cells [n, 3]."""
    coords, masks, _ = pack_vertices(np.unique(np.asarray(cells, np.int64).reshape(-1, 3), axis=0))
    return Bricks(coords, masks)


def ball(resolution: int, level: int, centre: np.ndarray, radius: float) -> np.ndarray:
    """Return the cells [n, 3] of a level whose middles are in a ball, which is given in units of the box."""
    n_cells = -(-resolution // 2**level)
    cells = np.argwhere(np.ones((n_cells,) * 3, bool))
    away = np.linalg.norm((cells + 0.5) * 2**level / resolution - centre, axis=-1)
    return cells[away < radius]


def filled(pyramid: Pyramid, wanted: list[np.ndarray], limits: tuple[int, int], kind: type) -> PyramidValues:
    """Return values as a bake stores them: [n, n_channels] per level, with borders from the coarser level."""
    steps = [1] * len(wanted)
    symbols = symbols_of(pyramid.vertices, wanted, steps, limits)
    values = values_of(pyramid.vertices, symbols, steps, limits)
    return PyramidValues(pyramid, tuple(some.astype(kind) for some in values))


class Reading:
    """The content of a pyramid: values by level and vertex, live cells and bricks by level."""

    def __init__(self, stored: PyramidValues) -> None:
        pyramid = stored.pyramid
        self.resolution = pyramid.resolution
        self.n_levels, self.n_channels = len(pyramid.levels), stored.n_channels
        self.live = [set(map(tuple, unpack_vertices(b.coords, b.masks).tolist())) for b in pyramid.levels]
        self.bricks = [set(map(tuple, b.coords.tolist())) for b in pyramid.levels]
        self.values: list[dict[Cell, np.ndarray]] = [
            dict(zip(map(tuple, vertices.index.tolist()), values.astype(np.float64), strict=True))
            for vertices, values in zip(pyramid.vertices, stored.values, strict=True)
        ]

    def cell(self, g: np.ndarray) -> Cell:
        return tuple(min(max(math.floor(x), 0), self.resolution - 1) for x in g)

    def level(self, g: np.ndarray) -> int | None:
        """Return the finest level that has a brick at a place; None if no level has one."""
        cell = self.cell(g)
        for level in range(self.n_levels):
            if tuple(c >> level >> 3 for c in cell) in self.bricks[level]:
                return level
        return None

    def live_at(self, g: np.ndarray) -> bool:
        level = self.level(g)
        return level is not None and tuple(c >> level for c in self.cell(g)) in self.live[level]

    def at(self, g: np.ndarray, level: int) -> tuple[np.ndarray, float]:
        """Return the sum of share times value over the corners stored on a level, and the sum of shares."""
        cell = tuple(c >> level for c in self.cell(g))
        total, out = 0.0, np.zeros(self.n_channels)
        for corner in CORNERS:
            value = self.values[level].get(tuple(np.add(cell, corner).tolist()))
            if value is not None:
                share = math.prod(
                    1 - abs(float(x) / 2**level - c - o) for x, c, o in zip(g, cell, corner, strict=True)
                )
                out, total = out + share * value, total + share
        return out, total

    def feature(self, g: np.ndarray) -> tuple[np.ndarray, float]:
        level = self.level(g)
        if level is not None:
            return self.at(g, level)
        for other in range(self.n_levels):
            brick = tuple(c >> other >> 3 for c in self.cell(g))
            near = itertools.product(*(range(8 * b, 8 * b + 9) for b in brick))
            if any(vertex in self.values[other] for vertex in near):
                return self.at(g, other)
        return np.zeros(self.n_channels), 0.0


@dataclass(eq=False)
class PyramidScene:
    """Two pyramids, the settings of their march, and the grid that a player makes of them."""

    densities: PyramidValues
    features: PyramidValues
    step: float
    level_steps: tuple[int, ...]
    contracted: bool = False
    density_range: tuple[float, float] = (-2.0, 4.0)

    @cached_property
    def code(self) -> Reading:
        return Reading(self.densities)

    @cached_property
    def feature(self) -> Reading:
        return Reading(self.features)

    @property
    def grid(self) -> SparseGrid:
        return self._built(skip_dead=False)

    @property
    def grid_that_skips(self) -> SparseGrid:
        """The same grid, but its table, like an asset's, has no brick at places where all cells are dead."""
        return self._built(skip_dead=True)

    def _built(self, skip_dead: bool) -> SparseGrid:
        edge = 2.0 if self.contracted else 1.0
        box = np.array([[-edge] * 3, [edge] * 3])
        return build_grid(
            self.densities, self.features, box, self.step, self.level_steps, self.density_range,
            self.contracted, skip_dead=skip_dead,
        )  # fmt: skip

    def march(self, ray_o: np.ndarray, ray_d: np.ndarray, k: int) -> tuple[float, float, int, np.ndarray]:
        """March one ray; return its opacity, depth, number of samples in live cells, and features."""
        path = path_of(self.grid_of_paths, ray_o[None], ray_d[None])
        zero, low, high = np.zeros(1, np.int64), *self.density_range
        tau, taken, n, samples = 0.0, 0, 0, []

        def place(n: int, size: int) -> tuple[np.float32, np.ndarray]:
            i, m = np.array([n], np.int32), np.array([size], np.int32)
            return path.sample(i, m)[0], path.place(zero, i, m)[:, 0]

        while math.exp(-tau) >= 1e-3:
            s, g = place(n, 1)
            if not s < path.length[0]:
                break
            level = self.code.level(g)
            if level is None:
                n += 1
                continue
            size = 1
            while 2 * size <= self.level_steps[level] and n % (2 * size) == 0:
                size *= 2
            s, g = place(n, size)
            n += size
            if not (s < path.length[0] and self.code.live_at(g)):
                continue
            found = self.code.level(g)
            assert found is not None
            code, total = self.code.at(g, found)
            assert abs(total - 1) < 1e-5
            way = size * float(np.float32(self.step))
            if self.contracted:
                phi = math.atan2(path.sin[0], path.cos[0]) + float(s)
                ends = [max(math.cos(phi + side * way / 2), float(MIN_COS)) for side in (-1, 1)]
                way = float(path.width[0]) * math.sin(way) / (ends[0] * ends[1])
            optical = math.exp(low + (high - low) * float(code[0]) / 255) * way
            samples.append((float(s), math.exp(-tau) * -math.expm1(-optical)))
            taken, tau = taken + 1, tau + optical
        return self._composed(path, tau, taken, [sample for sample in samples if sample[1] > 0], k)

    def _composed(self, path, tau, taken, samples, k) -> tuple[float, float, int, np.ndarray]:
        opacity = -math.expm1(-tau)
        if not samples:
            return 0.0, 0.0, taken, np.zeros(self.feature.n_channels)
        mean = sum(s * w for s, w in samples) / sum(w for _, w in samples)
        zero = np.zeros(1, np.int64)
        depth = float(path.distances(zero, np.float32([mean]))[0])
        fetches = [(s, w, s) for s, w in samples]
        if 0 < k < len(samples):
            fetches = [(s, opacity / k, heaviest) for s, heaviest in bins(samples, k)]
        out = np.zeros(self.feature.n_channels)
        for s, w, heaviest in fetches:
            value, total = self._feature(path, s)
            if total < 1e-3:
                value, total = self._feature(path, heaviest)
            if total >= 1e-3:
                out = out + w * value / total
        return opacity, depth, taken, out

    def _feature(self, path, s: float) -> tuple[np.ndarray, float]:
        g = path.at(np.zeros(1, np.int64), np.float32([s]))[:, 0]
        scale = np.float32(self.feature.resolution / self.code.resolution)
        return self.feature.feature(np.clip(g * scale, 0, np.float32(self.feature.resolution)))

    @property
    def grid_of_paths(self) -> SparseGrid:
        """The grid, built only once, to make the paths of rays, which depend on its box and step alone."""
        if not hasattr(self, "_grid"):
            self._grid = self.grid
        return self._grid


def random_pyramid(resolution: int, n_levels: int, seed: int) -> Pyramid:
    """Return a pyramid of random balls of cells on every level, smaller on finer levels."""
    random = np.random.default_rng(seed)
    leaves = []
    for level in range(n_levels):
        parts = [ball(resolution, level, random.uniform(0.2, 0.8, 3), 0.2 + 0.06 * level) for _ in range(3)]
        cells = np.concatenate(parts)
        leaves.append(bricks_of(cells[random.random(len(cells)) < 0.9]))
    return whole_pyramid(resolution, leaves)


@lru_cache(16)
def random_scene(
    resolution: int,
    feature_resolution: int,
    level_steps: tuple[int, ...],
    seed: int,
    contracted: bool = False,
) -> PyramidScene:
    """Return a scene of smooth codes with some noise, on random pyramids with a level per `level_steps`."""
    random = np.random.default_rng(seed + 100)
    n_levels = len(level_steps)

    def values(pyramid: Pyramid, n_channels: int, top: float) -> list[np.ndarray]:
        wave = random.normal(0, 9, (3, n_channels))
        return [
            top * np.sin(v.index * 2**level / pyramid.resolution @ wave)
            + random.normal(0, top / 20, (v.n, n_channels))
            for level, v in enumerate(pyramid.vertices)
        ]

    solid = random_pyramid(resolution, n_levels, seed)
    dense = filled(solid, [160 + some for some in values(solid, 1, 80)], (0, 255), np.uint8)
    coarse = random_pyramid(feature_resolution, n_levels, seed)
    features = filled(coarse, values(coarse, 3, 100), (-127, 127), np.int8)
    step = 4 / 2 / resolution if not contracted else 2 / resolution
    return PyramidScene(dense, features, step, level_steps, contracted)


def sparse_scene(level_steps: tuple[int, ...], seed: int, contracted: bool) -> PyramidScene:
    """Return a scene of small cubes of noise, far apart in a fine grid."""
    random, resolution = np.random.default_rng(seed), 300
    leaves = []
    for level in range(len(level_steps)):
        n_cells = -(-resolution // 2**level)
        corners = random.integers(0, n_cells, (30, 1, 3))
        cells = (corners + np.argwhere(np.ones((5, 5, 5)))).reshape(-1, 3)
        leaves.append(bricks_of(cells[(cells < n_cells).all(axis=1)]))
    pyramid = whole_pyramid(resolution, leaves)
    codes = [random.uniform(0, 255, (v.n, 1)) for v in pyramid.vertices]
    features = [random.uniform(-127, 127, (v.n, 3)) for v in pyramid.vertices]
    dense, coarse = (
        filled(pyramid, codes, (0, 255), np.uint8),
        filled(pyramid, features, (-127, 127), np.int8),
    )
    step = (2 if contracted else 4) / resolution
    return PyramidScene(dense, coarse, step, level_steps, contracted, (0.0, 6.0))
