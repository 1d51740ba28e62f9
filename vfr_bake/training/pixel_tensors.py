"""Witnesses and training pixels as the tensors of a model file or a checkpoint.

Keys: counts [n_views] int32 (pixels of each training view), pixels [n_pixels] int32 (row * width + column in
their view, ascending in each view), rgba [n_pixels, 4] uint8. Witnesses also have whole [n_whole] int32 (the
numbers, ascending, of the views that nothing was learned from).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from player.cameras.camera import Camera
from player.errors import FormatError
from player.files.json_files import brief
from vfr_bake.data.view_pixels import N_TRAINING_PIXELS, ViewPixels
from vfr_bake.data.witnesses import N_WITNESSES, Witnesses
from vfr_bake.training.tensor_files import check_kinds, check_plain

KEYS = {"counts": torch.int32, "pixels": torch.int32, "rgba": torch.uint8}
WITNESS_KEYS = KEYS | {"whole": torch.int32}


def pixel_content(pixels: ViewPixels) -> dict[str, torch.Tensor]:
    """Return the tensors of `pixels`: 8 bytes a pixel, so less than 500 kB for witnesses."""
    keys = WITNESS_KEYS if isinstance(pixels, Witnesses) else KEYS
    return {name: torch.from_numpy(np.ascontiguousarray(getattr(pixels, name))) for name in keys}


def restore_training_pixels(content: Any, cameras: Sequence[Camera], where: str) -> ViewPixels:
    """Restore training pixels from what `pixel_content` returned; `cameras` has one for each training view.

    Raises FormatError: a tensor is missing or of another kind or shape, or a number is out of range.
    """
    _check(content, KEYS, N_TRAINING_PIXELS, cameras, where)
    return ViewPixels(**{name: content[name].numpy() for name in KEYS})


def restore_witnesses(content: Any, cameras: Sequence[Camera], where: str) -> Witnesses:
    """Restore witnesses; otherwise as `restore_training_pixels`."""
    _check(content, WITNESS_KEYS, N_WITNESSES, cameras, where)
    found = Witnesses(**{name: content[name].numpy() for name in WITNESS_KEYS})
    n_views, whole = len(cameras), found.whole
    fits = whole.ndim == 1 and len(whole) < n_views and (np.diff(whole) > 0).all()
    if not fits or ((whole < 0) | (whole >= n_views)).any():
        raise FormatError(
            f"{where}: whole: expected ascending numbers of some of {n_views} views, got others"
        )
    return found


def _check(
    content: Any, keys: dict[str, torch.dtype], most: int, cameras: Sequence[Camera], where: str
) -> None:
    """Check that the tensors hold at most `most` pixels of `cameras`; raises FormatError if they do not."""
    check_kinds(content, dict.fromkeys(keys, torch.Tensor), where)
    for name, dtype in keys.items():
        numbers = "bytes" if dtype == torch.uint8 else "32-bit integers"
        check_plain(content[name], content[name].dtype == dtype, numbers, f"{where}: {name}")
    n_views, n = len(cameras), content["pixels"].numel()
    if n > most:
        raise FormatError(f"{where}: pixels: expected at most {most:,}, got {n:,}")
    for name, shape in {"counts": (n_views,), "pixels": (n,), "rgba": (n, 4)}.items():
        if content[name].shape != shape:
            raise FormatError(
                f"{where}: {name}: expected {list(shape)}, got {brief(list(content[name].shape))}"
            )
    found = ViewPixels(**{name: content[name].numpy() for name in KEYS})
    if (found.counts < 0).any() or found.counts.sum(dtype=np.int64) != n:
        raise FormatError(f"{where}: counts: expected {n:,} pixels of {n_views} views, got others")
    views = found.views()
    n_pixels = np.array([camera.width * camera.height for camera in cameras], np.int64)
    inside = (found.pixels >= 0) & (found.pixels < n_pixels[views])
    if not inside.all() or ((np.diff(found.pixels) <= 0) & (np.diff(views) == 0)).any():
        raise FormatError(f"{where}: pixels: expected ascending ones inside each view's picture, got others")
