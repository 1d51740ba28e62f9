"""Plan a bake before it starts: estimate its memory and time, and choose sizes that fit the memory allowed.

Bytes are counted from the arrays that are held at the same time. Seconds are estimated from the speed at
which the model renders rays on this machine.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import numpy as np

from exporters.head.onnx_head import head_onnx
from player.asset.arranging import OTHERS
from player.cameras.transforms import write_cameras
from player.errors import ConfigError, TrainingError
from player.kept_code import is_kept
from vfr_bake.baking.cells import (
    BLOCK,
    CELL_SHARE,
    FLOORS,
    Resolutions,
    occupied_cells,
    pixel_footprints,
    rays_of_contracted_views,
    rays_of_views,
)
from vfr_bake.baking.distillation import photographed, render_teacher
from vfr_bake.baking.head import fold_head, small_head
from vfr_bake.baking.held_out import BETWEEN
from vfr_bake.baking.limits import WIDTHS, cells_of_page
from vfr_bake.baking.mesh import mesh_bytes
from vfr_bake.baking.refinement import BATCH, HEAD_BATCH, head_steps, refined_steps, steps_at_k
from vfr_bake.config import BakeConfig
from vfr_bake.kernels import SOURCES
from vfr_bake.presets import BakeChoice
from vfr_bake.training.model_file import Model

PROGRAM_BYTES = 800_000_000
"""Bytes taken by Python, torch, numba and the model itself."""
N_RAYS = 6_000_000
"""Training rays of an object's refinement, where there is memory for them; most of them meet something. With
fewer rays, the head and the stored values overfit to them."""
UNBOUNDED_RAYS = 2_500_000
"""Training rays of an unbounded scene's refinement, where there is memory for them: fewer than for an object,
because every ray meets something, at many samples each."""
RAYS_OF_DRAW, FEW_DRAWN = 0.6, 500_000
"""Limits on the number of training rays. At most RAYS_OF_DRAW rays are made for each ray that the steps of
refinement draw: five of six rays meet something, so each of those is drawn about twice. This limit never goes
below FEW_DRAWN, because the stored values are also chosen by some of these rays."""
RAYS_SHARE = 0.3
"""Share of the memory for cells and rays that is reserved for the rays, if they need it."""
FEWEST_RAYS = 100_000
FASTER = 0.6
"""Factor on the resolutions, and on the number of march steps of a ray, if frames take too long."""
RAYS_OF_CELL = 2.0
"""Training rays for each stored cell of the features' grid."""
RAY_BYTES = 120
"""Bytes that a training ray takes. The ray and its target colour take 40 bytes; rays that meet something in
the grid are copied, which takes 40 more; concatenating the rays takes another 40."""
MADE_RAY_BYTES = 40
"""Bytes of these that it takes once the training rays are made: an object's are made before its cells are
chosen."""
REFINED_SHARE = 0.5
"""Share of the bytes of a cell that it takes while refinement trains. What it takes only later, while codes
are chosen, can hold fetches of the training rays until then."""
CHANNEL_BYTES = 8.5
"""Bytes that a stored channel takes in a cell while codes are chosen. A cell has about 1.3 vertices. Each
vertex has two bytes for the trained latent feature, and one each for the codes being tried, the best codes so
far and the codes being played, all with their coarser levels."""
DENSITY_BYTES = 40
"""Bytes that a density takes. A feature cell has as many densities as the density cells that fit into it."""
REFINED_BY = 0.8
"""Share of a bake's time after which refinement ends. The rest is for the mesh and for playing the written
files."""
LEAST_REFINED = 0.4
"""Share of a bake's minutes that refinement may take in any case, however long everything before it took: a
longer bake is better than a small head that is hardly trained."""
VIEWS_TIMED, MOST_TIMED = 4, 25_000
"""Views that are rendered to time the teacher, with as many rays each as in the bake, but at most MOST_TIMED:
twice as many as in the bakes by which the costs below were measured, and few enough to take only seconds if
there are few views. The timed rays differ from those of the run before, which compiles the code: the memory
that those have read is in the cache, where rays are several times as fast as the millions of a bake."""
STEP_COST, HEAD_COST = {False: 3.4, True: 0.6}, {False: 1.3, True: 0.6}
"""Time of a training ray in a step of refinement, and in a step that trains the head alone, by whether the
scene is unbounded. The unit is the time that the teacher takes for a ray, which is several times as long in
an unbounded scene. All costs here are times of the main thread, measured on two cores
(docs/notes/2026-11-24-bakes-of-weak-models.md)."""
VERTEX_COST, SEEN_COST = {False: 0.17, True: 0.18}, {False: 0.48, True: 1.0}
"""Time to evaluate a vertex, and time of a ray that marks the cells it sees, in the same unit."""
AT_K_COST = 0.7
"""Time of a step of refinement with the lookups and bits that are played, as a share of that of a step before
these were chosen."""
TYPICAL_LOSS = 3.5
"""Loss before refinement, in target losses of the preset, from which its number of steps is estimated."""
OWN_HEAD = 2
"""Factor on the time of a step with the model's own head."""
REST_COST, OWN_REST_COST = {False: 12_000_000, True: 5_000_000}, {False: 20_000_000, True: 3_700_000}
"""Time of everything else (measurements, mesh, files), which hardly depends on the scene, in the same unit;
and the time to add with the model's own head."""
CHOSEN_COST = {False: 0.36, True: 0.12}
"""Time of a vertex while its detail and codes are chosen after refinement, in the same unit."""
COMPILE_SECONDS = 45.0
"""Seconds that the first bake after an installation spends on compiling its code: about half a minute of the
bake of `make demo` with AVX-512, and a minute without."""

