"""Tests of pixels that become the mean of their neighbours, against a float64 loop, and of such pictures."""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from player.asset.asset import Asset, write_asset
from player.asset.bricks import pack_vertices
from player.asset.density import encode_density
from player.asset.grid import SparseGrid
from player.asset.manifest import AGREEMENT, Manifest
from player.cameras.camera import Camera
from player.cameras.transforms import read_cameras
from player.compiled import interpolation as compiled
from player.march.bounds import BLOCK
from player.march.interpolation import Agreement, MarchStage, Quality, interpolate, stages
from player.march.march import MarchResult, march
from player.march.pixels import Pixels, Planes, pixels_of_blocks
from player.render import Frame, Renderer
from tests.numerics.bounds import Row
from tests.player.conftest import DENSITY_RANGE, RESOLUTION, STEP, cameras_bytes, head_bytes
from tests.vertex_grids import arrays_of

QUALITIES: tuple[Quality, ...] = ("exact", "high", "fast")
LOSSY = QUALITIES[1:]


def usual_stages(quality: Quality, contracted: bool = False) -> tuple[MarchStage, ...]:
    """Return the stages of a picture whose asset's manifest has no `agreement`."""
    return stages(dict(zip(QUALITIES, (0.0, *AGREEMENT[contracted]), strict=True))[quality], contracted)


MARCHES = ["numpy", pytest.param("numba", marks=pytest.mark.extra)]

REUSE = "Reuse within a frame"
MEANS = Row(
    REUSE, "pixel that is the mean of its neighbours", "colour, opacity and depth", 1e-6, "of it, in float64",
    "empty neighbours, pictures of one pixel, transparent ones; the same pixels as in a loop",
)  # fmt: skip
TWINS = Row(
    REUSE, "numpy and compiled means", "both backgrounds, box and contracted space", unit="the same bytes"
)
MARCHED = Row(
    REUSE, "pixel that is marched in `high` and `fast`", "any background, k = 1 and 5",
    unit="the bytes it has where every pixel is",
)  # fmt: skip
MEAN_OPACITY = Row(REUSE, "mean change of the opacity by reuse", "`high`, `fast`", 0.01)
HIGH = Row(
    REUSE, "rgb of `high`, root mean square against `exact`", "analytic shells", 10 ** (-34 / 20), "(34 dB)"
)
FAST = Row(
    REUSE, "rgb of `fast`, root mean square against `exact`", "analytic shells", 10 ** (-28 / 20), "(28 dB)"
)
THREADS = Row(
    REUSE, "tasks, threads, the same frame again", "1 to 3 threads, 1 to 1000 blocks, two frames each",
    unit="the same bytes", at_ends="a renderer keeps nothing from one frame to the next",
)  # fmt: skip
LINE = Row(
    REUSE, "pictures one pixel wide or high", "1x1, 1x9", unit="the bytes of the whole picture",
    at_ends="no pixel has four neighbours",
)  # fmt: skip
WIRE = Row(
    REUSE, "wire one pixel wide between the pixels of the lattice", "an odd row, an odd column",
    unit="does not vanish", at_ends="8 pixels of it in a row have one of opacity over 0.5",
)  # fmt: skip


def random_planes(n_pixels: int, random: np.random.Generator) -> Planes:
    """Return colours, opacities and depths; most squares of four agree, some disagree in every way."""
    rgb = (0.5 + random.normal(0, 0.004, (n_pixels, 3))).astype(np.float32)
    opacity = (0.6 + random.normal(0, 0.004, n_pixels)).astype(np.float32)
    depth = random.uniform(2, 2.05, n_pixels).astype(np.float32)
    rgb[random.random(n_pixels) < 0.03, 1] += np.float32(0.2)
    opacity[random.random(n_pixels) < 0.03] += np.float32(0.2)
    depth[random.random(n_pixels) < 0.03] *= np.float32(1.5)
    empty = random.random(n_pixels) < 0.2
    depth[empty], opacity[empty] = 0, random.choice([0, 1e-4], empty.sum())
    return Planes(rgb, opacity, depth, np.zeros(n_pixels, np.int32))


