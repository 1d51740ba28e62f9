"""The model file, `model.pt`: a trained field with all that baking needs. It holds tensors and plain values
only, and loads with `weights_only=True`.

Keys: format "vfr-model", version [major, minor], field (settings of the architecture), train (settings of the
training, for the record), world_from_model [4, 4], has_alpha, cameras (training cameras in the WORLD frame,
as transforms.json text), sampler (see below), state (the field's tensors), figures (measured by the
training).

Keys that older files do not have: witnesses since version 2.1 and training_pixels since version 2.5 (both:
`vfr_bake.training.pixel_tensors`), exposure since version 2.2, if it differs between pictures
(`vfr_bake.training.captures.picture_colours`), and object_background since version 2.6 (three numbers; white
in older files).

The sampler of an object is its occupancy grid: step (march step in model units), occupied (bits), resolution.
The sampler of an unbounded scene is its proposals: near (model units), state (their tensors) and, since
version 2.4, layouts (levels and finest resolution of each round's grid; 10 and 128, 10 and 512 in older
files).
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import nn

from player.cameras.camera import Camera
from player.cameras.transforms import parse_transforms, transforms_cameras, write_cameras
from player.errors import ConfigError, FormatError, VersionError
from player.files.json_files import as_float, brief
from vfr_bake.config import FieldConfig, field_config_from
from vfr_bake.data import check_settings
from vfr_bake.data.scene import WHITE
from vfr_bake.data.view_pixels import SomePixels, ViewPixels
from vfr_bake.data.witnesses import Witnesses
from vfr_bake.field.field import VfrField
from vfr_bake.field.hash_grid import GridLayout
from vfr_bake.rendering.occupancy import OccupancyGrid
from vfr_bake.rendering.proposals import BASE_RESOLUTION, FAR, FIRST_LAYOUTS, ProposalSampler
from vfr_bake.rendering.render import Sampler, mean_colour, render_rays
from vfr_bake.training.captures.exposure import Correction
from vfr_bake.training.captures.picture_colours import (
    GAINS,
    OFFSETS,
    PictureColours,
    colours_content,
    fitted,
    restore_colours,
)
from vfr_bake.training.pixel_tensors import pixel_content, restore_training_pixels, restore_witnesses
from vfr_bake.training.tensor_files import check_kinds, check_plain, read_tensors, write_tensors

if TYPE_CHECKING:
    from vfr_bake.data.scene import Scene
    from vfr_bake.training.trainer import Trainer

FORMAT = "vfr-model"
VERSION = (2, 6)
N_MEAN_VIEWS = 16
"""Number of cameras, about, spread evenly over all, whose pictures give the mean colour of a scene."""


@dataclass(frozen=True)
class Model:
    """Trained field with its sampler, its frame and its cameras."""

    field: VfrField
    sampler: Sampler
    world_from_model: np.ndarray
    """[4, 4] float64 similarity. In the model frame, an object's box is [-1, 1]^3, and the cameras of an
    unbounded scene are in the unit ball."""
    cameras: list[Camera]
    """Training cameras, in the WORLD frame."""
    has_alpha: bool
    """True if the background was cut out of the photographs."""
    train: dict[str, Any]
    """Settings of the training, for the record."""
    figures: dict[str, Any]
    """Figures that training measured, for the record."""
    witnesses: Witnesses | None = None
    """Pixels of the training views that training has not learned from; None in models of versions without
    witnesses."""
    exposure: PictureColours | None = None
    """Gains and offsets with which the training views show the field's colours; None if all show them
    unchanged."""
    training_pixels: ViewPixels | None = None
    """Pixels of the training views that training has learned from, and that a bake learns from too; None in
    models of versions without them."""
    object_background: tuple[float, float, float] = WHITE
    """What was behind an object in training, sRGB in [0, 1]."""

    @property
    def occupancy(self) -> OccupancyGrid:
        """The occupancy grid of an object. Raises ConfigError for an unbounded scene, which has none."""
        if not isinstance(self.sampler, OccupancyGrid):
            raise ConfigError("model: sampler: expected an object's occupancy grid, got a scene's sampler")
        return self.sampler

    @cached_property
    def background(self) -> np.ndarray:
        """[3] float32: default background, sRGB. It is white where pictures have alpha, as usual for
        NeRF-synthetic, and behind opaque pictures of an object what they were trained over. In other
        unbounded scenes it is the mean colour that the cameras see, because the background shows there
        through holes in what is reconstructed, where white would stand out."""
        if self.has_alpha or not self.field.config.unbounded:
            return np.array(self.object_background, np.float32)
        cameras = self.model_cameras()
        some = cameras[:: max(1, len(cameras) // N_MEAN_VIEWS)]
        seen = mean_colour(self.field, self.sampler, some)
        return (np.round(255 * seen) / 255).astype(np.float32)

    def model_cameras(self) -> list[Camera]:
        """Return the cameras of the views that training has learned from, in the model frame."""
        cameras = self._in_model_frame()
        return cameras if self.witnesses is None else [cameras[i] for i in self.witnesses.learned()]

    def witness_rays(self) -> tuple[np.ndarray, np.ndarray]:
        """Return origins and unit directions of the witnesses' rays, [n_witnesses, 3] float32, model frame.

        Raises ConfigError for a model without witnesses.
        """
        if self.witnesses is None:
            raise ConfigError(
                "model: witnesses: expected some, got none: it was trained before there were any"
            )
        return self.witnesses.rays(self._in_model_frame())

    def neutral_witnesses(self) -> Witnesses | None:
        """Return the witnesses with the colours that the field should show, without their pictures'
        exposure."""
        return None if self.witnesses is None else self.neutral(self.witnesses)

    def neutral(self, pixels: SomePixels) -> SomePixels:
        """Return pixels of the training views with the colours that the field should show."""
        return pixels if self.exposure is None else self.exposure.neutral(pixels)

    def training_pixel_rays(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the origins and unit directions of the training pixels' rays, [n, 3] float32 each, in the
        model frame, and the colours [n, 4] uint8 that the field should show there; n is 0 for a model without
        training pixels."""
        if self.training_pixels is None:
            return np.zeros((0, 3), np.float32), np.zeros((0, 3), np.float32), np.zeros((0, 4), np.uint8)
        return *self.rays(self.training_pixels), self.neutral(self.training_pixels).rgba

    def rays(self, pixels: ViewPixels) -> tuple[np.ndarray, np.ndarray]:
        """Return the origins and unit directions of the rays of pixels of the training views, [n, 3] float32
        each, in the model frame."""
        return pixels.rays(self._in_model_frame())

    def _in_model_frame(self) -> list[Camera]:
        model_from_world = np.linalg.inv(self.world_from_model)
        return [camera.transformed(model_from_world) for camera in self.cameras]