FEWEST_MANIFEST_BYTES = 5000
"""Bytes that the manifest of a bake takes at least, even with the coarsest grids."""
CULLING_BYTES = 8
"""Bytes that each cell of a box takes while it is decided which cells are left out: marks of the cells that
may hold matter, of those that weigh enough and of their neighbours, and distances to them. A byte for each
weight floor is added."""


@dataclass(frozen=True)
class Plan:
    """Sizes chosen for the memory allowed, and the memory that the bake is expected to take."""

    resolutions: Resolutions
    wanted: Resolutions
    """What the resolutions would be if there were memory for the marks of any number of cells."""
    n_cells: float
    """Cells of the features' grid that are expected to be stored."""
    cell_bytes: float
    """Bytes that a cell of the features' grid takes, with its densities."""
    unbounded: bool
    room: float
    """Bytes available for cells and rays together."""
    marks: float
    """Bytes of the marks by which the stored cells are found. They are freed before there are cells."""
    page_cells: float
    """Cells that fit into a page of the asset; infinite if the resolution was given."""
    most_rays: int
    """The most training rays that refinement has use for."""
    longer: float = 1.0
    """Factor by which the march steps are longer than usual, so that frames take less time."""

    @property
    def most_cells(self) -> int:
        """The number of cells that fit beside the training rays. If not all rays fit, they get a share of the
        room (RAYS_SHARE), because refinement gains little with few rays."""
        rays = max(min(self.most_rays * RAY_BYTES, RAYS_SHARE * self.room), FEWEST_RAYS * RAY_BYTES)
        return int((self.room - rays) / self.cell_bytes)

    def n_rays(self, n_cells: float) -> int:
        """Return the number of training rays for `n_cells` cells: as many as the cells need and as fit beside
        them."""
        left = (self.room - n_cells * self.cell_bytes) / RAY_BYTES
        return int(np.clip(min(left, RAYS_OF_CELL * n_cells), FEWEST_RAYS, self.most_rays))

    def kept_bytes(self, n_cells: float) -> int:
        """Return the bytes that the fetches of all training rays may take while `n_cells` cells are
        refined."""
        n_rays = self.n_rays(self.n_cells if self.marks_with_rays else n_cells)
        taken = REFINED_SHARE * n_cells * self.cell_bytes + n_rays * RAY_BYTES
        return int(max(self.room - taken, 0))

    @property
    def marks_with_rays(self) -> bool:
        """Whether there is room for the training rays beside the marks of an object's cells."""
        made = MADE_RAY_BYTES * self.n_rays(self.n_cells)
        return not self.unbounded and self.marks + made <= self.room

    def coarser(self) -> Plan:
        """Return the plan of a bake whose frames take less time: with coarser grids and longer steps."""
        fine, coarse = (int(FASTER * n) for n in self.resolutions)
        coarse -= coarse % BLOCK if self.unbounded else 0
        return replace(self, resolutions=Resolutions(fine, coarse), longer=self.longer / FASTER)

    @property
    def n_bytes(self) -> int:
        """Expected peak of memory, bytes."""
        n_rays = self.n_rays(self.n_cells)
        marks = self.marks + (MADE_RAY_BYTES * n_rays if self.marks_with_rays else 0)
        held = self.n_cells * self.cell_bytes + n_rays * RAY_BYTES
        return int(PROGRAM_BYTES + max(marks, min(held, self.room)))


