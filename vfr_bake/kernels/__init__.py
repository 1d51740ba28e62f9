"""The field's inner loops compiled with numba for the CPU.

Each kernel has a counterpart for a GPU in `vfr_bake.torch_kernels`, and the tests compare both with slow,
readable loops. Kernels are generic in the float type: training runs in float32, `gradcheck` in float64.
Constants are cast to the type of the arrays, because a bare `1.0` would silently turn float32 arithmetic into
float64.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
from numba import config

import player
from player.kept_code import keep

# OpenMP is on every Linux that has torch, workqueue is everywhere, and TBB is only where somebody installed
# it, often in a version that is too old.
config.THREADING_LAYER_PRIORITY = ["omp", "workqueue", "tbb"]  # pyright: ignore[reportAttributeAccessIssue]

SOURCES = Path(__file__).parent, Path(player.__file__).parent
"""Folders with the sources of all kernels: this one, and the player's, because kernels use its functions."""


def njit(cache: bool = False, **options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Return a decorator that compiles with `numba.njit`. With `cache`, compiled code is kept until a file in
    `SOURCES` changes (`player.kept_code`). While a kernel runs, Python's other threads can go on
    (`nogil`)."""

    def compiled(function: Callable[..., Any]) -> Any:
        dispatcher = numba.njit(nogil=True, **options)(function)
        return keep(dispatcher, *SOURCES) if cache else dispatcher

    return compiled
