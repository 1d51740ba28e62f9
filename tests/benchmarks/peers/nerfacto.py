"""Train nerfstudio's nerfacto on a CPU, and render pixels of its test views after some minutes.

Runs in an environment that has nerfstudio 1.1.5 and not this package; `compare.py` starts it:

    python nerfacto.py DATA pixels.npz colours.npz --minutes 2 5 10 --rays 4096 [--object]

DATA is a folder in nerfstudio's format, or with --object one of NeRF-synthetic. pixels.npz holds "pixels" [n,
3] int64: test view, row and column. colours.npz gets "colours" [n_marks, n, 3] float32 in [0, 1] and, for
each mark, "steps" and "seconds" of training alone. All settings are nerfacto's own, except those that its
documentation advises for CPUs and for synthetic objects, and the rays of a batch.
"""

# pyright: reportMissingImports=false

from __future__ import annotations

import argparse
import time
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch
from nerfstudio.configs.method_configs import method_configs
from nerfstudio.data.dataparsers.blender_dataparser import BlenderDataParserConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from nerfstudio.engine.callbacks import TrainingCallbackLocation
from nerfstudio.engine.trainer import Trainer, TrainerConfig
from nerfstudio.model_components.ray_generators import RayGenerator
from torchmetrics.image import lpip

AT_ONCE = 4096
"""Number of pixels that are rendered at once."""


def configured(data: Path, is_object: bool, n_rays: int, outputs: Path) -> TrainerConfig:
    """Return nerfacto's configuration for a CPU."""
    config = method_configs["nerfacto"]
    config.machine.device_type = "cpu"
    config.mixed_precision = False
    config.vis = "tensorboard"
    config.data, config.output_dir, config.timestamp = data, outputs, "run"
    manager, model = config.pipeline.datamanager, config.pipeline.model
    model.implementation = "torch"
    manager.train_num_rays_per_batch = manager.pixel_sampler.num_rays_per_batch = n_rays
    if is_object:
        manager.dataparser = BlenderDataParserConfig(data=data)
        model.near_plane, model.far_plane = 2.0, 6.0
        model.background_color = "white"
        model.disable_scene_contraction = True
        model.proposal_initial_sampler = "uniform"
        model.distortion_loss_mult = 0.0
        model.average_init_density = 1.0
        model.camera_optimizer.mode = "off"
    else:
        manager.dataparser = NerfstudioDataParserConfig(data=data, eval_mode="filename")
    return config


def train_step(trainer: Trainer, step: int) -> None:
    """Take one step as nerfstudio's own loop does."""
    trainer.pipeline.train()
    for callback in trainer.callbacks:
        callback.run_callback_at_location(step, location=TrainingCallbackLocation.BEFORE_TRAIN_ITERATION)
    trainer.train_iteration(step)
    for callback in trainer.callbacks:
        callback.run_callback_at_location(step, location=TrainingCallbackLocation.AFTER_TRAIN_ITERATION)


@torch.no_grad()
def rendered(trainer: Trainer, pixels: torch.Tensor) -> np.ndarray:
    """Return the colours [n, 3] of pixels [n, 3] of the test views."""
    trainer.pipeline.eval()
    rays = RayGenerator(trainer.pipeline.datamanager.eval_dataset.cameras)
    parts = [trainer.pipeline.model(rays(some))["rgb"] for some in pixels.split(AT_ONCE)]
    return torch.cat(parts).clamp(0, 1).numpy()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("pixels", type=Path)
    parser.add_argument("colours", type=Path)
    parser.add_argument("--minutes", type=float, nargs="+", required=True)
    parser.add_argument("--rays", type=int, required=True, help="rays of a batch")
    parser.add_argument("--object", action="store_true")
    options = parser.parse_args()
    torch.manual_seed(0)
    # A score that is not needed here, and for which a network would be downloaded.
    lpip.LearnedPerceptualImagePatchSimilarity = lambda **_: torch.nn.Identity()
    with np.load(options.pixels, allow_pickle=False) as found:
        pixels = torch.from_numpy(found["pixels"])
    with TemporaryDirectory() as outputs:
        config = configured(options.data, options.object, options.rays, Path(outputs))
        trainer: Trainer = config.setup(local_rank=0, world_size=1)
        trainer.setup(test_mode="test")
        seconds, step, colours, marks = 0.0, 0, [], []
        for minutes in sorted(options.minutes):
            while seconds < 60 * minutes:
                begin = time.monotonic()
                train_step(trainer, step)
                seconds, step = seconds + time.monotonic() - begin, step + 1
            colours.append(rendered(trainer, pixels))
            marks.append((step, seconds))
            print(f"nerfacto: {step} steps in {seconds:.0f} s", flush=True)
    steps, at = zip(*marks, strict=True)
    np.savez(options.colours, colours=np.stack(colours), steps=steps, seconds=at)


if __name__ == "__main__":
    main()
