"""Codes, heads and pictures at the ends of their ranges, and changes that must not change a picture."""

from __future__ import annotations

from dataclasses import replace
from types import ModuleType

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from exporters.shapes.colour import linear_from_srgb
from player.asset.asset import Asset
from player.asset.bricks import pack_vertices
from player.asset.density import decode_density, encode_density
from player.asset.grid import SparseGrid
from player.asset.version_3.packing import unpack_codes
from player.cameras.transforms import read_cameras
from player.compiled import march as march_compiled
from player.march import march
from player.render import Frame, Renderer, render
from tests.numerics.bounds import Row
from tests.numerics.fog import fog
from tests.player.conftest import RESOLUTION, STEP, shells
from tests.reference import srgb_from_linear
from tests.version_3 import pack_codes
from tests.vertex_grids import grid_of
from vfr_bake.baking.grids import code_step, latent, whole_codes

MARCHES = [pytest.param(march, id="numpy"), pytest.param(march_compiled, id="numba")]
BOX = np.array([[-1.0] * 3, [1.0] * 3])

STORED = "What is stored"
DENSITY_CODES = Row(
    STORED, "density codes of the densities that a player computes", "ranges of 0.01 to 160 within ±80",
    0, "codes", "all 256 come back",
)  # fmt: skip
FEATURE_CODES = Row(
    STORED, "feature codes", "±7 to ±127, scales of 1e-300 to 1e300", 0, "codes", "all come back"
)
CONSTANT = Row(
    STORED, "value of a constant channel", "0, 5, -1e30", 1e-6, "of it",
    "a channel of zeros has the step 1; a subnormal value keeps its first digits",
)  # fmt: skip
CLIPPED = Row(
    STORED, "feature codes out of range", "±1e9", unit="the last code", at_ends="clipped, never wrapped"
)
PACKED = Row(STORED, "packed codes (version 3 of the format)", "0 to 255, none to 300", unit="come back")
SEAM_DENSITY = Row(
    STORED, "density codes across brick borders", "a linear ramp along each axis", 2e-3, "codes"
)
SEAM_FEATURES = Row(
    STORED, "features across brick borders", "a linear ramp along each axis", 1e-4, "codes",
    "a shift of a voxel shows as one code",
)  # fmt: skip
ANY_K = Row(STORED, "opacity with any number of fetches", "k = 0, 1, 2, 5, 1000", unit="the same bytes")
ANY_K_FEATURES = Row(STORED, "one feature with any number of fetches", "the same", 2e-5, "of it")
LEVELS = Row(
    "Pictures",
    "8-bit values",
    "0 to 1, 1e-6 beside each of the 255 joints",
    0,
    "levels",
    "outside is clipped",
)
SRGB = Row(
    "Pictures",
    "sRGB to linear light and back",
    "0 to 1",
    1e-7,
    at_ends="both pieces meet at the joint to 1e-6",
)
BEHIND = Row(
    "Pictures", "picture over any background, against that over black and what shows through",
    "any colour", 3e-7, "of rgb", "the opacity is the same bytes",
)  # fmt: skip
MOVED_COLOUR = Row(
    "Pictures", "mean change of rgb of a scene moved with its cameras",
    "moved by 50 units, turned by quarters, scaled by 0.01 to 100", 1e-5, at_ends="depth in proportion",
)  # fmt: skip
MOVED_OPACITY = Row(
    "Pictures", "mean change of the opacity of a scene moved with its cameras", "the same", 1e-6
)
TURNED_OPACITY = Row(
    "Pictures", "opacity of a grid turned by a quarter with its rays", "500 rays", 2e-5,
    at_ends="where the same samples are taken, on more than 99 % of the rays",
)  # fmt: skip
TURNED_DEPTH = Row("Pictures", "depth of a grid turned by a quarter with its rays", "500 rays", 2e-4, "units")


# --- codes ---


@given(st.floats(-80, 79), st.floats(1e-2, 160))
def test_every_density_code_comes_back(low: float, width: float) -> None:
    """Each code is found from the float32 density that a player computes, in any range of a manifest."""
    high = min(low + width, 80.0)
    codes = np.arange(256)
    sigmas = decode_density(codes, (low, high)).astype(np.float64)
    # float32 rounds the exponent by up to 80 * 2^-24, less than a step of the code in the narrowest range
    DENSITY_CODES.check(encode_density(np.log(sigmas), (low, high)), codes)


@pytest.mark.parametrize("scale", [1e-300, 1e-38, 1e-30, 1.0, 1e30, 1e300])
@pytest.mark.parametrize("levels", [7, 31, 63, 127])
def test_every_feature_code_comes_back(scale: float, levels: int) -> None:
    codes = np.arange(-levels, levels + 1)[:, None]
    values = codes * (scale / levels)
    step = code_step(values, levels)
    assert np.isfinite(step) and step > 0
    FEATURE_CODES.check(whole_codes(latent(values / step)), codes)


