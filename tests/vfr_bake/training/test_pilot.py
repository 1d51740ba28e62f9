"""Section 3.3 of the paper: some scenes do not converge with a large head unless a pilot network finds their
geometry first.

The paper observed this with `ship`. Here it is the built-in scene photographed in front of a white wall,
without alpha: the wall is white whatever the opacity is, so that nothing but the head's colours says where
matter is.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numba
import numpy as np
import pytest
import torch

from vfr_bake.config import FieldOptions, TrainConfig
from vfr_bake.data.demo import demo_scene
from vfr_bake.data.scene import Scene
from vfr_bake.data.store.capture import PosedImages
from vfr_bake.evaluation import render_views
from vfr_bake.training.model_file import trained_model
from vfr_bake.training.trainer import Trainer

SMALL_GRID = {"n_levels": 8, "max_resolution": 64, "log2_table_size": 14, "density_width": 16}


def before_a_wall(views: PosedImages) -> PosedImages:
    """Return the same pictures as a camera would take them in front of a white wall: opaque."""
    images = []
    for image in views.images:
        rgb, alpha = image[..., :3].astype(np.float64), image[..., 3:] / 255
        opaque = np.full_like(alpha, 255)
        images.append(np.concatenate([rgb * alpha + 255 * (1 - alpha), opaque], axis=-1).astype(np.uint8))
    return PosedImages(views.cameras, images)


@pytest.fixture
def one_thread() -> Iterator[None]:
    """Run on one thread, so that sums have one order: the seeds that fail depend on the last bit."""
    n_torch, n_numba = torch.get_num_threads(), numba.get_num_threads()
    torch.set_num_threads(1)
    numba.set_num_threads(1)
    yield
    torch.set_num_threads(n_torch)
    numba.set_num_threads(n_numba)


def psnr(scene: Scene, pilot_steps: int, seed: int) -> float:
    """Return the PSNR on held-out views, after 300 steps with 10 layers of 256 and twice the paper's rate."""
    config = TrainConfig(
        device="cpu", steps=300, minutes=60.0, pilot_steps=pilot_steps, batch_samples=4096, seed=seed,
        network_rate=2e-2, occupancy_resolution=32,
        field=FieldOptions(**SMALL_GRID, head_width=256, n_directional_layers=8),
    )  # fmt: skip
    trainer = Trainer(scene, config)
    trainer.field.head.products = torch.float32  # on any machine: the seeds that fail depend on it
    for _ in trainer.run():
        pass
    views = render_views(trained_model(trainer, scene, {}), scene.test)
    return float(np.mean([view.score().psnr for view in views]))


def test_a_large_head_needs_the_pilot_to_converge(one_thread: None) -> None:
    scene = demo_scene(size=48, n_train=20, n_test=3)
    scene = replace(scene, train=before_a_wall(scene.train), test=before_a_wall(scene.test), has_alpha=False)
    blank = np.mean(
        [10 * np.log10(255**2 / np.mean((image[..., :3] - 255.0) ** 2)) for image in scene.test.images]
    )
    # Without the pilot, about three of four seeds fail: the field stays nearly empty, and the picture white.
    # With it, about as many reach some 8 dB more, because the head begins when its rate, high for so many
    # layers, is falling. Which seeds these are depends on the processor: its sums have another order.
    assert any(psnr(scene, 0, seed) < blank + 3 and psnr(scene, 200, seed) > blank + 6 for seed in range(8))
