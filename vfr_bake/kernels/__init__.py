"""The field's inner loops compiled with numba for the CPU.

Each kernel has a counterpart for a GPU in `vfr_bake.torch_kernels`, and the tests compare both with slow,
readable loops. Kernels are generic in the float type:
training runs in float32, `gradcheck` in float64. Constants are cast to the type of the arrays, because a bare
`1.0` would silently turn float32 arithmetic into float64.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
from numba import config

import player
from player.kept_code import keep

# OpenMP is on every Linux with torch, workqueue everywhere; TBB only where somebody installed it, often too
# old.
config.THREADING_LAYER_PRIORITY = ["omp", "workqueue", "tbb"]  # pyright: ignore[reportAttributeAccessIssue]

SOURCES = Path(__file__).parent, Path(player.__file__).parent
"""Folders of the sources of all kernels, which take functions from the player."""


def njit(cache: bool = False, **options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Compile with `numba.njit`; with `cache`, compiled code is kept until one of `SOURCES` changes
    (`player.kept_code`). Other threads of Python go on meanwhile."""

    def compiled(function: Callable[..., Any]) -> Any:
        dispatcher = numba.njit(nogil=True, **options)(function)
        return keep(dispatcher, *SOURCES) if cache else dispatcher

    return compiled