def check_bakeable(model: Model, config: BakeConfig) -> None:
    """Raise ConfigError if the model's field cannot be stored in an asset, or not as asked for."""
    field = model.field.config
    for name, needed in (("compositing", "features"), ("activation", "gelu")):
        if getattr(field, name) != needed:
            raise ConfigError(f"model: {name}: expected {needed} to bake, got {getattr(field, name)}")
    if field.unbounded and config.no_cull:
        raise ConfigError("--no-cull: expected the model of an object, got that of an unbounded scene")
    if config.n_channels is not None and config.n_channels > field.n_channels:
        raise ConfigError(
            f"n_channels: expected at most the {field.n_channels} of the model, got {config.n_channels}"
        )


def make_plan(model: Model, config: BakeConfig) -> Plan:
    """Plan a bake that takes at most `config.memory` gigabytes.

    Raises ConfigError if even the fewest rays, or the marks of the cells, do not fit; TrainingError if the
    cameras, the head and the manifest alone take more than `config.max_mb`.
    """
    choice, field = config.choice(model.field.config.unbounded), model.field.config
    if config.max_mb is not None and (least := _fixed_bytes(model, config) / 1e6) >= config.max_mb:
        raise TrainingError(
            f"bake: size: expected at most {config.max_mb:g} MB, got {np.ceil(100 * least) / 100:.2f} MB for "
            f"{len(model.cameras)} cameras, the head and the manifest alone: nothing was written: allow more"
        )
    room = config.memory * 1e9 - PROGRAM_BYTES
    drawn = max(int(RAYS_OF_DRAW * choice.refine_steps * BATCH), FEW_DRAWN)
    most_rays = min(UNBOUNDED_RAYS if field.unbounded else N_RAYS, drawn)
    mark_bytes = _marks_bytes(model, config)
    wanted = _resolutions(model, config, np.inf)
    rays_room = 0 if field.unbounded else min(MADE_RAY_BYTES * most_rays, RAYS_SHARE * room)
    resolutions = _resolutions(model, config, int(np.cbrt(max(room - rays_room, 0) / mark_bytes)))
    fine, coarse = resolutions
    marks = mark_bytes * coarse**3
    n_channels = min(choice.n_channels, field.n_channels)
    cell_bytes = CHANNEL_BYTES * n_channels + 60
    cell_bytes += DENSITY_BYTES * (fine / coarse) ** 3
    given = config.resolution or config.feature_resolution
    page_cells = np.inf if given else cells_of_page(choice.page_mb, n_channels, (fine / coarse) ** 3)
    n_cells = _cells(model, coarse)
    plan = Plan(resolutions, wanted, n_cells, cell_bytes, field.unbounded, room, marks, page_cells, most_rays)
    plan = replace(plan, n_cells=min(plan.n_cells, max(plan.most_cells, 0), page_cells))
    if plan.most_cells <= 0 or marks > room:
        least = PROGRAM_BYTES + max(marks, FEWEST_RAYS * RAY_BYTES)
        raise ConfigError(
            f"max_memory: expected at least {np.ceil(least / 1e7) / 100:.2f} GB for {fine} cells "
            f"per axis, got {config.memory:.3g} GB: allow more, or lower --resolution and "
            "--feature-resolution"
        )
    return plan


def _fixed_bytes(model: Model, config: BakeConfig) -> int:
    """Return the least bytes that the cameras, the head and the manifest take, however coarse the grids are
    and however few channels they have. A small head takes the least if it does without directions."""
    choice = config.choice(model.field.config.unbounded)
    width, n_channels = choice.head_width, config.n_channels or 1
    if config.target_ms is not None:
        width = min(width or WIDTHS[0], *WIDTHS)  # the head may become so narrow
    head = fold_head(model.field.head, np.zeros((model.field.head.width, n_channels)))
    if width:
        head = small_head(head, width, choice.head_layers, 1, np.ones(n_channels))
    any_ranges = [(0.0, 1.0)] * (2 + len(head.directional)) if choice.head_bits == 8 else None
    return len(write_cameras(model.cameras)) + len(head_onnx(head, any_ranges)) + FEWEST_MANIFEST_BYTES


def other_bytes(model: Model, choice: BakeChoice, max_mb: float) -> int:
    """Estimate the bytes of an asset of `max_mb` megabytes other than stored values and manifest."""
    mesh = mesh_bytes(round(max_mb * 1e6 * OTHERS / (OTHERS + 1)), None)
    n_weights = sum(array.numel() for array in model.field.head.parameters())
    head = 0 if choice.head_width else n_weights * choice.head_bits // 8
    return mesh + len(write_cameras(model.cameras)) + head


