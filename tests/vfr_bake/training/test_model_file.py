"""`model.pt`: a saved model is loaded unchanged, and anything but a model is refused."""

from __future__ import annotations

import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from player.cameras.camera import Camera
from player.errors import ConfigError, FormatError, VersionError
from vfr_bake.config import FieldConfig
from vfr_bake.data.view_pixels import ViewPixels
from vfr_bake.data.witnesses import N_WITNESSES, Witnesses
from vfr_bake.field.field import VfrField
from vfr_bake.rendering.occupancy import OccupancyGrid
from vfr_bake.rendering.proposals import FIRST_LAYOUTS, ProposalSampler
from vfr_bake.rendering.render import render_image
from vfr_bake.training.model_file import Model, load_model, save_model
from vfr_bake.training.pixel_tensors import pixel_content

CONFIG = FieldConfig(n_levels=2, base_resolution=4, max_resolution=8, log2_table_size=10, head_width=8)


@pytest.fixture
def model() -> Model:
    torch.manual_seed(0)
    occupancy = OccupancyGrid(16, step=0.01, seed=0)
    occupancy.set_occupied(np.random.default_rng(0).random((16, 16, 16)) < 0.5)
    world = np.diag([2.0, 2, 2, 1])
    world[:3, 3] = 1, 2, 3
    cameras = [Camera(f"./train/r_{i}", np.eye(4), 8, 6 + i, 9.0, 9.0, 4.0, 3.0 + i) for i in range(2)]
    figures = {"test_psnr": 30.0}
    return Model(VfrField(CONFIG), occupancy, world, cameras, True, {"steps": 3}, figures, some_witnesses())


def some_witnesses() -> Witnesses:
    rgba = np.arange(20, dtype=np.uint8).reshape(5, 4)
    parts = [2, 3], [0, 47, 0, 1, 55]
    counts, pixels = (np.array(part, np.int32) for part in parts)
    return Witnesses(counts, pixels, rgba, np.array([1], np.int32))


@pytest.fixture
def saved(model: Model, tmp_path: Path) -> Path:
    save_model(tmp_path / "model.pt", model)
    return tmp_path / "model.pt"


def change(path: Path, **values: object) -> None:
    torch.save(torch.load(path, weights_only=True) | values, path)


def sampler(**values: object) -> dict:
    whole = {"step": 0.01, "occupied": torch.zeros(512, dtype=torch.uint8), "resolution": 16}
    return whole | values


def witnesses(**values: object) -> dict:
    """Return the model's witnesses as tensors, some replaced; a list stands for 32-bit integers or floats."""
    whole = {"counts": [2, 3], "pixels": [0, 47, 0, 1, 55], "whole": [1]} | values
    tensors = {name: torch.tensor(value) for name, value in whole.items() if isinstance(value, list)}
    tensors = {name: value.int() if value.dtype == torch.int64 else value for name, value in tensors.items()}
    return {"rgba": torch.zeros(5, 4, dtype=torch.uint8)} | whole | tensors


def test_round_trip(model: Model, saved: Path) -> None:
    again = load_model(saved)
    for name, tensor in model.field.state_dict().items():
        assert torch.equal(tensor, again.field.state_dict()[name])
    assert np.array_equal(model.occupancy.occupied, again.occupancy.occupied)
    assert np.array_equal(model.world_from_model, again.world_from_model)
    assert [c.name for c in again.cameras] == ["./train/r_0", "./train/r_1"] and again.cameras[0].fx == 9
    assert again.witnesses is not None and model.witnesses is not None
    for name in ("counts", "pixels", "rgba", "whole"):
        one, other = getattr(model.witnesses, name), getattr(again.witnesses, name)
        assert np.array_equal(one, other) and one.dtype == other.dtype
    assert (again.train, again.figures, again.occupancy.step) == ({"steps": 3}, {"test_psnr": 30.0}, 0.01)


