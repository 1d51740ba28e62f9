"""Time and memory: limits that a bake keeps to, and what it expects beforehand."""

from __future__ import annotations

import gc
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from exporters.head.onnx_head import head_onnx
from player.asset.asset import Asset
from player.cameras.camera import Camera
from player.cameras.transforms import write_cameras
from player.errors import ConfigError, TrainingError
from player.kept_code import is_kept
from player.page.gpu_memory import TILE, gpu_bytes
from player.progress import silent
from tests.exporters.meshes import read_ply
from tests.vfr_bake.baking.conftest import SMALL
from vfr_bake.baking.bake import _Bake, bake
from vfr_bake.baking.cells import FLOORS, Resolutions
from vfr_bake.baking.grids import Layout
from vfr_bake.baking.head import fold_head, small_head
from vfr_bake.baking.limits import RESERVE, file_sizes, keep_to_time
from vfr_bake.baking.mesh import bake_mesh
from vfr_bake.baking.plan import (
    AT_K_COST,
    CHOSEN_COST,
    COMPILE_SECONDS,
    CULLING_BYTES,
    FASTER,
    FEW_DRAWN,
    FEWEST_MANIFEST_BYTES,
    FEWEST_RAYS,
    HEAD_COST,
    MOST_TIMED,
    N_RAYS,
    OWN_HEAD,
    OWN_REST_COST,
    PROGRAM_BYTES,
    RAY_BYTES,
    RAYS_OF_CELL,
    RAYS_OF_DRAW,
    REFINED_SHARE,
    STEP_COST,
    UNBOUNDED_RAYS,
    VERTEX_COST,
    expected_seconds,
    is_compiled,
    make_plan,
)
from vfr_bake.baking.refinement import BATCH, HEAD_BATCH, HEAD_SHARE, Stored, Tuning
from vfr_bake.config import LEAST_MEMORY, BakeConfig
from vfr_bake.kernels import SOURCES
from vfr_bake.presets import PRESETS, Preset
from vfr_bake.training.length.witness_loss import Loss
from vfr_bake.training.model_file import Model

REFINED = SMALL | {"refine_steps": 1}


@dataclass(frozen=True)
class Baked:
    """A small asset that was baked with a step of refinement."""

    folder: Path
    held_before: list[str]
    """Types of the refined values and layouts that were there before the bake."""
    held_by_mesh: list[str]
    """Types of those that were there when the mesh was made."""


@pytest.fixture(scope="module")
def baked(model: Model, tmp_path_factory: pytest.TempPathFactory) -> Baked:
    def held() -> list[str]:
        return [type(o).__name__ for o in gc.get_objects() if type(o) in (Stored, Layout)]

    def mesh(*arguments: Any) -> Any:
        result.held_by_mesh.extend(held())
        return bake_mesh(*arguments)

    gc.collect()
    result = Baked(tmp_path_factory.mktemp("budgets") / "asset", held(), [])
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("vfr_bake.baking.bake.bake_mesh", mesh)
        bake(model, result.folder, BakeConfig(**REFINED), silent)
    return result


@pytest.fixture(autouse=True)
def _compiled(monkeypatch: pytest.MonkeyPatch) -> None:
    """Take compiled code as present, so that the expected time does not depend on earlier runs."""
    monkeypatch.setattr("vfr_bake.baking.plan.is_compiled", lambda: True)


def took(width: int, k: int) -> float:
    """Return the ms of a machine that takes 1 ms for each unit of head width, and 10 ms a lookup."""
    return (width or 256) + 10 * (k or 40)


def test_the_head_gives_before_the_lookups_do() -> None:
    balanced = replace(PRESETS["balanced"], n_fetches=8)
    assert keep_to_time(balanced, 1000, took, False, False) == balanced
    fewer = keep_to_time(balanced, 120, took, False, False)
    assert (fewer.head_width, fewer.n_fetches) == (64, 4)
    narrow = keep_to_time(balanced, 70, took, False, False)
    assert (narrow.head_width, narrow.n_fetches) == (48, 1)
    own = replace(balanced, head_width=0, n_fetches=0)
    assert keep_to_time(own, 1000, took, False, False) == own
    assert keep_to_time(own, 400, took, False, False).n_fetches == 8


