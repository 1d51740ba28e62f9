"""Checkpoints, from which `vfr-train --resume` goes on: all of a trainer's state, beside the model file until
that is written.

Keys: format "vfr-checkpoint", version [major, minor], settings (of the run), state (`Trainer.state`).
Tensors and plain values only; loads with `weights_only=True`.
"""

from __future__ import annotations

from pathlib import Path

from player.errors import ConfigError, FormatError
from vfr_bake.training.tensor_files import read_tensors, write_tensors
from vfr_bake.training.trainer import Trainer

FORMAT = "vfr-checkpoint"
VERSION = [1, 4]
LENGTH_SETTINGS = {"effort", "steps", "minutes", "eval_views", "checkpoint_minutes"}
"""Settings that may differ between the run that was interrupted and the one that goes on."""


def checkpoint_path(model: Path) -> Path:
    """Path of the checkpoint of the training of `model`.

    >>> checkpoint_path(Path("a/model.pt")).name
    'model.pt.checkpoint'
    """
    return model.with_name(model.name + ".checkpoint")


def save_checkpoint(path: Path, trainer: Trainer) -> None:
    """Write beside `path` and rename into place, so that there is always a whole one."""
    content = {
        "format": FORMAT,
        "version": VERSION,
        "settings": trainer.settings,
        "state": trainer.state(),
    }
    write_tensors(path, content)


def load_checkpoint(path: Path, trainer: Trainer) -> None:
    """Put `trainer` where the checkpoint was.

    Raises FormatError (not a checkpoint, cut short) or ConfigError (of a run with other settings).
    """
    content = read_tensors(path, "a checkpoint written by vfr-train")
    if not isinstance(content, dict) or content.get("format") != FORMAT or content.get("version") != VERSION:
        raise FormatError(
            f"{path}: expected a checkpoint of this version of vfr-train: train without --resume"
        )
    then, now = content["settings"], trainer.settings
    # The device first: other settings follow from it.
    for name in ["device", *sorted(set(then) | set(now))]:
        if name not in LENGTH_SETTINGS and then.get(name) != now.get(name):
            raise ConfigError(
                f"{path}: {name}: expected {then.get(name)} as in the interrupted run, got {now.get(name)}"
            )
    try:
        trainer.restore(content["state"])
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        raise FormatError(f"{path}: state: does not fit this data set: {error}") from error
