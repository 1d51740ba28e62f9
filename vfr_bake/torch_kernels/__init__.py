"""The field's inner loops as vectorised torch, for a GPU; any device runs them.

Each function is the counterpart of a numba kernel in `vfr_bake.kernels`, with the same letters, and the tests
compare the two. The functions are pure, and never branch on the values of tensors, so that `torch.compile`
turns each into few kernels.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from functools import cache
from importlib.util import find_spec
from typing import Any

import torch


def fast(function: Callable[..., Any], device: torch.device) -> Callable[..., Any]:
    """Compile `function` for a GPU where Triton, torch's code generator, is there; else return it as it is.

    >>> fast(len, torch.device("cpu")) is len
    True
    """
    return _compiled(function) if can_compile(device) else function


def can_compile(device: torch.device) -> bool:
    """Return whether torch can generate code for `device`; Triton does not come with torch on Windows."""
    return device.type == "cuda" and find_spec("triton") is not None


@cache
def _compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    # torch advises products of 19 bits (TensorFloat32), but densities are exponentials and need more digits.
    warnings.filterwarnings("ignore", "TensorFloat32 tensor cores", UserWarning)
    # The number of samples differs from step to step; without `dynamic`, code is compiled for each number.
    return torch.compile(function, dynamic=True)
