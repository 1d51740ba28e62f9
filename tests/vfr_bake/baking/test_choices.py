"""What a scene does not need is left out: three scenes that need different things."""

from __future__ import annotations

import json

import numpy as np
import pytest

from player.asset import Asset
from tests.vfr_bake.baking.scenes import analytic_scene
from vfr_bake.baking.bake import bake
from vfr_bake.config import BakeConfig, FieldOptions, TrainConfig
from vfr_bake.training.model_file import Model
from vfr_bake.training.trainer import Trainer

MAX_MB = 0.6


def quiet(*_: object) -> None:
    """No progress."""


def trained(kind: str) -> Model:
    scene = analytic_scene(kind, size=40, n_train=16)
    field = FieldOptions(
        n_levels=6, max_resolution=48, log2_table_size=13, head_width=24, density_width=16, sh_degree=3
    )
    config = TrainConfig(
        device="cpu", field=field, steps=400, pilot_steps=60, batch_samples=4096, occupancy_resolution=32
    )
    trainer = Trainer(scene, config)
    losses = [step.loss for step in trainer.run()]
    cameras = [camera.transformed(scene.world_from_model) for camera in scene.train.cameras]
    figures = {"training_psnr": float(-10 * np.log10(np.mean(losses[-50:])))}
    return Model(trainer.field, trainer.sampler, scene.world_from_model, cameras, True, {}, figures)


@pytest.fixture(scope="module")
def chosen(tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict]:
    """Report and manifest of each scene's bake."""
    found = {}
    for kind in ("matte", "glossy", "fog"):
        folder = tmp_path_factory.mktemp(kind) / "asset"
        settings = BakeConfig(
            preset="fast", resolution=48, refine_steps=150, mesh_resolution=24, check_views=2, max_mb=MAX_MB
        )
        bake(trained(kind), folder, settings, quiet)
        found[kind] = json.loads((folder / "report.json").read_text())
        found[kind]["manifest"] = Asset.open(folder, verify=True).manifest
    return found


def test_each_scene_keeps_to_its_budget(chosen: dict[str, dict]) -> None:
    for report in chosen.values():
        assert sum(report["bytes"].values()) / 1e6 <= MAX_MB
        assert report["missed"] == [], "what the preset aims at"


def test_directions_stay_only_where_colours_depend_on_them(chosen: dict[str, dict]) -> None:
    def without(kind: str) -> bool:
        return chosen[kind]["left_out"].get("directions", "").startswith("all of them")

    assert without("matte") and not without("glossy")
    heads = {kind: report["bytes"]["head.onnx"] for kind, report in chosen.items()}
    assert heads["matte"] < heads["glossy"], "fewer harmonics, fewer bytes"


def test_fog_takes_more_lookups_than_a_surface_and_fewer_channels_than_gloss(chosen: dict[str, dict]) -> None:
    lookups = {kind: report["manifest"].n_samples for kind, report in chosen.items()}
    channels = {kind: report["manifest"].n_channels for kind, report in chosen.items()}
    assert lookups["fog"] > lookups["matte"]
    assert len(set(zip(lookups.values(), channels.values(), strict=True))) == 3