def _resolutions(model: Model, config: BakeConfig, most: float) -> Resolutions:
    """Return the resolutions to bake at; unless they are given, with at most `most` feature cells per
    axis."""
    choice, field = config.choice(model.field.config.unbounded), model.field.config
    if config.resolution:
        resolution = config.resolution
    elif field.unbounded:
        resolution = choice.contracted_resolution
    else:
        resolution = round(2 * choice.cells_per_pixel / float(np.median(pixel_footprints(model))))
    if not config.resolution:
        resolution = min(resolution, most / choice.feature_share)
    resolution = int(np.clip(resolution, 8, 3 * field.max_resolution // 2))
    coarse = config.feature_resolution or round(choice.feature_share * resolution)
    if not (config.resolution or config.feature_resolution):
        coarse = min(coarse, most)  # rounding above may have exceeded `most`
    coarse = int(np.clip(coarse, 8, min(field.max_resolution, resolution)))
    return Resolutions(resolution, coarse - coarse % BLOCK if field.unbounded else coarse)


def _marks_bytes(model: Model, config: BakeConfig) -> float:
    """Return the bytes that each cell of the features' grid takes while the stored cells are found."""
    if model.field.config.unbounded:
        return (4 if config.no_cull else 5) / BLOCK**3
    n_floors = len(FLOORS) if config.weight_floor is None else 1
    return 4 if config.no_cull else CULLING_BYTES + n_floors


def _cells(model: Model, resolution: int) -> float:
    """Estimate how many cells of the features' grid will be stored."""
    if model.field.config.unbounded:
        return CELL_SHARE * resolution**3
    return float(np.count_nonzero(occupied_cells(model, resolution)))


def expected_seconds(model: Model, config: BakeConfig, plan: Plan) -> float:
    """Estimate the seconds that the bake will take, by timing the teacher on some rays on this machine."""
    choice, unbounded = config.choice(model.field.config.unbounded), model.field.config.unbounded
    every = model.model_cameras()
    views = every[:: -(-len(every) // VIEWS_TIMED)]
    a_view = min(max(plan.n_rays(plan.n_cells) // ((1 + BETWEEN) * len(every)), 1), MOST_TIMED)
    n_rays = sum(min(a_view, camera.width * camera.height) for camera in views)
    render_teacher(model, views, a_view * len(views), 0, lambda done, of: None)  # compiles the code
    begin = time.perf_counter()
    shown = render_teacher(model, views, a_view * len(views), 1, lambda done, of: None)
    ray_seconds = (time.perf_counter() - begin) / n_rays
    fine, coarse = plan.resolutions
    n_all, met = plan.n_rays(plan.n_cells), len(shown.opacity) / n_rays
    n_photographed = photographed(model, n_all)
    n_met = n_photographed + met * (n_all - n_photographed)
    n_vertices = plan.n_cells * (1 + (fine / coarse) ** 3)
    work = n_met / max(met, 1e-3) + VERTEX_COST[unbounded] * n_vertices
    if unbounded:
        work += SEEN_COST[True] * rays_of_contracted_views(model, coarse)
    elif not config.no_cull:
        steps = max(model.occupancy.step * coarse / 2, 1.0)
        marched = n_all if plan.marks_with_rays else 0
        work += SEEN_COST[False] * steps * max(rays_of_views(model, coarse) - marched, 0)
    n_steps = refined_steps(config, choice, n_met, TYPICAL_LOSS * choice.target_loss_db)
    refined = (n_steps + AT_K_COST * steps_at_k(n_steps)) * BATCH * STEP_COST[unbounded]
    refined += head_steps(choice) * HEAD_BATCH * HEAD_COST[unbounded]
    before, refinement = ray_seconds * work, ray_seconds * refined * (1 if choice.head_width else OWN_HEAD)
    if config.refine_steps is None:
        refinement = min(refinement, refinement_seconds(choice, before))
    rest = CHOSEN_COST[unbounded] * n_vertices + REST_COST[unbounded]
    rest += 0 if choice.head_width else OWN_REST_COST[unbounded]
    return before + refinement + ray_seconds * rest + (0 if is_compiled() else COMPILE_SECONDS)


def is_compiled() -> bool:
    """Return whether an earlier bake has compiled the code and cached it."""
    return is_kept("descend", *SOURCES)


def refinement_seconds(choice: BakeChoice, before: float) -> float:
    """Return the seconds that all rounds of refinement may take if everything before took `before` seconds.

    >>> from vfr_bake.presets import PRESETS
    >>> refinement_seconds(PRESETS["balanced"], 100.0), refinement_seconds(PRESETS["balanced"], 1000.0)
    (284.0, 192.0)
    """
    seconds = 60 * choice.minutes
    return max(REFINED_BY * seconds - before, LEAST_REFINED * seconds)
