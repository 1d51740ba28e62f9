"""The bake, step by step: what is seen, what of it is stored, the head, the mesh, and a check from the
written files."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from exporters.int8_head import activation_ranges
from exporters.onnx_head import head_onnx
from exporters.ply import ply_bytes
from player.asset import Asset, GridArrays, write_asset
from player.bricks import pack_vertices
from player.cameras import Camera
from player.density import encode_density
from player.errors import ConfigError
from player.files import check_target
from player.manifest import Manifest
from player.render import render
from player.sparse_grid import SparseGrid, build_grid
from player.transforms import write_cameras
from vfr_bake import __version__
from vfr_bake.baking.head_weights import fold_head
from vfr_bake.baking.mesh import bake_mesh
from vfr_bake.baking.projection import Projection, code_scales, encode_features, project
from vfr_bake.baking.refinement import collect_lessons, refine
from vfr_bake.baking.visibility import corner_vertices, pixel_footprints, visible_cells
from vfr_bake.config import BakeConfig
from vfr_bake.rendering.render import render_image
from vfr_bake.training.metrics import psnr, to_8_bit
from vfr_bake.training.model_file import Model

Report = Callable[[str, int, int], object]
"""Called with (stage, done, of)."""
CELLS_PER_PIXEL = 1.25
"""Finer cells store what no picture has shown; on lego 400x400 this is 448 cells, and 512 plays no nearer to
the photographs."""
N_RENDERED = 200_000
"""Rays whose rendered features decide the projection."""
N_CALIBRATION = 20_000
"""Rays that decide the ranges of the head's activations."""
VERTEX_CHUNK = 1 << 18
"""Vertices evaluated at once: 32 MB of features."""
FAINTEST, DENSEST = 1e-5, 20.0
"""Optical depths of one march step at codes 0 and 255: from invisible to opaque, in steps of 5.9 %."""


@dataclass(frozen=True)
class BakeResult:
    """What was written and what it cost."""

    n_vertices: int
    n_bytes: int
    seconds: float
    figures: dict[str, Any]


def bake(model: Model, folder: Path, config: BakeConfig, report: Report, force: bool = False) -> BakeResult:
    """Bake `model` into the asset `folder`. Raises OutputError, TrainingError (nothing visible)."""
    check_target(folder, force)
    _check_bakeable(model)
    begin = time.monotonic()
    resolution = config.resolution or round(2 * CELLS_PER_PIXEL / float(np.median(pixel_footprints(model))))
    resolution = int(np.clip(resolution, 8, model.field.config.max_resolution))
    visible = visible_cells(model, resolution, config.weight_floor, _stage(report, "visibility"))
    rendered = _rendered_features(model)
    projection = project(model.field.head.first_weights(), rendered, config.n_channels)
    arrays, scales, density_range = _grid_arrays(model, visible, projection, _stage(report, "grid"))
    step = float(model.occupancy.step)
    grid = build_grid(
        (arrays.brick_coords, arrays.brick_masks, arrays.density, arrays.features),
        resolution, np.array([[-1.0] * 3, [1.0] * 3]), step, density_range,
    )  # fmt: skip
    head = _head(model, projection, scales, grid, config, report)
    mesh, n_floaters = bake_mesh(model, visible, config.mesh_resolution or resolution, _stage(report, "mesh"))
    figures = {
        "n_vertices": len(arrays.density),
        "visible_cells": int(visible.sum()),
        "first_layer_kept": projection.kept,
        "mesh_faces": len(mesh.faces),
        "mesh_floaters_removed": n_floaters,
    }
    camera = model.cameras[0]
    manifest = Manifest(
        generator=f"vfr-bake {__version__}",
        resolution=resolution,
        step=step,
        density_range=density_range,
        n_channels=arrays.features.shape[1],
        view_size=(camera.width, camera.height),
        world_from_model=tuple(tuple(row) for row in model.world_from_model.tolist()),
        n_samples=config.n_samples,
        background=tuple(model.background.tolist()),
        provenance={"bake": asdict(config), "train": model.train, "trained": model.figures, "baked": figures},
    )
    write_asset(folder, manifest, arrays, head, ply_bytes(mesh), write_cameras(model.cameras), force)
    figures = figures | check_asset(model, folder, config.check_views, _stage(report, "check"))
    n_bytes = sum(path.stat().st_size for path in folder.iterdir())
    return BakeResult(len(arrays.density), n_bytes, time.monotonic() - begin, figures)


