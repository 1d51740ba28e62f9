"""What a scene does not need is left out, for three scenes that need different things."""

from __future__ import annotations

import json
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from player.asset.asset import Asset
from player.progress import silent
from tests.vfr_bake.baking.scenes import analytic_scene, trained
from vfr_bake.baking import refinement
from vfr_bake.baking.bake import _Bake, bake
from vfr_bake.baking.detail.detail import Detail
from vfr_bake.baking.distillation import TeacherRays, render_teacher
from vfr_bake.baking.held_out import Shown
from vfr_bake.config import BakeConfig, FieldOptions, TrainConfig
from vfr_bake.presets import PRESETS
from vfr_bake.training.length.stopwatch import LONGEST_STEP
from vfr_bake.training.length.witness_loss import Loss
from vfr_bake.training.model_file import Model

MAX_MB = 1.0


def trained_scene(kind: str) -> Model:
    scene = analytic_scene(kind, size=48, n_train=20)
    field = FieldOptions(n_levels=8, max_resolution=64, log2_table_size=14, head_width=32, density_width=16)
    config = TrainConfig(
        device="cpu", field=field, steps=400, pilot_steps=100, batch_samples=8192, occupancy_resolution=32
    )
    return trained(scene, config)


@pytest.fixture(scope="module")
def models() -> dict[str, Model]:
    return {kind: trained_scene(kind) for kind in ("matte", "glossy", "fog")}


@pytest.fixture(scope="module")
def chosen(models: dict[str, Model], tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict]:
    """The report and manifest of each scene's bake."""
    found = {}
    for kind, model in models.items():
        folder = tmp_path_factory.mktemp(kind) / "asset"
        settings = BakeConfig(refine_steps=40, mesh_resolution=24, check_views=2, max_mb=MAX_MB)
        bake(model, folder, settings, silent)
        found[kind] = json.loads((folder / "report.json").read_text())
        found[kind]["manifest"] = Asset.open(folder, verify=True).manifest
    return found


def test_each_scene_keeps_to_its_budget(chosen: dict[str, dict]) -> None:
    assert all(sum(report["bytes"].values()) / 1e6 <= MAX_MB for report in chosen.values())


def test_fog_takes_more_lookups_and_gloss_more_channels_than_a_surface(chosen: dict[str, dict]) -> None:
    """With two lookups fog loses about a decibel, a surface less than a tenth. How many lookups a surface
    takes depends on the last hundredths of a decibel, which differ with processor and number of threads."""
    lookups = {kind: report["manifest"].n_fetches for kind, report in chosen.items()}
    lost = {kind: report["lookups"]["2"] for kind, report in chosen.items()}
    channels = {kind: report["manifest"].n_channels for kind, report in chosen.items()}
    assert lookups["fog"] >= lookups["matte"] and lost["fog"] > 4 * max(lost["matte"], 0.1)
    assert channels["glossy"] > channels["matte"] > channels["fog"]


