"""From cells to the arrays of an asset and back to a grid that can be marched."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from player.asset import GridArrays
from player.bricks import pack_vertices
from player.density import encode_density
from player.sparse_grid import SparseGrid, build_grid
from vfr_bake.baking.projection import encode_features
from vfr_bake.baking.visibility import corner_vertices
from vfr_bake.training.model_file import Model

VERTEX_CHUNK = 1 << 18
"""Vertices evaluated at once: 32 MB of features."""
FAINTEST, DENSEST = 1e-5, 20.0
"""Optical depths of one march step at codes 0 and 255: from invisible to opaque, in steps of 5.9 %."""
FAR = 30.0
"""In contracted space a step has different lengths, from dphi on: codes begin at what is invisible even so
many model units away, where a step is as long as its square."""


@dataclass(frozen=True, eq=False)
class Layout:
    """Which vertices are stored, and how their densities are coded."""

    brick_coords: np.ndarray
    brick_masks: np.ndarray
    vertices: np.ndarray
    """[n_vertices, 3] grid indices, in the order of the rows on disk."""
    resolution: int
    step: float
    density_range: tuple[float, float]
    contracted: bool = False

    @property
    def aabb(self) -> tuple[tuple[float, ...], ...]:
        """The grid's box: that of an object, or of contracted space."""
        edge = 2.0 if self.contracted else 1.0
        return (-edge,) * 3, (edge,) * 3

    def unit_points(self, rows: slice) -> np.ndarray:
        """[n, 3] float32: where the vertices in `rows` are looked up in the unit cube of the field. Corners
        of cells that stick out of contracted space, where the field has learnt nothing, take what is at its
        border."""
        points = self.vertices[rows] / self.resolution
        if self.contracted:
            centred = points - 0.5
            norm = np.linalg.norm(centred, axis=-1, keepdims=True)
            points = np.where(norm > 0.5, centred * (0.5 / np.maximum(norm, 0.5)) + 0.5, points)
        return points.astype(np.float32)

    def arrays(self, density: np.ndarray, features: np.ndarray) -> GridArrays:
        """The asset's arrays, from codes that need not be whole: [n_vertices], [n_vertices, n_channels]."""
        whole = np.clip(np.rint(density), 0, 255).astype(np.uint8)
        return GridArrays(self.brick_coords, self.brick_masks, whole, encode_features(features))

    def grid(self, density: np.ndarray, features: np.ndarray) -> SparseGrid:
        """The grid that a player makes of `arrays`."""
        a = self.arrays(density, features)
        return build_grid(
            (a.brick_coords, a.brick_masks, a.density, a.features),
            self.resolution,
            np.array(self.aabb),
            self.step,
            self.density_range,
            self.contracted,
        )

    def float_grid(self, density: np.ndarray, features: np.ndarray) -> SparseGrid:
        """The same with features [n_vertices, n_channels] float32 as they are, for measuring alone."""
        empty = np.zeros((len(features), 1), np.float32)
        return replace(self.grid(density, empty), features=features)


def make_layout(visible: np.ndarray, step: float, contracted: bool = False) -> Layout:
    """Layout of the corners of the cells `visible` [n, n, n] bool, for march steps of `step`."""
    vertices = corner_vertices(visible)
    coords, masks, order = pack_vertices(vertices)
    longest = step * FAR**2 if contracted else step
    density_range = (float(np.log(FAINTEST / longest)), float(np.log(DENSEST / step)))
    whole = vertices[order].astype(np.int16)
    return Layout(coords, masks, whole, len(visible), step, density_range, contracted)


def evaluate_vertices(
    model: Model, layout: Layout, progress: Callable[[int, int], object]
) -> tuple[np.ndarray, np.ndarray]:
    """The field's features [n_vertices, n_channels] float32 and density codes [n_vertices] float32 there."""
    n = len(layout.vertices)
    features = np.empty((n, model.field.config.n_channels), np.float32)
    density = np.empty(n, np.float32)
    for start in range(0, n, VERTEX_CHUNK):
        rows = slice(start, start + VERTEX_CHUNK)
        points = layout.unit_points(rows)
        features[rows] = model.field.features(points)
        density[rows] = encode_density(model.field.log_densities(points), layout.density_range)
        progress(min(start + VERTEX_CHUNK, n), n)
    return features, density
