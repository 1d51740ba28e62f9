"""Benchmarks of training: what is compared differs in nothing but what the comparison is about."""

from __future__ import annotations

from argparse import Namespace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tests.benchmarks.bench_ablation import train
from tests.benchmarks.bench_compositing import KINDS, Turns
from tests.benchmarks.peers import compare
from vfr_bake.config import Compositing
from vfr_bake.data.demo import demo_scene
from vfr_bake.field import networks
from vfr_bake.training import trainer


def refuse(*args: Any) -> None:
    raise AssertionError("expected not to be called")


@pytest.mark.parametrize("compositing", KINDS)
def test_features_and_colours_learn_from_all_rays_and_samples(
    compositing: Compositing, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(trainer, "chosen_rays", refuse)
    monkeypatch.setattr(trainer, "composite_field", refuse)
    options = Namespace(minutes=1.0, batch_samples=1024, step_cells=None)
    run = Turns(demo_scene(16, 6, 1), compositing, options)
    loss, n_rays, n_samples = run.trainer._step(1000, 0.5)
    assert np.isfinite(loss) and n_rays > 0 and n_samples > 0
    assert run.trainer.head_learns and run.trainer._next is None, "nothing is sampled ahead"


def test_the_ablation_runs_no_code_that_only_some_of_its_heads_have(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(networks, "fused_head", refuse)
    options = Namespace(steps=4, batch_samples=1024, batch_rays=64, views=1)
    assert np.isfinite(train(demo_scene(16, 6, 1), "I", 0, options)["psnr"])


def test_a_training_beside_another_tool_is_timed_as_a_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compare, "time", SimpleNamespace(monotonic=iter([10.0, 75.0]).__next__))
    mark = compare.ours(demo_scene(16, 6, 1), 1e-4, np.zeros((1, 5, 2), int))
    assert mark.seconds == 65.0 and mark.steps > 0