@pytest.mark.parametrize("value", [0.0, 1e-320, 5.0, -1e30])
def test_a_constant_channel_keeps_its_value(value: float) -> None:
    values = np.full((9, 1), value)
    step = code_step(values, 127)
    kept = whole_codes(latent(values / step)) * step
    if 0 < abs(value) < 1e-300:  # a step of 1e-320 / 127 has only seven bits
        np.testing.assert_allclose(kept, values, rtol=1e-2)
    else:
        CONSTANT.check(kept, values, of=np.abs(values))


def test_what_is_out_of_range_is_clipped_not_wrapped() -> None:
    CLIPPED.holds(whole_codes(latent(np.array([-1e9, -127.6, 127.6, 1e9]))) == [-127, -127, 127, 127])


@given(st.lists(st.integers(0, 255), max_size=300), st.integers(1, 4))
def test_packed_codes_come_back(values: list[int], n_channels: int) -> None:
    codes = np.array(values * n_channels, np.uint8).reshape(-1, n_channels)
    PACKED.holds(np.array_equal(unpack_codes(pack_codes(codes), codes.shape, "u1", "codes"), codes))


# --- bricks ---


def ramp(resolution: int, axis: int, shift: int = 0) -> SparseGrid:
    """Return a grid with density code and features that grow by one a vertex along an axis."""
    vertices = np.argwhere(np.ones((resolution + 1,) * 3))
    coords, masks, order = pack_vertices(vertices)
    values = vertices[order][:, axis] + shift
    codes, features = (values + 100).astype(np.uint8), values.astype(np.int8)[:, None]
    where, both = (coords, masks), (resolution, resolution)
    return grid_of((*where, codes), (*where, features), both, BOX, 0.01, (-4.0, 5.0))


@pytest.mark.parametrize("module", MARCHES)
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_brick_borders_are_seamless(module: ModuleType, axis: int) -> None:
    """Brick borders are seamless: density is found from the opacity of rays one sample long, features by one
    fetch, at places all over the borders. A shift by half a voxel would be half a code off."""
    resolution = 24
    grid = ramp(resolution, axis)
    random = np.random.default_rng(0)
    places = random.uniform(0.1, 23.9, (400, 3))
    places[:200, axis] = random.choice([8, 16], 200) + random.uniform(-1e-2, 1e-2, 200)
    rays_o = (places * 2 / resolution - 1).astype(np.float32)
    d = np.zeros(3, np.float32)
    d[(axis + 1) % 3] = 1
    step = float(grid.step)
    near, far = np.zeros(400, np.float32), np.full(400, 0.75 * step, np.float32)
    result = module.march(grid, rays_o, np.tile(d, (400, 1)), 0, (near, far))
    assert result.n_density_samples.tolist() == [1] * 400
    sigma = -np.log1p(-result.opacity.astype(np.float64)) / step
    code = (np.log(sigma) + 4) * 255 / 9
    at = rays_o[:, axis].astype(np.float64) * resolution / 2 + resolution / 2
    # float32 opacities are right to 1e-6 of themselves, and a code is 9 / 255 of a logarithm
    SEAM_DENSITY.check(code, at + 100)
    hits = result.hits
    assert len(hits) > 20
    features = result.features[:, 0] / result.opacity[hits]
    SEAM_FEATURES.check(features, at[hits])
    shifted = module.march(ramp(resolution, axis, 1), rays_o, np.tile(d, (400, 1)), 0, (near, far))
    other = shifted.features[:, 0] / shifted.opacity[shifted.hits]
    SEAM_FEATURES.check(other, at[shifted.hits] + 1)


# --- choice of samples ---


@pytest.mark.parametrize("module", MARCHES)
@pytest.mark.parametrize("optical", [1e-4, 0.01, 0.3, 5.0])
def test_k_changes_no_bit_of_the_opacity(module: ModuleType, optical: float) -> None:
    grid = fog(optical)
    rays_o = np.float32(np.random.default_rng(0).uniform(-0.9, 0.9, (50, 3)))
    rays_o[:, 0] = -3
    rays_d = np.tile(np.float32([1, 0, 0]), (50, 1))
    results = [module.march(grid, rays_o, rays_d, k) for k in (0, 1, 2, 5, 1000)]
    for result in results[1:]:
        ANY_K.holds(result.opacity.tobytes() == results[0].opacity.tobytes())
        ANY_K_FEATURES.check(result.features, results[0].features, of=np.abs(results[0].features))


# --- pictures ---


def test_8_bit_rounding_at_every_joint() -> None:
    """A level of 8 bits begins half a level below its value, in float32."""
    joints = (np.arange(255) + 0.5) / 255
    below, above = (joints - 1e-6).astype(np.float32), (joints + 1e-6).astype(np.float32)
    for values, levels in ((below, np.arange(255)), (above, np.arange(1, 256))):
        rgb = np.repeat(values[:, None, None], 3, axis=2)
        zeros = np.zeros((255, 1), np.float32)
        frame = Frame(rgb, zeros, zeros, zeros, (0.0, 0.0, 0.0))
        LEVELS.check(frame.to_uint8()[:, 0, 0], levels)


