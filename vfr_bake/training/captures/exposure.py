"""Exposure and white balance that change from picture to picture: a gain and an offset for each picture and
channel.

Letters: a field shows the colour c with the opacity A, and a picture shows that colour as g c + o, where g
[3] are the picture's gains and o [3] its offsets. Before a background b, a pixel y is therefore

    y = g (A c) + o A + (1 - A) b,

which is linear in g and o. They are found by least squares: for each picture and channel, a few sums over the
pixels of the last steps are kept, and two equations with two unknowns are solved now and then. Each picture
counts as if it also had PRIOR_PIXELS pixels of black and of white that need no correction. The means of gains
and offsets over all pictures are made 1 and 0, so that the field has the mean exposure.

Whether corrections are worth it is measured in the same way as held-out views are scored: a correction that
is fitted on one half of a picture is applied to its other half.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

PRIOR_PIXELS = 1.0
"""Number of pixels of black, and of white, that need no correction and count as part of every picture: enough
for a picture that shows nothing yet, and too few to pull the gains of others towards 1."""
LEAST_GAIN_DB = 0.2
"""Least reduction in dB, of the error on the other half of the pictures, for which corrections are turned
on."""
N_SUMS = 6


class Correction(NamedTuple):
    """Gains and offsets with which pictures show the field's colours."""

    gains: Tensor
    """[n_pictures, 3] float64."""
    offsets: Tensor
    """[n_pictures, 3] float64."""

    def neutral(self) -> Correction:
        """Return these corrections for a field whose own colours are changed by the mean correction.

        >>> fitted = Correction(torch.tensor([[1.0], [3.0]]), torch.tensor([[0.0], [0.2]]))
        >>> neutral = fitted.neutral()
        >>> neutral.gains.tolist(), [round(float(o), 3) for o in neutral.offsets]
        ([[0.5], [1.5]], [-0.05, 0.05])
        """
        gain, offset = self.gains.mean(dim=0), self.offsets.mean(dim=0)
        return Correction(self.gains / gain, self.offsets - self.gains * (offset / gain))


def products(colours: Tensor, opacity: Tensor, wanted: Tensor) -> Tensor:
    """Return the terms of the sums that `fit` needs, [n, 3, N_SUMS] float64.

    `colours` [n, 3]: c A; `opacity` [n]: A; `wanted` [n, 3]: y - (1 - A) b.
    """
    a, t = colours.double(), wanted.double()
    b = opacity.double()[:, None].expand_as(a)
    return torch.stack([a * a, a * b, b * b, a * t, b * t, t * t], dim=-1)


def fit(sums: Tensor) -> Correction:
    """Return the gains and offsets with the least squared error over the pixels and the prior pixels.

    `sums` [..., 3, N_SUMS]: sums of the terms of `products`.

    >>> colours = torch.rand(1000, 3, dtype=torch.float64)
    >>> found = fit(products(colours, torch.ones(1000), 0.8 * colours + 0.1).sum(dim=0) * 1000)
    >>> [round(float(value), 3) for value in (found.gains[0], found.offsets[0])]
    [0.8, 0.1]
    """
    n = PRIOR_PIXELS
    aa, ab, bb, at, bt, _ = (sums + torch.tensor([n, n, 2 * n, n, n, n], device=sums.device)).unbind(dim=-1)
    determinant = aa * bb - ab * ab
    return Correction((at * bb - bt * ab) / determinant, (bt * aa - at * ab) / determinant)


def squared_error(sums: Tensor, correction: Correction) -> Tensor:
    """Return [..., 3]: sums of the squared errors of corrected colours, from the `sums` that `fit` takes."""
    aa, ab, bb, at, bt, tt = sums.unbind(dim=-1)
    g, o = correction
    return g * g * aa + 2 * g * o * ab + o * o * bb - 2 * (g * at + o * bt) + tt


def gain_on_other_half(halves: Tensor) -> float:
    """Return the dB by which a correction for each picture, fitted on one half of it, reduces the error on
    the other half, compared with one correction for all pictures.

    `halves` [n_pictures, 2, 3, N_SUMS]: sums over the left and the right half of the pictures.
    """
    fitted_elsewhere = fit(halves.flip(1))
    corrected = float(squared_error(halves, fitted_elsewhere).sum())
    common = float(squared_error(halves, fit(halves.sum(dim=(0, 1)))).sum())
    if not 0 < corrected < float("inf"):
        return 0.0
    return float(10 * torch.log10(torch.tensor(common / corrected)))
