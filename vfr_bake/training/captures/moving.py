"""Things that move: places of single pictures that contradict all other pictures.

A field learns what most pictures agree on. Where something stood in one picture alone, the field is off by
much, and on average: the thing has another colour than what is behind it. Where the field is merely not sharp
yet, or detail is hard, its errors have both signs, and their mean over a few dozen pixels is small.

So each picture is cut into cells. For every cell the mean error m [3] over its pixels of the last steps is
kept, with the share of it taken off that chance gives. A cell stands out where |m| / sqrt(3) is more than
STANDS_OUT; its pixels, and those of its neighbours, teach the field nothing until that is over. They are
drawn and compared all the same, so that a cell which was wrongly left out comes back.

RobustNeRF (Sabour et al., 2023) and NeRF on-the-go (Ren et al., 2024) look at the size of errors in patches
of one picture, and so leave out fine detail for long. The sign of errors tells the two apart.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

N_CELLS = 2**14
"""Cells of all pictures together, where each picture has SIDES cells along its sides."""
SIDES = (8, 16)
"""Fewest and most cells along each side of a picture."""
FEWEST_PIXELS = 6
"""A cell with fewer pixels is not looked at."""
MEAN_PIXELS = 12
"""Pixels of a mean cell from which on things that move are looked for."""
STANDS_OUT = 0.15
"""Mean error of a cell that contradicts the other pictures, of channels of 0 to 1."""
IS_OVER = 0.075
"""A cell is learned from again where its mean error is smaller."""
SHARES = (1e-3, 0.3)
"""Share of the cells that stand out where something moves: less is not worth it, and more is no thing that
moves but a field that fails."""
TWO_KINDS = 0.4
"""Where something moves there are cells that stand out, and few that nearly do: of those above IS_OVER, this
share stands out at least. Of a field that is not done yet there are few that stand out and many that nearly
do."""
N_SUMS = 5


def cells_per_side(n_pictures: int) -> int:
    """Cells along each side of a picture.

    >>> [cells_per_side(n) for n in (8, 50, 100, 1000)]
    [16, 16, 12, 8]
    """
    fewest, most = SIDES
    return min(most, max(fewest, math.isqrt(N_CELLS // n_pictures)))


def mean_errors(sums: Tensor) -> Tensor:
    """[...] root mean square over the channels of each cell's mean error, without what chance adds to it.

    `sums` [..., N_SUMS] over the pixels of a cell: their number, their errors in three channels, and their
    squared errors summed over the channels. 0 where there are less than FEWEST_PIXELS.

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
    """[n_pictures, side, side] bool: the cells whose `errors`, of `mean_errors`, stand out, and those of
    `before` that stood out and still do a little."""
    stands_out = errors > STANDS_OUT
    return stands_out if before is None else stands_out | (before & (errors > IS_OVER))


def something_moves(errors: Tensor) -> bool:
    """Whether `errors` of `mean_errors` are of two kinds, those that stand out and those that are small.

    >>> two_kinds = torch.tensor([0.01, 0.02, 0.03, 0.01, 0.1, 0.3, 0.4])
    >>> something_moves(two_kinds), something_moves(two_kinds / 3), something_moves(two_kinds * 10)
    (True, False, False)
    """
    standing, nearly = (float((errors > limit).double().mean()) for limit in (STANDS_OUT, IS_OVER))
    return SHARES[0] <= standing <= SHARES[1] and standing >= TWO_KINDS * nearly


def widened(cells: Tensor) -> Tensor:
    """`cells` [n_pictures, side, side] bool with the eight neighbours of each.

    >>> cells = torch.zeros(1, 4, 4, dtype=torch.bool)
    >>> cells[0, 0, 0] = True
    >>> widened(cells).int().tolist()[0]
    [[1, 1, 0, 0], [1, 1, 0, 0], [0, 0, 0, 0], [0, 0, 0, 0]]
    """
    return max_pool2d(cells[:, None].float(), 3, stride=1, padding=1)[:, 0] > 0
