"""Rendering of pictures from an asset and a camera: blocks of pixels are marched and shaded by a few threads.

Each task takes up to TASK_BLOCKS blocks of 8 x 8 pixels, marches their rays, and runs the head on those that
hit something. So the march of one task and the head of another run at the same time. The result depends
neither on the number of threads nor on the size of a task.
"""

from __future__ import annotations

import math
import os
import sys
import threading
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property, lru_cache
from types import ModuleType
from typing import Any, Literal, NamedTuple, get_args

import numpy as np

from player.asset.asset import Asset
from player.cameras.camera import Camera
from player.cameras.views import asset_cameras
from player.errors import ConfigError, MissingExtraError
from player.files.images import to_8_bit
from player.files.json_files import brief
from player.head.head import Head
from player.march.bounds import block_bounds
from player.march.interpolation import OPAQUE_DEPTH, MarchStage, Quality, interpolate, stages
from player.march.march import MAX_TAU, MarchResult
from player.march.normals import composited_normals
from player.march.pixels import EVERY, Planes, write_pixels
from player.march.view import View
from player.threads import bounded_threads, default_threads

Background = Literal["transparent"] | tuple[float, float, float]
Colour = Sequence[float] | np.ndarray
"""Three numbers in 0..1: red, green, blue."""
March = Literal["auto", "numpy", "numba"]

MAX_PIXELS = 1 << 26
"""Most pixels of a picture: 8192 x 8192."""

FRAME_BYTES = 30
"""Memory of a frame in bytes per pixel: 12 for colour, 4 each for opacity, depth and samples, and 6 for its
8-bit picture and the arrays that round to it."""

TASK_BLOCKS = 256
"""Most blocks of a task. What Python does for a task takes as long as the compiled march of ten blocks. In
numpy, threads wait for each other between calls, and smaller tasks need more calls; larger ones gain little,
and take more memory."""
TASKS_A_THREAD = {"numba": 8, "numpy": 1}
"""Least number of tasks per thread, if there are enough blocks, so that the work is shared out evenly. For
numpy it is 1: a call of numpy takes as long for ten rays as for a hundred, and threads wait for one another
between calls."""
LEAST_IN_STAGES = 0.5
"""Least size, as a share of the training size, at which pixels are interpolated. In smaller pictures so few
neighbours agree that it takes longer than to march all pixels."""


@dataclass(frozen=True, eq=False)
class Frame:
    """One rendered picture."""

    rgb: np.ndarray
    """[h, w, 3] float32, over the background; straight (not multiplied by opacity) if it is transparent."""
    opacity: np.ndarray
    """[h, w] float32, 0..1."""
    depth: np.ndarray
    """[h, w] float32, mean distance along the ray, WORLD units; 0 where nothing was met."""
    n_density_samples: np.ndarray
    """[h, w] int32, density samples taken; 0 where the pixel was interpolated."""
    background: Background
    """Colour of the background, or "transparent"."""
    features: np.ndarray | None = None
    """[h, w, n_channels] float32, the input of the head (in units of the codes), 0 where it was not run; None
    unless asked for with `layers`."""
    find_normals: Callable[[], np.ndarray] | None = None
    """Function that computes `normals`; None in a frame that was copied or pickled."""

    def __getstate__(self) -> dict[str, Any]:
        """Return what is copied or pickled: normals, if they are already computed, but not the grid that they
        need otherwise."""
        return vars(self) | {"find_normals": None}

    @cached_property
    def normals(self) -> np.ndarray:
        """[h, w, 3] float32, WORLD frame, of unit length or 0 (`player.march.normals`).

        They are computed when they are first asked for, at the cost of a second march, unless the frame was
        rendered with `layers`. Raises ConfigError for a frame that was not made by a renderer, or was
        copied or pickled before they were computed.
        """
        if self.find_normals is None:
            raise ConfigError(
                "normals: expected the frame of a renderer, got one that was put together, copied or "
                "pickled without them: render with layers=True"
            )
        return self.find_normals()

    def to_uint8(self) -> np.ndarray:
        """Return 8-bit values [h, w, 3], or [h, w, 4] with straight alpha if transparent; rounded to the
        nearest level."""
        if self.background != "transparent":
            return to_8_bit(self.rgb)
        levels = np.empty((*self.opacity.shape, 4), np.uint8)
        to_8_bit(self.rgb, levels[..., :3])
        to_8_bit(self.opacity, levels[..., 3])
        return levels


