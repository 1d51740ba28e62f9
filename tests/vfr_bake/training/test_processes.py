"""Two processes, each with a share of the batch, learn what one process with the whole batch learns."""

from __future__ import annotations

import json
import subprocess
import sys
from datetime import timedelta
from typing import Any

import numpy as np
import pytest
import torch
from torch import distributed

from player.errors import ConfigError
from tests.cores import every_core
from vfr_bake.training.processes import Processes

PROGRAM = """
import json, sys
import numba, torch
from dataclasses import replace
from vfr_bake.config import FieldOptions, TrainConfig
from vfr_bake.data.demo import demo_capture
from vfr_bake.data.scene import build_scene
from vfr_bake.training.processes import Processes
from vfr_bake.training.trainer import Trainer

out, n_threads, kinds = sys.argv[1], int(sys.argv[2]), sys.argv[3:]
torch.set_num_threads(n_threads)
numba.set_num_threads(n_threads)
processes = Processes.from_environment()
losses = {}
for kind in kinds:
    # What is transparent is learned from in contracted space, too: a few steps show it.
    scene = build_scene(demo_capture(size=32, n_train=12, n_test=2), kind)
    scene = replace(scene, has_alpha=True, masked=False)
    field = FieldOptions(n_levels=6, max_resolution=64, log2_table_size=12, head_width=24, density_width=16)
    config = TrainConfig(device="cpu", steps=120, pilot_steps=10, batch_samples=2048, batch_rays=64,
                         field=field, occupancy_resolution=32)
    trainer = Trainer(scene, config, processes)
    trainer.field.head.products = torch.float32  # so that sums in another order are the same to seven digits
    losses[kind] = [report.loss for report in trainer.run()]
if processes.first:
    with open(out, "w") as file:
        json.dump(losses, file)
processes.leave()
"""


KINDS = ("object", "unbounded")


@pytest.fixture(scope="module")
def curves(tmp_path_factory: pytest.TempPathFactory) -> list[dict[str, list[float]]]:
    """The losses of each kind, for one process and for two. A process trains all kinds one after the other,
    because starting a process takes longer than training."""
    folder = tmp_path_factory.mktemp("processes")
    program, one, two = (folder / name for name in ("program.py", "one.json", "two.json"))
    program.write_text(PROGRAM)
    # The joint batch is cut into as many parts either way: two threads, or two processes of one.
    torchrun = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    with every_core():
        subprocess.run([sys.executable, program, one, "2", *KINDS], check=True, timeout=600)
        subprocess.run([*torchrun, program, two, "1", *KINDS], check=True, timeout=600)
    return [json.loads(path.read_text()) for path in (one, two)]


@pytest.mark.parametrize("kind", KINDS)
def test_two_processes_have_the_loss_curve_of_one(kind: str, curves: list[dict[str, list[float]]]) -> None:
    losses = [np.array(of[kind]) for of in curves]
    assert len(losses[0]) == len(losses[1]) == 120
    # Sums of gradients in another order: float32 rounding, which training amplifies step by step.
    np.testing.assert_allclose(losses[1][:10], losses[0][:10], rtol=1e-4)
    np.testing.assert_allclose(losses[1][:40], losses[0][:40], rtol=0.05)
    # Backgrounds are random, so that a step's loss says little: over 40 steps it hides the progress.
    for curve in losses:
        assert np.mean(curve[60:]) < np.mean(curve[:20])


def test_a_process_waits_as_long_as_the_first_one_needs(monkeypatch: pytest.MonkeyPatch) -> None:
    """Estimating cameras, or rendering many test views, takes the first process hours."""
    given: dict[str, Any] = {}
    monkeypatch.setattr(distributed, "init_process_group", lambda *_, **settings: given.update(settings))
    monkeypatch.setenv("WORLD_SIZE", "2")
    monkeypatch.setenv("RANK", "1")
    assert not Processes.from_environment().first
    assert given["timeout"] > timedelta(days=1)


@pytest.mark.parametrize(
    ("variables", "named"),
    [
        ({"WORLD_SIZE": "x"}, "'x'"),
        ({"WORLD_SIZE": "2"}, "RANK"),
        ({"WORLD_SIZE": "2", "RANK": "x"}, "'x'"),
        ({"WORLD_SIZE": "2", "RANK": "0"}, "MASTER_ADDR"),
    ],
)
def test_an_environment_that_torchrun_did_not_make_is_named(
    variables: dict[str, str], named: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("WORLD_SIZE", "RANK", "MASTER_ADDR", "MASTER_PORT"):
        monkeypatch.delenv(name, raising=False)
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    with pytest.raises(ConfigError, match=named):
        Processes.from_environment()


@pytest.mark.parametrize("size", ["0", "-1", "1"])
def test_one_process_has_all_of_a_batch(size: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("WORLD_SIZE", size)
    assert Processes.from_environment().share(torch.arange(3)).tolist() == [0, 1, 2]
