"""What `vfr-bench` is to measure, checked."""

from __future__ import annotations

from argparse import ArgumentTypeError
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from player.app.option_types import size
from player.errors import ConfigError

Size = tuple[int, int]
"""Width and height in pixels."""


@dataclass(frozen=True, kw_only=True)
class Plan:
    """Settings of `vfr-bench`."""

    assets: Sequence[Path]
    """Folders of assets of one scene."""
    data: str
    model: Path | None
    views: int
    """Test views that are compared, spread evenly."""
    sizes: Sequence[Size]
    """Of the timed frames, besides the photographs' own; none: half and twice of that."""
    samples: Sequence[int]
    """Numbers of lookups a ray, 0 for every sample."""
    frames: int
    """Timed frames of each setting and size."""
    threads: int | None
    max_memory: float | None
    """Gigabytes that each asset may take when it is opened; a share of the machine's if None."""

    def __post_init__(self) -> None:
        _check(len(self.assets) > 0, "assets", "at least one folder", "none")
        _check(len(set(self.assets)) == len(self.assets), "assets", "each once", list(map(str, self.assets)))
        _check(self.views >= 1, "views", "at least 1", self.views)
        _check(len(self.samples) > 0, "samples", "at least one number", "none")
        _check(all(0 <= k <= 1024 for k in self.samples), "samples", "0 to 1024", list(self.samples))
        _check(self.frames >= 2, "frames", "at least 2", self.frames)
        _check(self.threads is None or self.threads >= 1, "threads", "at least 1", self.threads)


def plan_of(options: Any) -> Plan:
    """The plan of a command line (`vfr_bake.options.Bench`). Raises ConfigError."""
    given: dict[str, Any] = {name: getattr(options, name) for name in Plan.__dataclass_fields__}
    given["sizes"] = [_size(text) for text in options.sizes]
    return Plan(**given)


def _size(text: str) -> Size:
    try:
        return size(text)
    except ArgumentTypeError as error:
        raise ConfigError(f"sizes: {error}") from None


def _check(fits: bool, name: str, expected: str, got: object) -> None:
    if not fits:
        raise ConfigError(f"{name}: expected {expected}, got {got}")