class Renderer:
    """An asset that is ready to render: its grid is in memory, its head is open, and threads are waiting. A
    context manager; `close` ends the threads. A forked process may render on with it, on threads of its own.
    """

    def __init__(self, asset: Asset, n_threads: int | None = None, march: March = "auto") -> None:
        """Raises MissingExtraError if `march` is "numba" and that is not installed or does not run here;
        ConfigError if there is no such march, or `n_threads` is no whole number from 1 on."""
        self.n_threads = default_threads() if n_threads is None else bounded_threads(n_threads)
        self._grid = asset.grid  # built first: numba may still be importing (`import_ahead`)
        self.march, self._module = choose_march(march)
        self._write_pixels, self._interpolate, self._directions = write_pixels, interpolate, None
        self._block_bounds = block_bounds
        if self.march == "numba":
            from player.compiled import bounds as bounds_compiled
            from player.compiled import interpolation as interpolation_compiled
            from player.compiled import pixels as pixels_compiled

            self._write_pixels = pixels_compiled.write_pixels
            self._interpolate = interpolation_compiled.interpolate
            self._block_bounds = bounds_compiled.block_bounds
            self._directions = pixels_compiled.directions
        self.asset = asset
        self._head = Head.of(asset, self.march == "numba")
        self._model_from_world = np.linalg.inv(asset.world_from_model)
        self._pool, self._process = self._new_pool(), os.getpid()
        self._closed = False

    def __enter__(self) -> Renderer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End the threads; tasks that have not begun are dropped. Nothing can be rendered afterwards."""
        self._closed = True
        self._threads().shutdown(wait=True, cancel_futures=True)

    def _new_pool(self) -> ThreadPoolExecutor:
        return ThreadPoolExecutor(self.n_threads, thread_name_prefix="vfr-play")

    def _threads(self) -> ThreadPoolExecutor:
        """Return the threads. A forked process has none of those that the pool counts, and would wait for
        them forever: it gets a pool of its own."""
        if self._process != os.getpid():
            self._pool = self._new_pool()
            self._process = os.getpid()  # last: whichever thread of the process sees it sees the new pool
        return self._pool

    def show(self, asset: Asset) -> None:
        """Continue with `asset`, the same asset with more of its parts. Pictures that have begun, in
        whichever thread, are finished with the parts that they began with."""
        self._grid, self.asset = asset.grid, asset

    def render(
        self,
        camera: Camera,
        n_fetches: int | None = None,
        background: Background | Colour | None = None,
        layers: bool = False,
        quality: Quality = "exact",
    ) -> Frame:
        """Render one picture.

        Args:
            camera: in the WORLD frame.
            n_fetches: feature lookups per ray; the asset's own number if None; one at every sample if 0, or
                if more than a ray can have. A quality may lower the number.
            background: colour 0..1 or "transparent"; the asset's own if None.
            quality: "exact" marches every pixel; "high" and "fast" interpolate pixels between neighbours that
                agree (`player.march.interpolation`), fetch features at fewer positions and end rays earlier,
                as far as the asset's `agreement` and `quality_fetches` allow, and less so in pictures that
                are smaller than those of training.
            layers: compute the frame's `features` and `normals` at once, at the cost of a second march; the
                picture is the same.

        Raises:
            ConfigError: a picture over MAX_PIXELS, a setting out of range, or a renderer that is closed.
            FormatError, IntegrityError: the asset's cameras, which a quality other than "exact" needs, are
                damaged or not there any more.
        """
        if self._closed:
            raise ConfigError("renderer: expected an open one, got one that was closed: make another")
        check_size(camera.width, camera.height)
        background = checked_background(self.asset.manifest.background if background is None else background)
        k = fetches_used(self.asset, n_fetches, quality)
        reduced = _reduced(self.asset, quality, 1.0 if quality == "exact" else self._scale(camera))
        picture = self._blank(camera, background, k, reduced.opaque_depth, layers)
        for stage in stages(reduced.levels, picture.view.grid.contracted):
            self._in_tasks(picture, stage)
        view, planes, features = picture.view, picture.planes, picture.features
        shape = (camera.height, camera.width)
        normals = self._all_normals(view, self._threads().map) if layers else None
        frame = Frame(
            planes.rgb.reshape(*shape, 3),
            planes.opacity.reshape(shape),
            planes.depth.reshape(shape),
            planes.n_density_samples.reshape(shape),
            background,
            None if features is None else features.reshape(*shape, -1),
            lambda: self._all_normals(view),
        )
        if normals is not None:
            vars(frame)["normals"] = normals  # already known
        return frame

    @cached_property
    def _focal_length(self) -> float:
        """Focal length of the training cameras in pixels."""
        return float(np.median([camera.fx for camera in asset_cameras(self.asset)]))

    def _scale(self, camera: Camera) -> float:
        """Return the size of a picture as a share of the training size, 1 at most. An asset that the bake has
        not written yet has no cameras; pictures of it count as if they had the training size."""
        known = "cameras.json" in self.asset.manifest.files
        return min(camera.fx / self._focal_length, 1.0) if known else 1.0

    def _blank(
        self,
        camera: Camera,
        background: Background,
        n_fetches: int,
        opaque_depth: np.float32,
        layers: bool,
    ) -> _Picture:
        """Make a picture that shows the background alone."""
        n_pixels = camera.width * camera.height
        behind = None if background == "transparent" else background
        rgb = np.empty((camera.height, 3 * camera.width), np.float32)
        rgb[:] = np.tile(np.asarray(behind or (0, 0, 0), np.float32), camera.width)
        zeros = np.zeros(n_pixels, np.float32), np.zeros(n_pixels, np.float32)
        return _Picture(
            view=View.of(self._grid, camera.transformed(self._model_from_world), self._block_bounds),
            planes=Planes(rgb.reshape(-1, 3), *zeros, np.zeros(n_pixels, np.int32)),
            behind=behind,
            n_fetches=n_fetches,
            opaque_depth=opaque_depth,
            features=np.zeros((n_pixels, self.asset.manifest.n_channels), np.float32) if layers else None,
        )

    def _in_tasks(self, picture: _Picture, stage: MarchStage) -> None:
        """Compute the pixels of a stage in all blocks, on all threads."""
        tasks = self._tasks(picture.view.blocks, len(stage.within))
        pool = self._threads()
        futures = [pool.submit(self._task, picture, stage, blocks) for blocks in tasks]
        try:
            for future in futures:
                future.result()
        finally:
            for future in futures:
                future.cancel()

    def _tasks(self, blocks: np.ndarray, n_pixels: int) -> list[np.ndarray]:
        """Divide blocks into tasks; `n_pixels` pixels of each block are computed at a time."""
        size = min(
            TASK_BLOCKS * len(EVERY) // n_pixels,
            max(len(blocks) // (TASKS_A_THREAD[self.march] * self.n_threads), 16),
        )
        return [blocks[i : i + size] for i in range(0, len(blocks), size)]

    def _task(self, picture: _Picture, stage: MarchStage, blocks: np.ndarray) -> None:
        """Compute the pixels of a stage in some blocks: pixels that cannot be interpolated are marched and
        shaded."""
        view, planes, camera = picture.view, picture.planes, picture.view.camera
        pixels = view.pixels(blocks, stage.within)
        if len(stage.neighbours):
            size, transparent = (camera.width, camera.height), picture.behind is None
            pixels = pixels.only(self._interpolate(planes, size, pixels, stage, transparent))
            if not len(pixels.rows):
                return
        index = view.index(pixels)
        rays_o, rays_d, bounds = view.rays(pixels, self._directions)
        result: MarchResult = self._module.march(
            view.grid, rays_o, rays_d, picture.n_fetches, bounds, picture.opaque_depth
        )
        if picture.features is not None:
            picture.features[index[result.hits]] = result.features
        rgb = self._head(result.features, rays_d[result.hits])
        self._write_pixels(planes, index, result, rgb, picture.behind, view.start, self.asset.scale)

    def _all_normals(self, view: View, each: Callable[..., Iterable[None]] = map) -> np.ndarray:
        """Compute normals [h, w, 3]. `each` is the map function of the threads, or the builtin, which runs on
        the caller's thread: the renderer may have been closed."""
        normals = np.zeros((view.camera.height * view.camera.width, 3), np.float32)
        rotation = self.asset.world_from_model[:3, :3] / self.asset.scale

        def find(blocks: np.ndarray) -> None:
            pixels = view.pixels(blocks)
            rays = view.rays(pixels, self._directions)
            normals[view.index(pixels)] = composited_normals(view.grid, *rays) @ rotation.T

        for _ in each(find, self._tasks(view.blocks, len(EVERY))):
            pass
        return normals.reshape(view.camera.height, view.camera.width, 3)


