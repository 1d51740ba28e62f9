"""From cells to the arrays of an asset and back to a grid that can be marched.

Densities and features are stored at the vertices of two grids over the same box. What a picture loses first
is where a surface is: densities take the finer one, a byte a vertex; features, whose vertices take a byte a
channel, the coarser one.

Fewer feature channels are stored than the field has, at the least loss for the colours. Compositing is
linear, so a linear map of the features can be applied per vertex before it and undone after it:
W1 sum w_i F_i ~ (W1 Q) sum w_i (P F_i). With the second moment G = E[x x^T] of the rendered features
x = sum w_i F_i and the mean square M = E[J^T J] of the colours' derivatives J = A d rgb / dx, the colours'
error E |J (x - Q P x)|^2 is least, J and x taken as independent, for P = U^T S and Q = S^-1 U, where
S = M^(1/2) and U holds the first r eigenvectors of S G S (Eckart-Young).
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
from vfr_bake.baking.cells import Progress, Resolutions, corners_of, subdivided
from vfr_bake.baking.coarser_levels import pyramid_beneath, values_beneath
from vfr_bake.field.networks import Head
from vfr_bake.kernels.latent_rows import LARGEST_LATENT, PARTS, PARTS_BITS
from vfr_bake.kernels.stored_features import table
from vfr_bake.training.model_file import Model

SLAB = 64
"""Planes of vertices that are found together."""
VERTEX_CHUNK = 1 << 18
"""Vertices evaluated at once: 32 MB of features."""
FAINTEST, DENSEST = 1e-5, 20.0
"""Optical depths of one march step at codes 0 and 255: from invisible to opaque, in steps of 5.9 %."""
FAR = 30.0
"""Distance in model units, in contracted space: there a step is as long as dphi at the middle and as dphi
times the square of the distance far away. The smallest density code is invisible even at this distance."""
ROWS_AT_ONCE = 1 << 18
"""Vertices whose codes are rounded at once."""
FAR_OUT, N_RANKED = 1e-4, 250_000
"""Share of the vertices whose features may have larger codes than was asked for, and vertices that decide it.
The largest of ten million of a room was 2.5 times as large as all but a ten thousandth."""
LEAST_SENSITIVITY = 1e-6
"""Every eigenvalue of M is at least this share of their mean, so that S has an inverse."""


Parts = Iterable[tuple[slice, np.ndarray]]
"""Rows of a table, and what they hold [n, n_columns], part after part."""


@dataclass(frozen=True, eq=False)
class Vertices:
    """The stored vertices of a grid, in the order of the rows on disk."""

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
        """The cells of which these are the corners, on one level."""
        return self.values(np.zeros((len(self), 1), np.uint8)).pyramid

    def rows(self) -> VertexRows:
        return vertex_rows(self.pyramid)

    def values(self, codes: np.ndarray) -> PyramidValues:
        """The pyramid of one level with the codes [n] or [n, n_channels] of these vertices."""
        return from_vertices(VertexBricks(self.coords, self.masks, codes), self.resolution)


class Pyramids(NamedTuple):
    """The cells of an asset on all levels."""

    densities: Pyramid
    features: Pyramid


@dataclass(frozen=True, eq=False)
class Layout:
    """Which vertices are stored, and how their densities are coded."""

    densities: Vertices
    features: Vertices
    step: float
    """Length of a march step, as in `StoredCells`."""
    density_range: tuple[float, float]
    """Logarithms of the densities of codes 0 and 255."""
    contracted: bool = False
    near: float = 0.0
    """Distance at which rays begin in contracted space, model units."""
    density_step: int = 1
    """Density codes from one that is stored to the next."""

    @property
    def aabb(self) -> tuple[tuple[float, ...], ...]:
        """The grids' box: that of an object, or of contracted space."""
        edge = 2.0 if self.contracted else 1.0
        return (-edge,) * 3, (edge,) * 3

    @cached_property
    def pyramids(self) -> Pyramids:
        """Densities and features with coarser levels; the same where they lie at the same vertices."""
        densities = pyramid_beneath(self.densities.pyramid)
        same = self.features is self.densities
        return Pyramids(densities, densities if same else pyramid_beneath(self.features.pyramid))

    def forget(self) -> None:
        """Give up what was found of the vertices, some hundred megabytes; it is found again if asked for."""
        vars(self).pop("pyramids", None)
        for vertices in (self.densities, self.features):
            vars(vertices).pop("pyramid", None)

    def _densities(self, codes: np.ndarray) -> PyramidValues:
        """The pyramid of density codes [n] that need not be whole."""
        whole = np.clip(np.rint(codes), 0, 255).astype(np.uint8)[:, None]
        return values_beneath(self.pyramids.densities, whole, "densities", self.density_step)

    def finest(self, density: np.ndarray, features: np.ndarray) -> GridArrays:
        """The asset's finest level, from density codes [n] that need not be whole, and latent features
        [n_features, n_channels] int16."""
        return GridArrays(_finest(self._densities(density)), self.features.values(whole_codes(features)))

    def grid(self, density: np.ndarray, features: np.ndarray) -> SparseGrid:
        """The grid that a player makes of `finest`."""
        return self.played(self.finest(density, features))

    def played(self, arrays: GridArrays) -> SparseGrid:
        """The grid that a player makes of `arrays`, with single steps through all levels."""
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
    """The finest level alone."""
    one = Pyramid(stored.pyramid.resolution, stored.pyramid.levels[:1])
    vars(one)["vertices"] = stored.pyramid.vertices[:1]  # they need not be found again
    return PyramidValues(one, stored.values[:1])