def trained_model(trainer: Trainer, scene: Scene, figures: dict[str, Any]) -> Model:
    """Return the model that `trainer` has so far; `scene` is the one that it trains on."""
    model = Model(
        field=trainer.field,
        sampler=trainer.sampler,
        world_from_model=scene.world_from_model,
        cameras=[camera.transformed(scene.world_from_model) for camera in scene.train.cameras],
        has_alpha=scene.has_alpha,
        train={"data": scene.name} | trainer.settings,
        figures=figures,
        witnesses=trainer.witnesses,
        training_pixels=trainer.training_pixels(),
        object_background=scene.background,
    )
    if not trainer.effects.exposure_on:
        return model
    return replace(model, exposure=_exposure(model, trainer.witnesses, trainer.effects.correction))


def _exposure(model: Model, witnesses: Witnesses, learned: Correction) -> PictureColours:
    """Return the gains and offsets of all training views: those that were `learned`, and for the whole views
    of the witnesses those that fit the model's colours to the pictures."""
    n_views = len(witnesses.counts)
    gains, offsets = np.ones((n_views, 3), np.float32), np.zeros((n_views, 3), np.float32)
    gains[witnesses.learned()] = learned.gains.cpu().numpy()
    offsets[witnesses.learned()] = learned.offsets.cpu().numpy()
    rays_o, rays_d = model.witness_rays()
    views = witnesses.views()
    for view in witnesses.whole:
        rows = views == view
        shown = render_rays(model.field, model.sampler, rays_o[rows], rays_d[rows])
        gains[view], offsets[view] = fitted(*shown, witnesses.rgba[rows])
    return PictureColours(gains.clip(*GAINS), offsets.clip(*OFFSETS))


