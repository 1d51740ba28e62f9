"""Make the arrays of an asset from its cells, and from the arrays a grid that can be marched.

Densities and features are stored at the vertices of two grids over the same box. Pictures suffer first from
surfaces that are in the wrong place. So densities, which take one byte a vertex, are on the finer grid, and
features, which take one byte a channel, on the coarser one.

Fewer feature channels are stored than the field has, chosen for the least error of the colours. Compositing
is linear, so a linear map of the features can be applied at each vertex before it and undone after it:
W1 sum w_i F_i ~ (W1 Q) sum w_i (P F_i). Let G = E[x x^T] be the second moment of the rendered features
x = sum w_i F_i, and M = E[J^T J] the mean square of the colours' derivatives J = A d rgb / dx. If J and x are
independent, the colours' error E |J (x - Q P x)|^2 is least for P = U^T S and Q = S^-1 U, where S = M^(1/2)
and U holds the first r eigenvectors of S G S (Eckart-Young).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch

from player.asset.asset import GridArrays
from player.asset.bricks import pack_vertices
from player.asset.density import encode_density
from player.asset.grid import SparseGrid, VertexRows, build_grid, vertex_rows
from player.asset.pyramid import Pyramid, PyramidValues
from player.asset.single_level import VertexBricks, from_vertices
from player.progress import Progress
from vfr_bake.baking.cells import Resolutions, corners_of, subdivided
from vfr_bake.baking.coarser_levels import pyramid_beneath, values_beneath
from vfr_bake.field.networks import HeadNetwork
from vfr_bake.kernels.latent_rows import LARGEST_LATENT, PARTS, PARTS_BITS
from vfr_bake.kernels.stored_features import table
from vfr_bake.training.model_file import Model

SIDE = 64
"""Vertices along each side of the blocks in which vertices are found: small enough that most of the blocks
hold none and are passed over, whole bricks wide."""
VERTEX_CHUNK = 1 << 18
"""Vertices that are evaluated at a time: 32 MB of features."""
FAINTEST, DENSEST = 1e-5, 20.0
"""Optical depths of one march step at density codes 0 and 255: from invisible to opaque, in steps of
5.9 %."""
FAR = 30.0
"""Distance in contracted space, model units, at which the smallest density code is still invisible. March
steps become longer with the distance: dphi at the middle, dphi times the square of the distance far away."""
ROWS_AT_ONCE = 1 << 18
"""Vertices whose codes are rounded at a time."""
FAR_OUT, N_RANKED = 1e-4, 250_000
"""Share of the vertices whose features may exceed the largest code asked for, and number of vertices from
which the code step is computed. In a room, the largest of ten million feature vectors was 2.5 times as large
as the quantile that leaves out this share."""
LEAST_SENSITIVITY = 1e-6
"""Least eigenvalue of M, as a share of their mean: smaller ones are raised to it, so that S has an
inverse."""
RAYS_DERIVED = 8192
"""Rays at once at which the head is differentiated: each holds the activations of all layers."""

Parts = Iterable[tuple[slice, np.ndarray]]
"""A table part by part: pairs of a slice of rows and the values [n, n_columns] in them."""


@dataclass(frozen=True, eq=False)
class GridVertices:
    """The stored vertices of a grid, in the order of their rows on disk."""

    coords: np.ndarray
    masks: np.ndarray
    """Coordinates and masks of the bricks that hold the vertices, as in `player.asset.bricks`."""
    index: np.ndarray
    """[n, 3] int16 position of each vertex, in cells."""
    resolution: int
    """Cells per axis."""

    def __len__(self) -> int:
        return len(self.index)

    @cached_property
    def pyramid(self) -> Pyramid:
        """The pyramid of one level whose live cells have these vertices as corners."""
        return self.values(np.zeros((len(self), 1), np.uint8)).pyramid

    def rows(self) -> VertexRows:
        return vertex_rows(self.pyramid)

    def values(self, codes: np.ndarray) -> PyramidValues:
        """Return the pyramid of one level with these vertices and their `codes` [n] or [n, n_channels]."""
        return from_vertices(VertexBricks(self.coords, self.masks, codes), self.resolution)


class Pyramids(NamedTuple):
    """The cells of an asset's two grids on all levels."""

    densities: Pyramid
    features: Pyramid