def test_a_model_of_before_there_were_witnesses_still_loads(saved: Path) -> None:
    content = torch.load(saved, weights_only=True)
    del content["witnesses"]
    torch.save(content | {"version": [2, 0]}, saved)
    again = load_model(saved)
    assert again.witnesses is None and len(again.model_cameras()) == 2
    with pytest.raises(ConfigError, match="witnesses: expected some, got none"):
        again.witness_rays()


def test_what_was_behind_an_object_comes_back(model: Model, saved: Path) -> None:
    """The background that an object was trained over is loaded as it was saved; it was white before version
    2.6."""
    save_model(saved, replace(model, object_background=(0.25, 0.5, 0.0)))
    assert load_model(saved).background.tolist() == [0.25, 0.5, 0.0]
    content = torch.load(saved, weights_only=True)
    del content["object_background"]
    torch.save(content | {"version": [2, 5]}, saved)
    assert load_model(saved).background.tolist() == [1, 1, 1]


def test_training_pixels_come_back(model: Model, saved: Path) -> None:
    """Training pixels are loaded as they were saved; a model from before there were any has none."""
    assert load_model(saved).training_pixels is None
    assert len(load_model(saved).training_pixel_rays()[2]) == 0
    pixels = model.witnesses
    assert pixels is not None
    kept = ViewPixels(pixels.counts, pixels.pixels, pixels.rgba)
    save_model(saved, replace(model, training_pixels=kept))
    again = load_model(saved)
    for name in ("counts", "pixels", "rgba"):
        one, other = getattr(kept, name), getattr(again.training_pixels, name)
        assert np.array_equal(one, other) and one.dtype == other.dtype
    for found, expected in zip(again.training_pixel_rays(), (*model.witness_rays(), kept.rgba), strict=True):
        np.testing.assert_array_equal(found, expected)


def test_as_many_witnesses_as_there_may_be_take_less_than_500_kb(model: Model, tmp_path: Path) -> None:
    camera = Camera("large", np.eye(4), 1000, 1000, 900.0, 900.0, 500.0, 500.0)
    counts, pixels = np.array([N_WITNESSES, 0], np.int32), np.arange(N_WITNESSES, dtype=np.int32)
    many = Witnesses(counts, pixels, np.zeros((N_WITNESSES, 4), np.uint8), np.zeros(0, np.int32))
    sizes = []
    for witnesses in (many, None):
        save_model(tmp_path / "m.pt", replace(model, cameras=[camera] * 2, witnesses=witnesses))
        assert (load_model(tmp_path / "m.pt").witnesses is None) == (witnesses is None)
        sizes.append((tmp_path / "m.pt").stat().st_size)
    assert 0 < sizes[0] - sizes[1] < 500_000
    content = torch.load(tmp_path / "m.pt", weights_only=True)
    more = {"pixels": torch.arange(N_WITNESSES + 1, dtype=torch.int32)}
    torch.save(content | {"witnesses": pixel_content(many) | more}, tmp_path / "m.pt")
    with pytest.raises(FormatError, match="pixels: expected at most 60,000, got 60,001"):
        load_model(tmp_path / "m.pt")


def test_rays_of_witnesses_are_those_of_their_pixels(model: Model) -> None:
    """Rays of witnesses are those of their pixels; cameras that were learned from are not of whole views."""
    rays = [camera.transformed(np.linalg.inv(model.world_from_model)).rays() for camera in model.cameras]
    views, pixels = [0, 0, 1, 1, 1], [0, 47, 0, 1, 55]
    for k, found in enumerate(model.witness_rays()):
        expected = [rays[view][k][pixel] for view, pixel in zip(views, pixels, strict=True)]
        np.testing.assert_allclose(found, expected, atol=1e-6)
    assert [camera.name for camera in model.model_cameras()] == ["./train/r_0"]


