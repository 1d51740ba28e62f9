"""Asset and camera to picture: blocks of pixels marched and shaded by a few threads.

Each task takes some hundred 8 x 8 blocks of pixels, marches their rays and runs the head on those that hit,
so that march and head of different tasks overlap. The result depends neither on the number of threads nor
on the size of a task.
"""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from types import ModuleType
from typing import Literal

import numpy as np

from player.asset import Asset
from player.bounds import BLOCK, block_bounds
from player.cameras import Camera
from player.errors import ConfigError, MissingExtraError
from player.head import Head
from player.march import MarchResult
from player.normals import composited_normals

Background = Literal["transparent"] | tuple[float, float, float]
March = Literal["auto", "numpy", "numba"]

MAX_PIXELS = 1 << 26
"""Largest picture, 8192 x 8192: a frame takes 24 bytes a pixel."""

TASK_BLOCKS = {"numba": 96, "numpy": 128}
"""Blocks a task: enough rays for the head's chunks and, in numpy, for its calls; few enough to share out
evenly."""


@dataclass(frozen=True, eq=False)
class Frame:
    """One rendered picture."""

    rgb: np.ndarray
    """[h, w, 3] float32, over the background; straight (not multiplied by opacity) if there is none."""
    opacity: np.ndarray
    """[h, w] float32, 0..1."""
    depth: np.ndarray
    """[h, w] float32, mean distance along the ray, WORLD units; 0 where nothing was met."""
    n_samples: np.ndarray
    """[h, w] int32, density samples taken."""
    background: Background
    """What is behind, or "transparent"."""
    features: np.ndarray | None = None
    """[h, w, n_channels] float32, what the head was given (in units of the codes), 0 where it was not run;
    None unless asked for with `layers`."""
    normals: np.ndarray | None = None
    """[h, w, 3] float32, WORLD frame, of unit length or 0 (`player.normals`); None unless asked for with
    `layers`."""

    def to_uint8(self) -> np.ndarray:
        """[h, w, 3], or [h, w, 4] with straight alpha if transparent; values rounded to the nearest level."""
        if self.background == "transparent":
            return _to_bytes(np.concatenate([self.rgb, self.opacity[..., None]], axis=-1))
        return _to_bytes(self.rgb)


def _to_bytes(values: np.ndarray) -> np.ndarray:
    return np.floor(np.clip(values, 0, 1) * np.float32(255) + np.float32(0.5)).astype(np.uint8)


def default_threads() -> int:
    """Cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


class Renderer:
    """An asset ready to render: grid in memory, head open, threads waiting. A context manager; `close` ends
    the threads."""

    def __init__(self, asset: Asset, n_threads: int | None = None, march: March = "auto") -> None:
        """Raises MissingExtraError if `march` is "numba" and numba is not installed."""
        self.n_threads = default_threads() if n_threads is None else n_threads
        if self.n_threads < 1:
            raise ConfigError(f"threads: expected at least 1, got {n_threads}")
        self.march, self._module = choose_march(march)
        self.asset = asset
        self._grid = asset.grid
        self._head = Head(asset.path("head.onnx"), asset.manifest.n_channels)
        self._model_from_world = np.linalg.inv(asset.world_from_model)
        self._pool = ThreadPoolExecutor(self.n_threads, thread_name_prefix="vfr-play")

    def __enter__(self) -> Renderer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End the threads; tasks that have not begun are dropped."""
        self._pool.shutdown(wait=True, cancel_futures=True)

    def render(
        self,
        camera: Camera,
        n_samples: int | None = None,
        background: Background | None = None,
        layers: bool = False,
    ) -> Frame:
        """One picture.

        Args:
            camera: in the WORLD frame.
            n_samples: feature fetches a ray; the asset's own if None, every sample if 0.
            background: colour 0..1 or "transparent"; the asset's own if None.
            layers: fill in the frame's `features` and `normals` too, at the cost of a second march; the
                picture is the same.

        Raises:
            ConfigError: a picture over MAX_PIXELS, or n_samples out of range.
        """
        k = self.asset.manifest.n_samples if n_samples is None else n_samples
        if k < 0:
            raise ConfigError(f"samples: expected 0 (all) or more, got {k}")
        check_size(camera.width, camera.height)
        if background is None:
            red, green, blue = self.asset.manifest.background
            background = (red, green, blue)
        n_pixels = camera.width * camera.height
        behind = (0.0, 0.0, 0.0) if background == "transparent" else background
        rgb = np.empty((n_pixels, 3), np.float32)
        rgb[:] = behind
        opacity, depth = np.zeros(n_pixels, np.float32), np.zeros(n_pixels, np.float32)
        counts = np.zeros(n_pixels, np.int32)
        features = np.zeros((n_pixels, self.asset.manifest.n_channels), np.float32) if layers else None
        normals = np.zeros((n_pixels, 3), np.float32) if layers else None
        frame = Frame(rgb, opacity, depth, counts, background, features, normals)
        model_camera = camera.transformed(self._model_from_world)
        near, far = block_bounds(self._grid, model_camera)
        blocks = np.flatnonzero(far >= near)
        size = TASK_BLOCKS[self.march]
        futures = [
            self._pool.submit(self._task, frame, model_camera, blocks[i : i + size], near, far, k)
            for i in range(0, len(blocks), size)
        ]
        try:
            for future in futures:
                future.result()
        finally:
            for future in futures:
                future.cancel()
        shape = (camera.height, camera.width)
        return Frame(
            rgb.reshape(*shape, 3),
            opacity.reshape(shape),
            depth.reshape(shape),
            counts.reshape(shape),
            background,
            None if features is None else features.reshape(*shape, -1),
            None if normals is None else normals.reshape(*shape, 3),
        )

    def _task(
        self, frame: Frame, camera: Camera, blocks: np.ndarray, near: np.ndarray, far: np.ndarray, k: int
    ) -> None:
        """March and shade the pixels of some blocks, into the flat arrays of `frame`."""
        columns, rows, owner = _pixels(camera, blocks, near.shape[1])
        rays_o, rays_d = _rays(camera, columns, rows)
        bounds = (near.reshape(-1)[owner], far.reshape(-1)[owner])
        result: MarchResult = self._module.march(self._grid, rays_o, rays_d, k, bounds)
        index = rows * camera.width + columns
        frame.opacity[index] = result.opacity
        frame.depth[index] = result.depth * np.float32(self.asset.scale)
        frame.n_samples[index] = result.n_samples
        if frame.features is not None:
            frame.features[index[result.hits]] = result.features
        if frame.normals is not None:
            rotation = self.asset.world_from_model[:3, :3] / self.asset.scale
            frame.normals[index] = composited_normals(self._grid, rays_o, rays_d, bounds) @ rotation.T
        rgb = self._head(result.features, rays_d[result.hits])
        if frame.background == "transparent":
            frame.rgb[index[result.hits]] = rgb
            return
        behind = np.asarray(frame.background, np.float32)
        colours = (1 - result.opacity)[:, None] * behind
        colours[result.hits] += rgb * result.opacity[result.hits][:, None]
        frame.rgb[index] = colours