@dataclass(frozen=True, eq=False)
class Layout:
    """The stored vertices, and the coding of their densities."""

    densities: GridVertices
    features: GridVertices
    step: float
    """Length of a march step, as in `StoredCells`."""
    density_range: tuple[float, float]
    """Logarithms of the densities that the codes 0 and 255 stand for."""
    contracted: bool = False
    near: float = 0.0
    """Distance at which rays begin in contracted space, model units."""
    density_step: int = 1
    """Quantization step of the density codes, in codes."""

    @property
    def aabb(self) -> tuple[tuple[float, ...], ...]:
        """The box of both grids: the box of an object, or of contracted space."""
        edge = 2.0 if self.contracted else 1.0
        return (-edge,) * 3, (edge,) * 3

    @cached_property
    def pyramids(self) -> Pyramids:
        """The pyramids of densities and features, with coarser levels. They are the same object if both have
        the same vertices."""
        densities = pyramid_beneath(self.densities.pyramid)
        same = self.features is self.densities
        return Pyramids(densities, densities if same else pyramid_beneath(self.features.pyramid))

    def forget(self) -> None:
        """Free the cached pyramids, some hundred megabytes. They are computed again if they are needed."""
        vars(self).pop("pyramids", None)
        for vertices in (self.densities, self.features):
            vars(vertices).pop("pyramid", None)

    def _densities(self, codes: np.ndarray) -> PyramidValues:
        """Return the pyramid of densities with the `codes` [n], which need not be whole, quantized."""
        whole = np.clip(np.rint(codes), 0, 255).astype(np.uint8)[:, None]
        return values_beneath(self.pyramids.densities, whole, "densities", self.density_step)

    def finest(self, density: np.ndarray, features: np.ndarray) -> GridArrays:
        """Return the asset's finest level, from density codes `density` [n], which need not be whole, and
        latent `features` [n_features, n_channels] int16."""
        return GridArrays(_finest(self._densities(density)), self.features.values(whole_codes(features)))

    def grid(self, density: np.ndarray, features: np.ndarray) -> SparseGrid:
        """Return the grid that a player makes of `finest`."""
        return self.played(self.finest(density, features))

    def played(self, arrays: GridArrays) -> SparseGrid:
        """Return the grid that a player makes of `arrays`, marched in base steps on all levels."""
        return build_grid(
            arrays.densities,
            arrays.features,
            np.array(self.aabb),
            self.step,
            (1,) * len(arrays.densities.values),
            self.density_range,
            self.contracted,
            self.near,
        )


def _finest(stored: PyramidValues) -> PyramidValues:
    """Return the finest level alone."""
    one = Pyramid(stored.pyramid.resolution, stored.pyramid.levels[:1])
    vars(one)["vertices"] = stored.pyramid.vertices[:1]  # reuse the vertices that were already found
    return PyramidValues(one, stored.values[:1])


def make_layout(
    visible: np.ndarray,
    step: float,
    resolutions: Resolutions,
    contracted: bool = False,
    near: float = 0.0,
    density_step: int = 1,
) -> Layout:
    """Lay out the values to store for the cells `visible` [n, n, n] bool.

    Densities and features are stored at the corners of those cells of their own grids whose centre is in a
    visible cell. `resolutions` are the cells along each axis of the two grids. `step` is the length of a
    march step; in contracted space, rays begin at the distance `near`.
    """
    longest = step * FAR**2 if contracted else step
    density_range = (float(np.log(FAINTEST / longest)), float(np.log(DENSEST / step)))
    densities = _corners(visible, resolutions.densities)
    same = resolutions.features == resolutions.densities
    features = densities if same else _corners(visible, resolutions.features)
    return Layout(densities, features, step, density_range, contracted, near, density_step)


def evaluate_densities(model: Model, layout: Layout, progress: Progress) -> np.ndarray:
    """Evaluate the field's densities at the stored vertices. Returns whole codes [n_densities] float32."""
    vertices = layout.densities
    codes = np.empty(len(vertices), np.float32)
    for rows, points in _chunks(vertices, layout.contracted):
        codes[rows] = encode_density(model.field.log_densities(points), layout.density_range)
        progress(rows.stop, len(vertices))
    return codes


