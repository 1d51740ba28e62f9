"""Gradients of rays and samples that are left out or made smaller."""

from __future__ import annotations

import torch
from torch import Tensor

CERTAIN = 0.5
"""Error, in root mean squares, from which on a ray is certainly learned from; smaller errors leave it to
chance."""


def chosen_rays(squares: Tensor, chances: Tensor) -> Tensor:
    """Return weights [n_rays] for rays with the squared errors `squares` [n_rays]: 0 for rays that are left
    out, and for the others the inverse of their probability to be kept, so that the expected sum stays the
    same.

    The probability is proportional to the error, and 1 from CERTAIN root mean squares on. Most rays of a step
    have been learned already: they add little to the gradient, but cost as much as the others. `chances`
    [n_rays], which are random numbers in [0, 1), decide.

    >>> import torch
    >>> squares, chances = torch.tensor([7.84, 0.08, 0.08, 0.0]), torch.tensor([0.9, 0.9, 0.3, 0.0])
    >>> [round(weight, 3) for weight in chosen_rays(squares, chances).tolist()]
    [1.0, 0.0, 2.5, 0.0]
    """
    share = (squares / (CERTAIN * CERTAIN * squares.mean())).sqrt().clamp(max=1)
    return torch.where(chances < share, 1 / share, torch.zeros_like(share))


def scale_near_gradients(features: Tensor, t_mid: Tensor, distance: float) -> Tensor:
    """Return `features` [n_samples, n_channels] as they are, with gradients scaled by min(1, (t / d)^2).

    Space just before a camera is sampled far more densely than what the camera looks at, and fog there
    explains a single picture better than any surface does, above all where poses are inaccurate. As in Philip
    and Deschaintre, "Floaters no more", 2023, the gradient at distance t is therefore scaled by min(1, (t /
    d)^2): the rays of a camera sample space at t more densely than at d by the inverse of this factor.

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