def save_model(path: Path, model: Model) -> None:
    """Write a model file beside `path`, then rename it to `path`."""
    content = {
        "format": FORMAT,
        "version": list(VERSION),
        "field": asdict(model.field.config),
        "train": model.train,
        "world_from_model": torch.from_numpy(np.asarray(model.world_from_model, np.float64)),
        "has_alpha": model.has_alpha,
        "cameras": write_cameras(model.cameras).decode(),
        "sampler": _sampler_content(model.sampler),
        "state": model.field.state_dict(),
        "figures": model.figures,
        "object_background": list(model.object_background),
    }
    if model.witnesses is not None:
        content["witnesses"] = pixel_content(model.witnesses)
    if model.training_pixels is not None:
        content["training_pixels"] = pixel_content(model.training_pixels)
    if model.exposure is not None:
        content["exposure"] = colours_content(model.exposure)
    write_tensors(path, content)


def load_model(path: Path, max_memory: float | None = None) -> Model:
    """Read a model file with at most `max_memory` gigabytes of memory; None for a share of what the machine
    has.

    Raises FormatError (not a model, cut short, or wrong shapes), VersionError (another major version) or
    ConfigError (it would take more memory than allowed).
    """
    content = _read(path, max_memory)
    try:
        config = field_config_from(content["field"], f"{path}: field")
    except ConfigError as error:
        raise FormatError(str(error)) from None
    _check_table(config, content["state"], f"{path}: state")
    field = VfrField(config)
    _restore(field, content["state"], f"{path}: state")
    restore_sampler = _restore_space if config.unbounded else _restore_occupancy
    sampler = restore_sampler(content["sampler"], f"{path}: sampler")
    matrix = content["world_from_model"]
    check_plain(matrix, matrix.is_floating_point(), "floats", f"{path}: world_from_model")
    if matrix.shape != (4, 4) or not matrix.isfinite().all():
        got = matrix.tolist() if matrix.numel() <= 16 else list(matrix.shape)
        raise FormatError(f"{path}: world_from_model: expected 4 x 4 finite numbers, got {brief(got)}")
    world_from_model = matrix.double().numpy()
    where = f"{path}: cameras"
    text = content["cameras"].encode(errors="surrogatepass")  # half a character then fails as bad UTF-8
    cameras = transforms_cameras(parse_transforms(text, where), where)
    witnesses = None
    if "witnesses" in content:
        witnesses = restore_witnesses(content["witnesses"], cameras, f"{path}: witnesses")
    training_pixels = None
    if "training_pixels" in content:
        where = f"{path}: training_pixels"
        training_pixels = restore_training_pixels(content["training_pixels"], cameras, where)
    exposure = None
    if "exposure" in content:
        exposure = restore_colours(content["exposure"], len(cameras), f"{path}: exposure")
    background = content.get("object_background", list(WHITE))
    if not (isinstance(background, list) and len(background) == 3 and all(map(_is_level, background))):
        raise FormatError(
            f"{path}: object_background: expected 3 numbers from 0 to 1, got {brief(background)}"
        )
    _check_record(content["train"], content["figures"], path)
    return Model(
        field=field,
        sampler=sampler,
        world_from_model=world_from_model,
        cameras=cameras,
        has_alpha=bool(content["has_alpha"]),
        train=content["train"],
        figures=content["figures"],
        witnesses=witnesses,
        exposure=exposure,
        training_pixels=training_pixels,
        object_background=(background[0], background[1], background[2]),
    )


def _is_level(value: Any) -> bool:
    return isinstance(value, float) and 0 <= value <= 1


def _check_record(train: dict[str, Any], figures: dict[str, Any], path: Path) -> None:
    """Raise FormatError unless the settings and the figures of the training can be used, and written to the
    manifest of an asset at the end of a bake."""
    check_settings(train, f"{path}: train")
    psnr = figures.get("training_psnr")
    if psnr is not None and as_float(psnr) is None:
        raise FormatError(f"{path}: figures: training_psnr: expected a finite number, got {brief(psnr)}")
    for name, record in (("train", train), ("figures", figures)):
        try:
            json.dumps(record, sort_keys=True, allow_nan=False)
        except (TypeError, ValueError) as error:
            raise FormatError(f"{path}: {name}: expected finite JSON values: {brief(str(error))}") from error


def _read(path: Path, max_memory: float | None) -> dict[str, Any]:
    content = read_tensors(path, "a model file written by vfr-train", max_memory)
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise FormatError(f"{path}: not a model file written by vfr-train: expected format {FORMAT!r}")
    version = content.get("version")
    if not (isinstance(version, list) and len(version) == 2 and all(isinstance(v, int) for v in version)):
        raise FormatError(f"{path}: version: expected two integers, got {brief(version)}")
    if version[0] != VERSION[0]:
        raise VersionError(
            f"{path}: version: expected {VERSION[0]}.x, got {version[0]}.{version[1]}: "
            + ("update vfr-bake" if version[0] > VERSION[0] else "train again")
        )
    kinds = {
        "field": dict, "train": dict, "world_from_model": torch.Tensor, "has_alpha": bool, "cameras": str,
        "sampler": dict, "state": dict, "figures": dict,
    }  # fmt: skip
    check_kinds(content, kinds, str(path))
    return content


