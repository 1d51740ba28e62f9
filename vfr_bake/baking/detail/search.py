"""Search for the largest amount of detail that can be given up within an allowed loss."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from vfr_bake.training.length.witness_loss import Loss

N_TRIES = 6
"""Halvings of the range in which the amount is searched."""


class Amount(NamedTuple):
    """An amount that is given up, and its loss."""

    amount: float
    loss: Loss
    """Loss by giving up `amount`."""


def largest(lost: Callable[[float], Loss], low: float, high: float, most_db: float) -> Amount | None:
    """Search for the largest amount between `low` and `high` that loses at most `most_db` dB, with two
    standard errors to spare, to a 64th of the range. Returns None if even `low` loses more.

    `lost` returns the loss of an amount. It is called for a few amounts, and taken to rise with the amount.

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
