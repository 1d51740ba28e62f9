"""Small assets for the page to draw, each with some peculiarity, and cameras around them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from exporters.head.onnx_head import head_onnx
from exporters.head.ranges import activation_ranges
from player.asset.asset import Asset, GridArrays, write_asset
from player.asset.bricks import pack_vertices
from player.asset.manifest import Manifest
from player.asset.pyramid import Bricks, Pyramid, PyramidValues
from player.asset.single_level import VertexBricks, from_vertices
from player.cameras.camera import Camera
from player.head.graph import Activation
from tests.exporters.head.test_onnx_head import inputs, random_head
from tests.player.conftest import cameras_bytes, head_bytes, look_at, write_shells
from tests.player.head.heads import head_onnx_with_floats
from tests.player.march.pyramid_scene import filled, random_scene, sparse_scene

WIDTH, HEIGHT = 60, 44


def head_of(n_channels: int, in_8_bits: bool, activation: Activation = "gelu") -> bytes:
    """Return a head of random weights whose widths are no multiples of four. In 8 bits and with GELU it is
    written as it was when encoded features were not rounded."""
    weights = random_head(n_channels, 18, n_sh_features=3, activation=activation)
    (first, bias), *more = weights.spatial
    weights = replace(weights, spatial=((first / np.float32(40), bias), *more))  # for codes up to 127
    features, dirs = inputs(500, n_channels)
    ranges = activation_ranges(weights, features * 40, dirs) if in_8_bits else None
    if ranges and activation == "gelu":
        return head_onnx_with_floats(weights, ranges)
    return head_onnx(weights, ranges)


def wider(values: PyramidValues, n_channels: int) -> PyramidValues:
    """Return the same pyramid with `n_channels` channels, mixed from its own."""
    mixed = np.random.default_rng(n_channels).normal(0, 0.5, (values.n_channels, n_channels))
    return filled(values.pyramid, [some @ mixed for some in values.values], (-127, 127), np.int8)


def write(folder: Path, manifest: Manifest, arrays: GridArrays, head: bytes) -> Asset:
    write_asset(folder, manifest, arrays, head, b"ply\n", cameras_bytes())
    return Asset.open(folder)


def shells(folder: Path) -> Asset:
    """Write an asset of two spherical shells whose world is not the model's frame."""
    return Asset.open(write_shells(folder))


def pyramid_asset(
    folder: Path, level_steps: tuple[int, ...], contracted: bool, n_channels: int, sparse: bool = False
) -> Asset:
    """Write an asset of random pyramids of as many levels as `level_steps` has, with a head of random weights
    in 8 bits. Its activation is the hard swish if the pyramids are `sparse`."""
    if sparse:
        scene = sparse_scene(level_steps, 3, contracted)
    else:
        scene = random_scene(70, 45, level_steps, 2, contracted)
    edge = 2.0 if contracted else 1.0
    n_levels = len(level_steps)
    manifest = Manifest(
        generator="tests", resolution=scene.densities.pyramid.resolution,
        feature_resolution=scene.features.pyramid.resolution, step=scene.step, level_steps=level_steps,
        density_range=scene.density_range, density_steps=(1,) * n_levels, feature_steps=(1,) * n_levels,
        n_channels=n_channels, aabb=((-edge,) * 3, (edge,) * 3), contracted=contracted,
        near=0.05 if contracted else 0.0, view_size=(48, 40), n_fetches=4, background=(0.2, 0.5, 0.9),
    )  # fmt: skip
    features = scene.features if n_channels == 3 else wider(scene.features, n_channels)
    head = head_of(n_channels, True, "hard_swish" if sparse else "gelu")
    return write(folder, manifest, GridArrays(scene.densities, features), head)


def dense(resolution: int, n_channels: int, top: int, kind: type[np.generic], seed: int) -> PyramidValues:
    """Return noise on every vertex of one level."""
    coords, masks, order = pack_vertices(np.argwhere(np.ones((resolution + 1,) * 3, bool)))
    random = np.random.default_rng(seed)
    values = random.uniform(0 if kind == np.uint8 else -top, top, (len(order), n_channels)).astype(kind)
    return from_vertices(VertexBricks(coords, masks, values if kind == np.int8 else values[:, 0]), resolution)


def fog(folder: Path, thickness: float = 2.0, activation: Activation = "gelu") -> Asset:
    """Write an asset of a box full of fog: hundreds of thin samples on a ray, or a few in a flat box."""
    box = ((-1.0, -1.0, -thickness / 2), (1.0, 1.0, thickness / 2))
    low = -3.0 - 2 * np.log(thickness / 2)
    manifest = Manifest(
        generator="tests", resolution=24, feature_resolution=15, step=0.004, density_range=(low, low + 4.0),
        n_channels=8, view_size=(48, 40), aabb=box, n_fetches=5,
    )  # fmt: skip
    features = dense(15, 8, 120, np.int8, 1)
    arrays = GridArrays(dense(24, 1, 255, np.uint8, 0), features)
    return write(folder, manifest, arrays, head_of(8, False, activation))


def empty(folder: Path, n_channels: int = 4) -> Asset:
    """Write an asset without density anywhere."""
    none = Bricks(np.zeros((0, 3), np.uint16), np.zeros((0, 8), np.uint64))
    densities = PyramidValues(Pyramid(24, (none,)), (np.zeros((0, 1), np.uint8),))
    manifest = Manifest(
        generator="tests", resolution=24, feature_resolution=8, step=0.05, density_range=(-3.0, 1.0),
        n_channels=n_channels, view_size=(48, 40),
    )  # fmt: skip
    features = dense(8, n_channels, 120, np.int8, 1)
    return write(folder, manifest, GridArrays(densities, features), head_bytes(n_channels))


def camera(name: str, c2w: np.ndarray, focal: float = 55.0, cx: float | None = None) -> Camera:
    return Camera(name, c2w, WIDTH, HEIGHT, focal, focal, WIDTH / 2 if cx is None else cx, HEIGHT / 2)


def cameras(asset: Asset) -> dict[str, Camera]:
    """Return world cameras outside, inside, far from, exactly along an axis, and on the wall of the model's
    box."""
    low, high = np.array(asset.manifest.aabb)
    middle, size = (low + high) / 2, float(np.max(high - low))
    along = np.eye(4)
    along[:3, 3] = middle + np.array([0, 0, 1.5 * size])
    away = 100.0 if asset.manifest.contracted else 374.0  # as far as float32 directions are useful
    far = look_at(tuple(middle + size * away * np.array([0.8, 0.5, 0.3])), tuple(middle))
    found = {
        "outside": camera(
            "outside", look_at(tuple(middle + size * np.array([0.9, -0.7, 0.6])), tuple(middle))
        ),
        "inside": camera(
            "inside", look_at(tuple(middle + size * np.array([0.05, 0.02, 0.01])), tuple(low)), 30.0
        ),
        "far": camera("far", far, away * 45.0),
        "axis": camera("axis", along, 60.0, WIDTH / 2 + 0.5),
        "wall": camera("wall", look_at((middle[0], low[1], middle[2]), tuple(middle)), 50.0),
    }
    turn = asset.world_from_model / np.array([asset.scale] * 3 + [1.0])
    for name, some in found.items():
        c2w = turn @ some.c2w
        c2w[:3, 3] = asset.world_from_model[:3, :3] @ some.c2w[:3, 3] + asset.world_from_model[:3, 3]
        found[name] = replace(some, c2w=c2w)
    return found
