"""Find the cells of the grid that a bake stores, and the length of the player's steps through them.

In an object's box, the cells that matter to the pictures are stored. The weight of a single sample says
little about that: in a fog every sample of a ray weighs next to nothing, but their sum is the picture. So
cells whose samples weigh less than a floor in every view are left out only if the pictures without them lose
next to nothing. That is measured on pixels that training has not learned from: rays through the others mark
cells themselves.

An unbounded scene has no occupancy grid, and the field holds untrained values where no view has ever put a
sample. So a cell is stored only if samples that the model's sampler chose on some ray have weight in it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import torch

from player.cameras.camera import Camera
from player.errors import TrainingError
from player.march.contracted import MAX_SPEED
from player.progress import Progress
from vfr_bake.baking.held_out import BETWEEN, MARGIN, HeldOut, Shown, views_between, widened
from vfr_bake.config import BakeConfig
from vfr_bake.field.field import VfrField
from vfr_bake.kernels.density import LIMITS
from vfr_bake.kernels.march import chebyshev_distance, render_features
from vfr_bake.kernels.visibility import mark_weighty_cells, render_and_mark
from vfr_bake.rendering.compositing import composite
from vfr_bake.rendering.occupancy import OccupancyGrid
from vfr_bake.training.model_file import Model

FLOORS = (0.02, 0.01, 0.005, 0.002, 0.001)
"""Weight floors: the weight that a sample must have in some view for its cell to be stored. They are tried in
this order; the first that loses little enough is used. If none does, nothing is left out."""
HITS, CONTRACTED_HITS = 8, 24
"""Mean number of rays, over all views, that meet a surface cell of a box, and a block of cells at the unit
sphere of an unbounded scene. Cells of a box that are missed nevertheless are gaps, which are closed."""
MOST_SEEING = 2_000_000
"""Most rays that search for the cells of an unbounded scene. It bounds the time, however many views there are
and wherever they stand. Fox needs 1.2 million rays for CONTRACTED_HITS hits."""
MOST_MARKING = 10_000_000
"""Most rays that search for the cells of an object, for the same reason. Lego at 460 cells needs 5.2 million
rays for HITS hits."""
LEAST_DISTANCE = 0.5
"""Distance, model units, at which a camera counts at least. A camera at the origin, as in a walk through a
room, would seem to meet every cell by itself, although it stands a unit away from those at the unit
sphere."""
VIEWS_OF_A_CELL = 0.4
"""Rough share of the training views that see a given piece of surface."""
BLOCK = 2
"""Cells along each edge of a block. In an unbounded scene whole blocks are marked, not cells, so that a
quarter of the rays is enough: sampling is slow (4,000 rays a second on one core for a model with proposals).
Surfaces are some cells thick anyway."""
FASTEST_CELLS = 2.0
"""Cells between two samples of a ray where it is fastest in contracted space; where it is slowest, two fifths
of that."""
CONTRACTED_RAYS_AT_ONCE = 1 << 14
WEIGHT_FLOOR = 0.01
"""Default weight that a cell of an unbounded scene must have on some ray. Fox at 1088 cells loses nothing by
it; with 0.003 it would have half again as many vertices."""
FOG_FLOOR = 1e-6
"""Default weight where no cell reaches WEIGHT_FLOOR, as in a thin even fog: low enough for all of the fog."""
CELL_SHARE = 0.008
"""Share of the cells of contracted space that is expected to be stored, before a scene is examined."""


class Resolutions(NamedTuple):
    """Cells per axis of the two grids of an asset."""

    densities: int
    features: int


class StoredCells(NamedTuple):
    """The cells to store, and the march step through them."""

    visible: np.ndarray
    """[n, n, n] bool: cells of the features' grid, or blocks of them."""
    step: float
    """Length of a march step: model units in a box, dphi of `player.march.contracted` in contracted space."""
    left_out: str | None
    """Description of the cells that are not stored; None without culling."""


class FittedCells(NamedTuple):
    """Cells to store, and resolutions that are low enough for them to fit into the room there is."""

    cells: np.ndarray
    """[n, n, n] bool: cells of the features' grid, or blocks of them."""
    resolutions: Resolutions
    n_cells: int
    """Rough number of stored cells of the features' grid."""


