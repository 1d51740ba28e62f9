"""Exposure and white balance of the training views, as a model keeps them in its file and for measurements.

Letters as in `vfr_bake.training.captures.exposure`: a picture shows the field's colour c as g c + o.

Keys in the file: gains [n_views, 3] and offsets [n_views, 3], float32, of the training views.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from player.errors import FormatError
from player.files.json_files import brief
from vfr_bake.data.view_pixels import SomePixels
from vfr_bake.training.captures.exposure import fit, products
from vfr_bake.training.tensor_files import check_kinds, check_plain

KEYS = ("gains", "offsets")
GAINS, OFFSETS = (0.01, 100.0), (-2.0, 2.0)
"""Ranges of values that are accepted from a file, far wider than those of any picture."""


@dataclass(frozen=True, eq=False)
class PictureColours:
    """Gains and offsets with which each training view shows the field's colours."""

    gains: np.ndarray
    """[n_views, 3] float32; their mean is 1 over the views that were learned from."""
    offsets: np.ndarray
    """[n_views, 3] float32, for colours of 0 to 1; their mean is 0 over the views that were learned from."""

    def neutral(self, pixels: SomePixels) -> SomePixels:
        """Return the same `pixels` with the colours that the field would show: (y - o) / g, clipped to 0 to
        255.

        >>> from vfr_bake.data.view_pixels import ViewPixels
        >>> ones = np.ones((1, 3), np.float32)
        >>> one = ViewPixels(np.array([1]), np.array([0]), np.array([[90, 190, 50, 255]]))
        >>> PictureColours(0.5 * ones, 0 * ones).neutral(one).rgba.tolist()
        [[180, 255, 100, 255]]
        """
        views = pixels.views()
        rgb = (pixels.rgba[:, :3] - 255 * self.offsets[views]) / self.gains[views]
        rgba = np.concatenate([rgb.round().clip(0, 255), pixels.rgba[:, 3:]], axis=1)
        return replace(pixels, rgba=rgba.astype(np.uint8))


def fitted(colours: np.ndarray, opacity: np.ndarray, rgba: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fit the gains [3] and offsets [3], float32, with which one picture shows a field's colours.

    `colours` [n, 3]: the field's, times opacity; `opacity` [n]; `rgba` [n, 4] uint8: the photograph's. Both
    are compared over black, so that no background is part of the fit.
    """
    photograph = rgba.astype(np.float32) / 255
    wanted = photograph[:, :3] * photograph[:, 3:]
    terms = products(*(torch.from_numpy(np.ascontiguousarray(rows)) for rows in (colours, opacity, wanted)))
    gains, offsets = fit(terms.sum(dim=0))
    return gains.numpy().astype(np.float32), offsets.numpy().astype(np.float32)


def colours_content(found: PictureColours) -> dict[str, torch.Tensor]:
    """Return the tensors of `found`."""
    return {name: torch.from_numpy(getattr(found, name)) for name in KEYS}


def restore_colours(content: Any, n_views: int, where: str) -> PictureColours:
    """Restore the colours of `n_views` views from what `colours_content` returned.

    Raises FormatError: a tensor is missing or of another kind or shape, or a number is out of range.
    """
    check_kinds(content, dict.fromkeys(KEYS, torch.Tensor), where)
    for name, (low, high) in zip(KEYS, (GAINS, OFFSETS), strict=True):
        tensor = content[name]
        check_plain(tensor, tensor.dtype == torch.float32, "32-bit floats", f"{where}: {name}")
        if tensor.shape != (n_views, 3):
            raise FormatError(f"{where}: {name}: expected [{n_views}, 3], got {brief(list(tensor.shape))}")
        if not ((tensor >= low) & (tensor <= high)).all():
            raise FormatError(f"{where}: {name}: expected numbers from {low} to {high}, got others")
    return PictureColours(**{name: content[name].numpy() for name in KEYS})
