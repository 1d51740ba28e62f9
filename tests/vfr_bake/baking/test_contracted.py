"""The bake of an unbounded scene: which cells are stored, and a whole bake of a small scene."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from exporters.export import export_asset
from player.asset.asset import Asset
from player.cameras.camera import Camera
from player.compiled import march as march_compiled
from player.errors import TrainingError
from player.march.contracted import enter_space
from player.progress import silent
from player.render import render
from tests.exporters.meshes import read_ply
from tests.reference import contract
from tests.vfr_bake.baking.scenes import trained
from vfr_bake.baking.bake import _Bake, bake
from vfr_bake.baking.cells import lattice_step, rays_of_contracted_views, weighty_cells
from vfr_bake.baking.distillation import TeacherRays, TrainingRays, collect_training_rays
from vfr_bake.baking.grids import unit_points
from vfr_bake.config import BakeConfig, FieldOptions, TrainConfig
from vfr_bake.data.demo import demo_capture
from vfr_bake.data.scene import build_scene
from vfr_bake.data.store.capture import PosedImages
from vfr_bake.kernels.visibility import mark_weighty_cells
from vfr_bake.rendering.compositing import composite
from vfr_bake.rendering.render import render_image
from vfr_bake.training.model_file import Model
from vfr_bake.training.scores.metrics import psnr

SETTINGS = BakeConfig(
    resolution=64, feature_resolution=64, mesh_resolution=24, refine_steps=20, head_width=0, check_views=1,
    n_channels=10, k=8, weight_floor=0.001,
)  # fmt: skip
OPAQUE = np.array([0, 0, 0, 255], np.uint8)


def photographs(views: PosedImages) -> PosedImages:
    """Return the views as photographed in front of an endless blue wall: no pixel is transparent."""
    wall = np.array([60, 90, 160, 255])
    share = [image[..., 3:] / 255 for image in views.images]
    mixed = [image * a + wall * (1 - a) for image, a in zip(views.images, share, strict=True)]
    return PosedImages(views.cameras, [image.round().astype(np.uint8) | OPAQUE for image in mixed])


@pytest.fixture(scope="module")
def model() -> Model:
    capture = demo_capture(size=48, n_train=16, n_test=2)
    capture = replace(capture, train=photographs(capture.train), test=photographs(capture.test))
    scene = build_scene(capture, "unbounded")
    field = FieldOptions(n_levels=6, max_resolution=128, log2_table_size=14, head_width=32)
    # So few steps have to find the middle of the scene, so none of it may learn more slowly; and fog has to
    # vanish five times faster than in a training of thousands of steps.
    config = TrainConfig(
        device="cpu",
        field=field,
        steps=300,
        pilot_steps=60,
        batch_rays=128,
        near_gradients=0.0,
        distortion=0.01,
    )
    return trained(scene, config)


@pytest.fixture(scope="module")
def folder(model: Model, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("bake") / "asset"
    bake(model, folder, SETTINGS, silent)
    return folder


def test_cells_are_where_intervals_weigh() -> None:
    """Cells with a heavy interval are marked. One ray along x from the middle has a short heavy interval
    inside and a thin one. The other has a long interval from 2 to 500, whose cells share its weight."""
    rays_o = np.zeros((2, 3), np.float32)
    rays_d = np.float32([[1, 0, 0], [-1, 0, 0]])
    t_mid, deltas = np.float32([0.55, 0.8, 251]), np.float32([0.01, 0.01, 498])
    weights, starts, counts = np.float32([0.5, 0.001, 0.9]), np.array([0, 2]), np.array([2, 1])

    def marked(floor: float) -> list[int]:
        visible = np.zeros((32, 32, 32), np.uint8)
        mark_weighty_cells(rays_o, rays_d, t_mid, deltas, weights, starts, counts, np.float32(floor), visible)
        assert set(np.argwhere(visible)[:, 1]) <= {16}, "y and z stay in the middle"
        return sorted(np.argwhere(visible)[:, 0].tolist())

    # 0.55 is in cell (0.55 + 2) * 8; contracted, -2 to -500 is -1.5 to -1.998, which is cells 4 to 0
    assert marked(0.05) == [0, 1, 2, 3, 20]
    assert marked(0.0005) == [0, 1, 2, 3, 20, 22]
    assert marked(0.95) == []


def test_cells_of_every_ray_are_marked() -> None:
    """Rays along x, one in each row of cells, each mark the cell in which their one heavy interval lies."""
    n = 12
    rays_o = np.zeros((n, 3), np.float32)
    rays_o[:, 1] = (np.arange(n) - 8 + 0.5) / 16
    rays_d = np.tile(np.float32([1, 0, 0]), (n, 1))
    t_mid = ((np.arange(n) % 4 + 0.5) / 16).astype(np.float32)
    deltas, weights = np.full(n, 0.01, np.float32), np.full(n, 0.5, np.float32)
    visible = np.zeros((64, 64, 64), np.uint8)
    starts, counts = np.arange(n), np.ones(n, np.int64)
    mark_weighty_cells(rays_o, rays_d, t_mid, deltas, weights, starts, counts, np.float32(0.1), visible)
    assert np.argwhere(visible).tolist() == sorted([32 + i % 4, 24 + i, 32] for i in range(n))


def test_what_no_sample_weighs_in_is_not_stored(model: Model) -> None:
    cells = weighty_cells(model, 64, 0.01, silent)
    assert 0.0005 < cells.mean() < 0.2
    few = weighty_cells(model, 64, 0.3, silent)
    assert few.sum() < cells.sum()
    camera = model.model_cameras()[0].c2w[:3, 3]
    x, y, z = ((contract(camera) + 2) * 8).astype(int)  # of the 32 blocks in 4 units
    assert not cells[x, y, z], "a camera stands in empty space"


def test_a_fog_in_which_no_cell_weighs_much_is_stored(
    model: Model, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A fog is stored although no cell of it reaches the usual weight floor; if that floor was asked for, it
    is refused. The floor is higher here than usual, because a fog that stays below 0.01 is hardly seen."""
    monkeypatch.setattr("vfr_bake.baking.cells.WEIGHT_FLOOR", 0.3)
    field = deepcopy(model.field)
    with torch.no_grad():
        field.density.out.weight.fill_(0)
        field.density.out.bias.fill_(-2)
    thin = replace(model, field=field, witnesses=None, training_pixels=None)
    settings = replace(SETTINGS, weight_floor=None, refine_steps=0)
    bake(thin, tmp_path / "asset", settings, silent)
    opacity = render(Asset.open(tmp_path / "asset"), model.cameras[0]).opacity
    _, wanted = thin.sampler.composited_features(field, *thin.model_cameras()[0].rays())
    assert 0.5 * wanted.mean() < opacity.mean() < 1.5 * wanted.mean()
    with pytest.raises(TrainingError, match=r"no cell weighs 0\.3 in any training view"):
        bake(thin, tmp_path / "other", replace(settings, weight_floor=0.3), silent)


