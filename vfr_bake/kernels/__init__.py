"""The field's inner loops compiled with numba for the CPU.

Each kernel has a slow, readable twin in torch (`vfr_bake.field`, `vfr_bake.rendering`) that the tests
compare it with, and one for a GPU in `vfr_bake.torch_kernels`. Kernels are generic in the float type:
training runs in float32, `gradcheck` in float64. Constants are cast to the type of the arrays, because a bare
`1.0` would silently turn float32 arithmetic into float64.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
from numba import config

import player
from player.compiled.kept_code import keep

# OpenMP is on every Linux with torch, workqueue everywhere; TBB only where somebody installed it, often too
# old.
config.THREADING_LAYER_PRIORITY = ["omp", "workqueue", "tbb"]  # pyright: ignore[reportAttributeAccessIssue]

SOURCES = Path(__file__).parent, Path(player.__file__).parent
"""Of all kernels: they take functions from the player."""


def njit(cache: bool = False, **options: Any) -> Callable[[Callable[..., Any]], Any]:
    """`numba.njit`, whose `cache` asks for all sources (`player.compiled.kept_code`)."""

    def compiled(function: Callable[..., Any]) -> Any:
        dispatcher = numba.njit(**options)(function)
        return keep(dispatcher, *SOURCES) if cache else dispatcher

    return compiled