def test_what_lies_behind_surroundings_is_their_mean_colour(model: Model) -> None:
    """The background of an unbounded scene is its mean colour, as every ray meets something: here fog, with
    another colour in each direction."""
    field = VfrField(replace(CONFIG, unbounded=True, density_width=0))
    with torch.no_grad():
        field.grid.table.fill_(1.0)
        field.density.out.bias.fill_(8.0)
        for layer in (field.head.spatial[0], field.head.spatial[1], field.head.directional[0]):
            layer.weight.mul_(3)
    camera = Camera("a", np.eye(4), 48, 24, 12.0, 12.0, 24.0, 12.0)
    surroundings = replace(
        model, field=field, sampler=ProposalSampler(0.1), world_from_model=np.eye(4), cameras=[camera] * 40,
        has_alpha=False, witnesses=None,
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
        ({"witnesses": None}, "witnesses: expected dict, got NoneType"),
        ({"witnesses": {}}, "witnesses: counts: expected Tensor, got NoneType"),
        ({"witnesses": witnesses(counts=[2.0, 3.0])}, "counts: expected a plain tensor of 32-bit integers"),
        ({"witnesses": witnesses(counts=[5])}, r"counts: expected \[2\], got \[1\]"),
        ({"witnesses": witnesses(counts=[6, -1])}, "counts: expected 5 pixels of 2 views"),
        ({"witnesses": witnesses(counts=[2**31 - 1, 2**31 - 1])}, "counts: expected 5 pixels of 2 views"),
        ({"witnesses": witnesses(pixels=[0, 48, 0, 1, 55])}, "pixels: expected ascending ones inside"),
        ({"witnesses": witnesses(pixels=[-1, 47, 0, 1, 55])}, "pixels: expected ascending ones inside"),
        ({"witnesses": witnesses(pixels=[0, 47, 0, 1, 56])}, "pixels: expected ascending ones inside"),
        ({"witnesses": witnesses(pixels=[0, 47, 1, 1, 55])}, "pixels: expected ascending ones inside"),
        ({"witnesses": witnesses(rgba=torch.zeros(5, 3, dtype=torch.uint8))}, r"rgba: expected \[5, 4\]"),
        ({"witnesses": witnesses(rgba=torch.zeros(5, 4))}, "rgba: expected a plain tensor of bytes"),
        ({"witnesses": witnesses(whole=[2])}, "whole: expected ascending numbers of some of 2 views"),
        ({"witnesses": witnesses(whole=[-1])}, "whole: expected ascending numbers"),
        ({"witnesses": witnesses(whole=[0, 1])}, "whole: expected ascending numbers"),
        ({"witnesses": witnesses(whole=[[0]])}, "whole: expected ascending numbers"),
        ({"object_background": None}, "object_background: expected 3 numbers from 0 to 1, got None"),
        ({"object_background": [0.5, 1.0]}, "object_background: expected 3 numbers from 0 to 1"),
        ({"object_background": [0.5, 1.5, 0.5]}, "object_background: expected 3 numbers from 0 to 1"),
        ({"object_background": [0.5, float("nan"), 0.5]}, "object_background: expected 3 numbers"),
        ({"train": {"downscale": 0}}, "train: downscale: expected 1 to 65536, got 0"),
        ({"train": {"max_side": 2.5}}, r"train: max_side: expected 1 to 65536, got 2\.5"),
        ({"train": {"scale": ["a", "b", 0]}}, "train: scale: expected two pictures and a distance, got"),
        ({"train": {"x": torch.zeros(2)}}, "train: expected finite JSON values"),
        ({"train": {"x": 1, 2: 3}}, "train: expected finite JSON values"),
        ({"figures": {"x": [float("nan")]}}, "figures: expected finite JSON values"),
        ({"figures": {"training_psnr": "x"}}, "figures: training_psnr: expected a finite number, got x"),
        ({"training_pixels": None}, "training_pixels: expected dict, got NoneType"),
        ({"training_pixels": witnesses(counts=[2.0, 3.0])}, "training_pixels: counts: expected a plain"),
        ({"training_pixels": witnesses(counts=[6, -1])}, "training_pixels: counts: expected 5 pixels"),
        ({"training_pixels": witnesses(pixels=[0, 47, 0, 1, 56])}, "training_pixels: pixels: expected ascen"),
        ({"training_pixels": witnesses(rgba=torch.zeros(4, 4).byte())}, r"training_pixels: rgba: expected"),
    ],
)
def test_a_broken_key_is_named(saved: Path, values: dict, message: str) -> None:
    change(saved, **values)
    with pytest.raises(VersionError if "2.x" in message else FormatError, match=message):
        load_model(saved)