def _sampler_content(sampler: Sampler) -> dict[str, Any]:
    if isinstance(sampler, ProposalSampler):
        layouts = torch.tensor(sampler.layouts)
        return {"near": sampler.near, "layouts": layouts, "state": sampler.state_dict()}
    bits = torch.from_numpy(np.packbits(sampler.occupied.reshape(-1)))
    return {"step": sampler.step, "occupied": bits, "resolution": sampler.resolution}


def _check_table(config: FieldConfig, state: dict[str, Any], where: str) -> None:
    """Raise FormatError if the settings describe another table than the file has, before one is allocated."""
    layout = GridLayout(
        config.n_levels, config.base_resolution, config.max_resolution, config.log2_table_size
    )
    table = state.get("grid.table")
    shape = list(table.shape) if isinstance(table, torch.Tensor) else None
    if shape != [layout.n_entries, 2]:
        raise FormatError(
            f"{where}: the tensors do not fit the settings: grid.table: expected [{layout.n_entries}, 2], "
            f"got {brief(shape)}"
        )


def _restore_occupancy(content: dict[str, Any], where: str) -> OccupancyGrid:
    check_kinds(content, {"step": float, "occupied": torch.Tensor, "resolution": int}, where)
    step, resolution = content["step"], content["resolution"]
    if not 0 < step < 1:
        raise FormatError(f"{where}: step: expected a number between 0 and 1, got {step}")
    if not 8 <= resolution <= 512:
        raise FormatError(f"{where}: resolution: expected 8 to 512, got {resolution}")
    packed = content["occupied"]
    check_plain(packed, packed.dtype == torch.uint8, "bytes", f"{where}: occupied")
    if packed.ndim != 1 or len(packed) != -(-(resolution**3) // 8):
        raise FormatError(
            f"{where}: occupied: expected {resolution**3} bits, got {brief(list(packed.shape))}"
        )
    bits = np.unpackbits(packed.numpy())[: resolution**3]
    occupancy = OccupancyGrid(resolution, step, seed=0)
    occupancy.set_occupied(bits.astype(bool).reshape((resolution,) * 3))
    return occupancy


def _restore_space(content: dict[str, Any], where: str) -> ProposalSampler:
    check_kinds(content, {"near": float, "state": dict}, where)
    if not 0 <= content["near"] < FAR:
        raise FormatError(f"{where}: near: expected 0 to {FAR}, got {content['near']}")
    sampler = ProposalSampler(content["near"], _layouts(content, where))
    _restore(sampler, content["state"], where)
    return sampler


def _layouts(content: dict[str, Any], where: str) -> list[tuple[int, int]]:
    """Return the number of levels and the finest resolution of each proposal round's grid."""
    if "layouts" not in content:
        return list(FIRST_LAYOUTS)
    check_kinds(content, {"layouts": torch.Tensor}, where)
    layouts = content["layouts"]
    check_plain(layouts, layouts.dtype == torch.int64, "whole numbers", f"{where}: layouts")
    if list(layouts.shape) != [2, 2]:
        raise FormatError(f"{where}: layouts: expected 2 x 2 numbers, got {brief(list(layouts.shape))}")
    for n_levels, resolution in layouts.tolist():
        if not (1 <= n_levels <= 32 and BASE_RESOLUTION <= resolution <= 8192):
            raise FormatError(
                f"{where}: layouts: expected 1 to 32 levels of {BASE_RESOLUTION} to 8192 cells, got "
                f"{n_levels} of {resolution}"
            )
    return [(n_levels, resolution) for n_levels, resolution in layouts.tolist()]


def _restore(module: nn.Module, state: dict[str, Any], where: str) -> None:
    try:
        module.load_state_dict(state)
    except (RuntimeError, AttributeError) as error:
        raise FormatError(
            f"{where}: the tensors do not fit the settings: {str(error).splitlines()[0]}"
        ) from error
    for name, tensor in module.state_dict().items():
        if not torch.isfinite(tensor).all():
            raise FormatError(f"{where}: {name}: expected finite numbers, got NaN or infinity")