@pytest.mark.parametrize(("n_specks", "k"), [(1, 2), (3, 8)])
def test_lookups_are_enough_for_pixels_not_to_stand_out(
    n_specks: int, k: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Lookups are enough for no pixel to stand out: of 20,000 pixels, n_specks are far off with fewer than 8
    lookups, while the mean error shows none of them."""

    class Seen:
        def look(self, name: str, grid: Any, head: Any, n_fetches: int) -> Any:
            rgb = np.zeros((20_000, 3), np.float32)
            rgb[: 0 if n_fetches in (0, 8) else n_specks, 1] = 0.2
            return SimpleNamespace(shown=Shown(0.0, None, rgb))

        def lost(self, before: Shown, after: Shown) -> Loss:
            return Loss(0.0, 0.0)

        def measure(self, name: str, grid: Any, head: Any, n_fetches: int) -> int:
            return n_fetches

    monkeypatch.setattr(refinement, "runner", lambda head: head)
    monkeypatch.setattr(refinement, "LOOKUPS", (2, 4, 8, 12))
    config = BakeConfig(preset="fast")
    tuning = refinement.Tuning(config, PRESETS["fast"], Seen(), lambda *_: None, 1.0)  # type: ignore[arg-type]
    assert tuning._choose_lookups(None, None) == tuning.n_fetches == k  # type: ignore[arg-type]
    assert set(tuning.lookups.values()) == {0.0}


def test_a_pause_in_a_round_takes_no_time_from_the_next(monkeypatch: pytest.MonkeyPatch) -> None:
    now = 0.0
    clock = SimpleNamespace(monotonic=lambda: now, perf_counter=lambda: now)
    monkeypatch.setattr(refinement, "time", clock)
    tuning = refinement.Tuning(BakeConfig(), PRESETS["fast"], None, lambda *_: None, 100.0)  # type: ignore[arg-type]
    with tuning._steps("refinement", 1000) as steps:
        for step in steps:
            now += 2**-6
            now += 3600 if step == 500 else 0  # the machine sleeps
    assert not tuning.left_out
    assert tuning._until - now == pytest.approx(100 - 999 / 2**6 - LONGEST_STEP)


@pytest.mark.parametrize(("n_steps", "are_kept"), [(2, False), (3, True)])
def test_fetches_are_kept_where_steps_draw_more_rays_than_there_are(n_steps: int, are_kept: bool) -> None:
    teacher = TeacherRays(*(np.zeros((10_000, *shape), np.float32) for shape in ((3,), (3,), (3,), ())))
    tuning = refinement.Tuning(BakeConfig(), PRESETS["fast"], None, lambda *_: None, 100.0)  # type: ignore[arg-type]
    assert (tuning._keeping("refinement", n_steps, teacher) is not None) == are_kept


@pytest.mark.parametrize(("max_loss_db", "steps"), [(None, (1, 2, 4)), (0.5, (1, 2, 2)), (0.4, (1, 1, 1))])
def test_longer_steps_keep_to_the_loss_that_was_asked_for(
    max_loss_db: float | None, steps: tuple[int, ...]
) -> None:
    """Steps are as long as the loss allows: 0.48 dB are lost anyway, 0.01 more by steps of 2, 0.03 by 4."""

    @dataclass
    class Grid:
        level_steps: np.ndarray
        n_levels: int = 3

    class Seen:
        def look(self, name: str, grid: Grid, head: Any, n_fetches: int) -> Any:
            lost = 0.48 + 0.01 * (int(max(grid.level_steps)) - 1)
            return SimpleNamespace(loss=Loss(lost, 0.0), shown=lost)

        def lost_by_leaving_out(self, before: float, after: float) -> Loss:
            return Loss(after - before, 0.0)

    detail = Detail(Seen(), None, 0, 0.1, silent)  # type: ignore[arg-type]
    assert detail.level_steps(Grid(np.ones(3)), max_loss_db) == steps  # type: ignore[arg-type]


def test_the_fewest_channels_that_lose_little_are_found_by_halving(models: dict[str, Model]) -> None:
    """Halving finds the fewest channels that lose little, as a trial takes the head on all held-out rays."""
    work = _Bake(models["matte"], BakeConfig(check_views=1), silent)
    teacher = render_teacher(work.model, work.model.model_cameras(), 2000, 0, silent)
    for fewest in (1, 6, 15, 99):
        asked = []

        def channel_loss(kept: np.ndarray, fewest: int = fewest, asked: list = asked) -> Loss:
            asked.append(round(float(np.trace(kept))))  # the rank of a projection
            return Loss(0.5 if asked[-1] < fewest else 0.1, 0.0)

        work.held_out.channel_loss = channel_loss  # type: ignore[method-assign]
        assert len(work._projection(teacher).matrix) == min(fewest, work.choice.n_channels)
        assert len(asked) <= 4
