"""`model.pt`: a trained field with all that baking needs. Tensors and plain values only; loads with
`weights_only=True`.

Keys: format "vfr-model", version [major, minor], field (settings of the architecture), train (settings of
the training, for the record), step (march step in model units), world_from_model [4, 4], has_alpha,
background [3], cameras (training cameras in the WORLD frame, as transforms.json text), occupied (bits of the
occupancy grid), occupancy_resolution, state (the field's tensors), figures (what training measured).
"""

from __future__ import annotations

import io
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from player.cameras import Camera
from player.errors import ConfigError, FormatError, VersionError
from player.files import write_bytes
from player.transforms import parse_transforms, transforms_cameras, write_cameras
from vfr_bake.config import FieldConfig, field_config_from
from vfr_bake.field.field import VfrField
from vfr_bake.rendering.occupancy import OccupancyGrid

FORMAT = "vfr-model"
VERSION = (1, 0)


@dataclass(frozen=True)
class Model:
    """A trained field with its frame, its cameras and its occupancy grid."""

    field: VfrField
    occupancy: OccupancyGrid
    world_from_model: np.ndarray
    """[4, 4] float64 similarity; the scene box is [-1, 1]^3 of the model frame."""
    cameras: list[Camera]
    """Training cameras, WORLD frame."""
    has_alpha: bool
    """Whether the photographs had a background cut away."""
    train: dict[str, Any]
    """Settings of the training, for the record."""
    figures: dict[str, Any]
    """What training measured, for the record."""

    @property
    def background(self) -> np.ndarray:
        """[3] default background: white, as NeRF-synthetic is compared."""
        return np.ones(3, np.float32)

    def model_cameras(self) -> list[Camera]:
        """The training cameras in the model frame."""
        model_from_world = np.linalg.inv(self.world_from_model)
        return [camera.transformed(model_from_world) for camera in self.cameras]


def save_model(path: Path, model: Model) -> None:
    """Write beside `path` and rename into place."""
    buffer = io.BytesIO()
    torch.save(
        {
            "format": FORMAT,
            "version": list(VERSION),
            "field": asdict(model.field.config),
            "train": model.train,
            "step": float(model.occupancy.step),
            "world_from_model": torch.from_numpy(np.asarray(model.world_from_model, np.float64)),
            "has_alpha": model.has_alpha,
            "cameras": write_cameras(model.cameras).decode(),
            "occupied": torch.from_numpy(np.packbits(model.occupancy.occupied.reshape(-1))),
            "occupancy_resolution": model.occupancy.resolution,
            "state": model.field.state_dict(),
            "figures": model.figures,
        },
        buffer,
    )
    write_bytes(path, buffer.getvalue())


def load_model(path: Path) -> Model:
    """Read a model file. Raises FormatError (not a model, cut short, wrong shapes) or VersionError (too
    new)."""
    content = _read(path)
    step = content["step"]
    if not (isinstance(step, float) and 0 < step < 1):
        raise FormatError(f"{path}: step: expected a number between 0 and 1, got {step}")
    try:
        config = field_config_from(content["field"], f"{path}: field")
    except ConfigError as error:
        raise FormatError(str(error)) from None
    field = _restore_field(path, config, content["state"])
    occupancy = OccupancyGrid(_resolution(path, content), step, seed=0)
    bits = np.unpackbits(content["occupied"].numpy())[: occupancy.resolution**3]
    if len(bits) != occupancy.resolution**3:
        raise FormatError(f"{path}: occupied: expected {occupancy.resolution**3} bits, got {len(bits)}")
    occupancy.restore(bits.astype(bool).reshape((occupancy.resolution,) * 3))
    world_from_model = content["world_from_model"].double().numpy()
    if world_from_model.shape != (4, 4) or not np.isfinite(world_from_model).all():
        raise FormatError(
            f"{path}: world_from_model: expected 4 x 4 finite numbers, got {world_from_model.tolist()}"
        )
    where = f"{path}: cameras"
    return Model(
        field=field,
        occupancy=occupancy,
        world_from_model=world_from_model,
        cameras=transforms_cameras(parse_transforms(content["cameras"].encode(), where), where),
        has_alpha=bool(content["has_alpha"]),
        train=content["train"],
        figures=content["figures"],
    )


def _read(path: Path) -> dict[str, Any]:
    if not path.is_file():
        raise FormatError(f"{path}: no such file: expected a model written by vfr-train")
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch.load has no documented set of errors for bad bytes
        raise FormatError(f"{path}: not a model file written by vfr-train, or cut short") from error
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise FormatError(f"{path}: not a model file written by vfr-train: expected format {FORMAT!r}")
    version = content.get("version")
    if not (isinstance(version, list) and len(version) == 2 and all(isinstance(v, int) for v in version)):
        raise FormatError(f"{path}: version: expected two integers, got {version}")
    if version[0] != VERSION[0]:
        raise VersionError(
            f"{path}: version: expected {VERSION[0]}.x, got {version[0]}.{version[1]}: update vfr-bake"
        )
    kinds = {
        "field": dict, "train": dict, "step": float, "world_from_model": torch.Tensor, "has_alpha": bool,
        "cameras": str, "occupied": torch.Tensor, "occupancy_resolution": int, "state": dict, "figures": dict,
    }  # fmt: skip
    for key, kind in kinds.items():
        if not isinstance(content.get(key), kind):
            raise FormatError(
                f"{path}: {key}: expected {kind.__name__}, got {type(content.get(key)).__name__}"
            )
    return content


def _resolution(path: Path, content: dict[str, Any]) -> int:
    n = content["occupancy_resolution"]
    if not 8 <= n <= 512:
        raise FormatError(f"{path}: occupancy_resolution: expected 8 to 512, got {n}")
    return n


def _restore_field(path: Path, config: FieldConfig, state: dict[str, Any]) -> VfrField:
    field = VfrField(config)
    try:
        field.load_state_dict(state)
    except (RuntimeError, AttributeError) as error:
        raise FormatError(
            f"{path}: state: the tensors do not fit the settings: {str(error).splitlines()[0]}"
        ) from error
    for name, tensor in field.state_dict().items():
        if not torch.isfinite(tensor).all():
            raise FormatError(f"{path}: state: {name}: expected finite numbers, got NaN or infinity")
    return field
