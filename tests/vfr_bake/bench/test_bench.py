"""`vfr-bench` on the analytic asset. The photographs are its own pictures, with all samples fetched."""

from __future__ import annotations

import json
import math
import re
import shutil
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest

from player.asset.asset import Asset, write_asset
from player.asset.bricks import pack_vertices
from player.asset.manifest import CONTRACTED_AABB, Manifest
from player.cameras.camera import Camera
from player.cameras.transforms import read_cameras, write_cameras
from player.errors import FormatError
from player.render import render
from tests.player.conftest import head_bytes
from tests.player.march.contracted_scene import RANGE, RESOLUTION, STEP, vertices_and_codes
from tests.vertex_grids import arrays_of
from vfr_bake.bench.commands import bake_command
from vfr_bake.bench.front import Point, beats, pareto_front, recommend
from vfr_bake.bench.process import Process
from vfr_bake.bench.result import MAX_PSNR
from vfr_bake.bench.timing import Dials, Times, lookup_slope, measure_times
from vfr_bake.bench.trade import Views, _read_views, _Run, describe
from vfr_bake.bench.worst import APART, worst_pixels
from vfr_bake.cli import bench_main
from vfr_bake.config import BakeConfig, BenchConfig, FieldConfig
from vfr_bake.field.field import VfrField
from vfr_bake.rendering.occupancy import OccupancyGrid
from vfr_bake.training.model_file import Model, load_model, save_model


