"""Two processes with a share of the batch each learn what one with the whole batch learns."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

PROGRAM = """
import json, sys
import numba, torch
from dataclasses import replace
from vfr_bake.config import FieldOptions, TrainConfig
from vfr_bake.data.demo import demo_capture
from vfr_bake.data.scene import build_scene
from vfr_bake.training.processes import Processes
from vfr_bake.training.trainer import Trainer

kind, sampling = {"object": ("object", "auto")}.get(sys.argv[1], ("unbounded", sys.argv[1]))
out, n_threads = sys.argv[2], int(sys.argv[3])
torch.set_num_threads(n_threads)
numba.set_num_threads(n_threads)
processes = Processes.from_environment()
# What is transparent is learned from in contracted space, too: a few steps show it.
scene = replace(build_scene(demo_capture(size=32, n_train=12, n_test=2), kind), has_alpha=True, masked=False)
field = FieldOptions(n_levels=6, max_resolution=64, log2_table_size=12, head_width=24, density_width=16)
config = TrainConfig(device="cpu", steps=120, pilot_steps=10, batch_samples=2048, batch_rays=64,
                     field=field, occupancy_resolution=32, sampling=sampling)
trainer = Trainer(scene, config, processes)
trainer.field.head.products = torch.float32  # so that sums in another order are the same to seven digits
losses = [report.loss for report in trainer.run()]
if processes.first:
    with open(out, "w") as file:
        json.dump(losses, file)
processes.leave()
"""


@pytest.mark.parametrize("kind", ["object", "proposals", "grid"])
def test_two_processes_have_the_loss_curve_of_one(kind: str, tmp_path: Path) -> None:
    program = tmp_path / "program.py"
    program.write_text(PROGRAM)
    one, two = tmp_path / "one.json", tmp_path / "two.json"
    # The joint batch is cut into as many parts either way: two threads, or two processes of one.
    subprocess.run([sys.executable, program, kind, one, "2"], check=True, timeout=300)
    torchrun = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    subprocess.run([*torchrun, program, kind, two, "1"], check=True, timeout=300)
    losses = [np.array(json.loads(path.read_text())) for path in (one, two)]
    assert len(losses[0]) == len(losses[1]) == 120
    # Sums of gradients in another order: float32 rounding, which training amplifies step by step.
    np.testing.assert_allclose(losses[1][:10], losses[0][:10], rtol=1e-4)
    np.testing.assert_allclose(losses[1][:40], losses[0][:40], rtol=0.05)
    # Backgrounds are random, so that a step's loss says little; over 40 steps it hides what is learned.
    for curve in losses:
        assert np.mean(curve[60:]) < np.mean(curve[:20])
