"""Tests of pictures: frames, backgrounds, threads, and the bounds of blocks."""

from __future__ import annotations

import pickle
import subprocess
import sys
import tracemalloc
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from player import render as render_module
from player.asset.asset import Asset
from player.cameras.camera import Camera
from player.cameras.transforms import read_cameras
from player.compiled import march as march_compiled
from player.compiled import pixels as pixels_compiled
from player.errors import ConfigError, FormatError, MissingExtraError, ShapeError
from player.files.images import png_bytes
from player.head.head import CHUNK, Head
from player.march import pixels
from player.march.bounds import BLOCK, block_bounds
from player.march.interpolation import Quality
from player.march.march import MarchResult, march
from player.render import FRAME_BYTES, MAX_PIXELS, Renderer, render
from tests.numerics.bounds import Row
from tests.player.conftest import head_arrays, head_bytes, look_at
from tests.player.march.oracle_march import Scene, march_ray
from tests.player.march.pyramid_scene import random_scene

LOOP = Row(
    "Pictures", "rgb against a float64 loop over rays, samples and head", "every 37th pixel", 2e-4,
    at_ends="what is not shaded, an opacity below 1/512, too",
)  # fmt: skip
THREADS = Row("Pictures", "tasks, threads, chunks", "1 to 3 threads, 1 to 1000 blocks", unit="the same bytes")
STRAIGHT = Row(
    "Pictures", "picture without a background, laid over one", "straight alpha", 2e-3, "of rgb",
    "what is not shaded has an opacity below 1/512",
)  # fmt: skip
JOINTS = Row("Pictures", "8-bit values out of range", "-1 to 7", unit="the nearest level", at_ends="clipped")
FAR_OPACITY = Row(
    "Rays", "mean opacity of a picture from far away", "1e4 and 1e8 units, with as long a lens", 0.01,
    at_ends="the renderer starts rays beside the box; with an ordinary lens the background is seen, exactly",
)  # fmt: skip

FORKED = """
import os, signal, sys
from player import Asset, Renderer
from player.cameras.views import asset_cameras
from player.render import render
asset, march = Asset.open(sys.argv[1]), sys.argv[2]
camera = asset_cameras(asset)[0]
with Renderer(asset, 2, march) as held:
    def pictures():
        frames = render(asset, camera, n_threads=2, march=march), held.render(camera, layers=True)
        return [frame.rgb.tobytes() for frame in frames]
    expected = pictures()
    child = os.fork()
    if child == 0:
        signal.alarm(60)  # ends the process if it waits for threads that it does not have
        same = pictures() == expected
        held.close()
        os._exit(0 if same else 1)
    sys.exit(os.waitpid(child, 0)[1] != 0)
"""


@pytest.fixture
def camera(asset: Asset) -> Camera:
    return read_cameras(asset.path("cameras.json"))[1]


def inside_camera() -> Camera:
    return Camera("inside", look_at((1, 2, 3.2), (3, 2, 3)), 50, 37, 30.0, 30.0, 25.0, 18.5)


@pytest.mark.parametrize("module", ["numpy", pytest.param("numba", marks=pytest.mark.extra)])
def test_picture_is_the_naive_loop(module: str, asset: Asset, scene: Scene, camera: Camera) -> None:
    """Every 37th pixel is that of a naive loop over the whole chain: world camera, rotated and scaled model,
    head, background, depth."""
    frame = render(asset, camera, background=(0.25, 0.5, 1.0), march=module)
    model = camera.transformed(np.linalg.inv(asset.world_from_model))
    rays_o, rays_d = model.rays()
    head = Head.of(asset)
    for pixel in range(0, camera.width * camera.height, 37):
        ray = march_ray(scene, rays_o[pixel], rays_d[pixel], 5)
        at = divmod(pixel, camera.width)
        expected = (1 - ray.opacity) * np.array([0.25, 0.5, 1.0])
        if ray.opacity > 1 / 512:
            expected += ray.opacity * head(np.float32(ray.features[None]), rays_d[pixel][None])[0]
        # rays are rounded once more than in `Camera.rays`: 1e-6 of a pixel beside a steep edge
        LOOP.check(frame.rgb[at], expected)
        assert abs(frame.opacity[at] - ray.opacity) < 1e-4
        assert abs(frame.depth[at] - 2 * ray.depth) < 1e-3


