"""How much each ray and each sample teaches: gradients that are left out, or made smaller."""

from __future__ import annotations

import torch
from torch import Tensor

CERTAIN = 0.5
"""Rays whose error is at least so many root mean squares are learned from, the others by chance."""


def chosen_rays(squares: Tensor, chances: Tensor) -> Tensor:
    """Weights [n_rays] of rays with the squared errors `squares` [n_rays]: 0 for those left out, and for the
    others the inverse of how probable it was that they are kept, so that a sum is the same in the mean.

    Rays are kept in proportion to their error, with certainty from CERTAIN root mean squares on: of a step's
    rays most have been learned already, and what they add to a gradient is little and costs the same.
    `chances` [n_rays] in [0, 1) decide.

    >>> import torch
    >>> squares, chances = torch.tensor([7.84, 0.08, 0.08, 0.0]), torch.tensor([0.9, 0.9, 0.3, 0.0])
    >>> [round(weight, 3) for weight in chosen_rays(squares, chances).tolist()]
    [1.0, 0.0, 2.5, 0.0]
    """
    share = (squares / (CERTAIN * CERTAIN * squares.mean())).sqrt().clamp(max=1)
    return torch.where(chances < share, 1 / share, torch.zeros_like(share))


def scale_near_gradients(features: Tensor, t_mid: Tensor, distance: float) -> Tensor:
    """Return `features` [n_samples, n_channels] as they are, with gradients scaled by min(1, (t / d)^2).

    Space just before a camera is sampled far more densely than what it looks at, and fog there explains a
    single picture better than any surface does, above all where poses are off. Philip and Deschaintre,
    "Floaters no more", 2023: the gradient at distance t is scaled by min(1, (t / d)^2), the share of its
    density that a volume of space has at the distance d.

    `t_mid` [n_samples] and `distance` > 0 (d) are distances from the cameras in model units.

    >>> import torch
    >>> features = torch.zeros(3, 1, requires_grad=True)
    >>> scale_near_gradients(features, torch.tensor([0.5, 1.0, 7.0]), 1.0).sum().backward()
    >>> features.grad.tolist()
    [[0.25], [1.0], [1.0]]
    """
    scale = (t_mid / distance).square().clamp(max=1)[:, None]
    scaled = features.view_as(features)
    scaled.register_hook(lambda gradient: gradient * scale)
    return scaled
