"""How much can be given up for a loss that is allowed."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from vfr_bake.training.length.witness_loss import Loss

N_TRIES = 6
"""Halvings of the range in which an amount is looked for."""


class Amount(NamedTuple):
    """How much is given up."""

    amount: float
    loss: Loss
    """What is lost by it."""


def largest(lost: Callable[[float], Loss], low: float, high: float, most_db: float) -> Amount | None:
    """The largest amount between `low` and `high` that loses no more than `most_db`, with two standard
    errors to spare, to a 64th of the range; None where even `low` loses more.

    `lost` tells what an amount loses. It is asked for some of them, and is taken to rise.

    >>> largest(lambda amount: Loss(amount**2, 0.0), 0, 1, 0.25).amount
    0.5
    """
    tried = Amount(low, lost(low))
    if tried.loss.worst > most_db:
        return None
    found = tried
    for _ in range(N_TRIES):
        middle = (low + high) / 2
        tried = Amount(middle, lost(middle))
        if tried.loss.worst <= most_db:
            low, found = middle, tried
        else:
            high = middle
    return found
