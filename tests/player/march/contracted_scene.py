"""Fields in all of space on a contracted grid, and a naive march of rays through them, without any
skipping."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from player.asset.bricks import pack_vertices
from player.asset.density import encode_density
from player.asset.grid import SparseGrid
from player.march.contracted import MAX_SPEED, enter_space
from tests.vertex_grids import grid_of

RESOLUTION = 48
STEP = 4 / RESOLUTION / float(MAX_SPEED)
RANGE = (-16.0, 8.0)
Function = Callable[[np.ndarray], np.ndarray]


def in_space(contracted: np.ndarray) -> np.ndarray:
    """Map contracted points [n, 3] back into space, those outside the ball of radius 2 far away. For tests
    only."""
    r = np.linalg.norm(contracted, axis=-1, keepdims=True)
    outside = contracted / np.maximum(r, 1e-9) / np.maximum(2 - r, 1e-3)
    return np.where(r <= 1, contracted, outside)


def vertices_and_codes(log_sigma: Function, keep: Function) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the stored vertices in the order on disk, their points in space, and their density codes."""
    axis = np.arange(RESOLUTION + 1)
    vertices = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    points = in_space(vertices * (4 / RESOLUTION) - 2)
    vertices = vertices[keep(points)]
    vertices = vertices[pack_vertices(vertices)[2]]
    points = in_space(vertices * (4 / RESOLUTION) - 2)
    return vertices, points, encode_density(log_sigma(points), RANGE)


def contracted_grid(log_sigma: Function, keep: Function) -> SparseGrid:
    """Return the grid of a field, with features linear in the contracted position and one that is 50."""
    vertices, _, codes = vertices_and_codes(log_sigma, keep)
    coords, masks, _ = pack_vertices(vertices)
    features = np.concatenate([vertices * 4 - 96, np.full((len(vertices), 1), 50)], axis=-1).astype(np.int8)
    box = np.array([[-2.0] * 3, [2.0] * 3])
    where, both = (coords, masks), (RESOLUTION, RESOLUTION)
    return grid_of((*where, codes), (*where, features), both, box, STEP, RANGE, True)


def naive(
    grid: SparseGrid, codes: np.ndarray, ray_o: np.ndarray, ray_d: np.ndarray
) -> tuple[float, float, int, np.ndarray]:
    """March one ray; return (opacity, depth, samples taken, features composited from every sample).

    `codes` is dense, -1 where no vertex is stored. Every sample of the lattice is tested. Its cell is found
    in float32, as the format says; the rest is float64.
    """
    path = enter_space(grid, ray_o[None], ray_d[None])
    n = np.flatnonzero(path.table[0, ::2] < path.length[0])
    ray = np.zeros(len(n), np.int64)
    tau, taken, samples = 0.0, 0, []
    for place, way, s in zip(path.place(ray, n).T, path.way(ray, n), path.sample(n), strict=True):
        cell = np.clip(place.astype(np.int32), 0, RESOLUTION - 1)
        x, y, z = cell
        around = codes[x : x + 2, y : y + 2, z : z + 2]
        if (around < 0).any():
            continue
        f = place.astype(np.float64) - cell
        code = around
        for share in f:
            code = code[0] * (1 - share) + code[1] * share
        optical = float(np.exp(RANGE[0] + (RANGE[1] - RANGE[0]) * code / 255)) * float(way)
        samples.append((float(s), np.exp(-tau) * -np.expm1(-optical), place))
        tau += optical
        taken += 1
        if tau > -np.log(1e-3):
            break
    total = sum(weight for _, weight, _ in samples)
    if not total:
        return 0.0, 0.0, taken, np.zeros(4)
    mean = sum(s * weight for s, weight, _ in samples) / total
    depth = float(path.distances(np.zeros(1, np.int64), np.float32([mean]))[0])
    features = sum(weight * np.append(place * 4 - 96, 50) for _, weight, place in samples)
    return -np.expm1(-tau), depth, taken, np.asarray(features)


def dense_codes(log_sigma: Function, keep: Function) -> np.ndarray:
    vertices, _, codes = vertices_and_codes(log_sigma, keep)
    dense = np.full((RESOLUTION + 1,) * 3, -1.0)
    dense[tuple(vertices.T)] = codes
    return dense
