"""Samples near a camera learn slowly, so that no fog settles there.

Space just before a camera is sampled far more densely than what it looks at, and fog there explains a single
picture better than any surface does, above all where poses are off. Philip and Deschaintre, "Floaters no
more", 2023: the gradient at distance t is scaled by min(1, (t / d)^2), the share of its density that a volume
of space has at the distance d.
"""

from __future__ import annotations

from torch import Tensor


def scale_near_gradients(features: Tensor, t_mid: Tensor, distance: float) -> Tensor:
    """`features` [n_samples, n_channels] as they are; what flows back to them is times min(1, (t / d)^2).

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
