"""Proposal sampling of unbounded scenes: two small density fields find where on a ray there is matter.

As in mip-NeRF 360 (Barron et al. 2022) and section 4 of the paper: two rounds of 64 samples, then 32 final
ones. Distances are spaced uniformly up to one model unit and by disparity beyond, and positions are
contracted. Letters as in `vfr_bake.kernels.proposals`.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numba import get_num_threads
from torch import Tensor, nn

from vfr_bake.field.field import VfrField
from vfr_bake.field.hash_grid import GridLayout, zeros
from vfr_bake.kernels import proposals as kernels
from vfr_bake.kernels.density import LIMITS
from vfr_bake.kernels.proposals import Round
from vfr_bake.rendering.compositing import RaySamples, composite

N_PROPOSED = 64
"""Intervals in each of the two rounds."""
N_FINAL = 32
"""Intervals in which the field itself is looked up; training uses half of them
once there is more than fog."""
FAR = 1e3
"""Distance at which rays end, model units; the farthest camera is at 1."""
LAYOUTS = ((5, 128), (5, 256))
"""For each round's grid, its number of levels and the cells per axis of its finest level over contracted
space. The coarsest level has BASE_RESOLUTION cells per axis."""
FIRST_LAYOUTS = ((10, 128), (10, 512))
"""Layouts of model files that do not state theirs."""
BASE_RESOLUTION = 16
LOG2_TABLE_SIZE = 17
RAY_CHUNK = 4096
"""Rays whose samples are held at once when pictures are rendered, with 35 MB of features at most."""


class ProposalGrid(nn.Module):
    """A log-density field: the sum over the levels of a hash grid of one interpolated channel."""

    def __init__(self, n_levels: int, max_resolution: int) -> None:
        super().__init__()
        self.layout = GridLayout(n_levels, BASE_RESOLUTION, max_resolution, LOG2_TABLE_SIZE)
        self.table = nn.Parameter(zeros(self.layout.n_entries, 1))


class ProposalSampler(nn.Module):
    """Guide that chooses where a field is looked up along the rays of an unbounded scene.

    `near` is the least distance of matter from a camera, model units. `layouts` has the number of levels and
    the finest resolution of each round's grid.
    """

    def __init__(self, near: float, layouts: Sequence[tuple[int, int]] = LAYOUTS) -> None:
        super().__init__()
        self.near, self.layouts = near, tuple(layouts)
        self.grids = nn.ModuleList(ProposalGrid(*layout) for layout in self.layouts)

    def sample_all(self, field: VfrField, rays_o: np.ndarray, rays_d: np.ndarray) -> RaySamples:
        """Return the samples of all rays [n_rays, 3], in the middle of their intervals."""
        middle = torch.full((len(rays_o), 3), 0.5)
        return self.sample_rounds(field, torch.from_numpy(rays_o), torch.from_numpy(rays_d), middle)[0]

    @torch.no_grad()
    def composited_features(
        self, field: VfrField, rays_o: np.ndarray, rays_d: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Composite the field's features along rays `rays_o`, `rays_d` [n_rays, 3], with a lookup at every
        sample; return (features [n_rays, n_channels], opacity [n_rays])."""
        features = np.empty((len(rays_o), field.config.n_channels), np.float32)
        opacity = np.empty(len(rays_o), np.float32)
        for start in range(0, len(rays_o), RAY_CHUNK):
            rows = slice(start, start + RAY_CHUNK)
            samples = self.sample_all(field, rays_o[rows], rays_d[rows])
            found = composite(
                samples.sigmas, samples.features, samples.deltas, samples.starts, samples.counts
            )
            features[rows], opacity[rows] = found[0].numpy(), found[1].numpy()
        return features, opacity

    def sample_rounds(
        self,
        field: VfrField,
        rays_o: Tensor,
        rays_d: Tensor,
        jitter: Tensor,
        exponent: float = 1.0,
        n_final: int = N_FINAL,
    ) -> tuple[RaySamples, np.ndarray, list[Round]]:
        """Return samples, the borders [n_rays, n_final + 1] of their intervals in s, and
        the results of the rounds.

        `exponent`: weights are raised to this power before they are drawn from; less than 1 early in
        training. `n_final`: number of final intervals, a multiple of 16.
        """
        n_rays = len(rays_o)
        # A camera's rays are stored axis by axis; the kernels expect the three numbers of a ray side by side.
        rays_o, rays_d = rays_o.contiguous(), rays_d.contiguous()
        rounds = [_empty_round(n_rays) for _ in self.grids]
        edges = np.empty((n_rays, n_final + 1), np.float32)
        near = np.float32(self.near)
        borders = (kernels.spacing(near), kernels.spacing(np.float32(FAR)))
        grids = [grid.layout.grid(grid.table) for grid in self.grids]  # type: ignore[union-attr, arg-type]
        kernels.propose(
            rays_o.numpy(), rays_d.numpy(), jitter.numpy(), borders, np.float32(exponent), *grids, LIMITS,
            *rounds, edges,
        )  # fmt: skip
        return self._field_samples(field, rays_o, rays_d, edges), edges, rounds

    def _field_samples(
        self, field: VfrField, rays_o: Tensor, rays_d: Tensor, edges: np.ndarray
    ) -> RaySamples:
        n_final = edges.shape[1] - 1
        n_rays, n_samples = len(rays_o), len(rays_o) * n_final
        counts = np.empty(n_rays, np.int64)
        t_mid, deltas = np.empty(n_samples, np.float32), np.empty(n_samples, np.float32)
        points = np.empty((n_samples, 3), np.float32)
        features = np.empty((n_samples, field.config.n_channels), np.float32)
        sigmas = np.empty(n_samples, np.float32)
        kernels.field_samples(
            rays_o.numpy(), rays_d.numpy(), edges, field.arrays(), LIMITS, counts, t_mid, deltas, points,
            features, sigmas,
        )  # fmt: skip
        arrays = [t_mid, deltas, points, features, sigmas]
        kept = np.flatnonzero(np.arange(n_final) < counts[:, None])
        if len(kept) < n_samples:
            arrays = [array[kept] for array in arrays]
        t_mid, deltas, points, features, sigmas = arrays
        return RaySamples(
            t_mid=torch.from_numpy(t_mid),
            deltas=torch.from_numpy(deltas),
            points=torch.from_numpy(points),
            features=torch.from_numpy(features),
            rays=torch.arange(n_rays),
            starts=torch.from_numpy(np.cumsum(counts) - counts),
            counts=torch.from_numpy(counts),
            sigmas=torch.from_numpy(sigmas),
        )

    def add_gradients(
        self, rounds: list[Round], edges: np.ndarray, samples: RaySamples, weights: Tensor, n_rays: int
    ) -> float:
        """Add the interlevel loss's gradient to the tables' `.grad` and return the loss, both
        as a mean over `n_rays`."""
        total = 0.0
        starts, counts = samples.starts.numpy(), samples.counts.numpy()
        for grid, found in zip(self.grids, rounds, strict=True):
            losses = np.empty(len(edges), np.float32)
            grad_logits = np.empty_like(found.weights)
            kernels.interlevel(edges, starts, counts, weights.detach().numpy(), found, losses, grad_logits)
            grad_logits /= n_rays
            kernels.scatter_logits(
                found.points, grad_logits, grid.layout.arrays(np.float32),  # type: ignore[union-attr]
                get_num_threads(), grid.table.grad.numpy(),  # type: ignore[union-attr]
            )  # fmt: skip
            total += float(losses.sum()) / n_rays
        return total


def _empty_round(n_rays: int) -> Round:
    return Round(
        edges=np.empty((n_rays, N_PROPOSED + 1), np.float32),
        depths=np.empty((n_rays, N_PROPOSED), np.float32),
        points=np.empty((n_rays, 3, N_PROPOSED), np.float32),
        weights=np.empty((n_rays, N_PROPOSED), np.float32),
    )
