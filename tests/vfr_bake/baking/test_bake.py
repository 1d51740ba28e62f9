"""The bake, in pieces, and as a whole on a small trained scene."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import onnxruntime
import pytest
import torch

from exporters.head.onnx_head import head_onnx
from player.asset.asset import Asset
from player.asset.bricks import pack_vertices
from player.cameras.camera import orbit
from player.errors import ConfigError, OutputError, TrainingError
from player.march.fetches import MIN_TOTAL
from player.march.march import march
from player.page.gpu_memory import gpu_bytes
from player.render import render
from tests.exporters.meshes import read_ply
from tests.numerics.fog import fog
from tests.vertex_grids import rows_of
from tests.vfr_bake.data.solids import AABB, signed_distance
from vfr_bake.baking.bake import _Bake, bake
from vfr_bake.baking.cells import corners_of, pixel_footprints
from vfr_bake.baking.distillation import (
    Fetches,
    TeacherRays,
    TrainingRays,
    collect_training_rays,
    corners,
    player_fetches,
)
from vfr_bake.baking.grids import code_step, head_sensitivity, latent, project, whole_codes
from vfr_bake.baking.head import FoldedHead, fold_head, runner
from vfr_bake.baking.held_out import views_between
from vfr_bake.baking.limits import file_sizes
from vfr_bake.baking.plan import FEWEST_MANIFEST_BYTES
from vfr_bake.baking.refinement import (
    BATCH,
    HEAD_RATE,
    N_TIMED,
    N_WARM,
    Steps,
    Stored,
    Tuning,
    refine,
    train_head,
)
from vfr_bake.baking.report import BakeResult
from vfr_bake.config import BakeConfig, FieldConfig
from vfr_bake.field.networks import HeadNetwork
from vfr_bake.kernels.latent_rows import PARTS
from vfr_bake.presets import PRESETS
from vfr_bake.rendering.render import render_image
from vfr_bake.training.length.witness_loss import Loss
from vfr_bake.training.model_file import Model
from vfr_bake.training.scores.metrics import psnr

FINE: dict[str, Any] = {
    "resolution": 96,
    "feature_resolution": 96,
    "mesh_resolution": 16,
    "refine_steps": 0,
    "check_views": 1,
}


def quiet(stage: str, done: int, of: int) -> None:
    """Take the place of a progress callback and do nothing."""


@pytest.fixture(scope="module")
def fine(model: Model, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, BakeResult]:
    """The asset that is baked with FINE, and the result of its bake."""
    folder = tmp_path_factory.mktemp("fine") / "asset"
    return folder, bake(model, folder, BakeConfig(**FINE), quiet)


@pytest.fixture(scope="module")
def default_sizes(model: Model, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An asset whose grids are as fine as its preset makes them."""
    folder = tmp_path_factory.mktemp("default") / "asset"
    bake(model, folder, BakeConfig(mesh_resolution=96, refine_steps=0, check_views=1), quiet)
    return folder


def test_projection_is_the_best_of_its_rank() -> None:
    random = np.random.default_rng(0)
    slopes = random.normal(size=(20, 8))  # colours that are linear in the features: Eckart-Young is exact
    rendered = random.normal(size=(500, 8)) * np.array([9, 5, 3, 2, 1, 0.5, 0.1, 0.01])
    exact = rendered @ slopes.T
    ours = project(slopes.T @ slopes, rendered, 3)
    loss = float(np.mean((rendered @ (ours.back @ ours.matrix).T @ slopes.T - exact) ** 2))
    singular = np.linalg.svd(exact, compute_uv=False)
    assert loss == pytest.approx(float((singular[3:] ** 2).sum() / exact.size), rel=1e-6), "Eckart-Young"
    for n_stored in (8, 20):
        whole = project(slopes.T @ slopes, rendered, n_stored)
        np.testing.assert_allclose(whole.back @ whole.matrix, np.eye(8), atol=1e-9)


