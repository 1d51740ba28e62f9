"""Models that cannot be baked well: a clear error that leaves no files, or a measured fallback."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from player.asset.asset import Asset
from player.errors import ConfigError, TrainingError
from player.progress import silent
from player.render import render
from vfr_bake.baking.bake import bake
from vfr_bake.config import BakeConfig, TrainConfig
from vfr_bake.data import demo
from vfr_bake.data.demo_solids import CENTRE, SCALE
from vfr_bake.rendering.render import render_image
from vfr_bake.training.model_file import Model
from vfr_bake.training.scores.metrics import psnr
from vfr_bake.training.trainer import Trainer


def test_an_empty_model_is_refused_and_leaves_nothing(model: Model, tmp_path: Path) -> None:
    empty = Trainer(demo.demo_scene(size=16, n_train=4, n_test=1), TrainConfig(device="cpu", steps=1))
    with torch.no_grad():
        empty.field.density.out.weight.fill_(0)
        empty.field.density.out.bias.fill_(-30)
    hollow = Model(empty.field, empty.sampler, np.eye(4), model.cameras, True, {}, {})
    with pytest.raises(TrainingError, match="got nothing: train longer"):
        bake(hollow, tmp_path / "asset", BakeConfig(resolution=32), silent)
    assert list(tmp_path.iterdir()) == []


def test_a_floor_that_no_cell_reaches_is_refused(model: Model, tmp_path: Path) -> None:
    settings = BakeConfig(resolution=32, weight_floor=0.9999, refine_steps=0, check_views=1)
    with pytest.raises(TrainingError, match=r"no cell weighs 0\.9999 .* lower --weight-floor"):
        bake(model, tmp_path / "asset", settings, silent)
    assert list(tmp_path.iterdir()) == []


def test_more_channels_than_the_model_has_are_refused(model: Model, tmp_path: Path) -> None:
    n = model.field.config.n_channels
    with pytest.raises(ConfigError, match=f"n_channels: expected at most the {n} of the model, got {n + 1}"):
        bake(model, tmp_path / "asset", BakeConfig(n_channels=n + 1), silent)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.usefixtures("planned_rays")
def test_a_grid_becomes_coarser_where_memory_does_not_hold_it(model: Model, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"max_memory: expected at least 0\.82 GB for 48 .* got 0\.8 "):
        bake(model, tmp_path / "asset", BakeConfig(resolution=48, max_memory=0.8), silent)
    assert list(tmp_path.iterdir()) == []
    settings = BakeConfig(resolution=48, max_memory=0.814, refine_steps=0, check_views=1)
    result = bake(model, tmp_path / "asset", settings, silent)
    assert "do not fit into 0.814 GB" in result.figures["left_out"]["resolution"]
    assert 8 <= Asset.open(tmp_path / "asset").manifest.resolution < 48


def test_a_grid_becomes_coarser_where_the_bytes_do_not_hold_it(
    model: Model, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("vfr_bake.baking.limits.CELL_BYTES", 10.0)
    settings = BakeConfig(resolution=96, feature_resolution=96, max_mb=0.4, refine_steps=0, check_views=1)
    result = bake(model, tmp_path / "asset", settings, silent)
    assert result.n_bytes <= 400_000
    assert "do not fit into 0.4 MB" in result.figures["left_out"]["resolution"]
    asset = Asset.open(tmp_path / "asset", verify=True)
    assert 16 <= asset.manifest.resolution < 96
    camera = model.cameras[0]
    full = render_image(model.field, model.sampler, model.model_cameras()[0], model.background)
    assert psnr(render(asset, camera).rgb, full) > 20, "it shows the scene"


def test_a_scene_far_larger_than_its_cameras_plays_what_the_model_shows(model: Model, tmp_path: Path) -> None:
    """If all cameras are within a thousandth of the box, looking as before, the grid is as fine as it may be,
    and what these cameras see is stored."""
    middle = CENTRE + SCALE * np.array([0.0, 0.0, 0.3])  # above the ball, with the plate in view
    cameras = []
    for camera in model.cameras:
        c2w = camera.c2w.copy()
        c2w[:3, 3] = middle + 1e-3 * (c2w[:3, 3] - middle)
        cameras.append(replace(camera, c2w=c2w))
    near = replace(model, cameras=cameras, witnesses=None)  # no photographs were taken from there
    settings = BakeConfig(preset="fidelity", mesh_resolution=16, refine_steps=0, check_views=8)
    bake(near, tmp_path / "asset", settings, silent)
    asset = Asset.open(tmp_path / "asset", verify=True)
    full = render_image(near.field, near.occupancy, near.model_cameras()[0], near.background)
    assert full.std() > 0.05, "they see something"
    assert psnr(render(asset, cameras[0]).rgb, full) > 28
