"""The head that is tuned equals the head that is exported, in float32 and in 8 bits."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import onnxruntime
import pytest
import torch

from exporters.head.onnx_head import HeadWeights, head_onnx
from exporters.head.ranges import activation_ranges
from player.head.graph import Activation
from vfr_bake.baking.grids import latent
from vfr_bake.baking.head import FoldedHead, fold_head, runner
from vfr_bake.baking.refinement import HEAD_RATE, Steps, Stored, refine
from vfr_bake.config import FieldConfig
from vfr_bake.field.networks import HeadNetwork
from vfr_bake.rendering.render import head_colours

from .test_bake import training_rays_of


def folded() -> HeadWeights:
    torch.manual_seed(0)
    head = HeadNetwork(FieldConfig(n_levels=6, head_width=24, sh_degree=3, n_sh_features=2))
    return fold_head(head, head.first_weights() * 0.01)


def inputs(n: int) -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(0)
    dirs = random.normal(size=(n, 3))
    dirs /= np.linalg.norm(dirs, axis=-1, keepdims=True)
    return random.uniform(-127, 127, (n, 12)).astype(np.float32), dirs.astype(np.float32)


@pytest.mark.parametrize("activation", ["gelu", "hard_swish"])
@pytest.mark.parametrize("eight", [False, True], ids=["float32", "8 bits"])
def test_the_trainable_head_is_the_exported_one(eight: bool, activation: Activation) -> None:
    weights = replace(folded(), activation=activation)
    codes, dirs = inputs(500)
    ranges = activation_ranges(weights, codes, dirs) if eight else None
    data = head_onnx(weights, ranges)
    (rgb,) = onnxruntime.InferenceSession(data).run(None, {"features": codes, "dirs": dirs})
    for run in (partial(head_colours, FoldedHead(weights, ranges=ranges)), runner(weights, ranges)):
        off = np.abs(run(codes, dirs) - np.asarray(rgb))
        if eight:  # seldom, a sum near the border of two levels is added in another order
            assert (off < 1e-4).mean() > 0.98 and off.max() < 0.02
        else:
            assert off.max() < 2e-6
    again = FoldedHead(weights, ranges=ranges).weights()
    (same,) = onnxruntime.InferenceSession(head_onnx(again, ranges)).run(
        None, {"features": codes, "dirs": dirs}
    )
    assert np.abs(np.asarray(same) - np.asarray(rgb)).max() < (0.02 if eight else 2e-6)


def test_refinement_gets_back_what_8_bits_lose() -> None:
    """Refinement gets back what 8 bits lose. Ranges are twice too wide, so that something is lost."""
    weights = folded()
    codes, dirs = inputs(4000)
    codes = codes.round()
    wanted = runner(weights)(codes, dirs)
    ranges = tuple((low, 2 * high) for low, high in activation_ranges(weights, codes, dirs))
    training_rays = training_rays_of(dirs, wanted)

    def error(stored: Stored) -> float:
        composed, _ = training_rays.composed(stored.features)
        return float(np.mean((runner(stored.head, ranges)(composed, dirs) - wanted) ** 2))

    stored = Stored(weights, latent(codes), np.zeros(len(codes), np.float32))
    steps = Steps(400, lambda done, of: None)
    tuned = refine(stored, training_rays, steps, None, HEAD_RATE, 0, ranges)
    assert error(tuned) < 0.8 * error(stored)
    untouched = replace(tuned, head=weights)
    assert error(untouched) == pytest.approx(error(stored), rel=1e-6)