def test_srgb_at_its_joint() -> None:
    low, at, high = linear_from_srgb(np.nextafter(0.04045, [0, 0.04045, 1]))
    assert low <= at <= high + 1e-7 and high - low < 1e-6
    values = np.linspace(0, 1, 4001)
    SRGB.check(srgb_from_linear(linear_from_srgb(values)), values)
    assert (np.diff(linear_from_srgb(values)) > 0).all()


@settings(max_examples=6, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(colour=st.tuples(*[st.floats(0, 1, width=32)] * 3))
def test_background_and_opacity_compose(colour: tuple[float, ...], shells_asset: Asset) -> None:
    """Over any background the picture is the one over black plus the background that shows through."""
    camera = read_cameras(shells_asset.path("cameras.json"))[0].resized(40, 30)
    black = render(shells_asset, camera, background=(0.0, 0.0, 0.0), march="numba")
    over = render(shells_asset, camera, background=colour, march="numba")
    wanted = black.rgb + (1 - black.opacity[..., None]) * np.float32(colour)
    BEHIND.check(over.rgb, wanted)
    assert over.opacity.tobytes() == black.opacity.tobytes()


# --- invariance ---


@pytest.fixture(scope="module")
def shells_asset(shells_folder) -> Asset:
    return Asset.open(shells_folder)


@settings(max_examples=8, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(move=st.tuples(*[st.floats(-50, 50)] * 3), scale=st.floats(0.01, 100), quarter=st.integers(0, 3))
def test_scene_and_cameras_moved_together_look_the_same(
    move: tuple[float, ...], scale: float, quarter: int, shells_asset: Asset
) -> None:
    """A scene that is moved, turned by quarters and scaled together with its camera looks the same."""
    turn = np.eye(4)
    c, s = [(1, 0), (0, 1), (-1, 0), (0, -1)][quarter]
    turn[:2, :2] = [[c, -s], [s, c]]
    turn[:3, :3] *= scale
    turn[:3, 3] = move
    placed = turn @ np.array(shells_asset.manifest.world_from_model)
    manifest = replace(shells_asset.manifest, world_from_model=tuple(map(tuple, placed.tolist())))
    moved = Asset(shells_asset.folder, manifest, shells_asset.arrays)
    camera = read_cameras(shells_asset.path("cameras.json"))[1].resized(40, 30)
    with Renderer(shells_asset, 1, "numba") as a, Renderer(moved, 1, "numba") as b:
        one, other = a.render(camera), b.render(camera.transformed(turn))
    # rays in the model frame are the same up to float64 rounding at 50 units, which is 1e-5 of a colour
    assert np.abs(one.rgb - other.rgb).max() < 0.02
    MOVED_COLOUR.check(np.abs(one.rgb - other.rgb).mean())
    MOVED_OPACITY.check(np.abs(one.opacity - other.opacity).mean())
    np.testing.assert_allclose(other.depth, one.depth * scale, rtol=2e-3, atol=1e-5 * scale)


@pytest.mark.parametrize("module", MARCHES)
def test_a_grid_turned_by_a_quarter_and_its_rays_give_the_same(module: ModuleType) -> None:
    """A grid and rays turned by x -> y, y -> -x give the same pictures, with other bricks and other jumps."""
    vertices, codes, features = shells()
    turned = np.stack([RESOLUTION - vertices[:, 1], vertices[:, 0], vertices[:, 2]], axis=1)
    _, _, order = pack_vertices(turned)
    grids = []
    for points, which in ((vertices, np.arange(len(vertices))), (turned, order)):
        c, m, _ = pack_vertices(points)
        where = (c, m, codes[which]), (c, m, features[which])
        grids.append(grid_of(*where, (RESOLUTION, RESOLUTION), BOX, STEP, (-2.0, 6.0)))
    random = np.random.default_rng(0)
    rays_o = random.normal(size=(500, 3)).astype(np.float32) * 2
    rays_d = random.uniform(-1, 1, (500, 3)) - rays_o
    rays_d = (rays_d / np.linalg.norm(rays_d, axis=1, keepdims=True)).astype(np.float32)

    def turn(rays: np.ndarray) -> np.ndarray:
        return np.stack([-rays[:, 1], rays[:, 0], rays[:, 2]], axis=1)

    a = module.march(grids[0], rays_o, rays_d, 5)
    b = module.march(grids[1], turn(rays_o), turn(rays_d), 5)
    same = a.n_density_samples == b.n_density_samples
    assert same.mean() > 0.99, "a sample within rounding of a cell's border may fall to either side"
    TURNED_OPACITY.check(a.opacity[same], b.opacity[same])
    TURNED_DEPTH.check(a.depth[same], b.depth[same])