def all_pixels(width: int, height: int, stage: MarchStage) -> Pixels:
    per_row = -(-width // BLOCK)
    blocks = np.arange(per_row * -(-height // BLOCK))
    camera = Camera("", np.eye(4), width, height, 1.0, 1.0, 0.5, 0.5)
    return pixels_of_blocks(camera, blocks, per_row, stage.within)


def expected_pixel(
    planes: Planes, size: tuple[int, int], row: int, column: int, stage: MarchStage, transparent: bool
) -> tuple[float, ...] | None:
    """Return r, g, b, opacity and depth of a pixel in float64; None if it is to be marched."""
    width, height = size
    four = []
    for down, right in stage.neighbours:
        y, x = row + int(down), column + int(right)
        if not (0 <= y < height and 0 <= x < width):
            return None
        four.append(y * width + x)
    a = [float(planes.opacity[i]) for i in four]
    t = [float(planes.depth[i]) for i in four]
    colours = [[float(c) * (a[n] if transparent else 1) for c in planes.rgb[i]] for n, i in enumerate(four)]
    allowed: Agreement = stage.agreement
    if max(a) - min(a) > allowed.opacity:
        return None
    if max(a) > allowed.opacity and max(t) - min(t) > allowed.depth * min(t):
        return None
    if any(max(channel) - min(channel) > allowed.colour for channel in zip(*colours, strict=True)):
        return None
    mean = [sum(channel) / 4 for channel in zip(*colours, strict=True)]
    opacity = sum(a) / 4
    if transparent:
        mean = [channel / opacity if opacity else 0 for channel in mean]
    return *mean, opacity, sum(t) / 4 if min(t) > 0 else 0.0


@pytest.mark.parametrize("contracted", [False, True])
@pytest.mark.parametrize("quality", QUALITIES)
def test_every_pixel_is_found_once_and_from_earlier_ones(quality: Quality, contracted: bool) -> None:
    found = np.full((3 * BLOCK, 3 * BLOCK), -1)
    for number, stage in enumerate(usual_stages(quality, contracted)):
        rows, columns = (
            (axis[:, None] + BLOCK * np.arange(3)).reshape(len(axis), 3) for axis in stage.within.T
        )
        for row, column in zip(rows, columns, strict=True):
            for y, x in itertools.product(row, column):
                assert found[y, x] == -1
                found[y, x] = number
    assert (found >= 0).all()
    for number, stage in enumerate(usual_stages(quality, contracted)):
        for row, column in stage.within + BLOCK:
            assert all(found[row + down, column + right] < number for down, right in stage.neighbours)


@pytest.mark.parametrize(
    "function",
    [
        pytest.param(interpolate, id="numpy"),
        pytest.param(compiled.interpolate, id="numba", marks=pytest.mark.extra),
    ],
)
@pytest.mark.parametrize("transparent", [False, True], ids=["background", "transparent"])
@pytest.mark.parametrize("size", [(1, 1), (2, 1), (7, 9), (33, 18)], ids=str)
def test_means_are_those_of_a_loop(function, transparent: bool, size: tuple[int, int]) -> None:  # type: ignore[no-untyped-def]
    random = np.random.default_rng(3)
    kept = filled = 0
    for stage in [
        stage for quality in LOSSY for kind in (False, True) for stage in usual_stages(quality, kind)
    ]:
        planes = random_planes(size[0] * size[1], random)
        before = Planes(*(plane.copy() for plane in planes))
        pixels = all_pixels(*size, stage)
        rest = set(function(planes, size, pixels, stage, transparent).tolist())
        for i, (row, column) in enumerate(zip(pixels.rows.tolist(), pixels.columns.tolist(), strict=True)):
            expected = (
                expected_pixel(before, size, row, column, stage, transparent)
                if len(stage.neighbours)
                else None
            )
            at = row * size[0] + column
            assert (i in rest) == (expected is None), (row, column)
            if expected is None:
                assert all(np.array_equal(a[at], b[at]) for a, b in zip(planes, before, strict=True))
                kept += 1
            else:
                got = [*planes.rgb[at], planes.opacity[at], planes.depth[at]]
                MEANS.check(got, expected, of=np.abs(expected))
                filled += 1
    assert kept > 0 and (filled > 20 or size[0] * size[1] < 70)


@pytest.mark.extra
@pytest.mark.parametrize("transparent", [False, True])
def test_compiled_code_gives_the_same_bits(transparent: bool) -> None:
    for seed in range(5):
        for stage in (*usual_stages("fast"), *usual_stages("fast", contracted=True)):
            both = []
            for function in (interpolate, compiled.interpolate):
                planes = random_planes(40 * 30, np.random.default_rng(seed))
                rest = function(planes, (40, 30), all_pixels(40, 30, stage), stage, transparent)
                both.append([rest, *planes])
            TWINS.holds([a.tobytes() == b.tobytes() for a, b in zip(*both, strict=True)])


def render(asset: Asset, camera: Camera, quality: Quality, march: str = "numpy", **settings: object) -> Frame:
    with Renderer(asset, 2, march) as renderer:  # type: ignore[arg-type]
        return renderer.render(camera, quality=quality, **settings)  # type: ignore[arg-type]


def render_all(
    asset: Asset, camera: Camera, quality: Quality, march: str = "numpy", **settings: object
) -> Frame:
    """Render the picture of a quality with every pixel marched."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("player.render.stages", lambda *_: stages(0.0))
        return render(asset, camera, quality, march, **settings)


@pytest.fixture(scope="module")
def camera(asset: Asset) -> Camera:
    return read_cameras(asset.path("cameras.json"))[0].resized(201, 157)


@pytest.mark.parametrize("march", MARCHES)
@pytest.mark.parametrize("quality", LOSSY)
@pytest.mark.parametrize(
    "settings",
    [{}, {"background": "transparent"}, {"n_fetches": 1}],
    ids=["usual", "transparent", "one fetch"],
)
def test_marched_pixels_are_those_of_the_whole_picture(
    march: str, quality: Quality, settings: dict, asset: Asset, camera: Camera
) -> None:
    exact, whole = (
        render(asset, camera, "exact", march, **settings),
        render_all(asset, camera, quality, march, **settings),
    )
    other = render(asset, camera, quality, march, **settings)
    marched = other.n_density_samples > 0
    assert 0.05 < marched.mean() < (exact.n_density_samples > 0).mean()
    first = usual_stages(quality)[0].within
    step = np.sort(first[first[:, 0] == 0, 1])[1]
    lattice = np.zeros(exact.opacity.shape, bool)
    lattice[::step, ::step] = True
    same = marched | lattice
    for name in ("rgb", "opacity", "depth", "n_density_samples"):
        MARCHED.holds(getattr(other, name)[same].tobytes() == getattr(whole, name)[same].tobytes())
    MEAN_OPACITY.check(np.abs(other.opacity - exact.opacity).mean())
    a, b = (
        frame.rgb * (frame.opacity[..., None] if settings.get("background") else 1)
        for frame in (exact, other)
    )
    (HIGH if quality == "high" else FAST).check(np.sqrt(np.mean((a - b) ** 2)))


def with_fetches(asset: Asset, fetches: tuple[int, int] | None) -> Asset:
    """Return the asset with `fetches` per ray in `high` and `fast` pictures, whose pixels are all marched."""
    changed = Asset.open(asset.folder)
    manifest = replace(asset.manifest, agreement=(0.0, 0.0), quality_fetches=fetches)
    object.__setattr__(changed, "manifest", manifest)
    return changed


@pytest.mark.parametrize("march", MARCHES)
@pytest.mark.parametrize(
    "quality, fetches, asked, expected",
    [("fast", (3, 2), None, 2), ("high", (3, 2), None, 3), ("high", (3, 2), 1, 1), ("fast", (3, 2), 0, 2)],
)
def test_rays_fetch_no_more_than_the_quality_has(
    march: str, quality: Quality, fetches: tuple[int, int], asked: int | None, expected: int, asset: Asset,
    camera: Camera,
) -> None:  # fmt: skip
    got = render(with_fetches(asset, fetches), camera, quality, march, n_fetches=asked)
    same = render_all(asset, camera, quality, march, n_fetches=expected)
    MARCHED.holds(got.rgb.tobytes() == same.rgb.tobytes())


@pytest.mark.parametrize("quality", LOSSY)
def test_a_quality_that_leaves_out_nothing_is_exact(quality: Quality, asset: Asset, camera: Camera) -> None:
    exact = render(asset, camera, "exact")
    for fetches in ((0, 0), None):
        got = render(with_fetches(asset, fetches), camera, quality)
        MARCHED.holds(got.rgb.tobytes() == exact.rgb.tobytes())


@pytest.mark.parametrize(
    ("share", "levels", "light"),
    [(2, 40, 0.1), (1, 40, 0.1), (0.75, 30, 0.075), (0.5, 20, 0.05), (0.25, 0, 0.025)],
)
def test_less_is_left_out_of_pictures_smaller_than_those_of_training(
    share: float, levels: float, light: float, asset: Asset, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Levels and the light that is left where rays end are in proportion to the size; below half of it, all
    pixels are marched."""
    given: list[tuple[float, float]] = []

    def noted(grid: SparseGrid, rays_o: np.ndarray, rays_d: np.ndarray, *rest: Any) -> MarchResult:
        given[-1] = given[-1][0], np.exp(-rest[-1])
        return march(grid, rays_o, rays_d, *rest)

    def found(levels: float, contracted: bool) -> tuple[MarchStage, ...]:
        given.append((levels, 0.0))
        return stages(levels, contracted)

    monkeypatch.setattr("player.march.march.march", noted)
    monkeypatch.setattr("player.render.stages", found)
    camera = read_cameras(asset.path("cameras.json"))[0]
    render(asset, camera.resized(int(48 * share), int(40 * share)), "fast")
    np.testing.assert_allclose(given, [(levels, light)], rtol=1e-6)


@pytest.mark.parametrize("quality", LOSSY)
def test_pictures_of_half_the_training_size_lose_less(quality: Quality, asset: Asset) -> None:
    """With the limits of the training size, their errors would be 0.8 to 1.2 times as large as there."""
    errors = []
    for share in (1, 0.5):
        camera = read_cameras(asset.path("cameras.json"))[0].scaled(share)
        exact, other = (render(asset, camera, of).rgb for of in ("exact", quality))
        errors.append(np.sqrt(np.mean((exact - other) ** 2)))
    assert 0 < errors[1] < 0.6 * errors[0]


@pytest.mark.parametrize("march", MARCHES)
@pytest.mark.parametrize("quality", LOSSY)
def test_threads_and_tasks_do_not_change_a_bit(
    march: str, quality: Quality, asset: Asset, camera: Camera, monkeypatch: pytest.MonkeyPatch
) -> None:
    frames = []
    for n_threads, blocks in ((1, 1000), (2, 7), (3, 1)):
        monkeypatch.setattr("player.render.TASK_BLOCKS", blocks)
        with Renderer(asset, n_threads, march) as renderer:  # type: ignore[arg-type]
            frames += [renderer.render(camera, quality=quality) for _ in range(2)]
    for frame in frames[1:]:
        for name in ("rgb", "opacity", "depth", "n_density_samples"):
            THREADS.holds(getattr(frame, name).tobytes() == getattr(frames[0], name).tobytes())


@pytest.mark.parametrize("quality", LOSSY)
@pytest.mark.parametrize("size", [(1, 1), (1, 9), (2, 2), (8, 8), (17, 3)])
def test_small_pictures(quality: Quality, size: tuple[int, int], asset: Asset, camera: Camera) -> None:
    width, height = size
    part = replace(camera, width=width, height=height, cx=width / 2, cy=height / 2)
    whole, other = (of(asset, part, quality) for of in (render_all, render))
    assert other.rgb.shape == whole.rgb.shape and np.isfinite(other.rgb).all()
    if min(size) == 1:  # no pixel has four neighbours
        LINE.holds(other.rgb.tobytes() == whole.rgb.tobytes())


@pytest.mark.parametrize("quality", LOSSY)
def test_nothing_is_marched_where_nothing_is(quality: Quality, asset: Asset, camera: Camera) -> None:
    from dataclasses import replace

    away = replace(camera, c2w=camera.c2w @ np.diag([-1.0, 1, -1, 1]))
    frame = render(asset, away, quality, background=(0.0, 1.0, 0.5))
    assert (frame.to_uint8() == [0, 255, 128]).all() and not frame.opacity.any() and not frame.depth.any()


@pytest.mark.parametrize("quality", LOSSY)
def test_layers_are_those_of_the_pixels_that_were_marched(
    quality: Quality, asset: Asset, camera: Camera
) -> None:
    whole, other = (of(asset, camera, quality, layers=True) for of in (render_all, render))
    assert whole.features is not None and other.features is not None
    marched = other.n_density_samples > 0
    assert other.features[marched].tobytes() == whole.features[marched].tobytes()
    assert not other.features[~marched].any()
    assert other.normals.tobytes() == whole.normals.tobytes()


@pytest.fixture(scope="module")
def wires(tmp_path_factory: pytest.TempPathFactory) -> Asset:
    """Write an asset of an upright and a level straight wire, a cell wide to each side, in an empty box."""
    axis = np.arange(RESOLUTION + 1)
    x, y, z = np.meshgrid(axis, axis, axis, indexing="ij")
    near = [np.maximum(abs(a - 32), abs(y - 32)) for a in (x, z)]
    vertices = np.stack([x, y, z], axis=-1)[np.minimum(*near) <= 1]
    coords, masks, order = pack_vertices(vertices)
    vertices = vertices[order]
    middle = np.minimum(*(np.maximum(abs(vertices[:, a] - 32), abs(vertices[:, 1] - 32)) for a in (0, 2)))
    codes = encode_density(np.where(middle == 0, 6.0, -2.0), DENSITY_RANGE)
    features = np.full((len(vertices), 4), 50, np.int8)
    manifest = Manifest(
        generator="tests", resolution=RESOLUTION, feature_resolution=RESOLUTION, step=STEP,
        density_range=DENSITY_RANGE, n_channels=4, view_size=(48, 40), background=(1.0, 1.0, 1.0),
    )  # fmt: skip
    folder = tmp_path_factory.mktemp("wires") / "asset"
    arrays = arrays_of((coords, masks, codes), (coords, masks, features), (RESOLUTION, RESOLUTION))
    write_asset(folder, manifest, arrays, head_bytes(), b"ply\n", cameras_bytes())
    return Asset.open(folder)


@pytest.mark.parametrize("quality", LOSSY)
@pytest.mark.parametrize("at", [(33, 33), (35, 37), (39, 35), (37, 39)])
def test_a_wire_between_the_pixels_of_the_lattice_does_not_vanish(
    quality: Quality, at: tuple[int, int], wires: Asset
) -> None:
    """A wire on one odd row and one odd column alone, between the lattice's pixels, does not vanish."""
    row, column = at
    c2w = np.array([[1.0, 0, 0, 0], [0, 0, -1, -100], [0, 1, 0, 0], [0, 0, 0, 1]])  # along y, z is up
    camera = Camera("wire", c2w, 80, 80, 1600.0, 1600.0, column + 0.5, row + 0.5)
    exact, other = (render(wires, camera, of) for of in ("exact", quality))
    seen = exact.opacity > 0.5
    assert seen[row].mean() > 0.3 and seen[:, column].mean() > 0.3
    assert not np.delete(np.delete(seen, row, axis=0), column, axis=1).any()
    for wire, found in ((seen[row], other.opacity[row]), (seen[:, column], other.opacity[:, column])):
        places = np.flatnonzero(wire)
        pieces = [found[first : first + BLOCK] for first in places[: 1 - BLOCK]]
        assert len(pieces) > 8
        WIRE.holds([piece.max() > 0.5 for piece in pieces])