def test_sensitivity_is_the_mean_square_of_finite_differences() -> None:
    torch.manual_seed(0)
    head = HeadNetwork(FieldConfig(n_levels=2, head_width=16)).double()
    random = np.random.default_rng(0)
    features, opacity = random.normal(size=(30, 4)), random.random(30)
    dirs = torch.nn.functional.normalize(torch.randn(30, 3, dtype=torch.float64), dim=-1).numpy()
    slopes = []
    with torch.no_grad():
        for step in np.eye(4) * 1e-5:
            ahead, behind = (
                head(torch.from_numpy(features + s), torch.from_numpy(dirs)) for s in (step, -step)
            )
            slopes.append(((ahead - behind) / 2e-5).numpy() * opacity[:, None])
    j = np.stack(slopes, axis=-1)  # [30, 3, 4]
    expected = np.einsum("nci,ncj->ij", j, j) / 30
    np.testing.assert_allclose(head_sensitivity(head, features, dirs, opacity), expected, rtol=1e-6)


@pytest.mark.parametrize("size", [1e-30, 1.0, 1e30])
def test_feature_codes_are_within_half_a_step(size: float) -> None:
    values = np.random.default_rng(0).normal(size=(1000, 3)) * np.array([size, 0, 0.1 * size])
    step = code_step(values)
    codes = whole_codes(latent(values / step))
    assert codes.dtype == np.int8 and np.abs(codes.astype(int)).max() == 127
    assert (np.abs(codes * step - values) <= step * 0.5000001).all()
    assert np.abs(codes[:, 2].astype(int)).max() < 30, "a channel of little use takes few bits"


def test_the_few_largest_features_do_not_make_all_codes_coarse() -> None:
    values = np.random.default_rng(1).uniform(-1, 1, (50_000, 2)).astype(np.float32)
    values[:4] *= 1000
    step = code_step(values)
    assert step == pytest.approx(1 / 127, rel=1e-3)
    assert np.abs(whole_codes(latent(values / step))[:4]).max() == 127, "they end there"
    few = np.zeros((50_000, 2), np.float32)
    few[7, 1] = -5.0
    assert code_step(few) == pytest.approx(5 / 127), "there is nothing else"


def test_every_corner_of_a_visible_cell_is_stored() -> None:
    cells = np.random.default_rng(0).random((5, 5, 5)) < 0.1
    expected = {tuple(cell + corner) for cell in np.argwhere(cells) for corner in np.ndindex(2, 2, 2)}
    assert {tuple(v) for v in np.argwhere(corners_of(cells))} == expected


def test_coarse_pictures_leave_no_hole_in_a_fine_grid(model: Model, fine: tuple[Path, BakeResult]) -> None:
    # A cell is a third of a pixel wide, so that one ray a pixel would miss most cells.
    camera, in_model = model.cameras[3], model.model_cameras()[3]
    large = camera.resized(256, 256)
    played = render(Asset.open(fine[0]), large, n_fetches=0)
    _, opacity = model.occupancy.composited_features(model.field, *in_model.resized(256, 256).rays())
    solid = opacity.reshape(256, 256) > 0.95
    assert solid.mean() > 0.1
    assert (played.opacity[solid] < 0.5).mean() < 0.002


def test_folded_head_equals_the_head() -> None:
    torch.manual_seed(0)
    head = HeadNetwork(FieldConfig(n_levels=6, head_width=24, sh_degree=3, n_sh_features=2))
    scales = np.linspace(0.5, 2, 12)
    first = head.spatial[0].weight.detach().double().numpy() * scales
    session = onnxruntime.InferenceSession(head_onnx(fold_head(head, first)))
    features = torch.randn(50, 12)
    dirs = torch.nn.functional.normalize(torch.randn(50, 3), dim=-1)
    with torch.no_grad():
        expected = head(features, dirs).numpy()
    codes = (features.numpy() / scales).astype(np.float32)
    (rgb,) = session.run(None, {"features": codes, "dirs": dirs.numpy()})
    np.testing.assert_allclose(rgb, expected, rtol=0, atol=2e-6)


