"""The search for the price of a bit, for prices whose losses and bytes are known."""

from __future__ import annotations

from typing import Any

import pytest

from vfr_bake.baking.rate.price import AIM, CLOSE, FIRST_PRICE, LOWEST_PRICE, NEAR, PriceSearch, Spent


class KnownPrices:
    """Stand-in for `Prices`: arrays are the price itself, and the bytes fall with the price's square root."""

    def __init__(self) -> None:
        self.tried: list[float] = []

    def at(self, price: float) -> Spent:
        self.tried.append(price)
        return Spent(price, 3e6 / price**0.5)  # type: ignore[arg-type]


def search(rounding_db: float = 0.0, model_error: float = 1 / FIRST_PRICE) -> tuple[Any, KnownPrices]:
    """Return a search that begins at price 1; pictures lose `rounding_db`, and 0.1 dB more at price 1."""
    prices = KnownPrices()

    def loss_db(price: Any) -> float:
        return rounding_db + 0.1 * price**0.7

    return PriceSearch(prices, loss_db, model_error, lambda done, of: None), prices  # type: ignore[arg-type]


@pytest.mark.parametrize("most_db", [0.001, 0.05, 0.1, 2.0])
def test_the_price_loses_little_less_than_it_may_and_its_values_are_not_chosen_again(most_db: float) -> None:
    found, prices = search()
    price = found.for_loss(most_db)
    exact = (most_db / 0.1) ** (1 / 0.7)
    assert exact / NEAR <= price <= exact or CLOSE <= 0.1 * price**0.7 / most_db <= 1
    n_tried = len(prices.tried)
    assert found.at(price).arrays == price and len(prices.tried) == n_tried <= 6


@pytest.mark.parametrize("rounding_db", [-0.01, 0.0, 0.09, 0.11, 0.3])
def test_what_rounding_loses_alone_does_not_count_for_a_preset(rounding_db: float) -> None:
    """Prices may add what a preset allows to the loss by rounding alone, however large that is."""
    found, _ = search(rounding_db=rounding_db)
    price = found.for_preset(0.1)
    lowest = LOWEST_PRICE / FIRST_PRICE
    rounding = max(rounding_db + 0.1 * lowest**0.7, 0.0)
    assert CLOSE * (rounding + 0.1) <= rounding_db + 0.1 * price**0.7 <= rounding + 0.1
    assert found.for_loss(0.1) <= price, "a limit is a limit"


def test_bytes_that_fit_keep_the_price_and_others_raise_it() -> None:
    found, prices = search()
    price = found.for_loss(0.1)
    values = 3 / price**0.5
    assert found.for_bytes(price, lambda values: (values + 1e6) / 1e6, values + 1) == price
    higher = found.for_bytes(price, lambda values: (values + 1e6) / 1e6, 0.5 * values + 1)
    megabytes = 3 / higher**0.5 + 1
    assert higher > price and 0.6 * AIM * (0.5 * values + 1) < megabytes <= 0.5 * values + 1
    n_tried = len(prices.tried)
    assert found.at(higher).arrays == higher and len(prices.tried) == n_tried
