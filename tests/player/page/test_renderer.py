"""Tests of what the page draws in a browser, against the numpy player's pictures of the same cameras."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from playwright.sync_api import Browser
from scipy import ndimage

from player.app.option_types import DEMO
from player.asset.asset import Asset
from player.asset.grid import DISTANCE_BITS, MAX_DISTANCE, SparseGrid
from player.cameras.camera import Camera
from player.cameras.views import asset_cameras
from player.page.gpu_memory import COLUMN_BRICK, DENSITY_BRICK, block_shape, gpu_bytes
from player.page.page import page_script, web_files
from player.render import Renderer
from player.viewer.layers import coloured
from tests.numerics.bounds import Row
from tests.player.page import scenes
from tests.player.page.render_page import RenderPage

PAGE = "The page's shaders"
ALL_ASSETS = "8 assets: 3 to 24 channels, 1 to 4 levels, fog, empty, contracted"
LEVELS = Row(
    PAGE, "pictures, root mean square against the numpy player", ALL_ASSETS, 255 * 10 ** (-50 / 20),
    "levels (50 dB)", "from inside, from far away, along an axis; k = 0, 1 and 5; transparent",
)  # fmt: skip
"""Two pictures of 8 bits differ by 50 dB if two thirds of their levels differ by one. Pixels that `FAR_OFF`
counts are left out: rounding turns some rays past an edge of these random grids, which ones depends on the
processor, and one such pixel in a picture of 60 x 44 outweighs all others."""
FAR_OFF = Row(
    PAGE, "share of the pixels that are off by more than 3 levels", ALL_ASSETS, 1e-3, "of the pixels",
    "rays along an edge that another rounding takes past it",
)  # fmt: skip
OPACITY = Row(PAGE, "opacity, as levels of 8 bits", ALL_ASSETS, 1.5, "levels")
NORMALS = Row(
    PAGE, "normals, on 98 % of the pixels", "where the opacity is above 0.6", 0.03, at_ends="stored in 8 bits"
)
ARRAYS = Row(
    PAGE, "codes, live cells, bricks and rows in the textures", ALL_ASSETS, unit="the player's, exactly"
)
GLSL = Row(PAGE, "shaders", ALL_ASSETS, unit="accepted by the reference compiler of GLSL")

ASSETS: dict[str, Callable[[Path], Asset]] = {
    "one level, 4 channels": lambda folder: scenes.shells(folder),
    "fog, 8 channels": lambda folder: scenes.fog(folder),
    "flat fog, 8 channels": lambda folder: scenes.fog(folder, 0.01, "hard_swish"),
    "4 levels, 9 channels": lambda folder: scenes.pyramid_asset(folder, (1, 1, 2, 4), False, 9),
    "sparse, 3 levels, 3 channels": lambda folder: scenes.pyramid_asset(
        folder, (1, 2, 2), False, 3, sparse=True
    ),
    "contracted, 3 levels, 24 channels": lambda folder: scenes.pyramid_asset(folder, (1, 1, 4), True, 24),
    "contracted, sparse, 16 channels": lambda folder: scenes.pyramid_asset(
        folder, (1, 2), True, 16, sparse=True
    ),
    "empty, 4 channels": lambda folder: scenes.empty(folder),
}


class Scene:
    """An asset, its open page and the player that it is compared with."""

    def __init__(self, asset: Asset, page: RenderPage) -> None:
        self.asset, self.page = asset, page
        self.player = Renderer(asset, 1, "numpy")
        self.cameras = scenes.cameras(asset)

    def check(self, camera: Camera, n_fetches: int | None = None, background: Any = None) -> np.ndarray:
        settings: dict[str, Any] = {"quality": "exact"}
        if n_fetches is not None:
            settings["n_fetches"] = n_fetches
        if background is not None:
            settings["background"] = background
        found = self.page.picture(camera, **settings)
        wanted = self.player.render(camera, n_fetches, background).to_uint8()
        off = np.abs(found[..., : wanted.shape[-1]].astype(int) - wanted)
        is_far_off = off.max(axis=-1) > 3
        FAR_OFF.check(is_far_off.mean())
        LEVELS.check(np.sqrt(np.mean(off[~is_far_off].astype(float) ** 2)))
        return found


@pytest.fixture(scope="module", params=ASSETS)
def scene(
    request: pytest.FixtureRequest, chromium: Browser, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Scene]:
    folder = tmp_path_factory.mktemp("page")
    asset = ASSETS[request.param](folder / "asset")
    page = RenderPage(chromium, asset, folder / "scene.html")
    found = Scene(asset, page)
    yield found
    found.player.close()
    page.close()
    assert page.said == [] and page.asked == []


@pytest.mark.parametrize("name", ["outside", "inside", "far", "axis"])
def test_exact_pictures_are_the_players(scene: Scene, name: str) -> None:
    found = scene.check(scene.cameras[name])
    if scene.asset.arrays.densities.pyramid.levels[0].masks.any() and name in ("outside", "inside"):
        assert np.ptp(found[..., :3].reshape(-1, 3), axis=0).max() > 20, "there is something to see"


@pytest.mark.parametrize("n_fetches", [1, 5, 0])
def test_any_number_of_fetches(scene: Scene, n_fetches: int) -> None:
    scene.check(scene.cameras["outside"], n_fetches)


@pytest.mark.parametrize("background", ["transparent", (0.0, 1.0, 0.25)], ids=str)
def test_any_background(scene: Scene, background: Any) -> None:
    scene.check(scene.cameras["outside"], None, background)


def test_thin_edges_before_a_transparent_background(chromium: Browser, tmp_path: Path) -> None:
    """The straight colours of thin rays, which a picture before a background hardly shows, are the
    player's."""
    asset = Asset.open(DEMO)
    demo = Scene(asset, RenderPage(chromium, asset, tmp_path / "demo.html"))
    views = [asset_cameras(asset)[view].resized(160, 160) for view in (3, 12, 40)]
    for camera in (*views, demo.cameras["wall"].resized(96, 72), demo.cameras["axis"].resized(96, 72)):
        demo.check(camera, None, "transparent")
    demo.player.close()
    demo.page.close()


