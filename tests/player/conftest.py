"""A small analytic asset: two spherical shells, features that are linear in the position."""

from __future__ import annotations

import json
import math
import shutil
from pathlib import Path

import numpy as np
import pytest
from scipy import ndimage

from exporters.head.onnx_head import HeadWeights, head_onnx
from player.asset.asset import Asset, write_asset
from player.asset.bricks import pack_vertices
from player.asset.density import encode_density
from player.asset.manifest import Manifest
from tests.player.march.oracle_march import Scene
from tests.vertex_grids import arrays_of

RESOLUTION = 64
DENSITY_RANGE = (-2.0, 6.0)
STEP = 0.9 * 2 / RESOLUTION
WORLD_FROM_MODEL = [[0.0, -2.0, 0.0, 1.0], [2.0, 0.0, 0.0, 2.0], [0.0, 0.0, 2.0, 3.0], [0.0, 0.0, 0.0, 1.0]]


def head_arrays(n_channels: int = 4) -> tuple[np.ndarray, np.ndarray]:
    """Return W [n_channels, 3] and V [3, 3] of `head_bytes`."""
    random = np.random.default_rng(0)
    w, v = random.normal(0, 0.02, (n_channels, 3)), random.normal(0, 0.5, (3, 3))
    return w.astype(np.float32), v.astype(np.float32)


def linear_head(w: np.ndarray, v: np.ndarray, b: np.ndarray) -> HeadWeights:
    """Return a head of rgb = sigmoid(features W + dirs V + b), by gelu(x) - gelu(-x) = x.

    W [n_channels, 3], V [3, 3], b [3].
    """
    both, apart = np.concatenate([np.eye(3), -np.eye(3)], axis=1), np.concatenate([np.eye(3), -np.eye(3)])
    # bands 0 and 1 of the spherical harmonics: a constant, -y, z, -x times sqrt(3 / 4 pi)
    of_basis = np.array([np.zeros(3), -v[1], v[2], -v[0]]) / np.sqrt(3 / (4 * np.pi))
    return HeadWeights(
        spatial=((w.astype(np.float64) @ both, b @ both),),
        to_sh=(np.zeros((6, 4)), np.ones(4)),
        directional_first=(apart @ both, of_basis @ both, np.zeros(6)),
        directional=(),
        output=(apart, np.zeros(3)),
        sh_degree=2,
        n_sh_features=1,
    )


def head_bytes(n_channels: int = 4) -> bytes:
    """Return the file of a head of rgb = sigmoid(features W + dirs V), with W and V of `head_arrays`."""
    return head_onnx(linear_head(*head_arrays(n_channels), np.zeros(3)))


def look_at(eye: tuple[float, float, float], target: tuple[float, float, float]) -> np.ndarray:
    back = np.subtract(eye, target) / np.linalg.norm(np.subtract(eye, target))
    right = np.cross([0, 0, 1.0], back)
    right /= np.linalg.norm(right)
    c2w = np.eye(4)
    c2w[:3, :4] = np.stack([right, np.cross(back, right), back, np.array(eye)], axis=-1)
    return c2w


def cameras_bytes(n: int = 5) -> bytes:
    frames = []
    for i in range(n):
        angle = 2 * math.pi * i / n
        eye = (1 + 6 * math.cos(angle), 2 + 6 * math.sin(angle), 5.0)
        frames.append({"file_path": f"./test/r_{i}", "transform_matrix": look_at(eye, (1, 2, 3)).tolist()})
    return json.dumps({"w": 48, "h": 40, "camera_angle_x": 1.0, "frames": frames}).encode()


def shells() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the stored vertices in the order on disk, their density codes and features."""
    axis = np.arange(RESOLUTION + 1)
    vertices = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    radius = np.linalg.norm(vertices / RESOLUTION * 2 - 1, axis=-1)
    inner, outer = np.abs(radius - 0.5) * RESOLUTION / 2, np.abs(radius - 0.99) * RESOLUTION / 2
    near = np.minimum(inner, outer)
    dense = (near < 2.7).reshape((RESOLUTION + 1,) * 3)
    stored = ndimage.binary_opening(dense, np.ones((2, 2, 2))).reshape(-1)  # corners of whole cells
    vertices, near = vertices[stored], near[stored]
    _, _, order = pack_vertices(vertices)
    vertices, near = vertices[order], near[order]
    codes = encode_density(3.0 - 1.3 * near, DENSITY_RANGE)
    features = np.concatenate([vertices * 3 - 96, np.full((len(vertices), 1), 50)], axis=-1).astype(np.int8)
    return vertices, codes, features


@pytest.fixture(scope="session")
def scene() -> Scene:
    vertices, codes, features = shells()
    keys = [tuple(v) for v in vertices.tolist()]
    box = np.array([[-1.0] * 3, [1.0] * 3])
    by_key = dict(zip(keys, codes.tolist(), strict=True)), dict(zip(keys, features, strict=True))
    return Scene(RESOLUTION, box, STEP, DENSITY_RANGE, *by_key)


def write_shells(folder: Path, sign: int = 1) -> Path:
    """Write the asset, with its features times `sign`; return its folder."""
    vertices, codes, features = shells()
    features = (sign * features).astype(np.int8)
    coords, masks, _ = pack_vertices(vertices)
    manifest = Manifest(
        generator="tests",
        resolution=RESOLUTION,
        feature_resolution=RESOLUTION,
        step=STEP,
        density_range=DENSITY_RANGE,
        n_channels=4,
        view_size=(48, 40),
        world_from_model=tuple(map(tuple, WORLD_FROM_MODEL)),
        provenance={"psnr": 30.5},
    )
    arrays = arrays_of((coords, masks, codes), (coords, masks, features), (RESOLUTION, RESOLUTION))
    write_asset(folder, manifest, arrays, head_bytes(), b"ply\n", cameras_bytes())
    return folder


@pytest.fixture(scope="session")
def asset(shells_folder: Path) -> Asset:
    return Asset.open(shells_folder, verify=True)


@pytest.fixture
def broken_folder(shells_folder: Path, tmp_path: Path) -> Path:
    """Return a copy of the asset that the test may break."""
    return Path(shutil.copytree(shells_folder, tmp_path / "broken"))
