"""An asset of a block of known place, size and colours, as a volume and as a mesh, to open in other programs.

The colour is the sigmoid of a linear function of the place alone, so that both have the same colours.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from exporters.formats.ply import ply_bytes
from exporters.head.onnx_head import head_onnx
from exporters.shapes.mesh import TriangleMesh
from player.asset.asset import write_asset
from player.asset.bricks import pack_vertices
from player.asset.density import encode_density
from player.asset.manifest import Manifest
from player.cameras.camera import Camera
from player.cameras.transforms import write_cameras
from tests.exporters.meshes import box
from tests.player.conftest import WORLD_FROM_MODEL, linear_head, look_at
from tests.vertex_grids import arrays_of

RESOLUTION = 64
LOW, HIGH = np.array([20, 16, 24]), np.array([36, 40, 56])
"""Grid indices of the block's corners; vertices are 1/32 model unit, or 1/16 world unit, apart."""
BOUNDS = np.array([[0.5, 1.25, 2.5], [2.0, 2.25, 4.5]])
"""The same corners in the world, by hand: x = 1 - 2 v, y = 2 + 2 u, z = 3 + 2 w with u = i / 32 - 1."""
SIGMA = 20.0
"""Density in 1/world unit: an optical depth of 1.25 per voxel, so the block, 16 voxels thick, is opaque."""
_WEIGHTS = np.array([[0.03, 0.0, -0.02], [0.0, 0.025, 0.01], [-0.02, 0.01, 0.03]])
_BIAS = np.array([0.2, -0.3, 0.4])


def colours(index: np.ndarray) -> np.ndarray:
    """Return the colours [n, 3], sRGB 0..1, at vertices [n, 3]."""
    codes = index * 2.0 - 64
    return 1 / (1 + np.exp(-(codes @ _WEIGHTS + _BIAS)))


def write_block(folder: Path) -> Path:
    axes = [np.arange(low, high + 1) for low, high in zip(LOW, HIGH, strict=True)]
    vertices = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    coords, masks, order = pack_vertices(vertices)
    vertices = vertices[order]
    density_range = (-2.0, 6.0)
    codes = encode_density(np.full(len(vertices), np.log(SIGMA * 2)), density_range)
    manifest = Manifest(
        generator="tests",
        resolution=RESOLUTION,
        feature_resolution=RESOLUTION,
        step=1 / RESOLUTION,
        density_range=density_range,
        n_channels=3,
        n_fetches=0,
        view_size=(160, 128),
        world_from_model=tuple(map(tuple, WORLD_FROM_MODEL)),
    )
    features = (vertices * 2 - 64).astype(np.int8)
    arrays = arrays_of((coords, masks, codes), (coords, masks, features), (RESOLUTION, RESOLUTION))
    head = head_onnx(linear_head(_WEIGHTS, np.zeros((3, 3)), _BIAS))  # the direction does not matter
    write_asset(folder, manifest, arrays, head, ply_bytes(_mesh()), write_cameras(cameras()))
    return folder


def cameras() -> list[Camera]:
    """Return cameras around, above and below the block, with principal points beside the picture's middle."""
    middle = BOUNDS.mean(axis=0)
    eyes = [middle + offset for offset in ([5.0, 2.0, 2.0], [-3.0, 4.0, -1.5], [1.0, -5.0, 3.0])]
    return [
        Camera(f"view_{k}", look_at(tuple(eye), tuple(middle)), 160, 128, 220.0, 220.0, 90.0, 58.0)
        for k, eye in enumerate(eyes)
    ]


def _mesh() -> TriangleMesh:
    """Return the block's faces, cut so finely that colours interpolated between vertices are close."""
    coarse = box(tuple(LOW.tolist()), tuple(HIGH.tolist()))
    corners, n = coarse.vertices[coarse.faces], 16
    i, j = np.array([(i, j) for i in range(n + 1) for j in range(n + 1 - i)]).T
    number = {pair: k for k, pair in enumerate(zip(i.tolist(), j.tolist(), strict=True))}
    small = [(number[a, b], number[a + 1, b], number[a, b + 1]) for a, b in number if a + b < n]
    small += [(number[a + 1, b], number[a + 1, b + 1], number[a, b + 1]) for a, b in number if a + b < n - 1]
    shares = np.stack([n - i - j, i, j], axis=-1) / n
    index = (shares @ corners).reshape(-1, 3)
    faces = (np.array(small)[None] + np.arange(len(corners))[:, None, None] * len(i)).reshape(-1, 3)
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    normals = np.cross(b - a, c - a)
    normals = np.repeat(normals / np.linalg.norm(normals, axis=-1, keepdims=True), len(i), axis=0)
    rgba = np.concatenate([np.rint(colours(index) * 255), np.full((len(index), 1), 255)], axis=1)
    mesh = TriangleMesh(index / 32 - 1, faces.astype(np.int32), normals, rgba.astype(np.uint8))
    return mesh.transformed(np.array(WORLD_FROM_MODEL))
