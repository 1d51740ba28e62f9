"""Samples along rays, packed: the rows `starts[r] : starts[r] + counts[r]` of the flat arrays are ray r's."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from torch import Tensor

from vfr_bake.field.networks import LARGEST_LOGIT

OPAQUE_DEPTH = float(-np.log(1e-3))
"""Optical depth at which a ray stops: what lies behind weighs less than 1e-3 in all."""
LIMITS = (np.float32(LARGEST_LOGIT), np.float32(OPAQUE_DEPTH))
"""(largest log-density, OPAQUE_DEPTH) as the kernels take them."""


@dataclass(frozen=True)
class Samples:
    """Visible samples of a batch of rays."""

    t_mid: Tensor
    """[n_samples] distance along the ray in model units."""
    deltas: Tensor
    """[n_samples] length of the sample's interval in model units."""
    points: Tensor
    """[n_samples, 3] in the unit cube of the field."""
    features: Tensor
    """[n_samples, n_channels], as they were met."""
    rays: Tensor
    """[n_served] indices of the rays that were served; rays past the sample budget are left out."""
    starts: Tensor
    """[n_served] first sample of each."""
    counts: Tensor
    """[n_served] number of samples of each, 0 where a ray meets nothing."""
