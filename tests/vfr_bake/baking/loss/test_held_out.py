"""The pixels on which a bake measures its loss: witnesses if the model has some, else its own pictures."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from player.asset.asset import Asset
from player.files.images import to_8_bit
from player.progress import silent
from player.render import render
from tests.player.march.pyramid_scene import random_scene
from vfr_bake.baking import held_out
from vfr_bake.baking.bake import bake
from vfr_bake.baking.held_out import HeldOut, Shown, expected_loss
from vfr_bake.baking.report import BakeResult
from vfr_bake.config import BakeConfig
from vfr_bake.rendering.render import render_image
from vfr_bake.training.length.witness_loss import PATCH_WEIGHT, Loss
from vfr_bake.training.model_file import Model
from vfr_bake.training.scores.metrics import over_background

SMALL = BakeConfig(
    preset="fast", resolution=64, mesh_resolution=16, refine_steps=40, check_views=1, n_channels=2, k=1
)

NOTHING = np.zeros((0, 3), np.float32)


@pytest.fixture(scope="module")
def baked(model: Model, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, BakeResult]:
    folder = tmp_path_factory.mktemp("baked") / "asset"
    return folder, bake(model, folder, SMALL, silent)


def test_many_views_share_their_rays(model: Model, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(held_out, "MOST_BETWEEN", 6000)
    assert [HeldOut(model, n)._n_between for n in (1, 2, 6)] == [64 * 64, 6000, 6000]


def test_rays_are_marched_in_parts_as_at_once(model: Model, monkeypatch: pytest.MonkeyPatch) -> None:
    shown, grid = HeldOut(model, 1), random_scene(40, 40, (1, 2), seed=3).grid
    monkeypatch.setattr(held_out, "RAYS_AT_ONCE", len(shown.rays_o))
    whole = shown.march(grid, 3)
    assert len(whole.hits) > 1000
    monkeypatch.setattr(held_out, "RAYS_AT_ONCE", 1000)
    for name, a, b in zip(whole._fields, whole, shown.march(grid, 3), strict=True):
        assert a.dtype == b.dtype and np.array_equal(a, b), name


def test_the_loss_is_what_whole_pictures_of_model_and_asset_say(
    model: Model, baked: tuple[Path, BakeResult]
) -> None:
    """The loss is that of whole pictures of model and asset, at the witnesses' pixels of every view."""
    folder, result = baked
    witnesses, asset = model.witnesses, Asset.open(folder)
    assert witnesses is not None and len(witnesses.whole) == 1
    model_from_world = np.linalg.inv(model.world_from_model)
    first, means = 0, {"model": {True: [], False: []}, "asset": {True: [], False: []}}
    for view, (camera, count) in enumerate(zip(model.cameras, witnesses.counts.tolist(), strict=True)):
        rows = slice(first, first := first + count)
        photograph = to_8_bit(over_background(witnesses.rgba[rows], model.background)) / 255
        in_model = camera.transformed(model_from_world)
        pictures = {
            "model": render_image(model.field, model.sampler, in_model, model.background),
            "asset": render(asset, camera).rgb,
        }
        for name, picture in pictures.items():
            shown = to_8_bit(picture.reshape(-1, 3)[witnesses.pixels[rows]]) / 255
            means[name][view in witnesses.whole].append(((shown - photograph) ** 2).mean(axis=1))
    errors = {
        name: [np.concatenate(kinds[whole]).mean() for whole in (False, True)]
        for name, kinds in means.items()
    }
    lost = 10 * np.log10(np.divide(errors["asset"], errors["model"]))
    loss = lost @ [PATCH_WEIGHT, 1 - PATCH_WEIGHT]
    assert abs(loss) > 0.05, "so few channels change the pictures"
    # The rays of a whole frame are rounded differently, which moves single samples.
    assert result.loss.db == pytest.approx(loss, abs=0.01)


def test_figures_and_report_have_the_loss_with_its_spread(baked: tuple[Path, BakeResult]) -> None:
    folder, result = baked
    said = json.loads((folder / "report.json").read_text())
    assert result.loss.spread is not None and 0 < result.loss.spread < 2
    for figures in (said, result.figures):
        assert (figures["loss_db"], figures["loss_db_spread"]) == (result.loss.db, result.loss.stated)
        assert figures["stages"][-1]["loss_db"] == result.loss.db
    assert said["measured_on"].startswith("The loss is measured on 5,959 pixels")
    assert "expected loss" not in (folder / "report.html").read_text()


