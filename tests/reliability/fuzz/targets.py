"""Target of the fuzzer: a reader, its name, and a function that makes broken inputs for it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from player.cameras.camera import Camera

Break = Callable[[np.random.Generator], object]
"""A function that writes one broken input."""


@dataclass(frozen=True)
class Target:
    """A reader, with a function that makes broken inputs for it."""

    name: str
    prepare: Break
    read: Callable[[], object]


def written(path: Path, data: bytes) -> Path:
    path.write_bytes(data)
    return path


def check_colours(rgb: np.ndarray, n: int) -> None:
    """Raise AssertionError unless there are n finite colours."""
    assert rgb.shape == (n, 3) and np.isfinite(rgb).all(), "expected finite colours"


def small_view(width: int = 8, height: int = 8) -> Camera:
    """Return a camera outside the box [-1, 1]^3 that sees all of it."""
    c2w = np.eye(4)
    c2w[:3, 3] = 0.1, -0.2, 3.0
    return Camera("fuzz", c2w, width, height, 0.9 * width, 0.9 * height, width / 2, height / 2)