def test_the_picture_shows_something(asset: Asset, camera: Camera) -> None:
    frame = render(asset, camera)
    assert 0.2 < (frame.opacity > 0.5).mean() < 0.8
    assert frame.rgb.dtype == frame.opacity.dtype == frame.depth.dtype == np.float32
    assert frame.rgb.shape == (40, 48, 3) and frame.opacity.shape == frame.n_density_samples.shape == (40, 48)


@pytest.mark.parametrize("module", ["numpy", pytest.param("numba", marks=pytest.mark.extra)])
def test_threads_and_tasks_do_not_change_a_bit(
    module: str, asset: Asset, camera: Camera, monkeypatch: pytest.MonkeyPatch
) -> None:
    frames = []
    for n_threads, blocks in ((1, 1000), (2, 7), (3, 1)):
        monkeypatch.setattr("player.render.TASK_BLOCKS", blocks)
        with Renderer(asset, n_threads, module) as renderer:  # type: ignore[arg-type]
            frames.append(renderer.render(camera.resized(101, 83)))
    for frame in frames[1:]:
        for name in ("rgb", "opacity", "depth", "n_density_samples"):
            THREADS.holds(getattr(frame, name).tobytes() == getattr(frames[0], name).tobytes())


@pytest.mark.needs("forks")
@pytest.mark.parametrize("module", ["numpy", pytest.param("numba", marks=pytest.mark.extra)])
def test_a_forked_process_renders(module: str, shells_folder: Path) -> None:
    """As `multiprocessing` makes them on Linux up to Python 3.13, after the parent has rendered."""
    command = [sys.executable, "-W", "ignore::DeprecationWarning", "-c", FORKED, str(shells_folder), module]
    subprocess.run(command, check=True)