class _Reduced(NamedTuple):
    """The reductions of a quality, compared with exact pictures."""

    levels: float
    """8-bit levels by which pixels may differ for another to become their mean; with 0, all pixels are
    marched."""
    n_fetches: int
    """Most feature lookups of a ray; 0: any number."""
    opaque_depth: np.float32
    """The optical depth at which rays stop."""


class _Picture(NamedTuple):
    """A picture while it is being rendered."""

    view: View
    planes: Planes
    behind: tuple[float, float, float] | None
    """The background's colour; None if transparent."""
    n_fetches: int
    opaque_depth: np.float32
    """The optical depth at which rays stop."""
    features: np.ndarray | None
    """[n, n_channels] float32, the input of the head for each pixel; None if it is not wanted."""


def fetches_used(asset: Asset, n_fetches: int | None = None, quality: Quality = "exact") -> int:
    """Return the most feature lookups of a ray in pictures of a quality; 0: one at every sample.

    `n_fetches`: as in `render`. Raises ConfigError if it or `quality` is out of range.
    """
    check_choice("quality", quality, get_args(Quality))
    k = checked_samples(asset.manifest.n_fetches if n_fetches is None else n_fetches)
    k = min((n for n in (k, _reduced(asset, quality).n_fetches) if n), default=0)
    return min(k, asset.most_samples)


