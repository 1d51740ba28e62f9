"""What the bake of an unbounded scene does in its own way: the cells come from the model's own samples.

There is no occupancy grid: where no view has ever put a sample, the field holds what nobody has taught it. So
a cell is stored only if the intervals that the proposals chose on some ray weigh something in it.
"""

from __future__ import annotations

import numpy as np
import torch

from player.errors import TrainingError
from player.march.contracted import MAX_SPEED
from vfr_bake.baking.views import BETWEEN, MARGIN, views_between, widened
from vfr_bake.baking.visibility import VIEWS_OF_A_CELL, Progress, close_gaps, pixel_footprints
from vfr_bake.kernels.contracted_visibility import mark_weighty_cells
from vfr_bake.rendering.compositing import composite
from vfr_bake.rendering.proposals import ProposalSampler
from vfr_bake.training.model_file import Model

N_RAYS = 500_000
"""Rays that head and stored values learn from: all of them meet something, and at many samples each."""
HITS = 24
"""Rays that meet a block of cells at the unit sphere over all views, on average."""
BLOCK = 2
"""Cells along each edge of a block. Blocks are found whole: the model's proposals take their time, 4,000 rays
a second of one core, and so a quarter of the rays is enough. Surfaces are some cells thick anyway."""
FASTEST_CELLS = 2.0
"""Cells between two samples of a ray where it is fastest in contracted space; where it is slowest two fifths
of it."""
RAYS_AT_ONCE = 1 << 14
WEIGHT_FLOOR = 0.01
"""Weight that a cell must have on some ray where none is asked for. Fox at 1088 cells loses nothing to it; it
would have half again as many vertices with 0.003."""
CELL_SHARE = 0.008
"""Cells that are stored, of all, before anything is known of a scene."""


def lattice_step(resolution: int) -> float:
    """dphi of `player.march.contracted` for densities on a grid of `resolution` cells.

    >>> round(lattice_step(512), 5)
    0.00699
    """
    return FASTEST_CELLS * 4 / (resolution * float(MAX_SPEED))


def weighty_cells(model: Model, resolution: int, weight_floor: float, progress: Progress) -> np.ndarray:
    """[resolution / BLOCK]^3 bool: blocks of cells of contracted space in which some ray of a view has at
    least the weight `weight_floor`, and the gaps of one block between them. Views are the training cameras
    and BETWEEN times as many between them.

    `resolution` is a multiple of BLOCK. Rays are as many as let a block at the unit sphere be met HITS times
    over all views. Pictures are taken a little wider than they are: another camera of the scene sees beyond
    their border, where the model goes on. Raises TrainingError when nothing is seen.
    """
    assert isinstance(model.sampler, ProposalSampler)
    n_blocks = resolution // BLOCK
    visible = np.zeros((n_blocks,) * 3, np.uint8)
    cameras = [widened(camera) for camera in model.model_cameras()]
    cameras += views_between(model, BETWEEN * len(cameras), seed=0, wide=True)
    random = np.random.default_rng(0)
    share = _share_of_pixels(model, resolution)
    for index, camera in enumerate(cameras):
        rays_o, rays_d = camera.rays()
        some = random.choice(len(rays_o), max(round(share * len(rays_o)), 1), replace=False)
        for first in range(0, len(some), RAYS_AT_ONCE):
            rows = some[first : first + RAYS_AT_ONCE]
            _mark(model, rays_o[rows], rays_d[rows], weight_floor, visible)
        progress(index + 1, len(cameras))
    if not visible.any():
        raise TrainingError(
            f"no cell weighs {weight_floor} in any training view: the model is empty or a thin fog: "
            "train longer, or lower --weight-floor"
        )
    return close_gaps(visible.view(bool))


def rays_of_contracted_views(model: Model, resolution: int) -> float:
    """Rays that `weighty_cells` sends out."""
    n_pixels = (1 + 2 * MARGIN) ** 2 * sum(camera.width * camera.height for camera in model.cameras)
    return (1 + BETWEEN) * _share_of_pixels(model, resolution) * n_pixels


def _share_of_pixels(model: Model, resolution: int) -> float:
    footprints = np.tile(pixel_footprints(model), 1 + BETWEEN)
    return min(HITS / (VIEWS_OF_A_CELL * float(np.sum((4 * BLOCK / resolution / footprints) ** 2))), 1.0)


@torch.no_grad()
def _mark(model: Model, rays_o: np.ndarray, rays_d: np.ndarray, floor: float, visible: np.ndarray) -> None:
    samples = model.sampler.sample_all(model.field, rays_o, rays_d)
    sigmas = model.field.density(samples.features)
    _, _, weights = composite(sigmas, samples.features, samples.deltas, samples.starts, samples.counts)
    mark_weighty_cells(
        rays_o, rays_d, samples.t_mid.numpy(), samples.deltas.numpy(), weights.numpy(),
        samples.starts.numpy(), samples.counts.numpy(), np.float32(floor), visible,
    )  # fmt: skip
