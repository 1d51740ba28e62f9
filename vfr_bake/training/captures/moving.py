"""Detection of things that move: places in single pictures that contradict all other pictures.

A field learns what most pictures agree on. Where something stood in one picture alone, the field's error is
large, and so is its mean, because the thing has another colour than what is behind it. Where the field is
merely not sharp yet, or detail is difficult, errors have both signs, and their mean over a few dozen pixels
is small.

So each picture is cut into cells. For every cell, the mean error m [3] over its pixels in the last steps is
kept, less the part that chance explains. A cell stands out if |m| / sqrt(3) is more than STANDS_OUT. The
field then learns nothing from its pixels, nor from those of its neighbours, until the error is below IS_OVER.
These pixels are still drawn and compared, so that a cell which was left out by mistake comes back.

RobustNeRF (Sabour et al., 2023) and NeRF on-the-go (Ren et al., 2024) look at the size of errors in patches
of one picture, and therefore leave out fine detail for a long time. The sign of the errors tells detail from
things that move.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

N_CELLS = 2**14
"""Number of cells of all pictures together, if SIDES allows it."""
SIDES = (8, 16)
"""Fewest and most cells along each side of a picture."""
FEWEST_PIXELS = 6
"""Fewest pixels of a cell; with fewer, its error counts as 0."""
MEAN_PIXELS = 12
"""Mean number of pixels of a cell from which on things that move are looked for."""
STANDS_OUT = 0.15
"""Mean error above which a cell contradicts the other pictures; channels are 0 to 1."""
IS_OVER = 0.075
"""Mean error at or below which a cell that stood out is learned from again."""
SHARES = (1e-3, 0.3)
"""Smallest and largest share of cells that stand out if something moves. With a smaller share, leaving cells
out is not worth it; with a larger one, it is the field that fails, and nothing moves."""
MOST_LEFT_OUT = 0.5
"""Largest share of the pictures' area that is left out, with the neighbours of the cells that stand out. If
these cells are scattered, their neighbours are nearly everything, and too little is left to learn from."""
TWO_KINDS = 0.4
"""Smallest share of cells that stand out, among those above IS_OVER, if something moves: then few cells only
nearly stand out. A field that is not trained yet has few cells that stand out, and many that nearly do."""
N_SUMS = 5


def cells_per_side(n_pictures: int) -> int:
    """Return the number of cells along each side of a picture.

    >>> [cells_per_side(n) for n in (8, 50, 100, 1000)]
    [16, 16, 12, 8]
    """
    fewest, most = SIDES
    return min(most, max(fewest, math.isqrt(N_CELLS // n_pictures)))


def mean_errors(sums: Tensor) -> Tensor:
    """Return [...]: the root mean square, over the channels, of each cell's mean error, without the part that
    chance adds to it; 0 for a cell with fewer than FEWEST_PIXELS.

    `sums` [..., N_SUMS] are sums over the pixels of a cell: their number, their errors in three channels, and
    their squared errors summed over the channels.

    >>> sums = torch.tensor([[10, 2.0, 2.0, 2.0, 1.2], [10, 0.0, 0.0, 0.0, 1.2], [1, 0.9, 0.9, 0.9, 2.43]])
    >>> [round(float(value), 3) for value in mean_errors(sums)]
    [0.2, 0.0, 0.0]
    """
    n = sums[..., 0].clamp(min=2)
    square = (sums[..., 1:4] / n[..., None]).square().sum(dim=-1)
    by_chance = (sums[..., 4] / n - square) / (n - 1)
    found = ((square - by_chance.clamp(min=0)).clamp(min=0) / 3).sqrt()
    return torch.where(sums[..., 0] >= FEWEST_PIXELS, found, 0.0)


def contradicting(errors: Tensor, before: Tensor | None = None) -> Tensor:
    """Return [n_pictures, side, side] bool: the cells whose `errors`, from `mean_errors`, stand out, and
    those that stood out `before` and whose errors are still above IS_OVER."""
    stands_out = errors > STANDS_OUT
    return stands_out if before is None else stands_out | (before & (errors > IS_OVER))


def something_moves(errors: Tensor) -> bool:
    """Return whether `errors`, from `mean_errors`, are of two kinds: those that stand out and those that are
    small.

    >>> two_kinds = torch.tensor([0.01, 0.02, 0.03, 0.01, 0.1, 0.3, 0.4])
    >>> something_moves(two_kinds), something_moves(two_kinds / 3), something_moves(two_kinds * 10)
    (True, False, False)
    """
    standing, nearly = (float((errors > limit).double().mean()) for limit in (STANDS_OUT, IS_OVER))
    return SHARES[0] <= standing <= SHARES[1] and standing >= TWO_KINDS * nearly


def widened(cells: Tensor) -> Tensor:
    """Return `cells` [n_pictures, side, side] bool together with the eight neighbours of each.

    >>> cells = torch.zeros(1, 4, 4, dtype=torch.bool)
    >>> cells[0, 0, 0] = True
    >>> widened(cells).int().tolist()[0]
    [[1, 1, 0, 0], [1, 1, 0, 0], [0, 0, 0, 0], [0, 0, 0, 0]]
    """
    return max_pool2d(cells[:, None].float(), 3, stride=1, padding=1)[:, 0] > 0