def test_many_views_take_no_more_rays_than_there_is_time_for(
    model: Model, monkeypatch: pytest.MonkeyPatch
) -> None:
    few = rays_of_contracted_views(model, 64)
    monkeypatch.setattr("vfr_bake.baking.cells.MOST_SEEING", few / 2)
    assert rays_of_contracted_views(model, 64) == pytest.approx(few / 2)
    many = replace(model, cameras=[camera.resized(800, 533) for camera in model.cameras] * 18)
    assert rays_of_contracted_views(many, 64) == pytest.approx(few / 2)


def test_a_camera_near_the_middle_does_not_take_the_rays_of_the_others(model: Model) -> None:
    few = rays_of_contracted_views(model, 64)
    for offset in (0.0, 0.01, 0.3):
        c2w = model.cameras[0].c2w.copy()
        c2w[:3, 3] = (model.world_from_model @ [offset, 0, 0, 1])[:3]
        inside = replace(model, cameras=[replace(model.cameras[0], c2w=c2w), *model.cameras[1:]])
        assert rays_of_contracted_views(inside, 64) > 0.5 * few


def depth_at_the_mean_angle(model: Model, asset: Asset, camera: Camera) -> np.ndarray:
    """Return the model's depth [n] as the player defines it: t where the angle is the mean over the weights
    (`player.march.contracted`). In fog it is nearer than the mean t."""
    rays_o, rays_d = camera.rays()
    rays = enter_space(asset.grid, rays_o, rays_d)
    samples = model.sampler.sample_all(model.field, rays_o, rays_d)
    with torch.no_grad():
        sigmas = model.field.density(samples.features)
        _, _, weights = composite(sigmas, samples.features, samples.deltas, samples.starts, samples.counts)
    ray = np.repeat(np.arange(len(rays_o)), samples.counts.numpy())
    angle = np.arctan((samples.t_mid.numpy() - rays.t_nearest[ray]) / rays.width[ray])
    total = np.bincount(ray, weights.numpy(), len(rays_o))
    mean = np.bincount(ray, weights.numpy() * angle, len(rays_o)) / total
    return rays.t_nearest + rays.width * np.tan(mean)


