"""The price of a bit: the values that are stored at a price, and the search for the price at which pictures
lose as much as they may, or at which the asset has as many bytes as were asked for (`vfr_bake.baking.rate`).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from player.asset.asset import GridArrays
from player.asset.pyramid import Pyramid
from player.asset.sections import Grid
from player.asset.structure import encode_structure
from player.files.memory import give_back
from vfr_bake.baking.detail.shown import Wanted
from vfr_bake.baking.grids import Layout
from vfr_bake.baking.rate.choices import Choices
from vfr_bake.baking.rate.importance import Importance, importance_of_levels

FIRST_PRICE = 1.5e-9
"""Price that is tried first, as a share of the model's mean square error. The final prices are 2e-9 to 5e-9
for balanced objects, and 4e-10 for captures."""
LOWEST_PRICE = 1e-10
"""Lowest price, as a share of the model's mean square error: below it, more bytes show next to nothing. Fox's
values take 8.0 MB at 3e-10, and 12.5 MB at 6e-11, where they lose 0.02 dB less on test views."""
SLOPE, SLOPES = 0.7, (0.25, 2.0)
"""The loss is taken to grow with a power of the price: with the exponent SLOPE at first, then with the one
that follows from two prices, limited to the range SLOPES."""
FURTHEST = 16.0
"""Largest factor from one tried price to the next."""
AIM, CLOSE = 0.95, 0.9
"""Share of the allowed loss that the next price aims at; and share from which a price is near enough."""
NEAR = 1.15
"""The search also ends at two prices with at most this factor between them, if the higher one loses too
much."""
MOST_PRICES = 12
PRICES_TRIED = 3
"""Typical number of prices that are tried."""


class Spent(NamedTuple):
    """The densities and features that are stored at some price."""

    arrays: GridArrays
    n_bytes: float
    """Expected bytes of densities and features in the asset's files."""


class Prices:
    """The refined densities and features, from which the values to store are chosen at any price."""

    def __init__(self, layout: Layout, densities: Wanted, features: Wanted, matters: Importance) -> None:
        """
        Args:
            layout: the layout of the finest level.
            densities, features: the cells that are shown, and the wanted values.
            matters: importance of the finest level's values.
        """
        pyramids = layout.pyramids
        self._densities = Choices(
            "densities",
            densities,
            _shown_importance("densities", densities, pyramids.densities, matters.densities),
            np.ones(1),
            layout.density_step,
        )
        self._features = Choices(
            "features",
            features,
            _shown_importance("features", features, pyramids.features, matters.features),
            matters.channels,
        )
        self._structure_bytes = sum(
            len(encode_structure(wanted.pyramid, level))
            for wanted in (densities, features)
            for level in range(len(wanted.pyramid.levels))
        )

    def at(self, price: float) -> Spent:
        """Choose the values to store if saving a bit is worth a mean square error of `price`."""
        densities, features = self._densities.at(price), self._features.at(price)
        return Spent(
            GridArrays(densities.stored, features.stored),
            self._structure_bytes + densities.n_bytes + features.n_bytes,
        )


def _shown_importance(grid: Grid, wanted: Wanted, whole: Pyramid, finest: np.ndarray) -> list[np.ndarray]:
    """Return for each level the importance of the vertices of `wanted`, which is a part of the pyramid
    `whole`, from the importance `finest` of the whole finest level."""
    return [
        of_level[vertices.rows_of(left.bricks)]
        for of_level, vertices, left in zip(
            importance_of_levels(grid, whole, finest), whole.vertices, wanted.pyramid.vertices, strict=True
        )
    ]