def test_a_model_without_witnesses_is_baked_by_its_own_pictures(model: Model, tmp_path: Path) -> None:
    own = replace(model, witnesses=None, figures={"training_psnr": 24.0, "test_psnr": 90.0})
    result = bake(own, tmp_path / "asset", SMALL, silent)
    said = json.loads((tmp_path / "asset" / "report.json").read_text())
    assert result.loss.spread is None and said["loss_db_spread"] is None
    error = 10 ** (-result.figures["psnr_to_full_model"] / 10)
    assert said["loss_db"] == pytest.approx(expected_loss(error, 24.0), rel=1e-6), "by the training split"
    assert said["measured_on"].startswith("The model has no witnesses")
    assert "an expected loss of" in (tmp_path / "asset" / "report.html").read_text()


def test_the_cameras_of_whole_views_are_not_looked_through(model: Model) -> None:
    """Cameras of whole views are not used by the bake, which would else know the views it is measured on."""
    assert model.witnesses is not None
    (whole,) = model.witnesses.whole.tolist()
    names = [camera.name for camera in model.cameras]
    assert [camera.name for camera in model.model_cameras()] == names[:whole] + names[whole + 1 :]


def test_what_shows_the_models_pictures_loses_nothing(model: Model) -> None:
    held_out = HeldOut(model, 1)
    features, opacity = model.sampler.composited_features(model.field, held_out.rays_o, held_out.rays_d)
    own = held_out.compare(features, opacity)
    assert own.error < 1e-12 and held_out.channel_loss(np.eye(features.shape[1])).db == 0
    dimmed = held_out.compare(features, 0.5 * opacity)
    loss = held_out.lost(own, dimmed)
    assert loss.least > 1, "half of the opacity is a loss beyond chance"
    assert held_out.lost(dimmed, own).db == pytest.approx(-loss.db)
    assert held_out.is_better(dimmed, own) and not held_out.is_better(own, dimmed)


def test_what_a_small_change_loses_is_known_better_than_it_is_measured(model: Model) -> None:
    """The loss of a small change that does not depend on the photographs, here noise, is known better than it
    can be measured: its mean square adds to the model's errors at the training pixels."""
    held_out = HeldOut(model, 1)
    own = held_out.own
    noise, measured, found, added = np.random.default_rng(0), [], [], []
    for _ in range(8):
        rgb = (own.rgb + noise.normal(0, 0.01, own.rgb.shape)).astype(np.float32)
        shown = held_out._compared(rgb)
        assert shown.learned is not None and own.learned is not None and held_out._learned is not None
        measured.append(held_out._learned.loss(own.learned, shown.learned).db)
        found.append(held_out.loss_of_change(own, shown))
        added.append(
            ((np.clip(rgb, 0, 1) - np.clip(own.rgb, 0, 1))[-held_out._n_learned :] ** 2).mean(axis=1)
        )
    assert held_out._learned is not None and own.learned is not None
    expected = held_out._learned.loss(own.learned, own.learned + np.mean(added, axis=0)).db
    assert np.mean(found) == pytest.approx(expected, rel=0.1) and np.std(found) < np.std(measured)


def test_a_change_that_knows_the_photographs_is_measured(model: Model) -> None:
    """A change that depends on the photographs, such as half of the opacity, is measured at the training
    pixels: it loses decibels, of which the estimate for independent errors says little."""
    held_out = HeldOut(model, 1)
    features, opacity = model.sampler.composited_features(model.field, held_out.rays_o, held_out.rays_d)
    own, dimmed = (held_out.compare(features, share * opacity) for share in (1.0, 0.5))
    assert held_out._learned is not None and own.learned is not None and dimmed.learned is not None
    measured = held_out._learned.loss(own.learned, dimmed.learned)
    change = held_out.loss_of_change(own, dimmed)
    assert measured.spread is not None
    assert abs(change - measured.db) < measured.spread
    assert held_out.loss_of_change(own, own) == 0


@pytest.mark.parametrize(
    ("lost", "closer", "better"),
    [
        (Loss(-0.1, 0.05), False, True),
        (Loss(0.1, 0.05), True, False),
        (Loss(0.04, 0.05), True, True),
        (Loss(-0.04, 0.05), False, False),
        (Loss(-0.001, None), False, True),
        (Loss(0.001, None), True, False),
    ],
)
def test_where_the_witnesses_see_no_difference_the_models_pictures_decide(
    lost: Loss, closer: bool, better: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    held_out = object.__new__(HeldOut)
    monkeypatch.setattr(held_out, "lost", lambda before, after: lost)
    before, after = Shown(2e-4, None, NOTHING), Shown(1e-4 if closer else 3e-4, None, NOTHING)
    assert held_out.is_better(before, after) == better


def test_pixels_are_far_off_in_one_channel() -> None:
    seen = np.full((8, 3), 0.5, np.float32)
    shown = seen.copy()
    shown[0, 2], shown[1] = 0.61, 0.55
    before, after = Shown(0.0, None, seen), Shown(0.0, None, shown)
    assert after.far_off(before) == before.far_off(after) == 1 / 8
    assert before.far_off(before) == 0