def test_the_asset_plays_what_the_model_shows(model: Model, folder: Path) -> None:
    asset = Asset.open(folder, verify=True)
    assert asset.manifest.contracted and asset.manifest.step == pytest.approx(lattice_step(64))
    camera = model.model_cameras()[2]
    wanted = render_image(model.field, model.sampler, camera, model.background)
    frame = render(asset, model.cameras[2])
    assert psnr(frame.rgb, wanted) > 24


def test_depth_is_the_models_own(model: Model, tmp_path: Path) -> None:
    """Depth is the model's own before refinement, which only looks at colours."""
    bake(model, tmp_path / "asset", replace(SETTINGS, refine_steps=0), silent)
    asset, camera = Asset.open(tmp_path / "asset"), model.model_cameras()[2]
    frame = render(asset, model.cameras[2], n_fetches=0)
    found, wanted = frame.depth.reshape(-1) / asset.scale, depth_at_the_mean_angle(model, asset, camera)
    solid = (frame.opacity.reshape(-1) > 0.99) & (wanted < 3)
    assert solid.sum() > 100
    cell = 1 / asset.grid.cells_per_unit[0]
    assert np.median(np.abs(found[solid] - wanted[solid])) < cell / 2
    normals = frame.normals.reshape(-1, 3)[solid]
    assert np.linalg.norm(normals, axis=-1) == pytest.approx(1, abs=1e-3)


@pytest.mark.parametrize("k", [0, 4])
def test_a_training_ray_composes_what_the_player_composes(model: Model, k: int) -> None:
    """In the grid of one level that refinement learns from, a training ray composes what the player does."""
    work = _Bake(model, SETTINGS, silent)
    layout, n_rays = work._cells()
    stored, *_ = work._store(layout, n_rays)
    grid = layout.grid(stored.density, stored.features)
    rays_o, rays_d = model.model_cameras()[3].rays()
    played = march_compiled.march(grid, rays_o, rays_d, k)
    nothing = np.zeros((len(rays_o), 3), np.float32)
    teacher_rays = TeacherRays(rays_o, rays_d, nothing, nothing[:, 0])
    densities = layout.densities.rows()
    training_rays: TrainingRays = collect_training_rays(teacher_rays, grid, k, densities)
    assert len(training_rays) == len(played.hits) > 1000
    composed, opacity = training_rays.composed(grid.features.astype(np.float32))
    np.testing.assert_allclose(composed, played.features, rtol=0, atol=5e-3)
    np.testing.assert_allclose(opacity, played.opacity[played.hits], rtol=0, atol=1e-6)
    if k == 0:  # the lengths of samples make their weights
        fetches = training_rays.fetches(np.arange(len(training_rays)))
        codes = layout.finest(stored.density, stored.features).densities.values[0][:, 0].astype(np.float32)
        code = (fetches.densities.shares * codes[fetches.densities.rows]).sum(axis=1)
        optical = np.exp(grid.density_low + grid.density_slope * code) * fetches.lengths
        first = fetches.starts[:-1]
        np.testing.assert_allclose(-np.expm1(-optical[first]), fetches.weights[first], rtol=1e-3, atol=1e-6)


def test_vertices_outside_contracted_space_take_its_border() -> None:
    index = np.argwhere(np.ones((9, 9, 9), bool))
    points = unit_points(index, 8, contracted=True) * 4 - 2
    assert np.linalg.norm(points, axis=-1).max() < 2 + 1e-5
    inside = np.linalg.norm(index / 2.0 - 2, axis=-1) <= 2
    np.testing.assert_allclose(points[inside], index[inside] / 2.0 - 2, atol=1e-6)


def test_exports_hold_the_inner_region_in_world_units(model: Model, folder: Path, tmp_path: Path) -> None:
    asset = Asset.open(folder)
    centre = model.world_from_model[:3, 3]
    mesh = read_ply(folder / "mesh.ply")
    assert len(mesh.faces) > 50
    for name in ("a.ply", "a.npz", "a.vdb"):
        facts = export_asset(folder, tmp_path / name)
        low, high = np.array(facts["bounds"])
        assert (np.abs(np.stack([low, high]) - centre) <= asset.scale * 1.001).all(), name
    again = export_asset(folder, tmp_path / "b.ply", _options(method="density"))
    assert again["faces"] > 50
    assert (np.abs(np.array(again["bounds"]) - centre) <= asset.scale * 1.001).all()
    densities = np.load(tmp_path / "a.npz")
    finest = asset.grid.live.reshape(-1, 64), asset.grid.slot_levels
    cells = float((np.unpackbits(finest[0], axis=1).sum(axis=1) * 8.0 ** finest[1]).sum())
    assert len(densities["density"]) < 0.9 * cells, "the surroundings are left out"


def _options(**settings: object) -> object:
    from exporters.options import ExportOptions

    return ExportOptions(**settings)  # type: ignore[arg-type]