def _check_bakeable(model: Model) -> None:
    """Raises ConfigError for a field that an asset cannot hold."""
    _ = model.occupancy  # says so if the scene is unbounded
    config = model.field.config
    for name, needed in (("compositing", "features"), ("activation", "gelu")):
        if getattr(config, name) != needed:
            raise ConfigError(f"model: {name}: expected {needed} to bake, got {getattr(config, name)}")


def _head(
    model: Model,
    projection: Projection,
    scales: np.ndarray,
    grid: SparseGrid,
    config: BakeConfig,
    report: Report,
) -> bytes:
    """The folded head, adapted to what the player will give it, as ONNX."""
    lessons = collect_lessons(model, grid, config.n_samples)
    folded = fold_head(model.field.head, projection.first * scales)
    folded = refine(folded, lessons, config.refine_steps, _stage(report, "refinement"))
    if config.head_bits == 32:
        return head_onnx(folded)
    some = slice(N_CALIBRATION)
    return head_onnx(folded, activation_ranges(folded, lessons.codes[some], lessons.dirs[some]))


def _stage(report: Report, name: str) -> Callable[[int, int], object]:
    return lambda done, of: report(name, done, of)


def _rendered_features(model: Model) -> np.ndarray:
    """Rendered features of rays spread over all training views, those that hit something."""
    cameras = model.model_cameras()
    random = np.random.default_rng(0)
    per_view = max(1, N_RENDERED // len(cameras))
    found = []
    for camera in cameras:
        rays_o, rays_d = camera.rays()
        rows = random.choice(len(rays_o), min(per_view, len(rays_o)), replace=False)
        features, opacity, _ = model.occupancy.composited_features(model.field, rays_o[rows], rays_d[rows])
        found.append(features[opacity > 0])
    return np.concatenate(found)


def _grid_arrays(
    model: Model, visible: np.ndarray, projection: Projection, progress: Callable[[int, int], object]
) -> tuple[GridArrays, np.ndarray, tuple[float, float]]:
    """Codes at the corners of the visible cells, the scale of each channel's code, and the range of the
    density's."""
    resolution = len(visible)
    vertices = corner_vertices(visible)
    brick_coords, brick_masks, order = pack_vertices(vertices)
    vertices = vertices[order]
    features = np.empty((len(vertices), len(projection.matrix)), np.float32)
    log_sigmas = np.empty(len(vertices), np.float32)
    matrix = projection.matrix.T.astype(np.float32)
    for start in range(0, len(vertices), VERTEX_CHUNK):
        rows = slice(start, start + VERTEX_CHUNK)
        points = (vertices[rows] / resolution).astype(np.float32)
        features[rows] = model.field.features(points) @ matrix
        log_sigmas[rows] = model.field.log_densities(points)
        progress(min(start + VERTEX_CHUNK, len(vertices)), len(vertices))
    scales = code_scales(features)
    step = model.occupancy.step
    density_range = (float(np.log(FAINTEST / step)), float(np.log(DENSEST / step)))
    arrays = GridArrays(
        brick_coords=brick_coords,
        brick_masks=brick_masks,
        density=encode_density(log_sigmas, density_range),
        features=encode_features(features, scales),
    )
    return arrays, scales, density_range


def check_asset(
    model: Model, folder: Path, n_views: int, progress: Callable[[int, int], object]
) -> dict[str, Any]:
    """Training views played from the written files against the full model's pictures: PSNR between the two,
    mean."""
    asset = Asset.open(folder, verify=True)
    chosen = np.unique(np.linspace(0, len(model.cameras) - 1, n_views).round().astype(int))
    in_model = model.model_cameras()
    agreement = []
    for done, index in enumerate(chosen):
        camera: Camera = model.cameras[index]
        played = render(asset, camera, background=tuple(model.background.tolist()))
        full = render_image(model.field, model.occupancy, in_model[index], model.background)
        agreement.append(psnr(to_8_bit(played.rgb) / 255, to_8_bit(full) / 255))
        progress(done + 1, len(chosen))
    return {"psnr_to_full_model": float(np.mean(agreement))}
