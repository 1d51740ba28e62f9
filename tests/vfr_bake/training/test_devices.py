"""Training with torch's kernels, as on a GPU, learns what numba's do; settings depend on the device."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from player.errors import ConfigError
from tests.vfr_bake.training.test_trainer import config, unbounded
from vfr_bake.config import FieldOptions, TrainConfig
from vfr_bake.data.demo import demo_scene
from vfr_bake.data.scene import Scene
from vfr_bake.evaluation import render_views
from vfr_bake.field.field import VfrField
from vfr_bake.field.hash_grid import Backend
from vfr_bake.field.networks import Pilot
from vfr_bake.rendering.occupancy import OccupancyGrid
from vfr_bake.training.checkpoint import load_checkpoint, save_checkpoint
from vfr_bake.training.model_file import load_model, save_model, trained_model
from vfr_bake.training.processes import Processes
from vfr_bake.training.trainer import Trainer, choose_device


def small_scene(kind: str) -> Scene:
    return demo_scene(size=32, n_train=12, n_test=2) if kind == "object" else unbounded()


def psnr(trainer: Trainer, scene: Scene) -> float:
    views = render_views(trained_model(trainer, scene, {}), scene.test)
    return float(np.mean([view.score().psnr for view in views]))


@pytest.mark.parametrize("kind", ["object", "unbounded"])
def test_torch_learns_what_numba_learns(kind: str, device: torch.device) -> None:
    scene = small_scene(kind)
    # Batches have room for the samples of all rays, because of those that do not fit, the two backends leave
    # out different ones. The learning rate is the same, although its default is another on a GPU.
    settings: dict[str, Any] = {"pilot_steps": 40, "batch_samples": 16384, "batch_rays": 48}
    settings["network_rate"] = 0.004
    settings |= {"steps": 150} if kind == "object" else {"steps": 120}
    ours = Trainer(scene, config(**settings | {"device": device.type}), backend="torch")
    expected = Trainer(scene, config(**settings))
    expected.field.head.products = torch.float32  # as torch has them, on any machine
    before = psnr(ours, scene)
    losses = [[report.loss for report in trainer.run()] for trainer in (ours, expected)]
    assert ours.n_bad_steps == 0 and len(losses[0]) == settings["steps"]
    if device.type == "cpu":
        # One generator: the same rays. Sums in another order, as of several threads, differ by 1e-5 in the
        # first steps and by a few per cent after ten.
        np.testing.assert_allclose(losses[0][:8], losses[1][:8], rtol=0.005)
    assert psnr(ours, scene) == pytest.approx(psnr(expected, scene), abs=1.0)
    assert psnr(ours, scene) > before + (3 if kind == "object" else 0.5)


@pytest.mark.parametrize("kind", ["object", "unbounded"])
def test_what_a_step_makes_is_made_beside_the_field(kind: str) -> None:
    """A step makes its tensors on the field's device; torch's default device may be another one."""
    settings = {"pilot_steps": 1, "batch_rays": 32, "batch_samples": 1024, "steps": 3}
    trainer = Trainer(small_scene(kind), config(**settings), backend="torch")
    with torch.device("meta"):
        reports = list(trainer.run())
    assert len(reports) == 3 and trainer.n_bad_steps == 0


def test_colours_can_be_composited_instead(device: torch.device) -> None:
    field = FieldOptions(**vars(config().field) | {"compositing": "colour"})
    settings = config(steps=5, batch_samples=1024, field=field, device=device.type)
    trainer = Trainer(small_scene("object"), settings, backend="torch")
    assert len(list(trainer.run())) == 5 and trainer.n_bad_steps == 0


@pytest.mark.parametrize("kind", ["object", "unbounded"])
def test_a_run_that_was_interrupted_goes_on(kind: str, device: torch.device, tmp_path: Path) -> None:
    scene = small_scene(kind)
    settings = {"steps": 24, "pilot_steps": 6, "batch_rays": 32, "batch_samples": 1024, "device": device.type}
    whole = Trainer(scene, config(**settings), backend="torch")
    losses = []
    for report in whole.run():
        losses.append(report.loss)
        if report.step == 11:
            save_checkpoint(tmp_path / "c", whole)
    again = Trainer(scene, config(**settings), backend="torch")
    load_checkpoint(tmp_path / "c", again)
    # A GPU adds up in no fixed order.
    tolerance = 0 if device.type == "cpu" else 1e-2
    np.testing.assert_allclose([report.loss for report in again.run()], losses[12:], rtol=tolerance)
    content = torch.load(tmp_path / "c", weights_only=True)  # without map_location: as saved
    assert {tensor.device.type for tensor in tensors(content)} == {"cpu"}


def tensors(content: object) -> list[torch.Tensor]:
    if isinstance(content, torch.Tensor):
        return [content]
    parts = content.values() if isinstance(content, dict) else content if isinstance(content, list) else []
    return [tensor for part in parts for tensor in tensors(part)]


def test_a_checkpoint_of_another_device_or_backend_is_refused(tmp_path: Path) -> None:
    scene = small_scene("object")
    trainer = Trainer(scene, config(steps=1))
    save_checkpoint(tmp_path / "c", trainer)
    content = torch.load(tmp_path / "c", weights_only=True)
    content["settings"]["device"] = "cuda"
    content["settings"]["batch_samples"] = 2**18
    torch.save(content, tmp_path / "c")
    with pytest.raises(ConfigError, match=r"device: expected cuda as in the interrupted run, got cpu"):
        load_checkpoint(tmp_path / "c", trainer)


@pytest.mark.parametrize("kind", ["object", "unbounded"])
def test_its_model_file_is_any_model_file(kind: str, device: torch.device, tmp_path: Path) -> None:
    scene = small_scene(kind)
    settings = config(steps=3, batch_rays=32, batch_samples=1024, device=device.type)
    trainer = Trainer(scene, settings, backend="torch")
    list(trainer.run())
    save_model(tmp_path / "model.pt", trained_model(trainer, scene, {}))
    loaded = load_model(tmp_path / "model.pt")
    for name, tensor in trainer.field.state_dict().items():
        assert torch.equal(tensor, loaded.field.state_dict()[name]), name
    assert loaded.train["device"] == device.type and loaded.train["batch_samples"] == 1024
    assert psnr(trainer, scene) == pytest.approx(
        np.mean([view.score().psnr for view in render_views(loaded, scene.test)]), abs=1e-6
    )


def test_a_gpu_is_taken_if_there_is_one_and_missed_if_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert choose_device("auto") == choose_device("cpu") == torch.device("cpu")
    with pytest.raises(ConfigError, match=r"device: expected a GPU .*, got none: pass --device cpu"):
        choose_device("cuda")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    assert choose_device("auto") == choose_device("cuda") == torch.device("cuda")
    assert choose_device("cpu") == torch.device("cpu")


# On Python 3.13.0 only, torch warns of a dictionary that it cannot watch. That costs time and nothing else.
@pytest.mark.filterwarnings("ignore:Guards may run slower on Python 3.13.0:RuntimeWarning")
@pytest.mark.parametrize("unbounded_field", [False, True])
def test_the_networks_are_one_graph_each(unbounded_field: bool, device: torch.device) -> None:
    """Each network compiles to one graph without a break, as on a GPU, with equal outputs and gradients."""
    options = FieldOptions(n_levels=4, max_resolution=64, log2_table_size=12, head_width=16)
    field = VfrField(options.resolved(unbounded_field)).to(device)
    torch._dynamo.reset()
    for network in (field.density.logits, field.head, Pilot(field.config).to(device)):
        graph = torch.compile(network, backend="aot_eager", fullgraph=True, dynamic=True)
        for n in (13, 50):
            features = torch.randn(n, field.config.n_channels, device=device, requires_grad=True)
            dirs = torch.nn.functional.normalize(torch.randn(n, 3, device=device), dim=-1)
            arguments = (features, dirs) if isinstance(network, torch.nn.Module) else (features,)
            results = [run(*arguments) for run in (network, graph)]
            gradients = [torch.autograd.grad(result.sum(), features)[0] for result in results]
            torch.testing.assert_close(results[1], results[0])
            torch.testing.assert_close(gradients[1], gradients[0], rtol=1e-4, atol=1e-5)


def test_several_processes_stay_on_the_cpu() -> None:
    with pytest.raises(ConfigError, match="device: several processes: expected cpu"):
        Trainer(small_scene("object"), config(), Processes(0, 2), backend="torch")


@pytest.mark.parametrize("backend", ["numba", "torch"])
def test_pictures_are_marched_with_steps_half_as_long_as_in_training(backend: Backend) -> None:
    trainer = Trainer(small_scene("object"), config(), backend=backend)
    training = 2 * trainer.config.step_cells / trainer.field.config.max_resolution
    _, samples = trainer._sampled(0)
    assert samples.deltas.numpy() == pytest.approx(training, rel=1e-6)
    sampler = trainer.sampler
    assert isinstance(sampler, OccupancyGrid)
    camera = trainer.cameras[0].resized(8, 8)
    in_pictures = sampler.sample_all(trainer.field, *camera.rays())
    assert in_pictures.deltas.numpy() == pytest.approx(training / 2, rel=1e-6)


def test_what_is_not_given_follows_from_the_device() -> None:
    cpu, gpu = (TrainConfig().for_device(device, False) for device in ("cpu", "cuda"))
    assert (cpu.steps, cpu.batch_rays, cpu.max_rays, cpu.network_rate) == (1_000_000, 512, 16_384, 4e-3)
    assert (gpu.steps, gpu.batch_samples, gpu.batch_rays) == (20_000, 2**18, 2**13)
    assert (gpu.network_rate, gpu.grid_rate) == (0.01, 0.01)
    assert TrainConfig().for_device("cuda", True).steps == 40_000
    assert TrainConfig(batch_rays=64).for_device("cuda", True).batch_rays == 64
    assert cpu.distortion == gpu.distortion > TrainConfig().for_device("cpu", True).distortion > 0
    assert TrainConfig(distortion=0.0).for_device("cuda", True).distortion == 0
    on_cpu, on_gpu = (FieldOptions().resolved(False, device) for device in ("cpu", "cuda"))
    assert (on_cpu.log2_table_size, on_cpu.head_width) == (20, 128)
    assert (on_gpu.log2_table_size, on_gpu.head_width) == (19, 256)
    assert FieldOptions(log2_table_size=15).resolved(False, "cuda").log2_table_size == 15
    assert FieldOptions().resolved(False) == FieldOptions().resolved(False, "cpu")
    best = FieldOptions().resolved(False, "cpu", "best")
    assert (best.log2_table_size, best.sh_degree) == (22, 7)
    assert FieldOptions().resolved(True, "cpu", "best") == FieldOptions().resolved(True, "cpu")
    assert FieldOptions().resolved(False, "cuda", "best") == on_gpu


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("steps", [0]),
        ("batch_samples", [3]),
        ("network_rate", [1.0]),
        ("device", ["tpu"]),
        ("seed", [-5, 2**63]),
        ("minutes", [0.0, 1e16, math.inf, math.nan]),
    ],
)
def test_settings_out_of_range_are_refused(name: str, values: list[object]) -> None:
    for value in values:
        with pytest.raises(ConfigError, match=f"{name}: expected"):
            TrainConfig(**{name: value})  # type: ignore[arg-type]


def test_architectures_out_of_range_are_refused_before_the_kind_of_scene_is_known() -> None:
    with pytest.raises(ConfigError, match="head_width: expected 4 to 1024, got 3"):
        TrainConfig(field=FieldOptions(head_width=3))
    finer = FieldOptions(base_resolution=1024)  # fits the finest level of an unbounded scene alone
    assert TrainConfig(field=finer).field == finer
    with pytest.raises(ConfigError, match="base_resolution: expected 2 to max_resolution"):
        TrainConfig(kind="object", field=finer)