def make_layout(
    visible: np.ndarray,
    step: float,
    resolutions: Resolutions,
    contracted: bool = False,
    near: float = 0.0,
    density_step: int = 1,
) -> Layout:
    """What is stored of the cells `visible` [n, n, n] bool, for march steps of `step`, from `near` on.

    Densities and features are stored at the corners of those cells of their own grids that lie in visible
    cells; `resolutions` are the cells along each axis of their grids.
    """
    longest = step * FAR**2 if contracted else step
    density_range = (float(np.log(FAINTEST / longest)), float(np.log(DENSEST / step)))
    densities = _corners(visible, resolutions.densities)
    same = resolutions.features == resolutions.densities
    features = densities if same else _corners(visible, resolutions.features)
    return Layout(densities, features, step, density_range, contracted, near, density_step)


def evaluate_densities(model: Model, layout: Layout, progress: Progress) -> np.ndarray:
    """The field's density codes [n_densities] float32."""
    vertices = layout.densities
    codes = np.empty(len(vertices), np.float32)
    for rows, points in _chunks(vertices, layout.contracted):
        codes[rows] = encode_density(model.field.log_densities(points), layout.density_range)
        progress(rows.stop, len(vertices))
    return codes


def some_features(model: Model, layout: Layout, matrix: np.ndarray) -> np.ndarray:
    """[n, n_stored] float32: the field's features times `matrix` [n_stored, n_channels] at N_RANKED of the
    vertices, spread evenly, or at all where there are no more."""
    vertices = layout.features
    index = vertices.index[:: max(-(-len(vertices) // N_RANKED), 1)]
    points = unit_points(index, vertices.resolution, layout.contracted)
    return model.field.features(points) @ matrix.T.astype(np.float32)


def latent_features(model: Model, layout: Layout, matrix: np.ndarray, progress: Progress) -> np.ndarray:
    """The field's features times `matrix` [n_stored, n_channels], which makes codes of them, as latent
    features [n_features, n_stored] int16."""
    features = table(len(layout.features), len(matrix))
    for rows, values in features_of_field(model, layout, matrix):
        features[rows] = values
        progress(rows.stop, len(features))
    return features


def features_of_field(model: Model, layout: Layout, matrix: np.ndarray) -> Parts:
    """The same a part at a time."""
    back = matrix.T.astype(np.float32)
    for rows, points in _chunks(layout.features, layout.contracted):
        yield rows, latent(model.field.features(points) @ back)


def _chunks(vertices: Vertices, contracted: bool) -> Iterator[tuple[slice, np.ndarray]]:
    for start in range(0, len(vertices), VERTEX_CHUNK):
        rows = slice(start, min(start + VERTEX_CHUNK, len(vertices)))
        yield rows, unit_points(vertices.index[rows], vertices.resolution, contracted)


def _corners(cells: np.ndarray, resolution: int) -> Vertices:
    """The corners of a grid's cells, `resolution` along each axis, that lie in `cells` [n, n, n] bool. They
    are found and put in order slab by slab, because a fine grid as a whole takes gigabytes. Slabs are some
    bricks thick, and bricks are ordered along x first."""
    parts = []
    for first in range(0, resolution + 1, SLAB):
        last = min(first + SLAB, resolution + 1)
        before = max(first - 1, 0)  # a vertex is a corner of the cells on both its sides
        corners = corners_of(subdivided(cells, resolution, slice(before, last)))
        index = np.argwhere(corners[first - before : last - before]).astype(np.int16)
        index[:, 0] += first
        coords, masks, order = pack_vertices(index)
        parts.append((coords, masks, index[order]))
    coords, masks, index = (np.concatenate(column) for column in zip(*parts, strict=True))
    return Vertices(coords, masks, index, resolution)


def unit_points(index: np.ndarray, resolution: int, contracted: bool) -> np.ndarray:
    """[n, 3] float32 points in the unit cube of the field at which vertices are evaluated. Corners of cells
    that stick out of contracted space, where the field is not trained, take what is at its border."""
    points = index / resolution
    if contracted:
        centred = points - 0.5
        norm = np.linalg.norm(centred, axis=-1, keepdims=True)
        points = np.where(norm > 0.5, centred * (0.5 / np.maximum(norm, 0.5)) + 0.5, points)
    return points.astype(np.float32)


@dataclass(frozen=True)
class Projection:
    """Stored channels are P F; the head is given Q P x."""

    matrix: np.ndarray
    """P [n_stored, n_channels]."""
    back: np.ndarray
    """Q [n_channels, n_stored]."""

    def first(self, n: int) -> Projection:
        """The best projection to the first n of its channels: the most important come first."""
        return Projection(self.matrix[:n], self.back[:, :n])


def project(sensitivity: np.ndarray, rendered: np.ndarray, n_stored: int) -> Projection:
    """The best projection to `n_stored` channels, or to all channels where there are no more.

    `sensitivity` [n_channels, n_channels] is M, `rendered` [n, n_channels] rendered features.

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


def head_sensitivity(head: Head, rendered: np.ndarray, dirs: np.ndarray, opacity: np.ndarray) -> np.ndarray:
    """M [n_channels, n_channels]: mean square of the derivatives of the shown colours, at `rendered` features
    [n, n_channels] seen along `dirs` [n, 3] with `opacity` [n]."""
    features = torch.from_numpy(rendered).requires_grad_(True)
    colours = head(features, torch.from_numpy(dirs)) * torch.from_numpy(opacity)[:, None]
    total = np.zeros((rendered.shape[1],) * 2)
    for channel in range(3):
        (gradient,) = torch.autograd.grad(colours[:, channel].sum(), features, retain_graph=channel < 2)
        total += gradient.double().numpy().T @ gradient.double().numpy()
    return total / max(len(rendered), 1)


def code_step(values: np.ndarray, levels: int = 127) -> float:
    """The step between signed codes of projected `values` [n, n_stored]; 1 if all values are 0. In all but
    FAR_OUT of the rows the largest magnitude has at most the code `levels`. The few others would make the
    steps of all coarse; their codes end at 127.

    It is the same for all channels: P makes an error in any of them weigh alike in the colours, so that the
    least bytes for a given error are those of one step, and a channel of little use takes few bits by itself.

    >>> code_step(np.array([[127.0, 0.0], [-254.0, 1.0]]))
    2.0
    """
    if not len(values):
        return 1.0
    magnitudes = np.maximum(values.max(axis=1), -values.min(axis=1))
    largest = np.quantile(magnitudes, 1 - FAR_OUT, method="higher") or max(values.max(), -values.min())
    return float(largest) / levels if largest > 0 else 1.0


def latent(values: np.ndarray) -> np.ndarray:
    """Codes that need not be whole as latent features, int16 in parts of a code
    (`vfr_bake.kernels.stored_features`), rounded down, so that `whole_codes` finds the nearest code; they end
    at 127.

    >>> latent(np.array([1.25, -3.5, 200.0])).tolist()
    [320, -896, 32512]
    """
    parts = np.floor(values * np.float32(PARTS))
    return np.clip(parts, -LARGEST_LATENT, LARGEST_LATENT).astype(np.int16)


def codes(values: np.ndarray) -> np.ndarray:
    """Codes as float32, from any that need not be whole or from latent features as int16.

    >>> codes(latent(np.array([1.25, -3.5]))).tolist(), codes(np.array([1.25])).tolist()
    ([1.25, -3.5], [1.25])
    """
    unit = 1 / PARTS if values.dtype == np.int16 else 1
    return values.astype(np.float32) * np.float32(unit)


def whole_codes(features: np.ndarray) -> np.ndarray:
    """The codes nearest to latent features [n_vertices, n_stored] int16, as signed bytes; ties upwards.

    >>> whole_codes(latent(np.array([[1.25, -3.5, 200.0]]))).tolist()
    [[1, -3, 127]]
    """
    whole = np.empty(features.shape, np.int8)
    for first in range(0, len(features), ROWS_AT_ONCE):
        rows = slice(first, first + ROWS_AT_ONCE)
        whole[rows] = (features[rows] + np.int16(PARTS // 2)) >> PARTS_BITS
    return whole


def remainders(features: np.ndarray) -> np.ndarray:
    """What `whole_codes` rounds away of latent features [n_vertices, n_stored], as signed bytes: their low
    bytes."""
    return features.astype(np.int8)


def with_remainders(whole: np.ndarray, left: np.ndarray) -> Parts:
    """The latent features of which `whole_codes` made `whole` and `remainders` made `left`, a part at a time.

    >>> features = latent(np.array([[1.25, -3.5]]))
    >>> [part.tolist() for _, part in with_remainders(whole_codes(features), remainders(features))]
    [[[320, -896]]]
    """
    for first in range(0, len(whole), ROWS_AT_ONCE):
        rows = slice(first, first + ROWS_AT_ONCE)
        yield rows, (whole[rows].astype(np.int16) << PARTS_BITS) + left[rows]


def move_towards(features: np.ndarray, others: Parts, share: float) -> None:
    """Move latent features [n_vertices, n_stored], in place, by a `share` of the way to `others`, which are
    given a part at a time: there may be no room for both.

    >>> features = np.zeros((3, 1), np.int16)
    >>> move_towards(features, [(slice(0, 2), np.full((2, 1), 40, np.int16))], 0.25)
    >>> features[:, 0].tolist()
    [10, 10, 0]
    """
    for rows, values in others:
        way = values.astype(np.float32) - features[rows]
        features[rows] += np.rint(np.float32(share) * way).astype(np.int16)