def test_layers_are_the_players(scene: Scene) -> None:
    """Opacity, depth and clear normals are the player's, and there is no depth where the opacity is below
    0.4."""
    camera = scene.cameras["outside"]
    frame = scene.player.render(camera)
    opacity = scene.page.picture(camera, layer="opacity")[..., 0]
    assert opacity.size
    OPACITY.check(opacity, frame.opacity * 255.0)
    normals = scene.page.picture(camera, layer="normals")[..., :3] / 127.5 - 1
    met = (frame.opacity > 0.6) & (np.linalg.norm(frame.normals, axis=-1) > 0.5)
    if met.any():
        off = np.abs(normals - frame.normals)[met].max(axis=-1)
        NORMALS.check(np.quantile(off, 0.98))
    depth = scene.page.picture(camera, layer="depth")[..., :3]
    assert not depth[frame.opacity < 0.4].any()
    low, high = np.array(scene.asset.manifest.aabb)
    eye = (np.linalg.inv(scene.asset.world_from_model) @ [*camera.c2w[:3, 3], 1])[:3]
    away, radius = np.linalg.norm((low + high) / 2 - eye), np.linalg.norm(high - low) / 2
    near, far = scene.asset.scale * np.array([max(away - radius, 0), away + radius])
    wanted, solid = 255 * coloured(1 - (frame.depth - near) / (far - near)), frame.opacity > 0.6
    if solid.any():
        assert np.quantile(np.abs(depth - wanted)[solid], 0.98) <= 2


