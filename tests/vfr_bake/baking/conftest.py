"""Small trained model that the tests of the bake share."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from tests.vfr_bake.baking.scenes import trained
from tests.vfr_bake.fewer_rays import fewer_rays
from vfr_bake.baking.plan import FEWEST_RAYS
from vfr_bake.config import FieldOptions, TrainConfig
from vfr_bake.data import demo
from vfr_bake.training.model_file import Model

SMALL: dict[str, Any] = {
    "resolution": 48,
    "feature_resolution": 48,
    "mesh_resolution": 16,
    "refine_steps": 0,
    "check_views": 1,
}
"""Settings of a bake that takes a second."""


@pytest.fixture(scope="module", autouse=True)
def few_rays() -> Iterator[None]:
    """Let each bake take a few seconds: these scenes have a hundredth of a real one's pixels."""
    with fewer_rays():
        yield


@pytest.fixture
def planned_rays(monkeypatch: pytest.MonkeyPatch) -> None:
    """Plan a bake with no fewer rays than a real one has."""
    monkeypatch.setattr("vfr_bake.baking.plan.FEWEST_RAYS", FEWEST_RAYS)


@pytest.fixture(scope="session")  # files of other folders may run between two of this one
def model() -> Model:
    scene = demo.demo_scene(size=64, n_train=24, n_test=2)
    field = FieldOptions(n_levels=8, max_resolution=96, log2_table_size=15, head_width=32, density_width=16)
    config = TrainConfig(
        device="cpu", field=field, steps=400, pilot_steps=100, batch_samples=8192, occupancy_resolution=48
    )
    return trained(scene, config)
