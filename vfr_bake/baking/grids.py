"""From cells to the arrays of an asset and back to a grid that can be marched.

Densities and features are stored at the vertices of two grids over the same box. What a picture loses first
is where a surface is: densities take the finer one, a byte a vertex; features, whose vertices take a byte a
channel, the coarser one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from player.asset.asset import GridArrays
from player.asset.bricks import pack_vertices
from player.asset.density import encode_density
from player.asset.grid import SparseGrid, build_grid
from player.asset.vertex_rows import VertexRows, vertex_rows
from vfr_bake.baking.projection import encode_features
from vfr_bake.baking.visibility import corners_of, subdivided
from vfr_bake.training.model_file import Model

SLAB = 64
"""Planes of vertices that are looked at together."""
VERTEX_CHUNK = 1 << 18
"""Vertices evaluated at once: 32 MB of features."""
FAINTEST, DENSEST = 1e-5, 20.0
"""Optical depths of one march step at codes 0 and 255: from invisible to opaque, in steps of 5.9 %."""
FAR = 30.0
"""In contracted space a step has different lengths, from dphi on: codes begin at what is invisible even so
many model units away, where a step is as long as its square."""
Progress = Callable[[int, int], object]
"""Called with (done, of)."""


@dataclass(frozen=True, eq=False)
class Vertices:
    """The stored vertices of a grid, in the order of the rows on disk."""

    coords: np.ndarray
    masks: np.ndarray
    """Of their bricks, as `player.asset.bricks` has them."""
    index: np.ndarray
    """[n, 3] int16."""
    resolution: int
    """Cells per axis."""

    def __len__(self) -> int:
        return len(self.index)

    def rows(self) -> VertexRows:
        return vertex_rows(self.coords, self.masks, self.resolution)


@dataclass(frozen=True, eq=False)
class Layout:
    """Which vertices are stored, and how their densities are coded."""

    densities: Vertices
    features: Vertices
    step: float
    density_range: tuple[float, float]
    contracted: bool = False
    near: float = 0.0
    """Where rays begin, model units, if contracted."""

    @property
    def aabb(self) -> tuple[tuple[float, ...], ...]:
        """The grids' box: that of an object, or of contracted space."""
        edge = 2.0 if self.contracted else 1.0
        return (-edge,) * 3, (edge,) * 3

    def arrays(self, density: np.ndarray, features: np.ndarray) -> GridArrays:
        """The asset's arrays, from codes that need not be whole: one for each vertex of the densities,
        [n, n_channels] for each of the features."""
        whole = np.clip(np.rint(density), 0, 255).astype(np.uint8)
        d, f = self.densities, self.features
        return GridArrays(d.coords, d.masks, whole, f.coords, f.masks, encode_features(features))

    def grid(self, density: np.ndarray, features: np.ndarray) -> SparseGrid:
        """The grid that a player makes of `arrays`."""
        a = self.arrays(density, features)
        return build_grid(
            (a.brick_coords, a.brick_masks, a.density),
            (a.feature_coords, a.feature_masks, a.features),
            (self.densities.resolution, self.features.resolution),
            np.array(self.aabb),
            self.step,
            self.density_range,
            self.contracted,
            self.near,
        )


def make_layout(
    visible: np.ndarray,
    step: float,
    resolutions: tuple[int, int],
    contracted: bool = False,
    near: float = 0.0,
) -> Layout:
    """What is stored of the cells `visible` [n, n, n] bool, for march steps of `step`, from `near` on:
    densities and features at the corners of the cells of their own grids that lie in them, of which there are
    `resolutions` along each axis."""
    longest = step * FAR**2 if contracted else step
    density_range = (float(np.log(FAINTEST / longest)), float(np.log(DENSEST / step)))
    densities = _corners(visible, resolutions[0])
    features = densities if resolutions[1] == resolutions[0] else _corners(visible, resolutions[1])
    return Layout(densities, features, step, density_range, contracted, near)


def evaluate_densities(model: Model, layout: Layout, progress: Progress) -> np.ndarray:
    """The field's density codes [n_densities] float32."""
    vertices = layout.densities
    codes = np.empty(len(vertices), np.float32)
    for rows, points in _chunks(vertices, layout.contracted):
        codes[rows] = encode_density(model.field.log_densities(points), layout.density_range)
        progress(rows.stop, len(vertices))
    return codes


def evaluate_features(model: Model, layout: Layout, matrix: np.ndarray, progress: Progress) -> np.ndarray:
    """The field's features times `matrix` [n_stored, n_channels]: [n_features, n_stored] float32."""
    vertices, back = layout.features, matrix.T.astype(np.float32)
    features = np.empty((len(vertices), len(matrix)), np.float32)
    for rows, points in _chunks(vertices, layout.contracted):
        np.matmul(model.field.features(points), back, out=features[rows])
        progress(rows.stop, len(vertices))
    return features


def _chunks(vertices: Vertices, contracted: bool) -> Iterator[tuple[slice, np.ndarray]]:
    for start in range(0, len(vertices), VERTEX_CHUNK):
        rows = slice(start, min(start + VERTEX_CHUNK, len(vertices)))
        yield rows, unit_points(vertices.index[rows], vertices.resolution, contracted)


def _corners(cells: np.ndarray, resolution: int) -> Vertices:
    """Those of the cells, `resolution` along each axis, that lie in `cells` [n, n, n] bool: slab by slab,
    because a fine grid as a whole takes gigabytes."""
    parts = []
    for first in range(0, resolution + 1, SLAB):
        last = min(first + SLAB, resolution + 1)
        before = max(first - 1, 0)  # a vertex is a corner of the cells on both its sides
        corners = corners_of(subdivided(cells, resolution, slice(before, last)))
        index = np.argwhere(corners[first - before : last - before]).astype(np.int16)
        index[:, 0] += first
        parts.append(index)
    index = np.concatenate(parts)
    coords, masks, order = pack_vertices(index)
    return Vertices(coords, masks, index[order], resolution)


def unit_points(index: np.ndarray, resolution: int, contracted: bool) -> np.ndarray:
    """[n, 3] float32: where vertices are looked up in the unit cube of the field. Corners of cells that stick
    out of contracted space, where the field has learnt nothing, take what is at its border."""
    points = index / resolution
    if contracted:
        centred = points - 0.5
        norm = np.linalg.norm(centred, axis=-1, keepdims=True)
        points = np.where(norm > 0.5, centred * (0.5 / np.maximum(norm, 0.5)) + 0.5, points)
    return points.astype(np.float32)