def some_features(model: Model, layout: Layout, matrix: np.ndarray) -> np.ndarray:
    """Return [n, n_stored] float32: the field's features, multiplied by `matrix` [n_stored, n_channels], at
    up to N_RANKED of the vertices, spread evenly."""
    vertices = layout.features
    index = vertices.index[:: max(-(-len(vertices) // N_RANKED), 1)]
    points = unit_points(index, vertices.resolution, layout.contracted)
    return model.field.features(points) @ matrix.T.astype(np.float32)


def latent_features(model: Model, layout: Layout, matrix: np.ndarray, progress: Progress) -> np.ndarray:
    """Return the field's features at all stored vertices as latent features [n_features, n_stored] int16.
    `matrix` [n_stored, n_channels] maps the field's features to codes."""
    features = table(len(layout.features), len(matrix))
    for rows, values in features_of_field(model, layout, matrix):
        features[rows] = values
        progress(rows.stop, len(features))
    return features


def features_of_field(model: Model, layout: Layout, matrix: np.ndarray) -> Parts:
    """Yield the same latent features as `latent_features`, part by part."""
    back = matrix.T.astype(np.float32)
    for rows, points in _chunks(layout.features, layout.contracted):
        yield rows, latent(model.field.features(points) @ back)


def _chunks(vertices: GridVertices, contracted: bool) -> Iterator[tuple[slice, np.ndarray]]:
    for start in range(0, len(vertices), VERTEX_CHUNK):
        rows = slice(start, min(start + VERTEX_CHUNK, len(vertices)))
        yield rows, unit_points(vertices.index[rows], vertices.resolution, contracted)


def _corners(cells: np.ndarray, resolution: int) -> GridVertices:
    """Return the corners of those cells of a grid of `resolution` that lie in `cells` [n, n, n] bool.

    They are found block by block and sorted slab by slab, because a whole fine grid would take gigabytes. The
    result is in order, because slabs are whole bricks thick and bricks are sorted along x first.
    """
    parts, firsts = [], range(0, resolution + 1, SIDE)
    for x in firsts:
        blocks = [_corners_in_block(cells, resolution, (x, y, z)) for y in firsts for z in firsts]
        index = np.concatenate(blocks)
        coords, masks, order = pack_vertices(index)
        parts.append((coords, masks, index[order]))
    coords, masks, index = (np.concatenate(column) for column in zip(*parts, strict=True))
    return GridVertices(coords, masks, index, resolution)


def _corners_in_block(cells: np.ndarray, resolution: int, first: tuple[int, int, int]) -> np.ndarray:
    """Return those of the corners [n, 3] int16 that are in the block of SIDE^3 vertices from `first` on."""
    before = [max(at - 1, 0) for at in first]  # a vertex is a corner of the cells on both sides of it
    last = [min(at + SIDE, resolution + 1) for at in first]
    fine = subdivided(cells, resolution, [slice(*of_axis) for of_axis in zip(before, last, strict=True)])
    if not fine.any():
        return np.zeros((0, 3), np.int16)
    inside = tuple(slice(a - b, c - b) for a, b, c in zip(first, before, last, strict=True))
    return (np.argwhere(corners_of(fine)[inside]) + first).astype(np.int16)


def unit_points(index: np.ndarray, resolution: int, contracted: bool) -> np.ndarray:
    """Return [n, 3] float32: the points, in the unit cube of the field, at which the vertices `index` [n, 3]
    are evaluated. Vertices outside contracted space, where the field is not trained, are moved to its
    border."""
    points = index / resolution
    if contracted:
        centred = points - 0.5
        norm = np.linalg.norm(centred, axis=-1, keepdims=True)
        points = np.where(norm > 0.5, centred * (0.5 / np.maximum(norm, 0.5)) + 0.5, points)
    return points.astype(np.float32)


@dataclass(frozen=True)
class Projection:
    """The projection to fewer channels: P F is stored, and the head is given Q P x."""

    matrix: np.ndarray
    """P [n_stored, n_channels]."""
    back: np.ndarray
    """Q [n_channels, n_stored]."""

    def first(self, n: int) -> Projection:
        """Return the best projection to `n` channels: the first ones, because they matter most."""
        return Projection(self.matrix[:n], self.back[:, :n])


def project(sensitivity: np.ndarray, rendered: np.ndarray, n_stored: int) -> Projection:
    """Return the best projection to `n_stored` channels, or to all channels if there are fewer.

    `sensitivity` [n_channels, n_channels] is M; `rendered` [n, n_channels] are rendered features, from which
    G is computed.

    >>> p = project(np.eye(3), np.diag([3.0, 2.0, 1e-9]), 2)
    >>> bool(np.allclose(p.back @ p.matrix, np.diag([1, 1, 0]), atol=1e-6))
    True
    """
    n_channels = len(sensitivity)
    least = LEAST_SENSITIVITY * max(float(np.trace(sensitivity)) / n_channels, 1e-30)
    values, vectors = np.linalg.eigh(sensitivity.astype(np.float64))
    root = np.sqrt(np.maximum(values, least))
    s, inverse = (vectors * root) @ vectors.T, (vectors / root) @ vectors.T
    moment = rendered.astype(np.float64).T @ rendered.astype(np.float64) / max(len(rendered), 1)
    _, basis = np.linalg.eigh(s @ moment @ s)
    basis = basis[:, ::-1][:, :n_stored]
    return Projection(basis.T @ s, inverse @ basis)


def head_sensitivity(
    head: HeadNetwork, rendered: np.ndarray, dirs: np.ndarray, opacity: np.ndarray
) -> np.ndarray:
    """Return M [n_channels, n_channels], the mean square of the derivatives of the shown colours, at the
    `rendered` features [n, n_channels] seen along `dirs` [n, 3] with `opacity` [n]."""
    total = np.zeros((rendered.shape[1],) * 2)
    for first in range(0, len(rendered), RAYS_DERIVED):
        some = slice(first, first + RAYS_DERIVED)
        features = torch.from_numpy(rendered[some]).requires_grad_(True)
        colours = head(features, torch.from_numpy(dirs[some])) * torch.from_numpy(opacity[some])[:, None]
        for channel in range(3):
            (gradient,) = torch.autograd.grad(colours[:, channel].sum(), features, retain_graph=channel < 2)
            total += gradient.double().numpy().T @ gradient.double().numpy()
    return total / max(len(rendered), 1)


def code_step(values: np.ndarray, levels: int = 127) -> float:
    """Return the quantization step of signed codes for the projected `values` [n, n_stored]; 1 if all are 0.

    With this step, all codes of a row have at most the magnitude `levels`, except in a share FAR_OUT of the
    rows. Those few rows would make the step coarse for all; their codes are clipped at 127 instead.

    All channels have the same step. P scales them such that an error in any channel counts alike in the
    colours. For a given error, one common step then takes the fewest bytes, and a channel of little use takes
    few bits by itself.

    >>> code_step(np.array([[127.0, 0.0], [-254.0, 1.0]]))
    2.0
    """
    if not len(values):
        return 1.0
    magnitudes = np.maximum(values.max(axis=1), -values.min(axis=1))
    largest = np.quantile(magnitudes, 1 - FAR_OUT, method="higher") or max(values.max(), -values.min())
    return float(largest) / levels if largest > 0 else 1.0


def latent(values: np.ndarray) -> np.ndarray:
    """Convert codes that need not be whole to latent features: int16, in parts of a code
    (`vfr_bake.kernels.stored_features`).

    Values are rounded down to parts, so that `whole_codes` finds the nearest code, and clipped at codes of
    magnitude 127.

    >>> latent(np.array([1.25, -3.5, 200.0])).tolist()
    [320, -896, 32512]
    """
    parts = np.floor(values * np.float32(PARTS))
    return np.clip(parts, -LARGEST_LATENT, LARGEST_LATENT).astype(np.int16)


def codes(values: np.ndarray) -> np.ndarray:
    """Convert to codes as float32, which need not be whole, from latent features (int16) or from codes of any
    other dtype.

    >>> codes(latent(np.array([1.25, -3.5]))).tolist(), codes(np.array([1.25])).tolist()
    ([1.25, -3.5], [1.25])
    """
    unit = 1 / PARTS if values.dtype == np.int16 else 1
    return values.astype(np.float32) * np.float32(unit)


def whole_codes(features: np.ndarray) -> np.ndarray:
    """Round latent features [n_vertices, n_stored] int16 to the nearest codes, int8; ties are rounded up.

    >>> whole_codes(latent(np.array([[1.25, -3.5, 200.0]]))).tolist()
    [[1, -3, 127]]
    """
    whole = np.empty(features.shape, np.int8)
    for first in range(0, len(features), ROWS_AT_ONCE):
        rows = slice(first, first + ROWS_AT_ONCE)
        whole[rows] = (features[rows] + np.int16(PARTS // 2)) >> PARTS_BITS
    return whole


def with_remainders(whole: np.ndarray, left: np.ndarray) -> Parts:
    """Yield, part by part, the latent features of which `whole` are the `whole_codes` and `left`, int8, the
    low bytes: what is rounded away.

    >>> features = latent(np.array([[1.25, -3.5]]))
    >>> [part.tolist() for _, part in with_remainders(whole_codes(features), features.astype(np.int8))]
    [[[320, -896]]]
    """
    for first in range(0, len(whole), ROWS_AT_ONCE):
        rows = slice(first, first + ROWS_AT_ONCE)
        yield rows, (whole[rows].astype(np.int16) << PARTS_BITS) + left[rows]


def move_towards(features: np.ndarray, others: Parts, share: float) -> None:
    """Move latent features [n_vertices, n_stored], in place, by a `share` of the way to `others`.

    `others` are given part by part, because there may be no memory for both tables.

    >>> features = np.zeros((3, 1), np.int16)
    >>> move_towards(features, [(slice(0, 2), np.full((2, 1), 40, np.int16))], 0.25)
    >>> features[:, 0].tolist()
    [10, 10, 0]
    """
    for rows, values in others:
        way = values.astype(np.float32) - features[rows]
        features[rows] += np.rint(np.float32(share) * way).astype(np.int16)
