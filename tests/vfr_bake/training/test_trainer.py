"""Training: it learns the built-in scene, ends when told, repeats itself, and survives bad steps."""

from __future__ import annotations

import copy
import itertools
import math
import weakref
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from torch import distributed

from player.errors import ConfigError, FormatError, TrainingError
from vfr_bake.config import FieldOptions, SceneKind, TrainConfig
from vfr_bake.data.demo import demo_capture, demo_scene
from vfr_bake.data.scene import Scene, build_scene
from vfr_bake.data.store import stored
from vfr_bake.data.store.capture import PosedImages
from vfr_bake.data.store.stored import StoreLayout, in_order, map_pictures, write_picture
from vfr_bake.data.store.working import WorkingSize
from vfr_bake.evaluation import render_views, training_psnr
from vfr_bake.field.hash_grid import Backend
from vfr_bake.training.checkpoint import load_checkpoint, save_checkpoint
from vfr_bake.training.gradients import CERTAIN, chosen_rays, scale_near_gradients
from vfr_bake.training.model_file import trained_model
from vfr_bake.training.optimiser import DENSITY_DECAY
from vfr_bake.training.processes import Processes
from vfr_bake.training.rays import Batch, PixelSampler, RayBatch
from vfr_bake.training.scores.metrics import decibels
from vfr_bake.training.trainer import Trainer

FIELD = FieldOptions(n_levels=8, max_resolution=64, log2_table_size=14, head_width=32, density_width=16)


def config(**changes: object) -> TrainConfig:
    settings = {
        "device": "cpu",
        "steps": 220,
        "minutes": 60.0,
        "batch_samples": 8192,
        "occupancy_resolution": 32,
        "pilot_steps": 60,
    }
    return TrainConfig(**({"field": FIELD} | settings | changes))  # type: ignore[arg-type]


def psnr_of_views(trainer: Trainer, scene: Scene, views: PosedImages) -> list[float]:
    """Return the PSNR of each of the views in dB."""
    return [view.score().psnr for view in render_views(trained_model(trainer, scene, {}), views)]


@pytest.fixture(scope="module")
def scene() -> Scene:
    return demo_scene(size=48, n_train=20, n_test=3)


def test_it_learns_the_scene(scene: Scene) -> None:
    trainer = Trainer(scene, config())
    before = np.mean(psnr_of_views(trainer, scene, scene.test))
    reports = list(trainer.run())
    after = np.mean(psnr_of_views(trainer, scene, scene.test))
    assert len(reports) == 220 and trainer.n_bad_steps == 0
    assert after > before + 6 and after > 18


def test_same_seed_same_field(scene: Scene) -> None:
    tables = []
    for _ in range(2):
        trainer = Trainer(scene, config(steps=25, pilot_steps=10))
        for _ in trainer.run():
            pass
        tables.append(trainer.field.grid.table.detach().clone())
    assert torch.equal(*tables)


