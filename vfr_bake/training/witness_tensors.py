"""Witnesses as the tensors of a model file or a checkpoint.

Keys: counts [n_views] int32 (witnesses of each training view), pixels [n_witnesses] int32 (row * width +
column in their view, ascending in each view), rgba [n_witnesses, 4] uint8, whole [n_whole] int32 (ascending
numbers of the views that nothing was learned from).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from player.cameras.camera import Camera
from player.errors import FormatError
from player.files.json_files import brief
from vfr_bake.data.witnesses import N_WITNESSES, Witnesses
from vfr_bake.training.tensor_files import check_kinds, check_plain

KEYS = {"counts": torch.int32, "pixels": torch.int32, "rgba": torch.uint8, "whole": torch.int32}


def witness_content(witnesses: Witnesses) -> dict[str, torch.Tensor]:
    """The tensors of `witnesses`, less than 500 kB."""
    return {name: torch.from_numpy(np.ascontiguousarray(getattr(witnesses, name))) for name in KEYS}


def restore_witnesses(content: Any, cameras: Sequence[Camera], where: str) -> Witnesses:
    """The witnesses of training `cameras`, one a view, from what `witness_content` gave.

    Raises FormatError: a tensor is missing or of another kind or shape, or a number is out of range.
    """
    if not isinstance(content, dict):
        raise FormatError(f"{where}: expected dict, got {type(content).__name__}")
    check_kinds(content, dict.fromkeys(KEYS, torch.Tensor), where)
    for name, dtype in KEYS.items():
        numbers = "bytes" if dtype == torch.uint8 else "32-bit integers"
        check_plain(content[name], content[name].dtype == dtype, numbers, f"{where}: {name}")
    n_views, n = len(cameras), content["pixels"].numel()
    if n > N_WITNESSES:
        raise FormatError(f"{where}: pixels: expected at most {N_WITNESSES:,}, got {n:,}")
    for name, shape in {"counts": (n_views,), "pixels": (n,), "rgba": (n, 4)}.items():
        if content[name].shape != shape:
            raise FormatError(
                f"{where}: {name}: expected {list(shape)}, got {brief(list(content[name].shape))}"
            )
    found = Witnesses(**{name: content[name].numpy() for name in KEYS})
    if (found.counts < 0).any() or found.counts.sum(dtype=np.int64) != n:
        raise FormatError(f"{where}: counts: expected {n:,} pixels of {n_views} views, got others")
    views = found.views()
    n_pixels = np.array([camera.width * camera.height for camera in cameras], np.int64)
    inside = (found.pixels >= 0) & (found.pixels < n_pixels[views])
    if not inside.all() or ((np.diff(found.pixels) <= 0) & (np.diff(views) == 0)).any():
        raise FormatError(f"{where}: pixels: expected ascending ones inside each view's picture, got others")
    whole = found.whole
    fits = whole.ndim == 1 and len(whole) < n_views and (np.diff(whole) > 0).all()
    if not fits or ((whole < 0) | (whole >= n_views)).any():
        raise FormatError(
            f"{where}: whole: expected ascending numbers of some of {n_views} views, got others"
        )
    return found