def _pixels(camera: Camera, blocks: np.ndarray, per_row: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Columns, rows and block of the pixels in some blocks, block after block; what sticks out is left
    away."""
    within = np.arange(BLOCK)
    top, left = np.divmod(blocks, per_row)
    shape = (len(blocks), BLOCK, BLOCK)
    rows = np.broadcast_to((top[:, None] * BLOCK + within)[:, :, None], shape).reshape(-1)
    columns = np.broadcast_to((left[:, None] * BLOCK + within)[:, None, :], shape).reshape(-1)
    owner = np.repeat(blocks, BLOCK * BLOCK)
    inside = (rows < camera.height) & (columns < camera.width)
    if inside.all():
        return columns, rows, owner
    return columns[inside], rows[inside], owner[inside]


def _rays(camera: Camera, columns: np.ndarray, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rays through pixel centres, as `Camera.rays` defines them, for pixels in any order."""
    x = (columns + (0.5 - camera.cx)) / camera.fx
    y = (rows + (0.5 - camera.cy)) / -camera.fy
    rotation = camera.c2w[:3, :3]
    rays = np.empty((3, len(x)))
    for axis in range(3):
        rays[axis] = x * rotation[axis, 0] + y * rotation[axis, 1] - rotation[axis, 2]
    rays /= np.sqrt(rays[0] * rays[0] + rays[1] * rays[1] + rays[2] * rays[2])
    rays_d = np.ascontiguousarray(rays.T, np.float32)
    return np.broadcast_to(camera.c2w[:3, 3].astype(np.float32), rays_d.shape), rays_d


def check_size(width: int, height: int) -> None:
    """Raise ConfigError for a picture over MAX_PIXELS."""
    if width * height > MAX_PIXELS:
        raise ConfigError(f"size: expected at most {MAX_PIXELS} pixels (8192x8192), got {width}x{height}")


def choose_march(name: March) -> tuple[str, ModuleType]:
    if name != "numpy":
        from player import march_compiled

        if march_compiled.available():
            return "numba", march_compiled
        if name == "numba":
            raise MissingExtraError(
                "march: expected numba, which is not installed: pip install 'vfr-bake[fast]'"
            )
    from player import march

    return "numpy", march


@lru_cache(maxsize=2)
def _renderer(asset: Asset, n_threads: int | None, march: March) -> Renderer:
    return Renderer(asset, n_threads, march)


def render(
    asset: Asset,
    camera: Camera,
    n_samples: int | None = None,
    background: Background | None = None,
    n_threads: int | None = None,
    march: March = "auto",
) -> Frame:
    """One picture of an asset; keeps its threads and head for the next call. Arguments as in `Renderer`."""
    return _renderer(asset, n_threads, march).render(camera, n_samples, background)