def test_the_head_multiplies_as_the_processor_does_best(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    for kind in (torch.bfloat16, torch.float32):
        monkeypatch.setattr("vfr_bake.training.trainer.fast_products", lambda kind=kind: kind)
        head = Trainer(scene, config(steps=1)).field.head
        assert head.products == kind and all(p.dtype == torch.float32 for p in head.parameters())


@pytest.mark.parametrize("unbounded", [False, True])
def test_densities_of_captures_do_not_steepen_without_end(
    scene: Scene, unbounded: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A decay holds back the density network's matrices in captures alone. A thousand times the usual decay
    is used, because its effect shows in a few steps."""
    sizes = []
    for decay in (0.0, 1000 * DENSITY_DECAY):
        monkeypatch.setattr("vfr_bake.training.trainer.DENSITY_DECAY", decay)
        trainer = Trainer(replace(scene, unbounded=unbounded), config(steps=30, pilot_steps=0))
        assert all(report.loss == report.loss for report in trainer.run())
        sizes.append([float(matrix.detach().norm()) for matrix in trainer.field.density.matrices()])
    assert sizes[0]
    for free, held in zip(*sizes, strict=True):
        assert held < 0.9 * free if unbounded else held == free


def test_the_minutes_end_it(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """The minutes end a training, by a clock that moves on by a second whenever it is read."""
    clock = itertools.count()
    monkeypatch.setattr("vfr_bake.training.trainer.time", SimpleNamespace(monotonic=lambda: next(clock)))
    reports = list(Trainer(scene, config(steps=10**6, minutes=0.5, batch_samples=1024)).run())
    # The clock is read at the beginning, and before and after each step: step 15 ends after 30 seconds.
    assert [report.seconds for report in reports] == list(range(2, 31, 2))
    assert [report.progress for report in reports] == [second / 30 for second in range(1, 30, 2)]


@pytest.mark.parametrize(("given", "taken"), [(None, 10), (30, 30)])
def test_the_pilot_leaves_a_short_training_to_the_head(scene: Scene, given: int | None, taken: int) -> None:
    """It learns in a quarter of the training at most, unless its steps were asked for."""
    trainer = Trainer(scene, config(steps=40, pilot_steps=given, batch_samples=1024))
    assert [trainer.head_learns for _ in trainer.run()] == [False] * taken + [True] * (40 - taken)


def test_minutes_leave_out_compiling_and_pauses(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """The first step compiles for 20 seconds, and the machine sleeps for an hour after the third."""
    now = 0.0
    monkeypatch.setattr("vfr_bake.training.trainer.time", SimpleNamespace(monotonic=lambda: now))
    trainer = Trainer(scene, config(steps=10**6, minutes=0.1, batch_samples=1024))
    step_of, seconds = trainer._step, {0: 20.0}

    def timed(step: int, progress: float) -> tuple[float, int, int]:
        nonlocal now
        now += seconds.get(step, 0.25)
        return step_of(step, progress)

    monkeypatch.setattr(trainer, "_step", timed)
    reports = []
    for report in trainer.run():
        reports.append(report)
        now += 3600 if report.step == 2 else 0
    assert [report.seconds for report in reports[1:3]] == [0.5, 0.75]
    assert reports[3].seconds == 5.75 and reports[-1].seconds == 6.0, "the hour counts five seconds"


def test_a_step_without_a_finite_loss_changes_nothing_and_many_stop(scene: Scene) -> None:
    trainer = Trainer(scene, config())
    with torch.no_grad():
        trainer.field.head.out.bias.fill_(math.nan)
        for parameter in trainer.pilot.parameters():
            parameter.fill_(math.nan)
    before = trainer.field.grid.table.detach().clone()
    with pytest.raises(TrainingError, match="not a finite number for 20 steps: lower --network-rate"):
        list(trainer.run())
    assert trainer.n_bad_steps == 20
    assert torch.equal(before, trainer.field.grid.table)


def test_pictures_without_alpha_train_over_their_own_background(scene: Scene) -> None:
    opaque = [image | np.array([0, 0, 0, 255], np.uint8) for image in scene.train.images]
    views = type(scene.train)(scene.train.cameras, opaque)
    photographs = Scene(scene.name, views, scene.test, False, scene.world_from_model)
    trainer = Trainer(photographs, config(steps=5))
    batch = trainer._draw(500)
    assert (batch.rgba[:, 3] == 1).all() and (batch.background == 1).all()
    assert all(report.loss == report.loss for report in trainer.run()) and trainer.next_step == 5
    grey = Trainer(replace(photographs, background=(0.25, 0.5, 0.75)), config(steps=5))._draw(500)
    assert (grey.background == torch.tensor([0.25, 0.5, 0.75])).all()
    for other in (scene, replace(photographs, unbounded=True)):  # else a thin fog would be as good as a wall
        background = Trainer(other, config(steps=5))._draw(500).background
        assert 0 <= background.min() < 0.05 and 0.95 < background.max() < 1
        assert (background.std(dim=1) > 0.01).float().mean() > 0.9, "each ray has a colour of its own"


def unbounded(scene_size: int = 32) -> Scene:
    """Return the built-in scene in contracted space. Its alpha is learned from, which teaches more in a few
    steps than surroundings do."""
    scene = build_scene(demo_capture(size=scene_size, n_train=12, n_test=2), "unbounded")
    return replace(scene, has_alpha=True, masked=False)


@pytest.mark.parametrize(("kind", "distance"), [("object", 1.0), ("unbounded", 0.7), ("unbounded", 0.0)])
def test_only_in_scenes_what_is_near_learns_slowly(
    kind: str, distance: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[float] = []

    def spy(features: torch.Tensor, t_mid: torch.Tensor, distance: float) -> torch.Tensor:
        assert len(features) == len(t_mid)
        seen.append(distance)
        return scale_near_gradients(features, t_mid, distance)

    monkeypatch.setattr("vfr_bake.training.trainer.scale_near_gradients", spy)
    scene = demo_scene(size=32, n_train=12, n_test=2) if kind == "object" else unbounded()
    settings = {"steps": 2, "pilot_steps": 1, "batch_rays": 64, "batch_samples": 2048}
    list(Trainer(scene, config(**settings, near_gradients=distance)).run())
    assert seen == ([0.7, 0.7] if distance == 0.7 else [])


def on_disk(scene: Scene, path: Path) -> Scene:
    """Return the scene with its training pictures on the disk, in ten chunks, each used for a few steps."""
    images = scene.train.images
    layout = StoreLayout.of((image.shape[1], image.shape[0]) for image in images)
    assert len(layout.chunks) == 11
    with path.open("wb") as file:
        for number, image in enumerate(images):
            write_picture(file, layout, number, in_order(image, 4))
    return replace(scene, train=PosedImages(scene.train.cameras, map_pictures(path, layout, 4, frozenset())))


@pytest.mark.parametrize("kind", ["object", "unbounded", "on disk"])
def test_a_run_that_was_interrupted_ends_where_the_whole_one_ends(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A resumed run ends, to the last bit, where the whole run ends: the checkpoint holds all it needs."""
    monkeypatch.setattr(stored, "PIXELS_OF_A_PIECE", 100)
    scene = unbounded() if kind == "unbounded" else demo_scene(size=32, n_train=12, n_test=2)
    if kind == "on disk":
        scene = on_disk(scene, tmp_path / "pixels.bin")
    settings = {"steps": 40, "pilot_steps": 10, "batch_rays": 64, "batch_samples": 2048}
    whole = Trainer(scene, config(**settings))
    losses = [report.loss for report in whole.run()]
    broken = Trainer(scene, config(**settings))
    for report in broken.run():
        if report.step == 17:
            save_checkpoint(tmp_path / "c", broken)
        if report.step == 20:
            break  # killed: what came after the checkpoint is lost
    again = Trainer(scene, config(**settings))
    load_checkpoint(tmp_path / "c", again)
    assert [report.loss for report in again.run()] == losses[18:]
    for name, tensor in whole.field.state_dict().items():
        assert torch.equal(tensor, again.field.state_dict()[name]), name


@pytest.mark.parametrize("backend", ["numba", "torch"])
@pytest.mark.parametrize("kind", ["object", "unbounded", "downscale", "opaque"])
def test_no_step_learns_from_a_witness(kind: str, backend: Backend, monkeypatch: pytest.MonkeyPatch) -> None:
    """No step learns from a witness: pixels' colours are their numbers, and drawn ones are checked."""
    capture = demo_capture(size=48, n_train=20, n_test=2)
    unbounded_kind: SceneKind = "unbounded" if kind == "unbounded" else "object"
    if kind == "downscale":
        size = WorkingSize(downscale=2)
        capture = replace(capture, train=size.of(capture.train), test=size.of(capture.test))
    scene = build_scene(capture, unbounded_kind)
    side = scene.train.images[0].shape[0]
    numbers = np.arange(20 * side * side).reshape(20, side, side)
    alpha = np.full_like(numbers, 255 if kind == "opaque" else 200)
    images = np.stack([numbers % 256, numbers // 256 % 256, numbers // 65536, alpha], axis=-1)
    train = type(scene.train)(scene.train.cameras, list(images.astype(np.uint8)))
    trainer = Trainer(
        replace(scene, train=train, has_alpha=kind != "opaque", masked=False),
        config(steps=12, pilot_steps=6, batch_rays=256, batch_samples=4096),
        backend=backend,
    )
    drawn: list[np.ndarray] = []
    draw = trainer._pixels.draw

    def spy(n_rays: int) -> RayBatch:
        batch = draw(n_rays)
        rgb = (batch.rgba[:, :3] * 255).round().long().numpy()
        drawn.append(rgb @ np.array([1, 256, 65536]))
        return batch

    monkeypatch.setattr(trainer._pixels, "draw", spy)
    for _ in trainer.run():
        pass
    found = np.concatenate(drawn)
    # One batch more is drawn if the next step's batch is drawn during the last step.
    assert len(drawn) in (12, 13) and len(found) > 300
    witnesses = trainer.witnesses
    kept = witnesses.views() * side * side + witnesses.pixels
    assert len(kept) > side * side and not np.isin(found, kept).any()
    assert witnesses.whole.tolist() == [10] and not (found // side**2 == 10).any()


def test_a_run_goes_on_with_the_witnesses_that_it_began_with(
    scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A resumed run keeps its first witnesses, even if this version would choose others: pixels that were
    learned from cannot be witnesses any more."""
    trainer = Trainer(scene, config(steps=3))
    save_checkpoint(tmp_path / "c", trainer)
    monkeypatch.setattr("vfr_bake.data.witnesses.SEED", 21)
    again = Trainer(scene, config(steps=9))
    assert not np.array_equal(trainer.witnesses.pixels, again.witnesses.pixels)
    load_checkpoint(tmp_path / "c", again)
    assert np.array_equal(trainer.witnesses.pixels, again.witnesses.pixels)
    drawn = [each._draw(3000).rgba for each in (trainer, again)]
    assert torch.equal(*drawn)
    model = trained_model(again, scene, {})
    assert model.witnesses is again.witnesses and len(model.model_cameras()) == 19


def test_pixels_for_a_bake_are_those_that_training_learns_from(scene: Scene) -> None:
    """Pixels kept for a bake are learned from: no witnesses, nothing that moves, nothing masked."""
    trainer = Trainer(scene, config(steps=3))
    learned, every = trainer.witnesses.learned(), trainer.training_pixels()
    assert (every.counts[learned] > 0).all() and not every.counts[trainer.witnesses.whole].any()
    trainer.effects.moving_on = True
    trainer.effects._left_out = trainer.effects._left_out.clone()
    n_rows = trainer.effects._left_out.shape[1]
    trainer.effects._left_out[5, n_rows // 2] = True  # cells across the middle of the sixth picture
    camera, still = scene.train.cameras[learned[5]], trainer.training_pixels()
    row_of_cells = (every.pixels // camera.width + 0.5) * n_rows // camera.height
    moves = (every.views() == learned[5]) & (row_of_cells == n_rows // 2)
    assert moves.any() and np.array_equal(still.pixels, every.pixels[~moves])
    masked = Trainer(replace(scene, masked=True), config(steps=3)).training_pixels()
    opaque = every.rgba[:, 3] == 255
    assert 0 < len(masked.pixels) < len(every.pixels) and (masked.rgba[:, 3] == 255).all()
    assert len(masked.pixels) >= opaque.sum(), "witnesses that are masked are none"


def test_each_process_goes_on_with_its_own_share(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """The first of two processes writes the checkpoint that both restore."""
    monkeypatch.setattr(distributed, "all_reduce", lambda *_: None)
    two = [Trainer(scene, config(steps=9, pilot_steps=1), Processes(rank, 2)) for rank in range(2)]
    next(steps := two[0].run())
    assert next(steps).step == 1 and two[0]._next is not None
    state = two[0].state()
    served = []
    for trainer in two:
        trainer.restore(copy.deepcopy(state))

        def spy(batch: Batch, *rest: Any, error: Any = trainer._error) -> Any:
            served.append(batch.rays_d)
            return error(batch, *rest)

        monkeypatch.setattr(trainer, "_error", spy)
        next(trainer.run())
    assert not torch.equal(*served)


def test_the_error_of_a_training_is_that_of_whole_pictures(scene: Scene) -> None:
    """It is neither that of the pixels that steps draw, most of which show detail, nor that of the pixels for
    a bake, all of which are near the object."""
    trainer = Trainer(scene, config(steps=120, pilot_steps=20))
    for _ in trainer.run():
        pass
    model = trained_model(trainer, scene, {})
    learned = render_views(model, scene.train, trainer.witnesses.learned())
    whole = decibels(float(np.mean([(view.rgb - view.photograph) ** 2 for view in learned])))
    found = training_psnr(model, trainer.training_pixels(10_000, everywhere=True))
    assert found == pytest.approx(whole, abs=0.3)
    near = training_psnr(model, trainer.training_pixels())
    assert near is not None and near < whole - 1


def test_a_restored_training_holds_its_pictures_once(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    trainer = Trainer(scene, config(steps=3))
    before = weakref.ref(trainer._pixels)

    def made(*given: Any) -> PixelSampler:
        assert before() is None
        return PixelSampler(*given)

    monkeypatch.setattr("vfr_bake.training.trainer.PixelSampler", made)
    trainer.restore(trainer.state())
    assert trainer._pixels.position


def test_a_checkpoint_of_another_run_is_refused(scene: Scene, tmp_path: Path) -> None:
    trainer = Trainer(scene, config(steps=3))
    save_checkpoint(tmp_path / "c", trainer)
    load_checkpoint(tmp_path / "c", Trainer(scene, config(steps=9, eval_views=1)))  # a longer run may go on
    with pytest.raises(ConfigError, match=r"seed: expected 0 as in the interrupted run, got 1"):
        load_checkpoint(tmp_path / "c", Trainer(scene, config(seed=1)))
    cameras = scene.train.cameras
    moved = cameras[0].c2w.copy()
    moved[0, 3] += 0.01
    for changes in ({"name": "another"}, {"c2w": moved}, {"fx": cameras[0].fx + 0.1}):
        views = PosedImages([replace(cameras[0], **changes), *cameras[1:]], scene.train.images)
        with pytest.raises(ConfigError, match="pictures: expected those of the interrupted run"):
            load_checkpoint(tmp_path / "c", Trainer(replace(scene, train=views), config(steps=3)))
    whole = (tmp_path / "c").read_bytes()
    for content in (b"", b"no", whole[: len(whole) // 2]):
        (tmp_path / "c").write_bytes(content)
        with pytest.raises(FormatError, match="not a checkpoint"):
            load_checkpoint(tmp_path / "c", trainer)


def test_a_checkpoint_of_another_background_is_refused(scene: Scene, tmp_path: Path) -> None:
    """Versions before 1.7 trained objects over white, and go on if that is still the background."""
    over_black = replace(scene, background=(0.0, 0.0, 0.0))
    save_checkpoint(tmp_path / "c", Trainer(over_black, config(steps=3)))
    load_checkpoint(tmp_path / "c", Trainer(replace(scene, background=(1 / 255, 0.0, 0.0)), config(steps=3)))
    expected = r"background: expected rgb\(0, 0, 0\) as in the interrupted run, got rgb\(255, 255, 255\)"
    with pytest.raises(ConfigError, match=expected):
        load_checkpoint(tmp_path / "c", Trainer(scene, config(steps=3)))
    content = torch.load(tmp_path / "c", weights_only=True)
    del content["background"]
    torch.save(content | {"version": [1, 6]}, tmp_path / "c")
    load_checkpoint(tmp_path / "c", Trainer(scene, config(steps=3)))
    with pytest.raises(ConfigError, match=r"background: expected rgb\(255, 255, 255\)"):
        load_checkpoint(tmp_path / "c", Trainer(over_black, config(steps=3)))


def test_colours_can_be_composited_instead(scene: Scene) -> None:
    """Composited colours (equation 2, the paper's baseline) learn the same scene, without a pilot."""
    colour = config(steps=150, field=FieldOptions(**vars(FIELD) | {"compositing": "colour"}))
    trainer = Trainer(scene, colour)
    before = [parameter.detach().clone() for parameter in trainer.pilot.parameters()]
    for _ in trainer.run():
        pass
    assert np.mean(psnr_of_views(trainer, scene, scene.test)) > 17
    assert all(torch.equal(a, b) for a, b in zip(before, trainer.pilot.parameters(), strict=True))


def test_an_unbounded_scene_is_learnt() -> None:
    """Three seeds gain 8.5 dB and more on learned views, and 4.4 dB and more on test views. More steps gain
    less on test views: the scene has few views."""
    scene = unbounded(48)
    trainer = Trainer(scene, config(steps=150, pilot_steps=60, batch_rays=128))

    def psnr() -> list[float]:
        return [float(np.mean(psnr_of_views(trainer, scene, views))) for views in (scene.train, scene.test)]

    before = psnr()
    reports = list(trainer.run())
    learned, test = np.subtract(psnr(), before)
    assert trainer.n_bad_steps == 0 and len(reports) == 150
    assert learned > 7 and test > 4


def test_a_gradient_that_is_not_finite_changes_nothing(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    trainer = Trainer(scene, config(steps=4, pilot_steps=0))
    before = {name: tensor.clone() for name, tensor in trainer.field.state_dict().items()}
    forward = trainer.field.head.forward
    monkeypatch.setattr(trainer.field.head, "forward", lambda f, d: Poison.apply(forward(f, d)))
    reports = list(trainer.run())
    assert trainer.n_bad_steps == 4 and all(math.isnan(report.loss) for report in reports)
    for name, tensor in trainer.field.state_dict().items():
        assert torch.equal(tensor, before[name]), name
    assert not trainer.field.grid.pending


class Poison(torch.autograd.Function):
    @staticmethod
    def forward(ctx, x: torch.Tensor) -> torch.Tensor:
        return x.clone()

    @staticmethod
    def backward(ctx, *grads: torch.Tensor) -> torch.Tensor:
        return grads[0] * math.nan


def test_rays_are_left_out_by_chance_and_sums_stay_the_same_in_the_mean() -> None:
    torch.manual_seed(0)
    squares = torch.tensor([4.0, 1.0, 1e-2, 1e-4, 1e-6, 0.0])
    weights = torch.stack([chosen_rays(squares, chances) for chances in torch.rand(20_000, 6)])
    kept = (weights > 0).float().mean(dim=0)
    least = CERTAIN * squares.mean().sqrt()
    expected = (squares.sqrt() / least).clamp(max=1)
    torch.testing.assert_close(kept, expected, rtol=0, atol=0.02)  # five standard deviations of 20,000 draws
    assert kept[0] == 1 and kept[-1] == 0
    # The rarest of these rays is kept some 440 times, so that its mean is known to a twentieth of itself.
    torch.testing.assert_close(weights.mean(dim=0)[:4], torch.ones(4), rtol=0, atol=0.25)


def test_the_choice_of_rays_hides_no_bad_step() -> None:
    squares = torch.tensor([1.0, math.nan])
    assert torch.isnan((squares * chosen_rays(squares, torch.zeros(2))).sum())
    assert not chosen_rays(torch.zeros(3), torch.zeros(3)).any()
    assert chosen_rays(torch.zeros(0), torch.zeros(0)).shape == (0,)
