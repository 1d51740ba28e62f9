"""Checkpoints, from which `vfr-train --resume` continues: the whole state of a trainer, kept beside the model
file until that is written.

Keys: format "vfr-checkpoint", version [major, minor], settings (of the run), pictures (names of the training
views), cameras ([n_views, 22], poses and intrinsics of these views), background (`Trainer.background` as a
list; white in version 1.6, which does not have it), state (`Trainer.state`). It holds tensors and plain
values only, and loads with `weights_only=True`.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
import torch

from player.errors import ConfigError, FormatError
from vfr_bake.data.scene import WHITE
from vfr_bake.training.tensor_files import read_tensors, write_tensors
from vfr_bake.training.trainer import Trainer

FORMAT = "vfr-checkpoint"
VERSION = [1, 7]
READABLE = ([1, 6], VERSION)
"""Versions that are read."""
LENGTH_SETTINGS = {"steps", "minutes", "eval_views", "checkpoint_minutes"}
"""Settings that may differ between the run that was interrupted and the one that continues it."""
NO_LIMIT = 1e8
"""Gigabytes of memory that reading may take: training has held all of it, and goes on with it."""
SAME = 1e-4
"""Largest difference between numbers of cameras that count as the same: processors round differently."""
SAME_LEVEL = 2.5 / 255
"""Largest difference between backgrounds that count as the same: decoders of pictures round differently."""


def checkpoint_path(model: Path) -> Path:
    """Return the path of the checkpoint for the training of `model`.

    >>> checkpoint_path(Path("a/model.pt")).name
    'model.pt.checkpoint'
    """
    return model.with_name(model.name + ".checkpoint")


def save_checkpoint(path: Path, trainer: Trainer) -> None:
    """Write a checkpoint beside `path`, then rename it to `path`, so that there is always a whole file."""
    content = {
        "format": FORMAT,
        "version": VERSION,
        "settings": trainer.settings,
        "pictures": [camera.name for camera in trainer.cameras],
        "cameras": _numbers(trainer),
        "background": None if trainer.background is None else trainer.background.tolist(),
        "state": trainer.state(),
    }
    write_tensors(path, content)


def load_checkpoint(path: Path, trainer: Trainer) -> None:
    """Restore the state of `trainer` from a checkpoint.

    Raises FormatError (not a checkpoint, or cut short) or ConfigError (the checkpoint is of a run with other
    settings, other pictures or another background).
    """
    content = read_tensors(path, "a checkpoint written by vfr-train", NO_LIMIT)
    is_ours = isinstance(content, dict) and content.get("format") == FORMAT
    if not is_ours or content.get("version") not in READABLE:
        raise FormatError(
            f"{path}: expected a checkpoint of this version of vfr-train: train without --resume"
        )
    then, now = content["settings"], trainer.settings
    # The device is compared first, because other settings follow from it.
    for name in ["device", *sorted(set(then) | set(now))]:
        if name not in LENGTH_SETTINGS and then.get(name) != now.get(name):
            raise ConfigError(
                f"{path}: {name}: expected {then.get(name)} as in the interrupted run, got {now.get(name)}"
            )
    try:
        names = [camera.name for camera in trainer.cameras]
        same = content["pictures"] == names and torch.allclose(
            content["cameras"], _numbers(trainer), rtol=0, atol=SAME
        )
        before, behind = content.get("background", WHITE), trainer.background
        same_behind = behind is None or np.allclose(before, behind, rtol=0, atol=SAME_LEVEL)
        if same and same_behind:
            trainer.restore(content["state"])
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        raise FormatError(f"{path}: state: does not fit this data set: {error}") from error
    if not same:
        raise ConfigError(
            f"{path}: pictures: expected those of the interrupted run with their cameras, got others: name "
            "that data set, or train without --resume"
        )
    if behind is not None and not same_behind:
        raise ConfigError(
            f"{path}: background: expected {_shown(before)} as in the interrupted run, got "
            f"{_shown(behind)}: train without --resume"
        )


def _shown(colour: Iterable[float]) -> str:
    return "rgb(" + ", ".join(f"{255 * level:.0f}" for level in colour) + ")"


def _numbers(trainer: Trainer) -> torch.Tensor:
    """Return the poses and intrinsics of the training views, [n_views, 22] float64, in the model frame."""
    rows = [
        [*camera.c2w.reshape(-1), camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy]
        for camera in trainer.cameras
    ]
    return torch.tensor(rows, dtype=torch.float64)