def test_what_was_asked_for_by_number_stays() -> None:
    balanced = replace(PRESETS["balanced"], n_fetches=8)
    same_k = keep_to_time(balanced, 140, took, False, True)
    assert (same_k.head_width, same_k.n_fetches) == (32, 8)
    same_head = keep_to_time(balanced, 120, took, True, False)
    assert (same_head.head_width, same_head.n_fetches) == (64, 4)
    with pytest.raises(TrainingError, match=r"at most 70 ms, got 74 ms .* nothing was written"):
        keep_to_time(balanced, 70, took, True, False)


def test_a_frame_that_takes_too_long_is_an_error_and_writes_nothing(
    model: Model, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(TrainingError, match=r"800 x 800 in at most 0\.001 ms, got"):
        bake(model, tmp_path / "asset", BakeConfig(target_ms=0.001, **SMALL), silent)
    # The files are measured again, so that what takes longer than before refinement is refused as well.
    times = iter([1.0, 1.0, 9.0])
    monkeypatch.setattr("vfr_bake.baking.bake.frame_ms", lambda *_: next(times))
    with pytest.raises(TrainingError, match=r"bake: time: expected at most 5 ms, got 9\.00 ms"):
        bake(model, tmp_path / "asset", BakeConfig(target_ms=5, **SMALL), silent)
    assert list(tmp_path.iterdir()) == []


def test_grids_and_steps_become_coarser_where_frames_take_too_long(
    model: Model, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A machine takes a millisecond for each cell along an axis, whatever the head. The first coarser grids
    reach the time that was asked for."""
    config = BakeConfig(mesh_resolution=16, refine_steps=0, check_views=1)
    fine = make_plan(model, config).resolutions.densities
    monkeypatch.setattr("vfr_bake.baking.bake.frame_ms", lambda asset, *_: float(asset.manifest.resolution))
    monkeypatch.setattr("vfr_bake.baking.bake.COARSEST", 8)
    config = replace(config, target_ms=0.65 * fine / RESERVE)
    result = bake(model, tmp_path / "asset", config, silent)
    made = Asset.open(tmp_path / "asset").manifest
    assert made.resolution == int(FASTER * fine) and made.step == pytest.approx(model.occupancy.step / FASTER)
    assert [stage["name"] for stage in result.figures["stages"]].count("grid") == 1
    said = result.figures["left_out"]["resolution"]
    assert said.startswith(f"{made.resolution} cells along") and f"frames of {config.target_ms:g} ms" in said
    monkeypatch.setattr("vfr_bake.baking.bake.COARSEST", fine)
    with pytest.raises(TrainingError, match="with the fewest lookups and the smallest head"):
        bake(model, tmp_path / "other", config, silent)


@pytest.mark.parametrize("target_ms", [None, 50.0])
def test_a_head_that_was_timed_in_8_bits_keeps_them(
    target_ms: float | None, model: Model, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It keeps them however much they lose: in float32, frames would take longer than was asked for."""
    config = BakeConfig(target_ms=target_ms, **SMALL)
    work = _Bake(model, config, silent)
    layout, _ = work._cells()
    stored, teacher, again = work._store(layout, 20_000)
    monkeypatch.setattr(work.held_out, "lost", lambda before, after: Loss(9.0, 0.0))
    tuning = Tuning(config, work.choice, work.held_out, lambda *_: None, 60.0)
    tuning.run(stored, layout, teacher, again)
    assert (tuning.ranges is None) == (target_ms is None)


def test_time_that_is_left_changes_nothing(model: Model, baked: Baked, tmp_path: Path) -> None:
    bake(model, tmp_path / "b", BakeConfig(target_ms=1e6, **REFINED), silent)
    a, b = (Asset.open(folder).manifest for folder in (baked.folder, tmp_path / "b"))
    assert (a.n_fetches, a.files["head.onnx"].bytes) == (b.n_fetches, b.files["head.onnx"].bytes)


def test_a_size_that_cannot_be_met_is_refused_when_the_bake_is_planned(
    model: Model, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The cameras of the pictures, the head and the manifest take bytes that no choice of grids saves."""
    cameras = len(write_cameras(model.cameras))
    own = fold_head(model.field.head, np.zeros((model.field.head.width, 1)))
    eight_bits = [(0.0, 1.0)] * 5
    for config, head in (
        (BakeConfig(resolution=48, refine_steps=0), head_onnx(own, eight_bits)),
        (BakeConfig(resolution=48, refine_steps=0, head_bits=32), head_onnx(own)),
        (BakeConfig(resolution=48), head_onnx(small_head(own, 64, 3, 1, np.ones(1)), eight_bits)),
        (
            BakeConfig(resolution=48, target_ms=50),
            head_onnx(small_head(own, 16, 3, 1, np.ones(1)), eight_bits),
        ),
    ):
        least = cameras + len(head) + FEWEST_MANIFEST_BYTES
        with pytest.raises(TrainingError, match=r"bake: size: expected at most .* the head and the manifest"):
            make_plan(model, replace(config, max_mb=0.99 * least / 1e6))
        make_plan(model, replace(config, max_mb=1.01 * least / 1e6))
    many = replace(model, cameras=model.cameras * 200)
    with pytest.raises(TrainingError, match=r"expected at most 1 MB, got .* MB for \d+ cameras, the head"):
        make_plan(many, BakeConfig(max_mb=1))
    monkeypatch.setattr("vfr_bake.baking.plan._fixed_bytes", lambda model, config: 1_024_000)
    with pytest.raises(TrainingError, match=r"expected at most 1\.02 MB, got 1\.03 MB for"):
        make_plan(model, BakeConfig(max_mb=1.02))


@pytest.mark.usefixtures("planned_rays")
@pytest.mark.parametrize(
    ("machine", "memory"),
    [(1 << 29, 0.54), (3 << 29, 0.85), (2 << 30, 1.07), (4 << 30, 2.15), (64 << 30, 4.0)],
)
def test_a_bake_takes_half_of_a_small_machine_or_what_it_needs(
    machine: int, memory: float, model: Model, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("player.files.memory.available_bytes", lambda: machine)
    assert BakeConfig().memory == pytest.approx(memory, rel=0.01)
    if memory < LEAST_MEMORY:
        with pytest.raises(ConfigError, match=r"expected at least 0\.82 GB .* got 0\.537 GB"):
            make_plan(model, BakeConfig())
    else:
        for config in (BakeConfig(), BakeConfig(resolution=48)):
            assert make_plan(model, config).n_bytes <= 1e9 * config.memory
    assert BakeConfig(max_memory=8).memory == 8


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ({"check_views": 0}, "check_views: expected 1 to 1,000, got 0"),
        ({"check_views": 1001}, "check_views: expected 1 to 1,000, got 1001"),
        ({"no_cull": True, "weight_floor": 0.01}, "weight_floor: expected none with --no-cull"),
    ],
)
def test_settings_without_bound_or_effect_are_refused(given: dict[str, Any], expected: str) -> None:
    with pytest.raises(ConfigError, match=expected):
        BakeConfig(**given)


def test_less_memory_means_fewer_rays(model: Model) -> None:
    n_cells = N_RAYS / RAYS_OF_CELL
    of_cells = n_cells * make_plan(model, BakeConfig(resolution=48)).cell_bytes + PROGRAM_BYTES
    sizes = [of_cells / 1e9 + more for more in (0.05, 0.2, 2.0)]
    plans = [make_plan(model, BakeConfig(resolution=48, max_memory=size)) for size in sizes]
    rays = [plan.n_rays(n_cells) for plan in plans]
    assert rays[0] < rays[1] < rays[2] == N_RAYS
    assert plans[1].n_rays(1.2 * n_cells) < rays[1]  # more cells leave less room for rays
    assert all(plan.n_bytes <= size * 1e9 for plan, size in zip(plans, sizes, strict=True))


@pytest.mark.parametrize("unbounded", [False, True])
def test_as_many_cells_as_fit_leave_room_for_the_rays_that_teach_them(unbounded: bool, model: Model) -> None:
    enough = UNBOUNDED_RAYS if unbounded else N_RAYS
    plan = make_plan(model, BakeConfig(resolution=48))
    plan = replace(plan, unbounded=unbounded, cell_bytes=244.0, most_rays=enough)
    for gigabytes in (1.0, 3.2, 12.0):
        room = replace(plan, room=1e9 * gigabytes)
        assert room.n_rays(room.most_cells) >= min(0.299e9 * gigabytes / RAY_BYTES, 0.999 * enough)
        assert room.most_cells * room.cell_bytes > 0.69 * room.room


def test_fetches_of_training_rays_are_kept_in_memory_that_cells_and_rays_leave(model: Model) -> None:
    """Beside the rays, fetches have the part of the memory that cells do not take, or take only later."""
    plan = make_plan(model, BakeConfig(resolution=48))
    plan = replace(plan, cell_bytes=244.0, most_rays=N_RAYS, room=1e9)
    for n_cells in (1e4, 1e6, 4e6):
        rays = plan.n_rays(plan.n_cells) * RAY_BYTES  # an object's are made before its cells are known
        assert plan.kept_bytes(n_cells) == pytest.approx(1e9 - REFINED_SHARE * n_cells * 244 - rays, abs=1)
    assert plan.kept_bytes(1e8) == 0


@pytest.mark.usefixtures("planned_rays")
def test_a_small_scene_is_learned_from_fewer_rays(model: Model) -> None:
    plan = make_plan(model, BakeConfig(resolution=48))
    assert [plan.n_rays(n) for n in (1e3, 5e5, 3e6)] == [FEWEST_RAYS, 5e5 * RAYS_OF_CELL, N_RAYS]


def test_few_steps_are_given_no_more_rays_than_they_draw(model: Model) -> None:
    found = [make_plan(model, BakeConfig(resolution=48, refine_steps=n)).n_rays(3e6) for n in (0, 400, 3000)]
    assert found == [FEW_DRAWN, int(RAYS_OF_DRAW * 400 * BATCH), N_RAYS]


def test_what_was_refined_is_gone_when_the_mesh_is_made(baked: Baked) -> None:
    """What was refined is freed before the mesh is made: for lego it would take a gigabyte of the four."""
    assert len(baked.held_by_mesh) <= len(baked.held_before), baked.held_by_mesh


@pytest.mark.parametrize("preset", PRESETS)
def test_a_grid_that_memory_limits_is_not_refused(
    preset: Preset, model: Model, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A grid limited by memory is not refused. Memory limits the features' grid, whose resolution is rounded
    from that of the densities."""
    monkeypatch.setattr("vfr_bake.baking.plan.FEWEST_RAYS", 1)
    wanted = make_plan(model, BakeConfig(preset=preset)).resolutions
    for n_cells in np.linspace(10, wanted.features - 1, 80):
        gigabytes = (PROGRAM_BYTES + (CULLING_BYTES + len(FLOORS)) * n_cells**3) / 1e9
        plan = make_plan(model, BakeConfig(preset=preset, max_memory=gigabytes))
        assert plan.resolutions.features <= n_cells and plan.resolutions.densities < wanted.densities
        assert plan.wanted == wanted


def test_a_grid_that_the_plan_made_coarser_is_reported(model: Model) -> None:
    """Memory limits the plan of a bake, before anything is found that limits its grids."""
    work = _Bake(model, BakeConfig(check_views=1), silent)
    wanted = work.plan.resolutions
    work.plan = replace(work.plan, resolutions=Resolutions(40, 30))
    work._cells()
    assert work.left_out["resolution"].startswith("40 cells along an axis for densities, 30 for features")
    assert f"in place of {wanted.densities} and {wanted.features}: more do not" in work.left_out["resolution"]
    assert f"into {work.config.memory:.3g} GB of memory;" in work.left_out["resolution"]


def test_a_mesh_that_takes_too_much_memory_is_left_out(baked: Baked) -> None:
    asset = Asset.open(baked.folder)
    assert len(asset.arrays.densities.pyramid.levels) > 1
    found = bake_mesh(asset, 16, 100_000, 1e-6, silent)
    assert not len(found.mesh.faces) and "more than 1e-06 GB of memory" in (found.left_out or "")
    assert bake_mesh(asset, 16, 100_000, 1.0, silent).left_out is None


def test_without_refinement_the_head_stays_the_models_own() -> None:
    """Without refinement the model's own head is kept, as a smaller one would not have learned anything."""
    assert BakeConfig(refine_steps=0).choice().head_width == 0
    with pytest.raises(ConfigError, match="head_width: expected 0 with --refine-steps 0"):
        BakeConfig(refine_steps=0, head_width=32)


@pytest.mark.parametrize("steps", [0, 5000])
def test_the_expected_time_follows_from_that_of_the_models_own_rays(
    steps: int, model: Model, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The expected time is in proportion to the time of the teacher's second answer, by a clock that moves
    only while it answers. The first answer does not count, because it may wait for a compiler. The rays that
    are timed are not those that were read into the cache before."""

    def expected(*answers: float) -> float:
        left, now = list(answers), 0.0
        seeds = set()

        def answer(model: Model, views: object, n_rays: int, seed: int, progress: object) -> SimpleNamespace:
            nonlocal now
            now += left.pop(0)
            seeds.add(seed)
            return SimpleNamespace(opacity=np.ones(n_rays // 3))

        with monkeypatch.context() as patch:
            patch.setattr("vfr_bake.baking.plan.time", SimpleNamespace(perf_counter=lambda: now))
            patch.setattr("vfr_bake.baking.plan.render_teacher", answer)
            found = expected_seconds(model, config, plan)
        assert not left and len(seeds) == 2
        return found

    config = BakeConfig(**(SMALL | {"refine_steps": steps}))
    plan = make_plan(model, config)
    slow, once = expected(0.02, 0.02), expected(0.01, 0.01)
    assert expected(100.0, 0.01) == pytest.approx(once, rel=1e-9)
    assert slow == pytest.approx(2 * once, rel=1e-9) and once > 0


def test_what_is_chosen_of_many_vertices_is_expected_to_take_longer(
    model: Model, monkeypatch: pytest.MonkeyPatch
) -> None:
    """More vertices are expected to take longer to choose from, by a clock of 1 second a teacher's ray. A
    view has at most as many rays as pixels."""
    now = 0.0

    def answer(model: Model, views: list[Camera], n_rays: int, *_: object) -> SimpleNamespace:
        nonlocal now
        n_rendered = sum(min(n_rays // len(views), view.width * view.height) for view in views)
        now += n_rendered
        return SimpleNamespace(opacity=np.ones(n_rendered))

    monkeypatch.setattr("vfr_bake.baking.plan.time", SimpleNamespace(perf_counter=lambda: now))
    monkeypatch.setattr("vfr_bake.baking.plan.render_teacher", answer)
    config = BakeConfig(**SMALL)
    plan = replace(make_plan(model, config), room=1e12)
    few, many = (
        expected_seconds(model, config, replace(plan, n_cells=n * N_RAYS / RAYS_OF_CELL)) for n in (1, 2)
    )
    n_vertices = 2 * N_RAYS / RAYS_OF_CELL  # as many of densities as of features
    assert many - few == pytest.approx((VERTEX_COST[False] + CHOSEN_COST[False]) * n_vertices, rel=1e-6)
    one_step = replace(config, refine_steps=1)
    own = expected_seconds(model, replace(one_step, head_width=0), plan)
    small = expected_seconds(model, one_step, plan)
    rounds = (1 + AT_K_COST) * BATCH * STEP_COST[False]  # a step of each
    # a small head is also trained alone, before refinement
    steps = OWN_HEAD * rounds - (rounds + HEAD_SHARE * HEAD_BATCH * HEAD_COST[False])
    assert own - small == pytest.approx(OWN_REST_COST[False] + steps, rel=1e-6)


def test_few_views_are_timed_with_few_rays(model: Model, monkeypatch: pytest.MonkeyPatch) -> None:
    n_asked = []

    def answer(model: Model, views: list[Camera], n_rays: int, *_: object) -> SimpleNamespace:
        n_asked.append(n_rays // len(views))
        return SimpleNamespace(opacity=np.ones(1))

    monkeypatch.setattr("vfr_bake.baking.plan.render_teacher", answer)
    plan = replace(make_plan(model, BakeConfig(**SMALL)), room=1e12, n_cells=1e7, most_rays=N_RAYS)
    for n_views in (2, len(model.cameras)):
        few = replace(model, cameras=model.cameras[:n_views], witnesses=None, training_pixels=None)
        expected_seconds(few, BakeConfig(**SMALL), plan)
    assert n_asked[:2] == [MOST_TIMED] * 2 and N_RAYS // 10 > MOST_TIMED
    assert n_asked[2:] == [min(N_RAYS // (5 * len(model.cameras)), MOST_TIMED)] * 2


def test_the_first_bake_is_expected_to_compile(model: Model, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("vfr_bake.baking.plan.time", SimpleNamespace(perf_counter=lambda: 0.0))
    config = BakeConfig(**SMALL)
    plan = make_plan(model, config)
    assert expected_seconds(model, config, plan) == 0
    monkeypatch.setattr("vfr_bake.baking.plan.is_compiled", lambda: False)
    assert expected_seconds(model, config, plan) == COMPILE_SECONDS


@pytest.mark.usefixtures("baked")
def test_what_a_bake_compiles_is_kept() -> None:
    assert is_compiled() and not is_kept("no such kernel", *SOURCES)


def test_more_work_is_expected_to_take_longer(model: Model) -> None:
    def seconds(**settings: Any) -> float:
        config = BakeConfig(**(SMALL | settings))
        return expected_seconds(model, config, make_plan(model, config))

    # This is ten times the least difference in work; noise of the machine changes a rate by far less.
    assert seconds(refine_steps=1_000_000) > 10 * seconds()


@pytest.mark.needs("open3d")
def test_the_mesh_is_at_most_a_tenth_of_the_asset(model: Model, tmp_path: Path) -> None:
    settings = BakeConfig(resolution=96, mesh_resolution=0, refine_steps=0, check_views=1)
    result = bake(model, tmp_path / "asset", settings, silent)
    asset = Asset.open(tmp_path / "asset", verify=True)
    sizes = file_sizes(tmp_path / "asset")
    total = sum(sizes.values())
    assert 0.05 * total < sizes["mesh.ply"] <= 0.1 * total
    assert len(read_ply(tmp_path / "asset" / "mesh.ply").faces) == result.figures["mesh_faces"]
    assert asset.manifest.provenance["baked"]["mesh_faces"] == result.figures["mesh_faces"]
    assert asset.manifest.provenance["bake"]["max_memory"] == settings.memory, "not null, but what it was"
    assert result.seconds >= result.figures["time"]["mesh"] > 0


def test_a_grid_is_as_coarse_as_a_page_of_it_has_to_be(model: Model, monkeypatch: pytest.MonkeyPatch) -> None:
    """A grid is about as coarse as its page has to be; shells have more bricks for cells than fog has."""

    def page_mb_of(allowed: float) -> float:
        monkeypatch.setitem(PRESETS, "balanced", replace(PRESETS["balanced"], page_mb=allowed))
        work = _Bake(model, BakeConfig(check_views=1), silent)
        layout, _ = work._cells()
        said = f"a page that takes {allowed:g} MB" in work.left_out.get("resolution", "")
        assert said == (allowed < 512)
        assert work.plan.n_cells <= work.plan.page_cells
        n_channels = work.choice.n_channels
        codes = np.zeros(len(layout.densities)), np.zeros((len(layout.features), n_channels), np.int16)
        tile = TILE * TILE * (16 * -(-n_channels // 8) + 12)
        return (gpu_bytes(SimpleNamespace(grid=layout.grid(*codes))) - tile) / 1e6

    whole = page_mb_of(512)
    for share in (0.3, 0.15):
        assert page_mb_of(share * whole) < 1.25 * share * whole
    assert make_plan(model, BakeConfig(resolution=48)).page_cells == np.inf, "it was asked for"
