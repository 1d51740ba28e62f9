"""The bake piece by piece, and whole on a small trained scene."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnxruntime
import pytest
import torch

from exporters.onnx_head import HeadWeights, head_onnx
from exporters.ply import read_ply
from player.asset import Asset
from player.errors import OutputError, TrainingError
from player.render import render
from vfr_bake.baking.bake import bake
from vfr_bake.baking.head_weights import fold_head
from vfr_bake.baking.projection import code_scales, encode_features, project
from vfr_bake.baking.refinement import FoldedHead, Lessons, refine
from vfr_bake.baking.visibility import close_gaps, corner_vertices, pixel_footprints, visible_cells
from vfr_bake.config import BakeConfig, FieldConfig, FieldOptions, TrainConfig
from vfr_bake.data import demo
from vfr_bake.field.head import Head
from vfr_bake.rendering.render import render_image
from vfr_bake.training.metrics import psnr
from vfr_bake.training.model_file import Model
from vfr_bake.training.trainer import Trainer


def quiet(stage: str, done: int, of: int) -> None:
    """No progress."""


@pytest.fixture(scope="module")
def model() -> Model:
    scene = demo.demo_scene(size=64, n_train=24, n_test=2)
    field = FieldOptions(n_levels=8, max_resolution=96, log2_table_size=15, head_width=32, density_width=16)
    config = TrainConfig(
        device="cpu", field=field, steps=400, pilot_steps=100, batch_samples=8192, occupancy_resolution=48
    )
    trainer = Trainer(scene, config)
    for _ in trainer.run():
        pass
    cameras = [camera.transformed(scene.world_from_model) for camera in scene.train.cameras]
    return Model(trainer.field, trainer.sampler, scene.world_from_model, cameras, True, {}, {})


def test_projection_is_the_best_of_its_rank() -> None:
    random = np.random.default_rng(0)
    first = random.normal(size=(20, 8))
    rendered = random.normal(size=(500, 8)) * np.array([9, 5, 3, 2, 1, 0.5, 0.1, 0.01])
    exact = rendered @ first.T

    def loss(projection_matrix: np.ndarray, unprojected: np.ndarray) -> float:
        return float(np.mean((rendered @ projection_matrix.T @ unprojected.T - exact) ** 2))

    ours = project(first, rendered, 3)
    best = loss(ours.matrix, ours.first)
    singular = np.linalg.svd(exact, compute_uv=False)
    assert best == pytest.approx(float((singular[3:] ** 2).sum() / exact.size), rel=1e-9), "Eckart-Young"
    assert ours.kept == pytest.approx(1 - best * exact.size / (exact**2).sum(), rel=1e-9)
    whole = project(first, rendered, 8)
    np.testing.assert_allclose(whole.first @ whole.matrix, first, atol=1e-10)


def test_feature_codes_are_within_half_a_step() -> None:
    values = np.random.default_rng(0).normal(size=(1000, 3)) * np.array([1e-30, 1.0, 1e30])
    values[:, 1] = 0
    scales = code_scales(values)
    codes = encode_features(values, scales)
    assert codes.dtype == np.int8 and np.abs(codes.astype(int)).max() == 127
    assert (np.abs(codes * scales - values) <= scales * 0.5000001).all()


def test_every_corner_of_a_visible_cell_is_stored() -> None:
    cells = np.random.default_rng(0).random((5, 5, 5)) < 0.1
    expected = {tuple(cell + corner) for cell in np.argwhere(cells) for corner in np.ndindex(2, 2, 2)}
    assert {tuple(v) for v in corner_vertices(cells)} == expected


def test_gaps_of_one_cell_are_closed_and_nothing_grows() -> None:
    cells = np.zeros((12, 12, 12), bool)
    cells[5:8, 2:10, 2:10] = True
    full = cells.copy()
    random = np.random.default_rng(0)
    for _ in range(6):  # single holes, some of them at the rim
        cells[6, random.integers(3, 9), random.integers(3, 9)] = False
    assert np.array_equal(close_gaps(cells), full)
    corner = np.zeros((4, 4, 4), bool)
    corner[0, 0, 0] = True
    assert np.array_equal(close_gaps(corner), corner)


def test_coarse_pictures_leave_no_hole_in_a_fine_grid(model: Model, tmp_path: Path) -> None:
    # Cells a third of a pixel wide: one ray a pixel would miss most of them.
    camera, in_model = model.cameras[3], model.model_cameras()[3]
    bake(model, tmp_path / "asset", BakeConfig(resolution=96, mesh_resolution=16, check_views=1), quiet)
    large = camera.resized(256, 256)
    played = render(Asset.open(tmp_path / "asset"), large, n_samples=0)
    _, opacity, _ = model.occupancy.composited_features(model.field, *in_model.resized(256, 256).rays())
    solid = opacity.reshape(256, 256) > 0.95
    assert solid.mean() > 0.1
    assert (played.opacity[solid] < 0.5).mean() < 0.002


def test_folded_head_equals_the_head() -> None:
    torch.manual_seed(0)
    head = Head(FieldConfig(n_levels=6, head_width=24, sh_degree=3, n_sh_features=2))
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


def test_the_trainable_head_is_the_exported_one() -> None:
    torch.manual_seed(0)
    head = Head(FieldConfig(n_levels=6, head_width=24, sh_degree=3, n_sh_features=2))
    weights = fold_head(head, head.first_weights() * 0.01)
    session = onnxruntime.InferenceSession(head_onnx(weights))
    codes = (torch.rand(50, 12) * 254 - 127).float()
    dirs = torch.nn.functional.normalize(torch.randn(50, 3), dim=-1)
    trainable = FoldedHead(weights)
    (rgb,) = session.run(None, {"features": codes.numpy(), "dirs": dirs.numpy()})
    with torch.no_grad():
        np.testing.assert_allclose(trainable(codes, dirs).numpy(), rgb, rtol=0, atol=2e-6)
    (again,) = onnxruntime.InferenceSession(head_onnx(trainable.weights())).run(
        None, {"features": codes.numpy(), "dirs": dirs.numpy()}
    )
    np.testing.assert_allclose(again, rgb, rtol=0, atol=2e-6)


def test_refinement_brings_the_head_back_to_its_teacher() -> None:
    torch.manual_seed(0)
    head = Head(FieldConfig(n_levels=6, head_width=24))
    weights = fold_head(head, head.first_weights() * 0.02)
    codes = torch.rand(4000, 12) * 254 - 127
    dirs = torch.nn.functional.normalize(torch.randn(4000, 3), dim=-1)
    ones = np.ones(4000, np.float32)
    with torch.no_grad():
        wanted = FoldedHead(weights)(codes, dirs).numpy()
    # What the bake might do to the features: a bias and a loss of contrast that the head can undo.
    lessons = Lessons((codes * 0.8 + 10).numpy(), dirs.numpy(), ones, wanted, ones)

    def error(weights: HeadWeights) -> float:
        with torch.no_grad():
            shown = FoldedHead(weights)(torch.from_numpy(lessons.codes), dirs).numpy()
        return float(np.mean((shown - wanted) ** 2))

    before = error(weights)
    assert error(refine(weights, lessons, 0, lambda done, of: None)) == pytest.approx(before, rel=1e-3)
    assert error(refine(weights, lessons, 200, lambda done, of: None)) < before / 5


def test_the_asset_plays_what_the_model_shows(model: Model, tmp_path: Path) -> None:
    settings = BakeConfig(resolution=96, mesh_resolution=64, n_channels=16, check_views=2)
    result = bake(model, tmp_path / "asset", settings, quiet)
    asset = Asset.open(tmp_path / "asset", verify=True)
    assert asset.manifest.n_channels == 16 and result.n_vertices == len(asset.arrays.density)
    camera, in_model = model.cameras[5], model.model_cameras()[5]
    full = render_image(model.field, model.occupancy, in_model, model.background)
    every = psnr(render(asset, camera, n_samples=0).rgb, full)
    five = psnr(render(asset, camera, n_samples=5).rgb, full)
    one = psnr(render(asset, camera, n_samples=1).rgb, full)
    assert every > 35 and five > 32, "the grid, the codes and the choice of samples lose little"
    assert one < five <= every + 0.5
    assert result.figures["psnr_to_full_model"] > 32


def test_the_mesh_lies_on_the_true_surface_in_world_units(model: Model, tmp_path: Path) -> None:
    bake(model, tmp_path / "asset", BakeConfig(mesh_resolution=96, check_views=1), quiet)
    mesh = read_ply(tmp_path / "asset" / "mesh.ply")
    distance = np.abs(demo.signed_distance(mesh.vertices))
    half = model.world_from_model[0, 0]
    voxel, pixel = 2 * half / 96, 2 * half / 64
    assert np.median(distance) < pixel, "pictures of 64 pixels across know the surface no better"
    low, high = demo.AABB
    assert (mesh.vertices.min(axis=0) > low - 3 * voxel).all()
    assert (mesh.vertices.max(axis=0) < high + 3 * voxel).all()
    colours = mesh.colours[:, :3].astype(int)
    assert colours.std(axis=0).min() > 10, "a colourful scene has colourful vertices"


def test_an_empty_model_is_refused_and_leaves_nothing(model: Model, tmp_path: Path) -> None:
    empty = Trainer(demo.demo_scene(size=16, n_train=4, n_test=1), TrainConfig(device="cpu", steps=1))
    with torch.no_grad():
        empty.field.density.out.bias.fill_(-30)
    hollow = Model(empty.field, empty.sampler, np.eye(4), model.cameras, True, {}, {})
    with pytest.raises(TrainingError, match="empty or a thin fog"):
        bake(hollow, tmp_path / "asset", BakeConfig(), quiet)
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_exists_is_kept(model: Model, tmp_path: Path) -> None:
    (tmp_path / "asset").mkdir()
    with pytest.raises(OutputError, match="--force"):
        bake(model, tmp_path / "asset", BakeConfig(), quiet)


def test_a_low_floor_stores_more(model: Model) -> None:
    def count(floor: float) -> int:
        return int(visible_cells(model, 64, floor, lambda done, of: None).sum())

    assert count(0.001) > count(0.01) > count(0.2) > 0


def test_the_grid_is_as_fine_as_the_pictures_and_never_finer_than_the_field(
    model: Model, tmp_path: Path
) -> None:
    cell_of_a_pixel = 2 * 1.25 / float(np.median(pixel_footprints(model)))
    assert 40 < cell_of_a_pixel < 96
    bake(model, tmp_path / "a", BakeConfig(mesh_resolution=16, refine_steps=0, check_views=1), quiet)
    assert Asset.open(tmp_path / "a").manifest.resolution == round(cell_of_a_pixel)
    finest = BakeConfig(resolution=500, mesh_resolution=16, refine_steps=0, check_views=1)
    bake(model, tmp_path / "b", finest, quiet)
    assert Asset.open(tmp_path / "b").manifest.resolution == 96