def _reduced(asset: Asset, quality: Quality, scale: float = 1.0) -> _Reduced:
    """Return the reductions of a quality, as far as the asset allows them.

    `scale`: the picture's size as a share of the training size, 1 at most. The bake chose the reductions at
    the training size. In a smaller picture, neighbours lie farther apart in the scene, and the same
    reductions lose more. So the levels, and the light that is left where rays end, are in proportion.
    """
    levels, n_fetches, manifest = 0.0, 0, asset.manifest
    if quality != "exact":
        number = ("high", "fast").index(quality)
        levels, n_fetches = manifest.agreement[number], (manifest.quality_fetches or (0, 0))[number]
    if not levels and not n_fetches:
        return _Reduced(0.0, 0, MAX_TAU)
    depth = min(OPAQUE_DEPTH[quality] - math.log(scale), MAX_TAU)
    return _Reduced(levels * scale * (scale >= LEAST_IN_STAGES), n_fetches, np.float32(depth))


def check_size(width: int, height: int) -> None:
    """Raise ConfigError for a picture over MAX_PIXELS; the message says how much memory it would take."""
    if width * height > MAX_PIXELS:
        raise ConfigError(
            f"size: expected at most {MAX_PIXELS} pixels (8192x8192), got {width}x{height}, "
            f"which would take {width * height * FRAME_BYTES / 1e9:.1f} GB of memory"
        )


def checked_samples(value: object) -> int:
    """Return a number of feature lookups as an integer of Python: numba would compile the march again for one
    of numpy. Raises ConfigError."""
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < 0:
        raise ConfigError(f"samples: expected 0 (all) or more, a whole number, got {brief(value)}")
    return int(value)


def check_choice(name: str, value: object, allowed: tuple[str, ...]) -> None:
    """Raise ConfigError if the setting `name` is none of the words that are allowed."""
    if not isinstance(value, str) or value not in allowed:
        raise ConfigError(f"{name}: expected {', '.join(allowed[:-1])} or {allowed[-1]}, got {brief(value)}")


