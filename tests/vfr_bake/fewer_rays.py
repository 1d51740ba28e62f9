"""Let the bakes of tests take seconds, by fewer rays than a bake has by default."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import pytest

FEWER = {
    "baking.bake.N_PROJECTED": 20_000,
    "baking.detail.detail.N_COMPARED": 20_000,
    "baking.detail.detail.N_SEEING": 400_000,
    "baking.held_out.N_LEARNED": 5_000,
    "baking.plan.FEWEST_RAYS": 25_000,
    "baking.rate.importance.N_RAYS": 40_000,
    "data.witnesses.N_WITNESSES": 15_000,
}
"""Numbers of rays and pixels from which a bake learns and on which it measures: a quarter or less of the
default."""


@contextmanager
def fewer_rays() -> Iterator[None]:
    """Let bakes, and the trainings that choose their witnesses, take fewer rays within this context."""
    with pytest.MonkeyPatch.context() as patch:
        for name, number in FEWER.items():
            patch.setattr(f"vfr_bake.{name}", number)
        yield