def fit_cells(cells: np.ndarray, resolutions: Resolutions, most: int) -> FittedCells:
    """Choose the finest grids, up to `resolutions`, with at most `most` feature cells inside `cells`.

    `cells` [n, n, n] bool covers the same box; it becomes coarser if the features' grid must be coarser.

    >>> fog = np.ones((8, 8, 8), bool)
    >>> fit_cells(fog, Resolutions(20, 16), 5000)[1:]
    (Resolutions(densities=20, features=16), 4096)
    >>> fit_cells(fog, Resolutions(20, 16), 1000)[1:]
    (Resolutions(densities=12, features=10), 1000)
    """
    while True:
        n = int(np.count_nonzero(cells))
        finest = int(len(cells) * (most / n) ** (1 / 3))
        if finest >= resolutions.features:
            return FittedCells(cells, resolutions, int(n * (resolutions.features / len(cells)) ** 3))
        if finest >= len(cells):
            densities = resolutions.densities * finest // resolutions.features
            return FittedCells(cells, Resolutions(densities, finest), int(n * (finest / len(cells)) ** 3))
        cells = _overlapping(cells, -(-len(cells) // 2))


def _overlapping(cells: np.ndarray, resolution: int) -> np.ndarray:
    """Resample `cells` [n, n, n] bool to a grid of `resolution` over the same box: a cell is marked if it
    overlaps a marked one.

    >>> _overlapping(np.array([True, False, False]).reshape(3, 1, 1).repeat(3, 1).repeat(3, 2), 2)[:, 0, 0]
    array([ True, False])
    """
    n = len(cells)
    first = np.arange(resolution) * n // resolution
    last = (np.arange(1, resolution + 1) * n - 1) // resolution
    for axis in range(3):
        parts = [cells.take(np.minimum(first + i, last), axis) for i in range(max(last - first) + 1)]
        cells = np.logical_or.reduce(parts)
    return cells


class MarkingGrid:
    """An object's occupancy grid that also marks the cells in which samples weigh enough, while features are
    composited along rays for another purpose."""

    def __init__(self, grid: OccupancyGrid, resolution: int, floors: Sequence[float]) -> None:
        """`resolution` is that of the marked cells; `floors` are the weights that samples must have."""
        self._grid, self._floors = grid, np.array(floors, np.float32)
        self.n_rays = 0
        """Rays that were marched so far."""
        self.marks = np.zeros((*(resolution,) * 3, len(floors)), np.uint8)
        """[resolution, resolution, resolution, n_floors]: 1 for each cell and floor for which a sample in the
        cell weighs at least the floor."""

    def composited_features(
        self, field: VfrField, rays_o: np.ndarray, rays_d: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return what `OccupancyGrid.composited_features` returns, and mark cells."""
        return self._march(field, rays_o, rays_d, float(self._grid.step), field.config.n_channels)

    def mark(self, field: VfrField, rays_o: np.ndarray, rays_d: np.ndarray) -> None:
        """Mark cells alone, in steps no longer than a cell: samples must not skip cells, because other rays
        than these will be played."""
        self._march(field, rays_o, rays_d, min(self._grid.step, 2 / len(self.marks)), 0)

    def _march(
        self, field: VfrField, rays_o: np.ndarray, rays_d: np.ndarray, step: float, n_channels: int
    ) -> tuple[np.ndarray, np.ndarray]:
        features = np.zeros((len(rays_o), n_channels), np.float32)
        opacity = np.zeros(len(rays_o), np.float32)
        render_and_mark(
            rays_o, rays_d, np.float32(step), self._grid.distance, field.arrays(), LIMITS, self._floors,
            self.marks, features, opacity,
        )  # fmt: skip
        self.n_rays += len(rays_o)
        return features, opacity


def marking_grid(model: Model, config: BakeConfig, resolution: int) -> MarkingGrid | None:
    """Return the grid that marks cells of `resolution` cells an axis for `find_cells`; None for an unbounded
    scene, and if no cells are to be left out."""
    if model.field.config.unbounded or config.no_cull:
        return None
    floors = FLOORS if config.weight_floor is None else (config.weight_floor,)
    return MarkingGrid(model.occupancy, resolution, floors)


def find_cells(
    model: Model,
    config: BakeConfig,
    resolutions: Resolutions,
    held_out: HeldOut,
    marking: MarkingGrid | None,
    progress: Progress,
) -> StoredCells:
    """Find the cells of an object's box, or of contracted space, that matter in some view. `marking` is the
    result of `marking_grid`, with which rays may have been marched already.

    Raises TrainingError if nothing is seen.
    """
    if model.field.config.unbounded:
        floor = config.weight_floor or WEIGHT_FLOOR
        visible = weighty_cells(model, resolutions.features, floor, progress)
        if config.weight_floor is None and not visible.any():
            floor = FOG_FLOOR
            visible = weighty_cells(model, resolutions.features, floor, progress)
        if not visible.any():
            raise _nothing_seen(floor)
        left_out = (
            f"{1 - visible.mean():.1%} of contracted space: no view gives a cell there a weight of "
            f"{floor:g}; part of the loss after 'grid'"
        )
        return StoredCells(visible, lattice_step(resolutions.densities), left_out)
    step = float(model.occupancy.step)
    if marking is None:
        return StoredCells(occupied_cells(model, resolutions.features), step, None)
    mark_rest(model, marking, progress)
    most_db = config.choice().culled_loss_db
    cells = cull(model, marking.marks, held_out, config.weight_floor, most_db)
    return StoredCells(cells.visible, step, cells.report())


@dataclass(frozen=True, eq=False)
class CulledCells:
    """The stored cells of a box, and the figures by which they were chosen."""

    visible: np.ndarray
    """[n, n, n] bool: the stored cells."""
    floor: float = 0.0
    """The weight that a sample must have; 0 if every cell that may hold matter is stored."""
    lost: dict[float, float] = field(default_factory=dict)
    """Loss in dB by each floor that was tried, taken alone."""
    removed: float = 0.0
    """Number of cells that are not stored, as a share of all cells that may hold matter."""

    def report(self) -> str:
        """Describe in words which cells were left out and what that changed."""
        tried = ", ".join(f"{loss:.3f} dB at {floor:g}" for floor, loss in self.lost.items())
        if not self.floor:
            return f"none: leaving out what weighs little loses too much ({tried or 'nothing weighs enough'})"
        return (
            f"{self.removed:.0%} of the cells that the model may hold matter in: no view gives them a weight "
            f"of {self.floor:g}; loss by the floor of weight, part of that after 'grid': {tried}"
        )


def cull(
    model: Model, marks: np.ndarray, held_out: HeldOut, floor: float | None, most_db: float
) -> CulledCells:
    """Find the cells that weigh enough in some view, by the `marks` of a `MarkingGrid`.

    Gaps of one cell between them are closed. Cells beside them in which the model may hold matter are added.

    `floor` is the weight that the cells must have; None takes the highest of FLOORS that loses at most
    `most_db`, compared with storing all cells. Raises TrainingError if a `floor` was given and no cell
    reaches it.
    """
    held = occupied_cells(model, len(marks))
    floors = FLOORS if floor is None else (floor,)
    every = _shown(model, held_out, held)
    lost: dict[float, float] = {}
    for level, tried in enumerate(floors):
        weighty = close_gaps(np.ascontiguousarray(marks[..., level]).view(bool))
        if not weighty.any():
            continue
        visible = weighty | (held & beside(weighty))
        loss = held_out.lost(every, _shown(model, held_out, visible))
        lost[tried] = loss.db
        if loss.most <= most_db or floor is not None:
            removed = 1 - float(visible.sum()) / max(int(held.sum()), 1)
            return CulledCells(visible, tried, lost, max(removed, 0.0))
    if floor is not None:
        raise _nothing_seen(floor)
    return CulledCells(held, lost=lost)


def _nothing_seen(floor: float) -> TrainingError:
    return TrainingError(
        f"no cell weighs {floor:g} in any training view: the model is empty or a thin fog: "
        "train longer, or lower --weight-floor"
    )


def _shown(model: Model, held_out: HeldOut, cells: np.ndarray) -> Shown:
    """Return what the model shows if only `cells` [n, n, n] bool hold matter."""
    distance = np.empty(cells.shape, np.uint8)
    chebyshev_distance(cells, distance)
    features = np.zeros((len(held_out.rays_o), model.field.config.n_channels), np.float32)
    opacity = np.zeros(len(features), np.float32)
    render_features(
        held_out.rays_o, held_out.rays_d, np.float32(model.occupancy.step), distance,
        model.field.arrays(), LIMITS, features, opacity,
    )  # fmt: skip
    return held_out.compare(features, opacity)


def mark_rest(model: Model, marking: MarkingGrid, progress: Progress) -> None:
    """March the rays that are still missing for `marking` to have met every surface cell about HITS times.

    Their views are the training cameras and as many between them. Whatever the sizes of the pictures and the
    distances of the cameras, rays are as dense as it takes for each view to meet the cells as often; but all
    rays together are at most MOST_MARKING.
    """
    resolution = len(marking.marks)
    missing = rays_of_views(model, resolution) - marking.n_rays
    if missing <= 0:
        return
    cameras = model.model_cameras()
    cameras += views_between(model, len(cameras), seed=0)
    thinner = np.sqrt(missing / _wanted_rays(model, resolution))
    for index, camera in enumerate(cameras):
        density = thinner * _ray_density(camera, len(cameras), resolution)
        marking.mark(model.field, *camera.scaled(density).rays())
        progress(index + 1, len(cameras))


def occupied_cells(model: Model, resolution: int) -> np.ndarray:
    """Return [resolution]^3 bool: the cells that overlap an occupied cell of the training's occupancy
    grid."""
    return _overlapping(model.occupancy.occupied, resolution)


def pixel_footprints(model: Model) -> np.ndarray:
    """Return [n_views]: the size of each training camera's pixels at the origin of the model frame, model
    units (`_footprint`)."""
    return np.array([_footprint(camera) for camera in model.model_cameras()])


def _footprint(camera: Camera) -> float:
    """Return the size of a camera's pixels at the origin, which counts as at least LEAST_DISTANCE away."""
    return max(float(np.linalg.norm(camera.c2w[:3, 3])), LEAST_DISTANCE) / camera.fx


def rays_of_views(model: Model, resolution: int) -> float:
    """Return the expected number of rays that search for cells."""
    return min(_wanted_rays(model, resolution), MOST_MARKING)


def _wanted_rays(model: Model, resolution: int) -> float:
    """Return the number of rays with which each surface cell is met HITS times."""
    cameras = model.model_cameras()
    densities = [_ray_density(camera, 2 * len(cameras), resolution) for camera in cameras]
    return 2 * sum(d**2 * c.width * c.height for d, c in zip(densities, cameras, strict=True))


def _ray_density(camera: Camera, n_views: int, resolution: int) -> float:
    """Return the camera's rays per pixel, along each image axis, with which rays of `n_views` such views meet
    each surface cell at the middle of the box HITS times; 4 at most."""
    hits = VIEWS_OF_A_CELL * n_views * (2 / resolution / _footprint(camera)) ** 2
    return min(float(np.sqrt(HITS / hits)), 4.0)


def close_gaps(cells: np.ndarray) -> np.ndarray:
    """Fill holes and cracks of one cell in [n, n, n] bool, by morphological closing with a cube of 3 cells.

    >>> row = np.zeros((5, 5, 5), bool)
    >>> row[1:4, 1:4, 1:4] = True
    >>> row[2, 2, 2] = False
    >>> bool(close_gaps(row)[2, 2, 2]), int(close_gaps(row).sum())
    (True, 27)
    """
    padded = np.pad(cells, 1)
    for axis in range(3):
        padded = _any_of_three(padded, axis)
    for axis in range(3):
        padded = ~_any_of_three(~padded, axis)
    # Outside the box, cells are neither known to be empty nor full: keep all cells that were marked.
    return padded[1:-1, 1:-1, 1:-1] | cells


def beside(cells: np.ndarray) -> np.ndarray:
    """Return [n, n, n] bool: the marked `cells` [n, n, n] bool, and those that share a face with one.

    Refinement needs the added cells. It moves a surface by changing densities up to a cell away from it;
    where no density is stored there, the surface would have a hole.

    >>> one = np.zeros((5, 5, 5), bool)
    >>> one[2, 2, 2] = True
    >>> int(beside(one).sum())
    7
    """
    found = cells.copy()
    for axis in range(3):
        found |= _any_of_three(cells, axis)
    return found


def _any_of_three(cells: np.ndarray, axis: int) -> np.ndarray:
    """Return [n, n, n] bool: True if a cell or either of its neighbours along `axis` is marked."""
    out = cells.copy()
    found, given = np.moveaxis(out, axis, 0), np.moveaxis(cells, axis, 0)
    found[:-1] |= given[1:]
    found[1:] |= given[:-1]
    return out


def corners_of(cells: np.ndarray) -> np.ndarray:
    """Return [n + 1, n + 1, n + 1] bool: the corners of the marked cells [n, n, n] bool.

    >>> int(corners_of(np.ones((1, 1, 1), bool)).sum())
    8
    """
    for axis in range(3):
        padded = np.pad(cells, [(int(i == axis),) * 2 for i in range(3)])
        along = np.moveaxis(padded, axis, 0)
        cells = np.moveaxis(along[:-1] | along[1:], 0, axis)
    return cells


def subdivided(
    cells: np.ndarray, resolution: int, region: Sequence[slice] = (slice(None),) * 3
) -> np.ndarray:
    """Resample `cells` [n, n, n] bool to a grid of `resolution` over the same box: a cell is marked if its
    centre is in a marked cell. Returns [nx, ny, nz] bool, the `region` of that grid, a slice for each axis.

    >>> subdivided(np.array([True, False]).reshape(2, 1, 1).repeat(2, 1).repeat(2, 2), 5)[:, 0, 0].tolist()
    [True, True, False, False, False]
    """
    which = (2 * np.arange(resolution) + 1) * len(cells) // (2 * resolution)
    x, y, z = (which[part] for part in region)
    box = cells[x[0] : x[-1] + 1, y[0] : y[-1] + 1, z[0] : z[-1] + 1]
    if not box.any():
        return np.zeros((len(x), len(y), len(z)), bool)
    return box[np.ix_(x - x[0], y - y[0], z - z[0])]


def lattice_step(resolution: int) -> float:
    """Return the step dphi of `player.march.contracted` for a density grid of `resolution` cells per axis.

    >>> round(lattice_step(512), 5)
    0.00699
    """
    return FASTEST_CELLS * 4 / (resolution * float(MAX_SPEED))


def weighty_cells(model: Model, resolution: int, weight_floor: float, progress: Progress) -> np.ndarray:
    """Return [resolution / BLOCK]^3 bool: the blocks of cells of contracted space in which some ray of a view
    has at least the weight `weight_floor`, with gaps of one block between them closed.

    Views are the training cameras and BETWEEN times as many between them. `resolution` is a multiple of
    BLOCK. There are as many rays as it takes for a block at the unit sphere to be met CONTRACTED_HITS times
    over all views, but at most MOST_SEEING. Pictures are widened a little, because another camera of the
    scene will see beyond their border, where the model has content, too.
    """
    n_blocks = resolution // BLOCK
    visible = np.zeros((n_blocks,) * 3, np.uint8)
    cameras = [widened(camera) for camera in model.model_cameras()]
    cameras += views_between(model, BETWEEN * len(cameras), seed=0, wide=True)
    random = np.random.default_rng(0)
    share = _share_of_pixels(model, resolution)
    for index, camera in enumerate(cameras):
        n_pixels = camera.width * camera.height
        some = random.choice(n_pixels, max(round(share * n_pixels), 1), replace=False)
        rays_o, rays_d = camera.rays_through(some)
        for first in range(0, len(some), CONTRACTED_RAYS_AT_ONCE):
            rows = slice(first, first + CONTRACTED_RAYS_AT_ONCE)
            _mark(model, rays_o[rows], rays_d[rows], weight_floor, visible)
        progress(index + 1, len(cameras))
    return close_gaps(visible.view(bool))


def rays_of_contracted_views(model: Model, resolution: int) -> float:
    """Return the expected number of rays that `weighty_cells` samples."""
    return _share_of_pixels(model, resolution) * _pixels_of_contracted_views(model)


def _pixels_of_contracted_views(model: Model) -> float:
    n_pixels = (1 + 2 * MARGIN) ** 2 * sum(camera.width * camera.height for camera in model.cameras)
    return (1 + BETWEEN) * n_pixels


def _share_of_pixels(model: Model, resolution: int) -> float:
    footprints = np.tile(pixel_footprints(model), 1 + BETWEEN)
    hits = VIEWS_OF_A_CELL * float(np.sum((4 * BLOCK / resolution / footprints) ** 2))
    return min(CONTRACTED_HITS / hits, MOST_SEEING / _pixels_of_contracted_views(model), 1.0)


@torch.no_grad()
def _mark(model: Model, rays_o: np.ndarray, rays_d: np.ndarray, floor: float, visible: np.ndarray) -> None:
    samples = model.sampler.sample_all(model.field, rays_o, rays_d)
    sigmas = model.field.density(samples.features)
    _, _, weights = composite(sigmas, samples.features, samples.deltas, samples.starts, samples.counts)
    mark_weighty_cells(
        rays_o, rays_d, samples.t_mid.numpy(), samples.deltas.numpy(), weights.numpy(),
        samples.starts.numpy(), samples.counts.numpy(), np.float32(floor), visible,
    )  # fmt: skip
