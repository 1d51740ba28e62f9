"""`model.pt`: what goes in comes out, and nothing but a model gets in."""

from __future__ import annotations

import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from player.cameras.camera import Camera
from player.errors import FormatError, VersionError
from vfr_bake.config import FieldConfig
from vfr_bake.field.field import VfrField
from vfr_bake.rendering.occupancy import OccupancyGrid
from vfr_bake.rendering.proposals import ProposalSampler
from vfr_bake.rendering.render import render_image
from vfr_bake.training.model_file import Model, load_model, save_model

CONFIG = FieldConfig(n_levels=2, base_resolution=4, max_resolution=8, log2_table_size=10, head_width=8)


@pytest.fixture
def model() -> Model:
    torch.manual_seed(0)
    occupancy = OccupancyGrid(16, step=0.01, seed=0)
    occupancy.set_occupied(np.random.default_rng(0).random((16, 16, 16)) < 0.5)
    world = np.diag([2.0, 2, 2, 1])
    world[:3, 3] = 1, 2, 3
    camera = Camera("./train/r_0", np.eye(4), 8, 6, 9.0, 9.0, 4.0, 3.0)
    return Model(VfrField(CONFIG), occupancy, world, [camera], True, {"steps": 3}, {"test_psnr": 30.0})


@pytest.fixture
def saved(model: Model, tmp_path: Path) -> Path:
    save_model(tmp_path / "model.pt", model)
    return tmp_path / "model.pt"


def change(path: Path, **values: object) -> None:
    torch.save(torch.load(path, weights_only=True) | values, path)


def sampler(**values: object) -> dict:
    whole = {"step": 0.01, "occupied": torch.zeros(512, dtype=torch.uint8), "resolution": 16}
    return whole | values


def test_round_trip(model: Model, saved: Path) -> None:
    again = load_model(saved)
    for name, tensor in model.field.state_dict().items():
        assert torch.equal(tensor, again.field.state_dict()[name])
    assert np.array_equal(model.occupancy.occupied, again.occupancy.occupied)
    assert np.array_equal(model.world_from_model, again.world_from_model)
    assert [c.name for c in again.cameras] == ["./train/r_0"] and again.cameras[0].fx == 9
    assert (again.train, again.figures, again.occupancy.step) == ({"steps": 3}, {"test_psnr": 30.0}, 0.01)


def test_what_lies_behind_surroundings_is_their_mean_colour(model: Model) -> None:
    """Every ray of an unbounded field meets something; here a fog, each of whose directions has a colour."""
    field = VfrField(replace(CONFIG, unbounded=True, density_width=0))
    with torch.no_grad():
        field.grid.table.fill_(1.0)
        field.density.out.bias.fill_(8.0)
        for layer in (field.head.spatial[0], field.head.spatial[1], field.head.directional[0]):
            layer.weight.mul_(3)
    camera = Camera("a", np.eye(4), 48, 24, 12.0, 12.0, 24.0, 12.0)
    surroundings = replace(
        model, field=field, sampler=ProposalSampler(0.1), world_from_model=np.eye(4), cameras=[camera] * 40,
        has_alpha=False,
    )  # fmt: skip
    picture = render_image(field, surroundings.sampler, camera, np.ones(3))
    assert np.ptp(picture, axis=(0, 1)).max() > 0.01 and np.ptp(picture.mean(axis=(0, 1))) > 0.01
    np.testing.assert_allclose(surroundings.background, picture.mean(axis=(0, 1)), atol=0.01)
    assert replace(surroundings, has_alpha=True).background.tolist() == [1, 1, 1]
    assert model.background.tolist() == [1, 1, 1]


@pytest.mark.parametrize("content", [b"", b"not a model", pickle.dumps({"format": "vfr-model"})])
def test_other_files_are_refused_in_one_line(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "model.pt").write_bytes(content)
    with pytest.raises(FormatError, match=r"model\.pt: not a model file") as caught:
        load_model(tmp_path / "model.pt")
    assert "\n" not in str(caught.value)


def test_loading_runs_no_code(tmp_path: Path) -> None:
    class Evil:
        def __reduce__(self) -> tuple:
            return (Path.touch, (tmp_path / "touched",))

    torch.save({"format": "vfr-model", "state": Evil()}, tmp_path / "model.pt")
    with pytest.raises(FormatError):
        load_model(tmp_path / "model.pt")
    assert not (tmp_path / "touched").exists()


def test_missing_file(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="no such file: expected a model file written by vfr-train"):
        load_model(tmp_path / "none.pt")


@pytest.mark.parametrize("share", [0.1, 0.5, 0.99])
def test_cut_short(saved: Path, share: float) -> None:
    data = saved.read_bytes()
    saved.write_bytes(data[: int(len(data) * share)])
    with pytest.raises(FormatError, match="cut short"):
        load_model(saved)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"version": [3, 0]}, "expected 2.x, got 3.0: update vfr-bake"),
        ({"version": [1, 0]}, "expected 2.x, got 1.0: train again"),
        ({"version": "1"}, "version: expected two integers"),
        ({"sampler": {}}, "sampler: step: expected float"),
        ({"sampler": sampler(step=float("nan"))}, "step: expected a number"),
        ({"field": {"n_levels": 2}}, "expected the settings"),
        ({"sampler": sampler(occupied=torch.zeros(3, dtype=torch.uint8))}, "occupied: expected 4096 bits"),
        ({"sampler": sampler(resolution=10**6)}, "resolution: expected 8 to 512"),
        ({"world_from_model": torch.zeros(3, 3)}, "world_from_model: expected 4 x 4"),
        ({"cameras": "{}"}, "cameras: frames"),
        ({"state": {}}, "the tensors do not fit"),
    ],
)
def test_a_broken_key_is_named(saved: Path, values: dict, message: str) -> None:
    change(saved, **values)
    with pytest.raises(VersionError if "2.x" in message else FormatError, match=message):
        load_model(saved)


def test_nan_in_the_weights_is_named(saved: Path) -> None:
    state = torch.load(saved, weights_only=True)["state"]
    state["grid.table"][5] = float("nan")
    change(saved, state=state)
    with pytest.raises(FormatError, match=r"grid\.table: expected finite numbers"):
        load_model(saved)