@pytest.mark.parametrize("near", [-1.0, float("nan")])
def test_where_a_scene_begins_is_checked(saved: Path, model: Model, near: float) -> None:
    field, sampler = VfrField(replace(CONFIG, unbounded=True, density_width=0)), ProposalSampler(0.1)
    save_model(saved, replace(model, field=field, sampler=sampler))
    change(saved, sampler={"near": near, "state": sampler.state_dict()})
    with pytest.raises(FormatError, match="near: expected 0 to"):
        load_model(saved)


def test_samplers_of_scenes_come_back(saved: Path, model: Model) -> None:
    """Samplers of scenes are loaded, with the proposals' levels of today and those before version 2.4."""
    field = VfrField(replace(CONFIG, unbounded=True, density_width=0))
    torch.nn.init.uniform_(field.grid.table, -1, 1)
    rays_o, rays_d = np.zeros((3, 3), np.float32), np.eye(3, dtype=np.float32)
    first = ProposalSampler(0.1, FIRST_LAYOUTS)
    for table in first.parameters():
        torch.nn.init.uniform_(table, -1, 1)
    for sampler in (ProposalSampler(0.1), first):
        save_model(saved, replace(model, field=field, sampler=sampler))
        if sampler is first:
            content = torch.load(saved, weights_only=True)["sampler"]
            assert content.pop("layouts").tolist() == [[10, 128], [10, 512]]
            change(saved, sampler=content)
        found = load_model(saved).sampler
        assert type(found) is type(sampler) and found.near == 0.1  # type: ignore[union-attr]
        expected = sampler.composited_features(field, rays_o, rays_d)
        for ours, theirs in zip(found.composited_features(field, rays_o, rays_d), expected, strict=True):
            np.testing.assert_array_equal(ours, theirs)


@pytest.mark.parametrize(
    ("layouts", "message"),
    [
        ([[5, 128], [5, 256]], "layouts: expected Tensor"),
        (torch.ones(2, 2), "layouts: expected a plain tensor of whole numbers"),
        (torch.ones(3, 2, dtype=torch.int64), r"layouts: expected 2 x 2 numbers, got \[3, 2\]"),
        (torch.tensor([[5, 128], [0, 256]]), "expected 1 to 32 levels of 16 to 8192 cells, got 0 of 256"),
        (torch.tensor([[33, 128], [5, 256]]), "expected 1 to 32 levels of 16 to 8192 cells, got 33 of 128"),
        (torch.tensor([[5, 15], [5, 256]]), "expected 1 to 32 levels of 16 to 8192 cells, got 5 of 15"),
        (torch.tensor([[5, 128], [5, 9000]]), "expected 1 to 32 levels of 16 to 8192 cells, got 5 of 9000"),
        (torch.tensor([[5, 128], [6, 256]]), "the tensors do not fit the settings"),
    ],
)
def test_broken_levels_of_proposals_are_named(
    saved: Path, model: Model, layouts: object, message: str
) -> None:
    field, sampler = VfrField(replace(CONFIG, unbounded=True, density_width=0)), ProposalSampler(0.1)
    save_model(saved, replace(model, field=field, sampler=sampler))
    change(saved, sampler={"near": 0.1, "state": sampler.state_dict(), "layouts": layouts})
    with pytest.raises(FormatError, match=message):
        load_model(saved)


def test_nan_in_the_weights_is_named(saved: Path) -> None:
    state = torch.load(saved, weights_only=True)["state"]
    state["grid.table"][5] = float("nan")
    change(saved, state=state)
    with pytest.raises(FormatError, match=r"grid\.table: expected finite numbers"):
        load_model(saved)