@pytest.mark.parametrize("view", ["outside", "inside", "beside", "short", "long"])
def test_block_bounds_hold_every_sample(view: str, asset: Asset, camera: Camera) -> None:
    beside = Camera("beside", look_at((1, 4.1, 3), (5, 4.3, 3.2)), 60, 50, 25.0, 25.0, 30.0, 25.0)
    # A file's matrix may be off by a thousandth; far away that is more than a brick.
    far_away = Camera("far away", look_at((141, 2, 3), (1, 2, 3)), 60, 50, 1500.0, 1500.0, 30.0, 25.0)
    off = np.diag([*[0.9996 if view == "short" else 1.0004] * 3, 1])
    views = {"outside": camera, "inside": inside_camera(), "beside": beside}
    camera = views.get(view, replace(far_away, c2w=far_away.c2w @ off))
    model = camera.transformed(np.linalg.inv(asset.world_from_model))
    near, far = block_bounds(asset.grid, model)
    rays_o, rays_d = model.rays()
    free = march(asset.grid, rays_o, rays_d, 0)
    assert free.opacity.any()
    rows, columns = np.divmod(np.arange(len(rays_o)), camera.width)
    bounds = (near[rows // BLOCK, columns // BLOCK], far[rows // BLOCK, columns // BLOCK])
    bounded = march(asset.grid, rays_o, rays_d, 0, bounds)
    for a, b in zip(free, bounded, strict=True):
        assert a.tobytes() == b.tobytes()


def test_block_bounds_leave_empty_sky_away(asset: Asset, camera: Camera) -> None:
    model = camera.resized(480, 400).transformed(np.linalg.inv(asset.world_from_model))
    near, far = block_bounds(asset.grid, model)
    assert 0.2 < (far >= near).mean() < 0.9
    away = replace(model, c2w=model.c2w @ np.diag([-1.0, 1, -1, 1]))
    near, far = block_bounds(asset.grid, away)
    assert not (far >= near).any()


def test_block_bounds_of_a_large_picture_take_little_memory(
    asset: Asset, camera: Camera, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Bricks are projected in groups, whose size changes no bound."""
    model = camera.resized(960, 800).transformed(np.linalg.inv(asset.world_from_model))
    found, peaks = [], []
    for most in (1 << 40, 1000, 1):
        monkeypatch.setattr("player.march.bounds.MOST_PAIRS", most)
        tracemalloc.start()
        found.append([bounds.tobytes() for bounds in block_bounds(asset.grid, model)])
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert found[0] == found[1] == found[2]
    assert max(peaks[1:]) < peaks[0] / 4


def test_looking_away_is_background(asset: Asset, camera: Camera) -> None:
    away = replace(camera, c2w=camera.c2w @ np.diag([-1.0, 1, -1, 1]))
    frame = render(asset, away, background=(0.0, 1.0, 0.5))
    assert (frame.to_uint8() == [0, 255, 128]).all() and not frame.opacity.any()


def test_transparent_is_straight_and_composites_to_the_same(asset: Asset, camera: Camera) -> None:
    over = render(asset, camera, background=(1.0, 0.0, 0.5))
    straight = render(asset, camera, background="transparent")
    a = straight.opacity[..., None]
    composed = straight.rgb * a + (1 - a) * np.float32([1, 0, 0.5])
    STRAIGHT.check(composed, over.rgb)  # what is not shaded has A < 1/512
    pixels = straight.to_uint8()
    assert pixels.shape == (40, 48, 4)
    assert (pixels[..., 3] == np.floor(straight.opacity * 255 + 0.5)).all()
    assert not pixels[straight.opacity == 0].any()


def test_default_background_and_k_are_the_assets_own(asset: Asset, camera: Camera) -> None:
    a, b = render(asset, camera), render(asset, camera, n_fetches=5, background=(1.0, 1.0, 1.0))
    assert a.rgb.tobytes() == b.rgb.tobytes()
    every = render(asset, camera, n_fetches=0)
    assert every.opacity.tobytes() == a.opacity.tobytes() and every.rgb.tobytes() != a.rgb.tobytes()


@pytest.mark.parametrize("quality", ["high", "fast"])
def test_one_picture_is_rendered_in_a_quality(quality: Quality, asset: Asset, camera: Camera) -> None:
    with Renderer(asset) as renderer:
        wanted = renderer.render(camera, quality=quality)
    got = render(asset, camera, quality=quality)
    assert got.rgb.tobytes() == wanted.rgb.tobytes() != render(asset, camera).rgb.tobytes()


def test_rounding_to_eight_bits() -> None:
    values = np.float32([[[-1, 0, 0.5 / 255 - 1e-6]], [[0.5 / 255 + 1e-6, 1, 7]]])
    zeros = np.zeros((2, 1), np.float32)
    frame = render_module.Frame(values, zeros, zeros, zeros, (0.0, 0.0, 0.0))
    JOINTS.holds(frame.to_uint8() == [[[0, 0, 0]], [[1, 255, 255]]])


@pytest.mark.parametrize("background", [(0.0, 0.0, 0.0), "transparent"])
@pytest.mark.parametrize("size", [(1, 1), (700, 900), (3, 70_001), (70_001, 3)])
def test_rounding_in_bands_is_the_formula_within_the_memory_of_a_frame(
    size: tuple[int, int], background: render_module.Background
) -> None:
    rng = np.random.default_rng(2)
    rgb, opacity = (rng.uniform(-0.2, 1.2, (*size, *more)).astype(np.float32) for more in ((3,), ()))
    frame = render_module.Frame(rgb, opacity, opacity, opacity, background)
    whole = rgb if background != "transparent" else np.concatenate([rgb, opacity[..., None]], axis=-1)
    expected = np.floor(np.clip(whole, 0, 1) * 255 + 0.5).astype(np.uint8)
    tracemalloc.start()
    pixels = frame.to_uint8()
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert pixels.dtype == np.uint8 and pixels.tobytes() == expected.tobytes()
    planes = 24  # bytes of the frame itself
    assert most <= (FRAME_BYTES - planes) * opacity.size + 2e6


@pytest.mark.parametrize("size", [(1, 1), (1, 9), (8, 8), (17, 3)])
def test_sizes_that_are_no_multiple_of_a_block(size: tuple[int, int], asset: Asset, camera: Camera) -> None:
    frame = render(asset, camera.resized(*size))
    assert frame.rgb.shape == (size[1], size[0], 3) and frame.opacity[size[1] // 2, size[0] // 2] > 0


@pytest.mark.extra
@pytest.mark.parametrize("contracted", [False, True])
def test_a_single_ray_is_marched_by_the_code_of_all_others(contracted: bool) -> None:
    """The origin of a single ray is a contiguous view of the camera's that is read-only. Numba does not
    compile anything for it."""
    from numba import types

    camera, zero = inside_camera(), np.zeros(1)
    rays_o, rays_d = pixels.rays_of_pixels(camera, zero, zero, 0.0)
    assert rays_o.flags.c_contiguous and not rays_o.flags.writeable
    march_compiled.enter(random_scene(20, 20, (1,), 2, contracted).grid, rays_o, rays_d)
    enters: Any = march_compiled._enter_curves if contracted else march_compiled._enter_rays
    arguments = [kind for signature in enters.signatures for kind in signature]
    assert all(kind.mutable for kind in arguments if isinstance(kind, types.Array))


def test_too_large_and_other_settings(asset: Asset, camera: Camera, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ConfigError, match=rf"size: expected at most {MAX_PIXELS} pixels .* got 20000x20000"):
        render(asset, camera.resized(20000, 20000))
    with pytest.raises(ConfigError, match="samples: expected 0"):
        render(asset, camera, n_fetches=-1)
    with pytest.raises(ConfigError, match="threads: expected at least 1, got 0"):
        Renderer(asset, 0)
    for n_threads in (2.0, "2"):
        with pytest.raises(ConfigError, match=f"threads: expected a whole number, got {n_threads}"):
            Renderer(asset, n_threads)  # type: ignore[arg-type]
    with Renderer(asset, np.int64(2)) as renderer:  # type: ignore[arg-type]
        assert type(renderer.n_threads) is int
    monkeypatch.setattr("player.compiling.numba", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'vfr-bake\[fast\]'"):
        Renderer(asset, 1, "numba")
    with Renderer(asset, 1) as renderer:
        assert renderer.march == "numpy"


@pytest.mark.parametrize(
    "background",
    [np.ones(3), np.float32([1, 1, 1]), [1, 1, 1], (1.0, np.float32(1), 1), np.ones(3, np.int64)],
)
def test_a_background_may_be_any_three_numbers(background: Any, asset: Asset, camera: Camera) -> None:
    frame = render(asset, camera, background=background)
    assert frame.background == (1.0, 1.0, 1.0)
    assert frame.rgb.tobytes() == render(asset, camera, background=(1.0, 1.0, 1.0)).rgb.tobytes()


def test_settings_that_are_none_are_told(asset: Asset, camera: Camera) -> None:
    expected = r'background: expected three numbers in 0\.\.1 or "transparent", got '
    for background in (
        "white",
        (255, 255, 255),
        (0.5, 0.5),
        np.ones((2, 3)),
        (0, float("nan"), 0),
        1.0,
        [None] * 3,
    ):
        with pytest.raises(ConfigError, match=expected):
            render(asset, camera, background=background)  # type: ignore[arg-type]
    for n_fetches in (2.5, "5", True):
        with pytest.raises(ConfigError, match=r"samples: expected 0 \(all\) or more, a whole number, got "):
            render(asset, camera, n_fetches=n_fetches)  # type: ignore[arg-type]
    assert render(asset, camera, n_fetches=np.int64(3)).rgb.shape == (40, 48, 3)  # type: ignore[arg-type]
    with Renderer(asset, 1) as renderer, pytest.raises(ConfigError) as caught:
        renderer.render(camera, quality="best")  # type: ignore[arg-type]
    assert str(caught.value) == "quality: expected exact, high or fast, got best"
    with pytest.raises(ConfigError, match="march: expected auto, numpy or numba, got foo"):
        Renderer(asset, 1, "foo")  # type: ignore[arg-type]


def test_a_renderer_that_is_closed_says_so(asset: Asset, camera: Camera) -> None:
    with Renderer(asset, 1, "numpy") as renderer:
        frame = renderer.render(camera)
    with pytest.raises(ConfigError, match="renderer: expected an open one, got one that was closed"):
        renderer.render(camera)
    assert frame.normals.shape == (40, 48, 3), "normals need no threads"


def test_a_frame_is_pickled_with_the_layers_that_it_has(asset: Asset, camera: Camera) -> None:
    with Renderer(asset, 1) as renderer:
        whole, other = (renderer.render(camera, layers=layers) for layers in (True, False))
    whole, again = pickle.loads(pickle.dumps((whole, other)))
    assert again.rgb.tobytes() == other.rgb.tobytes() and again.background == other.background
    assert whole.normals.tobytes() == other.normals.tobytes() and whole.features.any()
    with pytest.raises(ConfigError, match=r"normals: expected .* copied or pickled without them: render"):
        again.normals  # noqa: B018
    assert pickle.loads(pickle.dumps(other)).normals.tobytes() == other.normals.tobytes()


def test_head_is_the_formula_in_any_number_of_pixels(asset: Asset) -> None:
    head = Head.of(asset)
    (w, v), rng = head_arrays(), np.random.default_rng(1)
    features = rng.uniform(-100, 100, (CHUNK * 2 + 1, 4)).astype(np.float32)
    dirs = rng.normal(size=(len(features), 3))
    dirs = (dirs / np.linalg.norm(dirs, axis=-1, keepdims=True)).astype(np.float32)
    expected = 1 / (1 + np.exp(-(features @ w + dirs @ v)))
    for n in (0, 1, CHUNK, len(features)):
        np.testing.assert_allclose(head(features[:n], dirs[:n]), expected[:n], rtol=0, atol=1e-6)


def test_heads_that_do_not_fit() -> None:
    for data, message in (
        (b"not onnx", "expected an ONNX graph"),
        (b"", "expected an ONNX graph"),
        (head_bytes(5), r"features: expected float \[n, 4\], got \[n, 5\]"),
    ):
        with pytest.raises(FormatError, match=message) as caught:
            Head(data, 4)
        assert "\n" not in str(caught.value)


def test_png_wants_bytes() -> None:
    with pytest.raises(ShapeError, match="pixels: expected"):
        png_bytes(np.zeros((2, 2, 3), np.float32))


@pytest.mark.parametrize("distance", [1e4, 1e8])
def test_a_camera_far_away_sees_what_a_parallel_one_sees(distance: float, asset: Asset) -> None:
    """With a focal length that grows with the distance, the picture stays; at 1e8 float32 has steps of 8."""
    frames = []
    for d in (distance, 3e3):
        pose = look_at((1 + d, 2, 3), (1, 2, 3))
        frames.append(render(asset, Camera("far", pose, 40, 30, 7 * d, 7 * d, 20.0, 15.0)))
    far, near = frames
    assert 0.1 < near.opacity.mean() < 0.9
    FAR_OPACITY.check(np.abs(far.opacity - near.opacity).mean())
    met = (far.opacity > 0.5) & (near.opacity > 0.5)
    assert np.abs((far.depth - distance) - (near.depth - 3e3))[met].max() < (0.02 if distance < 1e5 else 9)
    assert (far.depth[far.opacity == 0] == 0).all()


def test_a_camera_far_away_with_an_ordinary_lens_sees_background(asset: Asset, camera: Camera) -> None:
    far = replace(camera, c2w=look_at((1e8, 2, 3), (1, 2, 3)))
    FAR_OPACITY.holds(render(asset, far, background=(0.0, 0.5, 1.0)).to_uint8() == [0, 128, 255])


@pytest.mark.parametrize("behind", [None, (0.25, 0.5, 1.0)])
@pytest.mark.parametrize("hits", [[], [0, 3], [4], [0, 1, 2, 3, 4]])
def test_compiled_pixels_are_numpys(behind: tuple[float, float, float] | None, hits: list[int]) -> None:
    """Compiled and numpy code write the same pixels: every field, in any order, also of rays that hit but are
    not shaded."""
    rng = np.random.default_rng(1)
    depth = rng.uniform(1, 2, 5).astype(np.float32) * [1, 0, 1, 1, 1]
    opacity, rgb = rng.uniform(0, 1, 5).astype(np.float32), rng.uniform(0, 1, (len(hits), 3))
    counts, none = np.arange(5, dtype=np.int32), np.zeros((len(hits), 4), np.float32)
    result = MarchResult(opacity, depth.astype(np.float32), counts, np.array(hits, np.int64), none)
    frames = []
    for write in (pixels.write_pixels, pixels_compiled.write_pixels):
        planes = (np.full(shape, 7, np.float32) for shape in ((6, 3), 6, 6))
        frame = pixels.Planes(*planes, np.full(6, 7, np.int32))
        write(frame, np.array([5, 0, 3, 1, 2]), result, rgb.astype(np.float32), behind, 0.5, 2.0)
        frames.append(frame)
    for a, b in zip(*frames, strict=True):
        np.testing.assert_allclose(a, b, rtol=2e-7, atol=0)
        assert (a[4] == 7).all(), "a pixel that no ray goes through"


def test_compiled_directions_are_the_cameras(camera: Camera) -> None:
    rows, columns = np.divmod(np.arange(camera.width * camera.height), camera.width)
    expected = camera.rays()[1]
    np.testing.assert_allclose(pixels_compiled.directions(camera, columns, rows), expected, rtol=0, atol=6e-8)


def test_a_frame_that_was_put_together_has_no_normals() -> None:
    zeros = np.zeros((2, 1), np.float32)
    frame = render_module.Frame(np.zeros((2, 1, 3), np.float32), zeros, zeros, zeros, (0.0, 0.0, 0.0))
    with pytest.raises(ConfigError, match="normals: expected the frame of a renderer"):
        frame.normals  # noqa: B018
