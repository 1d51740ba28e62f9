"""The kernels of training and rendering, run as plain Python, where numpy checks every index, which compiled
code does not do."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np

REPOSITORY = Path(__file__).resolve().parents[3]
PROGRAM = """
import sys
import numpy as np
import torch
from numba import config
from vfr_bake.config import FieldOptions
from player.compiled.lanes import LANES
from vfr_bake.kernels import adam, hash_grid, proposals
from vfr_bake.kernels.contraction import contracted_unit
from vfr_bake.field.field import VfrField
from vfr_bake.kernels.visibility import render_and_mark
from vfr_bake.rendering.occupancy import OccupancyGrid
from vfr_bake.rendering.proposals import ProposalSampler
from vfr_bake.kernels.density import LIMITS
from vfr_bake.rendering.sampling import march
from vfr_bake.training.optimiser import FusedGridAdam, GridAdam


def along(origin, direction, edges, first):
    t = [proposals.distance(s) for s in edges[first : first + LANES + 1]]
    for near, far in zip(t[:LANES], t[1:], strict=True):
        middle = (near + far) / np.float32(2)
        yield middle, far - near, contracted_unit(*(origin + middle * direction), np.float32(1))


def propose_lanes(origin, direction, edges, first, grid, limits, tau, points, depths, weights):
    for lane, (_, length, place) in enumerate(along(origin, direction, edges, first)):
        logit = 0
        for level in range(len(grid.scales)):
            where = grid.scales[level], grid.offsets[level], grid.mask, grid.hashed[level]
            rows, shares = hash_grid.corners(*place, *where)
            logit += sum(share * grid.table[row, 0] for row, share in zip(rows, shares, strict=True))
        depth = np.exp(min(logit, limits.largest_logit)) * length
        seen = tau <= limits.opaque_depth
        points[:, first + lane] = place
        depths[first + lane] = seen * depth
        weights[first + lane] = seen * np.exp(-tau) * -np.expm1(-depth)
        tau += depth
    return tau


def look_up_lanes(origin, direction, edges, first, grid, places, features):
    for lane, (middle, length, place) in enumerate(along(origin, direction, edges, first)):
        places[:, lane] = middle, length, *place
        hash_grid.encode_point(*place, grid, features[lane])


if config.DISABLE_JIT:  # these have no Python: instructions that ask for memory ahead, and registers
    adam.prefetch = hash_grid.prefetch = lambda table, row: None
    proposals.propose_lanes, proposals.look_up_lanes = propose_lanes, look_up_lanes
torch.manual_seed(0)
torch.set_num_threads(1)
found = {}
generator = torch.Generator().manual_seed(2)
rays_o = torch.randn(5, 3, generator=generator) * 1.5
rays_d = torch.nn.functional.normalize(torch.rand(5, 3, generator=generator) - 0.5 - rays_o, dim=-1)
options = FieldOptions(n_levels=7, base_resolution=4, max_resolution=20, log2_table_size=10, head_width=8)
for kind in ("object", "unbounded"):
    unbounded = kind == "unbounded"
    field = VfrField(options.resolved(unbounded))
    torch.nn.init.uniform_(field.grid.table, -1, 1)
    if unbounded:
        sampler = ProposalSampler(0.05)
        for grid in sampler.grids:
            torch.nn.init.uniform_(grid.table, -2, 2)
        samples = sampler.sample_all(field, rays_o[:2].numpy(), rays_d[:2].numpy())
    else:
        sampler = OccupancyGrid(8, 0.1, seed=0)
        sampler.set_occupied(np.random.default_rng(1).random((8, 8, 8)) < 0.4)
        samples = march(field, sampler.distance, 0.1, rays_o, rays_d, torch.full((5,), 0.5), 300)
        found["sigmas"] = samples.sigmas.numpy()
        visible = np.zeros((9, 9, 9, 2), np.uint8)
        arguments = (np.float32(0.1), sampler.distance, field.arrays(), LIMITS)
        composited = np.zeros((5, 2 * options.n_levels), np.float32), np.zeros(5, np.float32)
        floors = np.float32([0.01, 0.2])
        render_and_mark(rays_o.numpy(), rays_d.numpy(), *arguments, floors, visible, *composited)
        found["marked features"], found["marked opacity"] = composited
        found["visible"] = visible
    for name in ("t_mid", "deltas", "points", "features", "counts"):
        found[f"{kind} {name}"] = getattr(samples, name).detach().numpy()
    features, opacity = sampler.composited_features(field, rays_o[:2].numpy(), rays_d[:2].numpy())
    found |= {f"{kind} rgb": features, f"{kind} opacity": opacity}
    optimiser = (GridAdam if unbounded else FusedGridAdam)(field.grid.table if unbounded else field.grid)
    field.grid(samples.points[:20]).square().sum().backward()
    optimiser.step(0.01)
    found[f"{kind} table"] = field.grid.table.detach().numpy()
np.savez(sys.argv[1], **found)
"""


def run(target: Path, **environment: str) -> dict[str, np.ndarray]:
    environment |= {"PYTHONPATH": str(REPOSITORY)}
    command = [sys.executable, "-c", PROGRAM, str(target)]
    done = subprocess.run(
        command, cwd=REPOSITORY, env=os.environ | environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr[-3000:]
    with np.load(target) as file:
        return {name: file[name] for name in file.files}


def test_kernels_stay_within_their_arrays_and_are_what_they_say(tmp_path: Path) -> None:
    plain = run(tmp_path / "plain.npz", NUMBA_DISABLE_JIT="1")
    compiled = run(tmp_path / "compiled.npz")
    assert set(plain) == set(compiled) and len(plain) > 15
    for name, values in plain.items():
        # Where a proposal's distribution is flat, each round magnifies float32 rounding a thousandfold.
        rtol, atol = (0.05, 5e-3) if name.startswith("unbounded") else (1e-3, 2e-4)
        np.testing.assert_allclose(compiled[name], values, rtol=rtol, atol=atol, err_msg=name)
        assert values.any(), name