class PriceSearch:
    """The search for the price of a bit. Only the values that are stored at the best price so far are kept,
    because those of all prices would not fit into the memory."""

    def __init__(
        self,
        prices: Prices,
        loss_db: Callable[[GridArrays], float],
        model_error: float,
        progress: Callable[[int, int], object],
    ) -> None:
        """
        Args:
            prices: what is stored at any price.
            loss_db: the dB that pictures lose if these values are stored in place of the refined ones.
            model_error: mean square error of the model's pictures, which prices are relative to.
            progress: called with the number of prices that were tried, and that of all.
        """
        self._prices, self._loss_db, self._progress = prices, loss_db, progress
        self._first, self._lowest = FIRST_PRICE * model_error, LOWEST_PRICE * model_error
        self._n_tried = 0
        self._kept: tuple[float, Spent] | None = None
        """The best price so far, and what is stored at it."""
        self._losses: dict[float, float] = {}
        """dB that are lost at the prices that were tried."""

    def at(self, price: float) -> Spent:
        """Choose the values to store at `price`."""
        if self._kept is not None and self._kept[0] == price:
            return self._kept[1]
        self._n_tried += 1
        self._progress(self._n_tried, max(self._n_tried + 1, PRICES_TRIED))
        spent = self._prices.at(price)
        give_back()  # what its threads have used, before there is a grid of it
        return spent

    def for_loss(self, most_db: float) -> float:
        """Return the highest price at which pictures lose at most `most_db`, nearly."""
        return highest_price(self._share_of(most_db), self._first, 0.0 if most_db > 0 else self._lowest)

    def for_preset(self, allowed_db: float) -> float:
        """Return the same price for a preset, which allows `allowed_db` more than rounding to whole codes
        alone loses. If that counted, bytes would depend on whether it is a little more or a little less than
        is allowed."""
        self._share_of(0.0)(self._lowest)
        most_db = max(self._losses[self._lowest], 0.0) + allowed_db
        return highest_price(self._share_of(most_db), self._first, self._lowest)

    def for_bytes(self, price: float, megabytes: Callable[[float], float], max_mb: float) -> float:
        """Return `price`, or the lowest one, nearly, at which the files have at most `max_mb` megabytes.
        `megabytes`: of all files, from the bytes of densities and features."""

        def share(price: float) -> float:
            spent = self.at(price)
            found = megabytes(spent.n_bytes) / max_mb
            if found <= 1:
                self._kept = price, spent
            return found

        if (found := share(price)) <= 1:
            return price
        # Bytes fall about with the square root of the price.
        return 1 / highest_price(lambda rate: share(1 / rate), (AIM / found) ** 2 / price)

    def _share_of(self, most_db: float) -> Callable[[float], float]:
        """Return the function that gives what pictures lose at a price, as a share of `most_db`."""

        def share(price: float) -> float:
            if price not in self._losses:
                spent = self.at(price)
                self._losses[price] = self._loss_db(spent.arrays)
                if self._losses[price] <= most_db or self._kept is None or price < self._kept[0]:
                    self._kept = price, spent
            return self._losses[price] / most_db if most_db > 0 else math.inf

        return share


def highest_price(share: Callable[[float], float], first: float, lowest: float = 0.0) -> float:
    """Search for a price at which `share`, such as the loss divided by the allowed loss, is little below 1.

    The share is taken to rise with the price, roughly as a power of it, so that few prices have to be tried.
    If it is above 1 at all prices, or below 1 at all, the price returned is far from `first`, but not below
    `lowest`.

    >>> 0.2 < highest_price(lambda price: (price / 0.3) ** 0.5, 1.0) <= 0.3
    True
    >>> highest_price(lambda price: 2.0, 1.0, lowest=0.05)
    0.05
    """
    tried: dict[float, float] = {}
    price, low, high = first, 0.0, math.inf
    while len(tried) < MOST_PRICES:
        found = tried[price] = share(price)
        low, high = (max(low, price), high) if found <= 1 else (low, min(high, price))
        if CLOSE <= found <= 1 or high <= max(NEAR * low, lowest):
            break
        if lowest and not low and len(tried) > 1:
            price = lowest  # check whether any price fits
        else:
            price = max(_next_price(tried, low, high, price), lowest)
    return low or min(tried)


def _next_price(tried: dict[float, float], low: float, high: float, last: float) -> float:
    """Return a price at which the share is expected to be about AIM.

    The share is known at the prices in `tried`, of which `last` is the latest. It is at most 1 at `low`,
    unless that is 0, and above 1 at `high`, unless that is infinite.
    """
    if low and high < math.inf:
        little, much = tried[low], tried[high]
        way = math.log(AIM / little) / math.log(much / little) if little > 0 else 0.5
        return float(low * (high / low) ** np.clip(way, 0.2, 0.8))
    found, slope = tried[last], SLOPE
    if len(tried) > 1:
        before = list(tried)[-2]
        if min(found, tried[before]) > 0 and max(found, tried[before]) < math.inf:
            slope = np.clip(math.log(found / tried[before]) / math.log(last / before), *SLOPES)
    factor = (AIM / found) ** (1 / slope) if found > 0 else FURTHEST
    return float(last * np.clip(factor, 1 / FURTHEST, FURTHEST))