class OneFetchEach(TrainingRays):
    """Rays of one fetch each, with weight 1: the first vertices of a grid of 16 cells, in their order."""

    def fetches(self, some: np.ndarray) -> Fetches:
        n = len(self)
        coords, masks, order = pack_vertices(np.argwhere(np.ones((16, 16, 16)))[:n])
        points = np.argwhere(np.ones((16, 16, 16)))[:n][order].astype(np.float32)
        around, ones = corners(rows_of(coords, masks, 16), points[some], MIN_TOTAL), np.ones(len(some))
        weights = ones.astype(np.float32)
        return Fetches(np.arange(len(some) + 1), around, around, weights, weights.copy(), weights.copy())


def training_rays_of(dirs: np.ndarray, wanted: np.ndarray) -> TrainingRays:
    teacher = TeacherRays(np.zeros_like(wanted), dirs, wanted, np.ones(len(dirs), np.float32))
    return OneFetchEach(teacher, fog(0.1), 0, None)


def test_refinement_brings_the_head_back_to_its_teacher(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("vfr_bake.baking.refinement.HEAD_BATCH", BATCH)  # to have the same rays
    torch.manual_seed(0)
    head = HeadNetwork(FieldConfig(n_levels=6, head_width=24))
    weights = fold_head(head, head.first_weights() * 0.02)
    codes = torch.rand(4000, 12) * 254 - 127
    dirs = torch.nn.functional.normalize(torch.randn(4000, 3), dim=-1)
    with torch.no_grad():
        wanted = FoldedHead(weights)(codes, dirs).numpy()
    # Damage of a kind that a bake may do to features, and that the head can undo: a bias and less contrast.
    baked = latent((codes * 0.8 + 10).numpy().round())
    training_rays = training_rays_of(dirs.numpy(), wanted)
    stored = Stored(weights, baked, np.full(4000, 255, np.float32))
    opaque = (0.0, float(np.log(20)))  # of a sample of length 1 with the largest code

    def error(stored: Stored) -> float:
        composed = torch.from_numpy(training_rays.composed(stored.features)[0])
        with torch.no_grad():
            shown = FoldedHead(stored.head)(composed, dirs).numpy()
        return float(np.mean((shown - wanted) ** 2))

    before = error(stored)
    nothing = refine(stored, training_rays, Steps(0, lambda *_: None), opaque)
    assert error(nothing) == pytest.approx(before, rel=1e-3)
    learned = train_head(stored, training_rays, Steps(200, lambda *_: None), HEAD_RATE)
    head_alone = replace(stored, head=learned)
    assert error(head_alone) < before / 5
    alone = error(head_alone)
    same = refine(stored, training_rays, Steps(200, lambda *_: None), opaque, code_rate=0)
    assert np.array_equal(same.features, baked), "left alone"
    assert error(same) == pytest.approx(alone, rel=1e-3)
    own = replace(stored, features=baked.copy())
    both = refine(own, training_rays, Steps(200, lambda *_: None), opaque, code_rate=4)
    assert error(both) < alone
    assert both.features is own.features, "moved where they are"
    assert not np.array_equal(both.features, baked) and np.abs(both.features).max() <= 127 * PARTS


def test_a_round_that_gains_nothing_leaves_what_was_stored(
    model: Model, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = BakeConfig(resolution=48, check_views=1, head_width=0, head_bits=32, k=4, refine_steps=20)
    work = _Bake(model, config, quiet)
    layout, _ = work._cells()
    stored, teacher, again = work._store(layout, 20_000)
    density, features = stored.density.copy(), stored.features.copy()
    assert (features % PARTS).any(), "codes that are not whole yet"
    monkeypatch.setattr("vfr_bake.baking.refinement.Tuning._gained", lambda *_: False)
    tuning = Tuning(config, work.choice, work.held_out, lambda *_: None, 60.0)
    left = tuning.run(stored, layout, teacher, again)
    np.testing.assert_array_equal(left.density, density)
    np.testing.assert_array_equal(left.features, features)
    assert left.head is stored.head
    assert tuning.kept.name == "k", "not a round that was given up"


@pytest.mark.parametrize("share", [-1e9, 1e9])
def test_a_head_in_8_bits_that_loses_too_much_is_played_in_float32(
    share: float, model: Model, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = BakeConfig(resolution=48, check_views=1, head_width=0, head_bits=8, k=4, refine_steps=20)
    work = _Bake(model, config, quiet)
    layout, _ = work._cells()
    stored, teacher, again = work._store(layout, 20_000)
    # Whether 8 bits lose anything depends on the few steps of training, so a loss is set here.
    monkeypatch.setattr(work.held_out, "lost", lambda before, after: Loss(0.2, 0.0))
    monkeypatch.setattr("vfr_bake.baking.refinement.BITS_SHARE", share)
    monkeypatch.setattr("vfr_bake.baking.refinement.ROUNDING_LEFT", -np.inf)  # 8 bits are tried
    monkeypatch.setattr("vfr_bake.baking.refinement.Tuning._gained", lambda *_: True)
    tuning = Tuning(config, work.choice, work.held_out, lambda *_: None, 600.0)
    left = tuning.run(stored, layout, teacher, again)
    assert (tuning.ranges is None) == (share < 0)
    if share < 0:  # the features are those that the head was measured with
        shown = work.held_out.look("again", layout.grid(left.density, left.features), runner(left.head), 4)
        assert shown.psnr == tuning.kept.psnr
    assert (tuning.kept.name == "k") == (share < 0)
    assert ("none" in tuning.left_out["head bits"]) == (share < 0)


def test_half_a_round_is_kept_where_all_of_it_loses(model: Model, monkeypatch: pytest.MonkeyPatch) -> None:
    config = BakeConfig(resolution=48, check_views=1, head_width=0, head_bits=32, k=4, refine_steps=20)
    work = _Bake(model, config, quiet)
    layout, _ = work._cells()
    stored, teacher, again = work._store(layout, 20_000)
    density, features = stored.density.copy(), stored.features.copy()
    farther = latent(features / PARTS + 2)

    def moved(stored: Stored, *_: object) -> Stored:
        stored.features[:] = farther
        output, bias = stored.head.output
        return Stored(replace(stored.head, output=(output, bias + 1)), stored.features, density + 4)

    answers = iter([False, True])
    monkeypatch.setattr("vfr_bake.baking.refinement.refine", moved)
    monkeypatch.setattr("vfr_bake.baking.refinement.Tuning._gained", lambda *_: next(answers, False))
    tuning = Tuning(config, work.choice, work.held_out, lambda *_: None, 60.0)
    before = stored.head
    left = tuning.run(stored, layout, teacher, again)
    assert "half" in tuning.left_out["refinement"]
    np.testing.assert_allclose(left.density, density + 2)
    assert np.abs(left.features - (features + farther.astype(int)) / 2).max() <= 0.5
    np.testing.assert_allclose(left.head.output[1], before.output[1] + 0.5)
    np.testing.assert_array_equal(left.head.spatial[0][0], before.spatial[0][0])


def test_a_round_takes_fewer_steps_where_there_is_no_time(monkeypatch: pytest.MonkeyPatch) -> None:
    now = 0.0
    monkeypatch.setattr("vfr_bake.baking.refinement.time", SimpleNamespace(perf_counter=lambda: now))
    told: list[tuple[int, int]] = []
    steps = Steps(100_000, lambda done, of: told.append((done, of)), seconds=0.5)
    taken = []
    for step in steps:
        taken.append(steps.falling(step))
        now += 0.25 if step < N_WARM - 1 else 2**-9  # the first steps may compile something
        now += 600 if step == N_WARM + N_TIMED // 2 else 0  # the machine sleeps
    assert N_WARM + N_TIMED < len(taken) == steps.n == 256 and told[-1] == (256, 256)
    assert taken[0] == 1 and taken[-1] < 0.01 and (np.diff(taken) < 0).all(), "it falls to 0 all the same"
    assert len(list(Steps(100, lambda *_: None))) == 100
    hasty = Steps(100_000, lambda *_: None, seconds=-1.0)
    assert len(list(hasty)) == N_WARM + N_TIMED


@pytest.mark.parametrize("n_fetches", [0, 1, 3, 5])
def test_a_training_ray_composes_what_the_player_composes(model: Model, n_fetches: int) -> None:
    work = _Bake(model, BakeConfig(resolution=48, refine_steps=0, check_views=1), quiet)
    layout, _ = work._cells()
    stored, *_ = work._store(layout, 20_000)
    grid = layout.grid(stored.density, stored.features)
    rays_o, rays_d = model.model_cameras()[3].rays()
    played = march(grid, rays_o, rays_d, n_fetches)
    found = player_fetches(grid, rays_o, rays_d, n_fetches)
    assert np.array_equal(found.hits, played.hits) and len(found.hits) > 100
    np.testing.assert_allclose(found.opacity, played.opacity[found.hits], rtol=1e-6)  # compiled, and in numpy
    assert len(found.lengths) == (0 if n_fetches else len(found.weights))
    assert (found.lengths == grid.step).all() and found.counts.max() == (n_fetches or found.counts.max())
    nothing = np.zeros_like(rays_o)
    teacher = TeacherRays(rays_o, rays_d, nothing, nothing[:, 0])
    training_rays = collect_training_rays(teacher, grid, n_fetches)
    composed, opacity = training_rays.composed(latent(grid.features))
    # float32 sums of up to 127, in another order
    np.testing.assert_allclose(composed, played.features, rtol=0, atol=1e-3)
    assert np.array_equal(opacity, found.opacity)


def test_the_asset_plays_what_the_model_shows(model: Model, tmp_path: Path) -> None:
    settings = BakeConfig(
        resolution=96,
        feature_resolution=96,
        mesh_resolution=64,
        n_channels=16,
        check_views=2,
        k=5,
        preset="fidelity",
        refine_steps=150,
    )
    result = bake(model, tmp_path / "asset", settings, quiet)
    asset = Asset.open(tmp_path / "asset", verify=True)
    assert asset.manifest.n_channels == 16 and result.n_vertices == asset.arrays.densities.first_rows[-1]
    camera, in_model = model.cameras[5], model.model_cameras()[5]
    full = render_image(model.field, model.occupancy, in_model, model.background)
    every = psnr(render(asset, camera, n_fetches=0).rgb, full)
    five = psnr(render(asset, camera, n_fetches=5).rgb, full)
    one = psnr(render(asset, camera, n_fetches=1).rgb, full)
    assert every > 35 and five > 32, "the grid, the codes and the choice of samples lose little"
    assert one < five <= every + 0.5
    assert result.figures["psnr_to_full_model"] > 32
    losses = {stage["name"]: stage["psnr"] for stage in result.figures["stages"]}
    assert losses["refined"] > losses["codes"] + 1, "refinement gets back what the bake lost"
    lost = {stage["name"]: stage["loss_db"] for stage in result.figures["stages"]}
    better = min(lost[name] for name in ("head in 8 bits", "refined at k") if name in lost)
    allowed = 1.5 * PRESETS["fidelity"].detail_loss_db + PRESETS["fidelity"].code_loss_db
    assert lost["files"] - better < allowed + 0.05, "detail and bits are left out by what the witnesses lose"


def test_the_report_adds_up(model: Model, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    checked = []
    monkeypatch.setattr("vfr_bake.baking.bake.check_budget", lambda *given: checked.append(given[2]))
    settings = BakeConfig(preset="fast", resolution=64, mesh_resolution=32, refine_steps=20, check_views=2)
    result = bake(model, tmp_path / "asset", settings, quiet)
    said = json.loads((tmp_path / "asset" / "report.json").read_text())
    names = [stage["name"] for stage in said["stages"]]
    refined = ["refined", "k", "head in 8 bits", "refined at k"]
    names.remove("files")
    assert names == ["grid", "rank", "codes", "small head", *refined][: len(names)] and len(names) >= 7
    assert said["bytes"] == file_sizes(tmp_path / "asset"), "the manifest as it lists the reports"
    assert said["bytes"]["manifest.json"] > FEWEST_MANIFEST_BYTES
    assert [1e6 * megabytes for megabytes in checked] == [sum(said["bytes"].values())] == [result.n_bytes]
    assert said["seconds"].keys() == result.figures["time"].keys(), "the report's own part is among them"
    assert said["gpu_bytes"] == result.figures["gpu_bytes"] == gpu_bytes(Asset.open(tmp_path / "asset"))
    assert said["asked"]["n_channels"] == PRESETS["fast"].n_channels and "channels" in said["left_out"]
    page = (tmp_path / "asset" / "report.html").read_text()
    assert page.count("data:image/png;base64,") == 2 and "<svg" in page
    assert not re.search(r'(src|href)="(?!data:)', page), "nothing is loaded from elsewhere"
    k = Asset.open(tmp_path / "asset", verify=True).manifest.n_fetches
    assert max(map(int, said["lookups"])) == k <= PRESETS["fast"].n_fetches


def test_a_budget_that_is_missed_is_an_error_and_writes_nothing(model: Model, tmp_path: Path) -> None:
    small: dict[str, Any] = {
        "resolution": 32,
        "feature_resolution": 32,
        "mesh_resolution": 16,
        "refine_steps": 0,
        "check_views": 1,
    }
    with pytest.raises(TrainingError, match=r"size: expected at most 0\.03 MB, got .* nothing was written"):
        bake(model, tmp_path / "asset", BakeConfig(max_mb=0.03, **small), quiet)
    with pytest.raises(TrainingError, match=r"loss: expected at most 0\.001 dB, got"):
        bake(model, tmp_path / "asset", BakeConfig(max_loss_db=0.001, **small), quiet)
    assert list(tmp_path.iterdir()) == []
    for name in ("max_mb", "max_loss_db", "target_ms", "max_memory"):
        with pytest.raises(ConfigError, match=f"{name}: expected more than 0, got 0"):
            BakeConfig(**{name: 0})


def test_a_budget_is_kept_by_storing_less_of_each_value(
    model: Model, fine: tuple[Path, BakeResult], tmp_path: Path
) -> None:
    folder, whole = fine
    manifest = Asset.open(folder).manifest
    sections = [section for part in manifest.parts for section in part.sections]
    symbols = sum(section.bytes for section in sections if section.kind == "symbols")
    limit = (whole.n_bytes - symbols / 2) / 1e6
    result = bake(model, tmp_path / "half", BakeConfig(max_mb=limit, **FINE), quiet)
    half = Asset.open(tmp_path / "half").manifest
    assert (half.n_channels, half.resolution) == (manifest.n_channels, manifest.resolution)
    assert 0.5 * limit < result.n_bytes / 1e6 <= limit
    agreed = [baked.figures["psnr_to_full_model"] for baked in (whole, result)]
    assert agreed[1] < agreed[0], "the witnesses of so small a scene do not tell so little"


def test_views_between_lie_between(model: Model) -> None:
    cameras = model.model_cameras()
    views = views_between(model, 10, seed=0)
    places = np.stack([camera.c2w[:3, 3] for camera in cameras])
    for view in views:
        to_others = np.linalg.norm(places - view.c2w[:3, 3], axis=1)
        assert 0 < to_others.min() < 0.3 * np.linalg.norm(view.c2w[:3, 3])
        np.testing.assert_allclose(view.c2w[:3, :3] @ view.c2w[:3, :3].T, np.eye(3), atol=1e-9)
    again, other = views_between(model, 10, seed=0), views_between(model, 10, seed=1)
    assert all(np.array_equal(a.c2w, b.c2w) for a, b in zip(views, again, strict=True))
    assert not any(np.array_equal(a.c2w, b.c2w) for a, b in zip(views, other, strict=True))


def test_views_between_come_near_to_what_lies_halfway_on_a_walk(model: Model) -> None:
    # As held-out views of a capture, which are every eighth view of a walk around something.
    walk = replace(model, cameras=orbit(model.cameras, 36))
    halfway = [
        camera.c2w[:3, 3] for camera in replace(walk, cameras=orbit(model.cameras, 72)).model_cameras()
    ]
    views = np.stack([camera.c2w[:3, 3] for camera in views_between(walk, 72, seed=0)])
    apart = np.stack([np.linalg.norm(views - place, axis=1).min() for place in halfway[1::2]])
    step = np.linalg.norm(halfway[0] - halfway[1])
    assert (apart < step / 2).mean() > 0.5


def test_views_of_a_scene_stand_aside_of_the_way_between_two_cameras(model: Model) -> None:
    walk = replace(model, cameras=orbit(model.cameras, 36))
    cameras = np.stack([camera.c2w[:3, 3] for camera in walk.model_cameras()])
    step = np.linalg.norm(cameras[0] - cameras[1])
    off_the_walk = []
    for wide in (False, True):
        places = np.stack([camera.c2w[:3, 3] for camera in views_between(walk, 200, seed=0, wide=wide)])
        off_the_walk.append(np.abs(np.linalg.norm(places, axis=1) - np.linalg.norm(cameras[0])))
    assert off_the_walk[0].max() < 0.2 * step
    assert step < off_the_walk[1].max() < 4 * step and np.median(off_the_walk[1]) > 0.1 * step


def test_the_mesh_lies_on_the_true_surface_in_world_units(model: Model, default_sizes: Path) -> None:
    mesh = read_ply(default_sizes / "mesh.ply")
    distance = np.abs(signed_distance(mesh.vertices))
    half = model.world_from_model[0, 0]
    voxel, pixel = 2 * half / 96, 2 * half / 64
    assert np.median(distance) < pixel, "pictures of 64 pixels across know the surface no better"
    low, high = AABB
    assert (mesh.vertices.min(axis=0) > low - 3 * voxel).all()
    assert (mesh.vertices.max(axis=0) < high + 3 * voxel).all()
    colours = mesh.colours[:, :3].astype(int)
    assert colours.std(axis=0).min() > 10, "a colourful scene has colourful vertices"


def test_a_folder_that_exists_is_kept(model: Model, tmp_path: Path) -> None:
    (tmp_path / "asset").mkdir()
    (tmp_path / "asset" / "photo.jpg").touch()
    with pytest.raises(OutputError, match="--force"):
        bake(model, tmp_path / "asset", BakeConfig(), quiet)


def test_grids_are_as_fine_as_the_pictures_and_features_never_finer_than_the_field(
    model: Model, default_sizes: Path
) -> None:
    per_pixel = PRESETS["balanced"].cells_per_pixel
    cell_of_a_pixel = 2 * per_pixel / float(np.median(pixel_footprints(model)))
    assert 40 < cell_of_a_pixel < 144
    made = Asset.open(default_sizes).manifest
    assert made.resolution == round(cell_of_a_pixel)
    assert made.feature_resolution == round(PRESETS["balanced"].feature_share * made.resolution)
    layout, _ = _Bake(
        model, BakeConfig(resolution=500, feature_resolution=400, check_views=1), quiet
    )._cells()
    assert (layout.densities.resolution, layout.features.resolution) == (144, 96)
