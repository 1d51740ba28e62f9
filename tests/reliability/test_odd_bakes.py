"""Hardly trained models of odd scenes: each bakes and plays. `odd_bakes` is the long form."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from tests.reliability.odd_bakes import what_does_not_play
from tests.reliability.odd_scenes import odd_capture
from tests.vfr_bake.baking.scenes import trained
from vfr_bake.baking.bake import bake
from vfr_bake.config import BakeConfig, FieldOptions, TrainConfig
from vfr_bake.data.scene import build_scene

FIELD = FieldOptions(n_levels=6, max_resolution=64, log2_table_size=13, head_width=16, density_width=16)
TRAIN = TrainConfig(device="cpu", field=FIELD, pilot_steps=10, batch_samples=4096, occupancy_resolution=32)


@pytest.mark.parametrize(
    ("name", "steps", "unbounded"),
    [("glass", 60, False), ("two views", 10, False), ("room", 60, True), ("horizon", 5, True)],
)
def test_what_is_hardly_trained_bakes_within_the_bytes_that_were_asked_for(
    name: str, steps: int, unbounded: bool, tmp_path: Path
) -> None:
    scene = build_scene(odd_capture(name, 20, 9))
    assert scene.unbounded == unbounded
    field = replace(FIELD, density_width=0) if unbounded else FIELD
    model = trained(scene, replace(TRAIN, field=field, steps=steps))
    config = BakeConfig(preset="fast", max_mb=0.5, refine_steps=3, check_views=1, mesh_resolution=16)
    result = bake(model, tmp_path / "asset", config, lambda *_: None)
    assert result.n_bytes <= 500_000
    assert what_does_not_play(tmp_path / "asset") == []