def checked_background(value: Any) -> Background:
    """Return a background as a frame has it: "transparent" or three floats. Raises ConfigError."""
    if isinstance(value, str) and value == "transparent":
        return "transparent"
    try:
        red, green, blue = (float(number) for number in value)
    except (TypeError, ValueError):
        red = green = blue = math.nan
    if not all(0 <= number <= 1 for number in (red, green, blue)):
        raise ConfigError(f'background: expected three numbers in 0..1 or "transparent", got {brief(value)}')
    return red, green, blue


def choose_march(name: March) -> tuple[str, ModuleType]:
    """Choose a march; returns its name and the module that has it. With "auto" it is the compiled one, if
    that is installed and was not found to be wrong.

    Raises MissingExtraError: `name` is "numba", which is not installed or does not run here; ConfigError:
    there is no such march.
    """
    check_choice("march", name, get_args(March))
    if name != "numpy":
        from player import compiling, proof

        if compiling.available() and not proof.refuted():
            from player.compiled import march as march_compiled

            return "numba", march_compiled
        if name == "numba":
            raise MissingExtraError(
                "march: expected compiled code that runs on this processor, got some that does not"
                if compiling.available()
                else "march: expected numba, which is not installed: pip install 'vfr-bake[fast]'"
            )
    from player.march import march

    return "numpy", march


def import_ahead(scipy: bool = True) -> None:
    """Begin to import what rendering needs, on a thread of its own, while the caller opens the asset: each
    takes half a second.

    `scipy`: whether other code in this process may import it in the meantime. If not, it is hidden from
    numba, which then does without its linear algebra; nothing here uses that, and it takes 0.3 s to import.
    """

    def imports() -> None:
        modules: dict[str, Any] = sys.modules  # an entry of None hides a module
        hidden = not scipy and not {"scipy.linalg", "numba.np.arraymath"} & set(modules)
        if hidden:
            modules["scipy.linalg"] = None
        try:
            with suppress(ImportError):  # reported where the module is needed
                if choose_march("auto")[0] == "numpy":
                    import onnxruntime  # noqa: F401
                else:
                    from player.compiled import pixels as pixels_compiled
                    from player.head import compiled as head_compiled  # noqa: F401

                    camera = Camera("", np.eye(4), 1, 1, 1.0, 1.0, 0.5, 0.5)
                    pixels_compiled.directions(camera, np.zeros(1), np.zeros(1))  # makes numba load its parts
        finally:
            if hidden:
                del modules["scipy.linalg"]

    threading.Thread(target=imports, daemon=True).start()


_renderer = lru_cache(maxsize=2)(Renderer)


def render(
    asset: Asset,
    camera: Camera,
    n_fetches: int | None = None,
    background: Background | Colour | None = None,
    n_threads: int | None = None,
    march: March = "auto",
    quality: Quality = "exact",
) -> Frame:
    """Render one picture of an asset; the threads and the open head are kept for the next call.

    Args:
        asset: an open asset.
        camera: in the WORLD frame, the photographs' own.
        n_fetches: feature lookups per ray; the asset's own number if None, one at every sample if 0.
        background: colour, 3 numbers 0..1, or "transparent"; the asset's own if None.
        n_threads: number of threads; one for each core if None.
        march: "numba", "numpy", or "auto": numba where it is installed and was not found to be wrong
            (`player.proof`).
        quality: "exact", or "high" or "fast" as in `Renderer.render`.

    Returns:
        The frame: `rgb` [h, w, 3], `opacity` [h, w], `depth` [h, w] in world units, `normals` [h, w, 3].

    Raises:
        ConfigError: a picture over MAX_PIXELS, or a setting out of range.
        FormatError: the file of the asset's head holds no valid head.
        MissingExtraError: `march` is "numba", which is not installed or does not run here.

    >>> from player.cameras.transforms import read_cameras
    >>> asset = Asset.open("out/")
    >>> camera = read_cameras("out/cameras.json")[0]
    >>> frame = render(asset, camera, background=(0.0, 0.0, 0.0))
    >>> frame.rgb.shape, frame.opacity.shape, frame.depth.shape, frame.normals.shape
    ((40, 48, 3), (40, 48), (40, 48), (40, 48, 3))
    """
    return _renderer(asset, n_threads, march).render(camera, n_fetches, background, quality=quality)