@pytest.fixture(scope="module")
def model(shells_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A model file with an untrained field in the asset's frame."""
    asset = Asset.open(shells_folder)
    field = VfrField(FieldConfig(n_levels=2, max_resolution=16, log2_table_size=10, head_width=8))
    grid = OccupancyGrid(8, step=0.2, seed=0)
    grid.set_occupied(np.ones((8, 8, 8), bool))
    cameras = read_cameras(asset.path("cameras.json"))
    path = tmp_path_factory.mktemp("model") / "model.pt"
    save_model(path, Model(field, grid, asset.world_from_model, cameras, False, {}, {}))
    return path


QUICK = ["--frames", "2", "--sizes", "24x20", "--threads", "1"]


@pytest.fixture(scope="module")
def results(shells_folder: Path, data: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[dict, str]:
    out = tmp_path_factory.mktemp("results")
    arguments = [str(shells_folder), "--data", str(data), "--samples", "1", "2", "0", *QUICK]
    assert bench_main([*arguments, "--json", str(out / "t.json"), "--html", str(out / "t.html")]) == 0
    return json.loads((out / "t.json").read_text()), (out / "t.html").read_text()


def test_every_setting_has_its_figures(results: tuple[dict, str], shells_folder: Path) -> None:
    rows = results[0]["settings"]
    assert [row["n_fetches"] for row in rows] == [1, 2, 5, 0, 5, 5], "5 is the asset's own"
    assert [row["quality"] for row in rows] == ["exact"] * 4 + ["high", "fast"]
    n_bytes = sum(path.stat().st_size for path in shells_folder.iterdir())
    for row in rows:
        assert row["n_bytes"] == n_bytes
        assert row["what"]["resolution"] == 64 and row["what"]["n_channels"] == 4
        assert set(row["times"]) == {"48x40", "24x20"}
        for times in row["times"].values():
            low, high = times["quartiles"]
            assert times["frames"] == 2 and 0 < low <= times["median"] <= high <= times["p95"] + 1e-9
            parts = times["march"] + times["lookups"] + times["head"] + times["rest"]
            assert min(times["march"], times["lookups"], times["head"]) >= 0
            assert parts == pytest.approx((low + high) / 2, rel=1e-6), (
                "two frames: mean of all = of quartiles"
            )
        assert row["peak_mb"] > 20 and row["first_picture_ms"] > 10
        assert row["commands"][1].startswith(f"vfr-play {shells_folder} --samples {row['n_fetches']} ")


@pytest.mark.parametrize("contracted", [False, True], ids=["object", "unbounded"])
def test_the_command_that_bakes_again_names_what_was_chosen(contracted: bool, shells_folder: Path) -> None:
    """The command that bakes again names only settings that differ from the preset's own. The preset's number
    of refinement steps is another one for an unbounded scene than for an object."""
    asset = Asset.open(shells_folder)

    def command(config: BakeConfig) -> str:
        remembered = {"bake": asdict(config) | asdict(config.choice(contracted))}
        aabb = CONTRACTED_AABB if contracted else asset.manifest.aabb
        manifest = replace(asset.manifest, contracted=contracted, aabb=aabb, provenance=remembered)
        return bake_command("out", replace(asset, manifest=manifest))

    other = BakeConfig().choice(not contracted).refine_steps
    plain = "vfr-bake model.pt out --preset balanced"
    assert command(BakeConfig()) == command(BakeConfig(max_memory=4)) == plain
    assert command(BakeConfig(refine_steps=other, k=3)) == f"{plain} --refine-steps {other} --k 3"
    given = BakeConfig(feature_resolution=96, weight_floor=0.02, target_ms=50, max_memory=8)
    options = "--feature-resolution 96 --weight-floor 0.02 --target-ms 50 --max-memory 8"
    assert command(given) == f"{plain} {options}"


@pytest.mark.parametrize(
    "remembered",
    [
        [],
        "balanced",
        {"preset": []},
        {"preset": "balanced", "k": "many"},
        {"preset": "balanced", "max_mb": []},
    ],
)
def test_settings_that_no_bake_has_written(remembered: object, shells_folder: Path) -> None:
    """Recorded settings that no bake has written, which may have any form, give no command and no error."""
    asset = Asset.open(shells_folder)
    manifest = replace(asset.manifest, provenance={"bake": remembered})
    assert bake_command("out", replace(asset, manifest=manifest)) == ""
    assert describe(replace(asset, manifest=manifest))["n_fetches"] == manifest.n_fetches


def test_quality_is_that_of_the_pictures(results: tuple[dict, str]) -> None:
    """With every sample fetched nothing is lost, because the photographs are the asset's own pictures; with
    fewer fetches more is lost."""
    rows = {row["n_fetches"]: row["scores"] for row in results[0]["settings"] if row["quality"] == "exact"}
    assert rows[0]["psnr"] is None and rows[0]["ssim"] == 1 and rows[0]["loss_db"] == 0
    assert rows[1]["psnr"] < rows[2]["psnr"] < rows[5]["psnr"] < MAX_PSNR
    assert rows[1]["loss_db"] == pytest.approx(MAX_PSNR - rows[1]["psnr"])
    assert rows[1]["psnr_to_model"] is None and rows[1]["lpips"] is None


def test_the_page_shows_plots_and_pictures(results: tuple[dict, str], shells_folder: Path) -> None:
    document, page = results
    assert page.count("<svg") == 3 and page.count('src="data:image/png;base64,') == 1
    assert "http" not in page and document["recommendation"] in page.replace("&#x27;", "'")
    on_front = [row for row in document["settings"] if row["on_front"]]
    assert on_front and all(row["commands"][1] in page for row in [*on_front, *document["recommended"]])
    worst = document["worst_pixels"][str(shells_folder)]
    assert [pixel["error"] for pixel in worst] == sorted([p["error"] for p in worst], reverse=True)


def test_against_the_full_model(
    model: Path,
    data: Path,
    shells_folder: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("vfr_bake.bench.trade.N_FIRST_PICTURES", 1)
    arguments = [str(shells_folder), "--data", str(data), "--model", str(model), "--samples", "5", *QUICK]
    assert bench_main([*arguments, "--json", str(tmp_path / "t.json")]) == 0
    document = json.loads((tmp_path / "t.json").read_text())
    first, *rows = document["settings"]
    assert first["name"] == str(model) and first["scores"]["loss_db"] == 0
    assert first["n_bytes"] == model.stat().st_size and first["commands"] == [f"vfr-eval {model} {data}"]
    assert first["times"]["48x40"]["median"] > 0
    for row in rows:
        assert row["scores"]["psnr_to_model"] < 40
        assert row["scores"]["loss_db"] == pytest.approx(first["scores"]["psnr"] - row["scores"]["psnr"])
    title, *lines = capsys.readouterr().out.splitlines()
    end = lines.index(document["recommendation"])
    assert title.split() == ["setting", "PSNR", "loss", "SSIM", "ms", "p95", "MB"]
    assert sum(row["on_front"] for row in (first, *rows)) == end // 2
    assert re.search(r"k=5 +[\d.]+ +-[\d.]+ +[\d.]+ +\d+ ±\d+ +\d+ +[\d.]+$", lines[0])
    assert lines[1].strip().startswith("vfr-play ") and lines[end].startswith("For at most 0.1 dB below the")
    named = [line for one in document["recommended"] for line in (one["name"], "    " + one["commands"][1])]
    assert named and lines[end + 1 :] == named and all(name in lines[end] for name in named[::2])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--views", "0"], "views: expected at least 1, got 0"),
        (["--frames", "1"], "frames: expected at least 2, got 1"),
        (["--sizes", "0x5"], "sizes: expected WIDTHxHEIGHT, 1 to 1000000 each, such as 800x600, got '0x5'"),
        (["--samples", "-3"], "samples: expected 0 to 1024, got [-3]"),
        (["--threads", "0"], "threads: expected at least 1, got 0"),
    ],
)
def test_what_cannot_be_measured_is_refused(
    options: list[str], message: str, shells_folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert bench_main([str(shells_folder), "--data", "nowhere", *options]) == 1
    assert capsys.readouterr().err == f"vfr-bench: error: {message}\n"


def test_a_player_that_fails_says_why(shells_folder: Path, tmp_path: Path) -> None:
    broken = shutil.copytree(shells_folder, tmp_path / "broken")
    (broken / "head.onnx").write_bytes(b"")
    arguments = (str(broken), str(broken / "cameras.json"), "1", "0")
    with (
        Process("player", *arguments) as process,
        pytest.raises(Exception, match=r"head\.onnx: size: expected \d+ bytes, got 0"),
    ):
        process.ask(view=0, size=[8, 8], rgb=None, **Dials(1).request())


def test_a_model_of_another_world_is_refused(
    model: Path, data: Path, shells_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A camera of the data has the name of one of the model's, and another pose."""
    other = load_model(model)
    camera = other.cameras[0].transformed(np.diag([2.0, 2, 2, 1]))
    save_model(tmp_path / "m.pt", replace(other, cameras=[replace(camera, name="./train/photo_0")]))
    arguments = [str(shells_folder), "--data", str(data), "--model", str(tmp_path / "m.pt"), *QUICK]
    assert bench_main(arguments) == 1
    said = capsys.readouterr().err.splitlines()[-1]
    assert said.startswith(f"vfr-bench: error: {data}: cameras: expected those that {tmp_path / 'm.pt'} was")


def test_a_model_is_read_within_the_memory(model: Path, shells_folder: Path) -> None:
    with (
        Process("model", str(model), str(shells_folder / "cameras.json"), "1", "1e-6") as process,
        pytest.raises(Exception, match=r"model\.pt: .*memory"),
    ):
        process.ask(view=0, size=[8, 8], rgb=None)


@pytest.mark.parametrize(
    ("seconds", "n_views", "halves", "twice"), [(0, 1, 1, 1), (25, 2, 2, 2), (58, 5, 3, 5), (1e9, 5, 3, 3)]
)
def test_the_full_model_keeps_to_its_seconds(
    seconds: float, n_views: int, halves: int, twice: int, model: Path, tmp_path: Path, monkeypatch
) -> None:
    """A picture takes 10 s here, three at half the size 7.5 s and three at twice the size 120 s. Where there
    is no time, there are fewer views, and times of other sizes are scaled."""
    now, size = [0.0], (48, 40)

    class Slow:
        def __init__(self, *arguments: str) -> None:
            assert arguments == ("model", str(model), str(tmp_path / "cameras.json"), "1", "3")

        def __enter__(self) -> Slow:
            return self

        def __exit__(self, *_: object) -> None:
            pass

        def ask(self, view: int, size: tuple[int, int], rgb: str | None) -> dict:
            taken = 10 * size[0] * size[1] / (48 * 40) if tuple(size) != (32, 32) else 0.0
            now[0] += taken
            if rgb is not None:
                np.save(rgb, np.ones((size[1], size[0], 4), np.float32))
            return {"ms": 1000 * taken, "march_ms": 0.0, "head_ms": 0.0, "fetches": 0, "peak_mb": 1.0}

    monkeypatch.setattr("vfr_bake.bench.trade.time.monotonic", lambda: now[0])
    monkeypatch.setattr("vfr_bake.bench.trade.Process", Slow)
    config = BenchConfig(assets=(), data="", threads=1, max_memory=3)
    cameras = [Camera(f"{i}", np.eye(4), *size, 40.0, 40.0, 24.0, 20.0) for i in range(5)]
    photographs = [np.full((40, 48, 4), 128, np.uint8)] * 5
    run = _Run(tmp_path, Views(cameras, np.ones(3), photographs, False, False), config, None, lambda *_: None)
    sizes = [size, (24, 20), (96, 80)]
    setting, pictures, lines = run.model(model, sizes, "data", seconds)
    assert len(pictures) == n_views and run.views.cameras == cameras[:n_views]
    assert [setting.times[some].frames for some in sizes] == [n_views, halves, twice]
    assert [setting.times[some].median for some in sizes] == [10_000, 2_500, 40_000]
    assert len(lines) == (halves != 3) + (twice != 3)
    assert all(line.startswith("there was no time to render the full model at ") for line in lines)


def test_fewer_views_are_compared_where_there_is_no_time(
    shells_folder: Path, data: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("vfr_bake.bench.trade.N_FIRST_PICTURES", 1)
    arguments = [str(shells_folder), "--data", str(data), "--samples", "1", *QUICK, "--minutes", "1e-9"]
    assert bench_main([*arguments, "--json", "-"]) == 0
    said = capsys.readouterr()
    conditions = json.loads(said.out)["conditions"]
    assert len(conditions["views"]) == 1 and len(conditions["notes"]) == 1
    assert re.search(r"vfr-bench: compared 1 of \d test views, because there is no time for more ", said.err)


# --- the front ---


def test_the_front_is_what_nothing_beats() -> None:
    points = [
        Point("best", 31, 200, 1, 30),
        Point("fast", 29, 50, 1, 30),
        Point("small", 28, 60, 1, 10),
        Point("beaten", 28.9, 55, 1, 30),
    ]
    assert pareto_front(points) == [True, True, True, False]
    assert pareto_front([*points, Point("perfect", 40, 1, 0, 1)]) == [False] * 4 + [True]


def test_only_the_front_excludes_settings() -> None:
    """The second is as fast as the first, as far as can be told, and the third as fast as the second, but the
    third is clearly faster than the first."""
    points = [Point(str(ms), psnr, ms, 15, 5) for psnr, ms in ((34, 100), (33.9, 85), (33.8, 60))]
    assert pareto_front(points) == pareto_front(points[::-1])[::-1] == [True, False, True]
    assert pareto_front([replace(point, uncertainty=5) for point in points]) == [True] * 3


def test_noise_throws_nothing_out() -> None:
    steady, noisy = Point("a", 30, 100, 1, 10), Point("b", 30, 104, 8, 10)
    assert not beats(steady, noisy) and not beats(noisy, steady)
    assert beats(steady, replace(noisy, uncertainty=1.0))
    assert beats(replace(noisy, psnr=30.1), steady), "as fast as can be told, and better"


def test_what_nothing_reaches_is_said() -> None:
    sentence, named = recommend([only := Point("only", 28, 500, 1, 40)], 31, "the model")
    assert named == [only] and sentence.count("there is none, nearest is only (3.00 dB, 500 ms, 40 MB)") == 3


# --- times ---


def test_lookups_are_told_from_the_march() -> None:
    """The time of a fetch, 2 us here, is found although the views' marches take very different times."""
    random = np.random.default_rng(0)
    rounds = [
        {
            Dials(k): {"fetches": 1000 * k, "march_ms": base + 2 * k + random.normal(0, 0.1)}
            for k in (1, 2, 4, 8)
        }
        | {Dials(8, "fast"): {"fetches": 4, "march_ms": base / 9}}
        for base in random.uniform(10, 400, 40)
    ]
    assert lookup_slope(rounds) == pytest.approx(0.002, rel=0.02)
    assert lookup_slope([{Dials(5): {"fetches": 9, "march_ms": 3.0}}]) is None


def test_rounds_ask_everybody_in_turn() -> None:
    asked: list[tuple[str, int]] = []

    def player(name: str):
        def ask(*, samples: int, **_: object) -> dict:
            asked.append((name, samples))
            return {"ms": 10.0 * samples, "march_ms": 4.0, "head_ms": 3.0, "fetches": samples}

        return ask

    times = measure_times(
        [player("a"), player("b")],
        2,
        [(8, 8)],
        [[Dials(1), Dials(2)]] * 2,
        3,
        math.inf,
        lambda done, of: None,
    )
    assert len(asked) == 3 * 2 * (1 + 2), "one frame of each visit is not counted"
    for visits in (asked[i : i + 6] for i in (0, 6, 12)):
        assert sorted({name for name, _ in visits}) == ["a", "b"]
    assert times[0, Dials(2), (8, 8)] == Times(20.0, 20.0, (20.0, 20.0), 0.0, 3, 4.0, 0.0, 3.0, 13.0)
    assert times[1, Dials(1), (8, 8)].uncertainty == 0


@pytest.mark.parametrize(("until", "n_rounds"), [(-1.0, 2), (25.0, 2), (65.0, 6), (1e9, 8)])
def test_there_are_as_many_rounds_as_there_is_time_for(
    until: float, n_rounds: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A round of two sizes and two settings has six frames, of 1.75 s each here: 10.5 s."""
    now, told = [0.0], []
    monkeypatch.setattr("vfr_bake.bench.timing.time.monotonic", lambda: now[0])

    def ask(**_: object) -> dict:
        now[0] += 1.75
        return {"ms": 1.0, "march_ms": 1.0, "head_ms": 0.0, "fetches": 1}

    def progress(done: int, of: int) -> None:
        told.append((done, of))

    times = measure_times([ask], 1, [(8, 8), (4, 4)], [[Dials(1), Dials(2)]], 8, until, progress)
    assert {each.frames for each in times.values()} == {n_rounds}
    assert told[0] == (1, 16) and told[-1] == (2 * n_rounds, 2 * n_rounds)


# --- where the loss sits ---


def test_worst_pixels_are_those_that_were_spoiled(shells_folder: Path) -> None:
    asset = Asset.open(shells_folder)
    cameras = read_cameras(asset.path("cameras.json"))[:2]
    frames = [render(asset, camera, 5, march="numpy") for camera in cameras]
    wanted = [frame.rgb.copy() for frame in frames]
    wanted[1][20, 24] += 0.5
    wanted[1][21, 24] += 0.4  # next to the worst pixel: not counted again
    wanted[0][3, 2] += 0.25
    first, second, *_ = worst = worst_pixels(asset, cameras, wanted, [frame.rgb for frame in frames])
    assert (first.view, first.column, first.row) == (cameras[1].name, 24, 20)
    assert first.error == pytest.approx(0.5, abs=1e-6)
    assert (second.view, second.column, second.row) == (cameras[0].name, 2, 3)
    assert first.opacity == pytest.approx(frames[1].opacity[20, 24], abs=1e-6)
    assert first.n_density_samples <= frames[1].n_density_samples[20, 24]
    weights = [weight for _, weight in first.weights]
    assert weights == sorted(weights, reverse=True) and sum(weights) <= first.opacity + 1e-5
    t = [t for t, _ in first.weights]
    assert min(t) <= frames[1].depth[20, 24] <= max(t)
    inside = [pixel for pixel in worst if pixel.view == cameras[1].name]
    for a in inside:
        assert all(a is b or max(abs(a.column - b.column), abs(a.row - b.row)) >= APART for b in inside)


@pytest.fixture(scope="module")
def walls(tmp_path_factory: pytest.TempPathFactory) -> Asset:
    """An unbounded scene in closed form: a wall all around, 8 model units from the centre, with almost
    nothing in front of it. A model unit is 2 world units."""

    def log_sigma(points: np.ndarray) -> np.ndarray:
        return np.where(np.linalg.norm(points, axis=-1) > 8, 8.0, -12.0)

    def keep(points: np.ndarray) -> np.ndarray:
        return np.linalg.norm(points, axis=-1) < 40

    vertices, _, codes = vertices_and_codes(log_sigma, keep)
    coords, masks, _ = pack_vertices(vertices)
    features = np.concatenate([vertices * 4 - 96, np.full((len(vertices), 1), 50)], axis=-1).astype(np.int8)
    manifest = Manifest(
        generator="tests", resolution=RESOLUTION, feature_resolution=RESOLUTION, step=STEP, near=0.1,
        density_range=RANGE, n_channels=4, view_size=(24, 20), contracted=True, aabb=CONTRACTED_AABB,
        world_from_model=((2, 0, 0, 0), (0, 2, 0, 0), (0, 0, 2, 0), (0, 0, 0, 1)),
    )  # fmt: skip
    folder = tmp_path_factory.mktemp("assets") / "walls"
    arrays = arrays_of((coords, masks, codes), (coords, masks, features), (RESOLUTION, RESOLUTION))
    write_asset(folder, manifest, arrays, head_bytes(), b"ply\n", write_cameras([]))
    return Asset.open(folder)


def test_worst_pixels_of_an_unbounded_scene_see_beyond_the_box(walls: Asset) -> None:
    """A worst pixel's ray is the player's: as opaque as in the frame, with its largest weight at the wall."""
    camera = Camera("a", np.eye(4), 24, 20, 20.0, 20.0, 12.0, 10.0)
    frame = render(walls, camera, march="numpy")
    wanted = frame.rgb.copy()
    wanted[5, 7] += 0.5
    worst, *_ = worst_pixels(walls, [camera], [wanted], [frame.rgb])
    assert (worst.column, worst.row) == (7, 5)
    assert worst.opacity == pytest.approx(frame.opacity[5, 7], abs=1e-6) and worst.opacity > 0.9
    assert worst.n_density_samples == frame.n_density_samples[5, 7]
    heaviest, _ = worst.weights[0]
    # A cell is 1/12 wide in contracted space. At distance r a model unit has the length 1/r^2 there, so that
    # a cell at r = 8 is 64/12 model units deep.
    assert heaviest == pytest.approx(2 * 8, abs=2 * 64 / 12)
    assert min(t for t, _ in worst.weights) <= frame.depth[5, 7] <= max(t for t, _ in worst.weights)


@pytest.mark.parametrize("exposure", [True, False])
def test_exposure_is_fitted_on_left_halves_where_training_learned_it(
    exposure: bool, shells_folder: Path, data: Path
) -> None:
    """Exposure is fitted on the left halves of pictures if training learned exposure. Here the photographs
    are the played pictures with a gain and an offset."""
    asset = Asset.open(shells_folder)
    trained = {"trained": {"effects": {"exposure": exposure}}}
    asset = replace(asset, manifest=replace(asset.manifest, provenance=trained))
    views, _ = _read_views(BenchConfig(assets=(shells_folder,), data=str(data)), [asset], lambda *_: None)
    assert views.exposure is exposure and not views.masked
    pictures, photographs = [], []
    for camera in views.cameras:
        frame = render(asset, camera, n_fetches=0, march="numba")
        pictures.append(np.concatenate([frame.rgb, frame.opacity[..., None]], axis=-1))
        covered = frame.opacity[..., None]
        shown = 0.7 * (frame.rgb - (1 - covered) * views.background) + 0.05 * covered
        rgba = np.concatenate([shown / np.maximum(covered, 1e-6), covered], axis=-1)
        photographs.append((255 * rgba).round().clip(0, 255).astype(np.uint8))
    beside = replace(views, photographs=photographs).beside(pictures)
    assert [view.first_column for view in beside] == [24 if exposure else 0] * len(pictures)
    scores = [view.score().psnr for view in beside]
    assert min(scores) > 45 if exposure else max(scores) < 30


def test_masked_pixels_are_not_scored(shells_folder: Path) -> None:
    picture = np.full((20, 24, 4), 0.5, np.float32)
    picture[..., 3] = 1
    rgba = np.full((20, 24, 4), 128, np.uint8)
    rgba[:, :, 3] = 255
    rgba[5:, :, :] = 0
    cameras = read_cameras(Asset.open(shells_folder).path("cameras.json"))[:1]
    (masked,) = Views(cameras, np.ones(3, np.float32), [rgba], True, False).beside([picture])
    (shown,) = Views(cameras, np.ones(3, np.float32), [rgba], False, False).beside([picture])
    assert masked.score().psnr_float > 50 > 10 > shown.score().psnr_float
    assert masked.seen is not None and masked.seen.mean() == 0.25 and shown.seen is None


@pytest.mark.parametrize("remembered", [None, [], {"effects": []}, {"effects": {"exposure": "yes"}}])
def test_what_training_never_wrote_is_no_exposure(
    remembered: object, shells_folder: Path, data: Path
) -> None:
    asset = Asset.open(shells_folder)
    asset = replace(asset, manifest=replace(asset.manifest, provenance={"trained": remembered}))
    config = BenchConfig(assets=(shells_folder,), data=str(data))
    assert not _read_views(config, [asset], lambda *_: None)[0].exposure
    asset = replace(asset, manifest=replace(asset.manifest, provenance={"train": [remembered]}))
    with pytest.raises(FormatError, match="provenance: train: expected the settings of a training"):
        _read_views(config, [asset], lambda *_: None)