def test_the_arrays_are_the_players(scene: Scene) -> None:
    """The textures hold the player's table, codes and rows of features, and take the memory predicted."""
    found, grid = scene.page.page.evaluate("() => arrays()"), scene.asset.grid
    table = scene.page.array(found["table"], np.uint8).reshape(-1, 4)
    check_table(entries_of(table, found["nSlots"]), grid)
    texels = unblocked(scene.page.array(found["density"], np.uint8), found["nSlots"], DENSITY_BRICK)
    codes = grid.codes.reshape(-1, 9, 9, 9)
    assert (texels[:, :, :, :9] == corners(codes)).all()
    live = texels[..., 9, 0]
    assert (live.reshape(-1) == grid.live).all()
    owners = scene.page.array(found["owners"], np.uint8).astype(np.int64).reshape(-1, 4)
    numbers = number_of(owners[:, :3], found["nHeld"], COLUMN_BRICK) << 3 | owners[:, 3]
    assert (np.where(owners[:, 3] < 255, numbers, -1) == grid.rows.bricks).all()
    texels = scene.page.array(found["columns"], np.uint32)
    wanted = grid.rows.rows.reshape(-1, 9, 9, 9)[: found["nHeld"]]
    assert (corners_of(unblocked(texels, found["nHeld"], COLUMN_BRICK)) == pairs(wanted)).all()
    n_channels, n_words = grid.n_channels, -(-grid.n_channels // 4)
    features = scene.page.array(found["features"], np.int8).reshape(-1, 4 * n_words)[:, :n_channels]
    ARRAYS.holds(features == grid.features[: len(features)])
    assert scene.page.page.evaluate("() => vfr.info.gpuBytes") == gpu_bytes(scene.asset)


BLOCKS = """
import { blockOf, COLUMN_BRICK, DENSITY_BRICK } from "./grid.js";
globalThis.blocks = (counts) => [DENSITY_BRICK, COLUMN_BRICK].map((brick) => counts.map((n) => {
  const { across, layers } = blockOf(n, brick);
  return [across, layers];
}));
"""


def test_textures_are_short_enough_for_devices_of_small_ones(chromium: Browser) -> None:
    """A page whose textures fill the 512 MB that are exported by default has none of more than 512 texels a
    side, and one of 64 MB none of more than 256, which every device has."""
    counts = [0, 1, 25, 26, 192, 193, 1000, 25_600, 100_000, 200_000]
    page = chromium.new_page()
    script = page_script({**web_files(), "main.js": BLOCKS}, "main.js", "main.js")
    page.set_content(f'<script type="module">{script}</script>')
    page.wait_for_function("() => globalThis.blocks")
    blocks = page.evaluate("counts => blocks(counts)", counts)
    page.close()
    for brick, found in zip((DENSITY_BRICK, COLUMN_BRICK), blocks, strict=True):
        assert [tuple(each) for each in found] == [block_shape(n, brick) for n in counts]
        for n, (across, layers) in zip(counts, found, strict=True):
            assert across**2 * layers >= n and max(across, layers) <= 256
            most = 256 if n <= 25_600 else 512
            assert max(across * brick[0], across * brick[1], layers * brick[2]) <= most, n


def number_of(place: np.ndarray, count: int, brick: tuple[int, int, int]) -> np.ndarray:
    """Return the numbers [n] of bricks at places [n, 3] of a texture of `count` bricks."""
    across, _ = block_shape(count, brick)
    return place[:, 0] + across * (place[:, 1] + across * place[:, 2])


def unblocked(texels: np.ndarray, count: int, brick: tuple[int, int, int]) -> np.ndarray:
    """Return the bricks [count, x, y, z, 4] of a texture."""
    across, _ = block_shape(count, brick)
    x, y, z = brick
    split = texels.reshape(-1, z, across, y, across, x, 4)
    return split.transpose(0, 2, 4, 5, 3, 1, 6).reshape(-1, x, y, z, 4)[:count]


def corners(values: np.ndarray) -> np.ndarray:
    """Return [n, 8, 8, 9, 4] from values [n, 9, 9, 9]: those at (x, y), (x, y + 1), (x + 1, y) and
    (x + 1, y + 1)."""
    return np.stack([values[:, x : x + 8, y : y + 8] for x, y in ((0, 0), (0, 1), (1, 0), (1, 1))], axis=-1)


def corners_of(columns: np.ndarray) -> np.ndarray:
    """Return the rows [n, 9, 8, 2, 9] of the vertices (x, y, z) and (x, y + 1, z), -1 for those that are not
    stored, from texels [n, 9, 8, 1, 4] of columns: see grid.js."""
    split = columns.astype(np.int64).reshape(-1, 9, 8, 2, 2)
    z = np.arange(8)
    own = split[..., :1]
    rows = (own >> 8) + np.bitwise_count(own & ((1 << z) - 1))
    next_rows = np.where(split[..., 1:] & 1, split[..., 1:] >> 8, -1)
    return np.concatenate([np.where(own >> z & 1, rows, -1), next_rows], axis=-1)


def pairs(rows: np.ndarray) -> np.ndarray:
    """Return, of rows [n, 9, 9, 9], those of the vertices (x, y, z) and (x, y + 1, z): [n, 9, 8, 2, 9]."""
    return np.stack([rows[:, :, :8], rows[:, :, 1:]], axis=3)


def entries_of(table: np.ndarray, count: int) -> np.ndarray:
    """Return entries [n] as in the player's table: slot << 3 | level, or minus the distance to the nearest
    brick with the level of a dead brick in the higher bits."""
    place, kind = table[:, :3].astype(np.int64), table[:, 3].astype(np.int64)
    nowhere = -(kind | place[:, 0] << DISTANCE_BITS)
    return np.where(kind < 32, nowhere, number_of(place, count, DENSITY_BRICK) << 3 | (kind - 32))


def check_table(found: np.ndarray, grid: SparseGrid) -> None:
    """Check that entries are those of the player's table: a place has a brick if a cell there is live, and
    any other place tells how far the nearest brick is."""
    assert (found == grid.table).all()
    n = grid.n_per_axis
    middles = np.stack(np.meshgrid(*[np.arange(8 * n)] * 3, indexing="ij")).reshape(3, -1) + np.float32(0.5)
    live = grid.find(middles.astype(np.float32)).live & (middles < grid.resolution).all(axis=0)
    occupied: np.ndarray = np.any(live.reshape(n, 8, n, 8, n, 8), axis=(1, 3, 5)).reshape(-1)
    assert ((found >= 0) == occupied).all()
    away: Any = ndimage.distance_transform_cdt(found.reshape(n, n, n) < 0, "chessboard")
    if occupied.any():
        assert (np.minimum(away, MAX_DISTANCE).reshape(-1) == -found & MAX_DISTANCE)[~occupied].all()
    else:
        assert (found == -MAX_DISTANCE).all()


def test_shaders_are_valid_glsl(scene: Scene, tmp_path: Path) -> None:
    """The reference compiler of GLSL, which is stricter than drivers, accepts all shaders."""
    program = shutil.which("glslangValidator")
    assert program, "expected glslangValidator, got none: make other-programs installs it"
    for number, source in enumerate(scene.page.page.evaluate("() => sources()")):
        path = tmp_path / f"{number}.frag"
        path.write_text(source)
        done = subprocess.run([program, str(path)], capture_output=True, text=True)
        assert done.returncode == 0, done.stdout
    GLSL.holds()
