"""Descriptions of what each part of an asset adds, for `vfr-play --info`."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby

from player.asset.sections import Part, Section


def what_it_adds(part: Part) -> str:
    """Describe the levels and channels that a part adds, the coarsest first.

    >>> of = {"grid": "features", "bytes": 9}
    >>> shapes = [Section(level=n, kind="structure", n_bricks=1, **of) for n in (2, 1, 0)]
    >>> symbols = [Section(level=n, kind="symbols", n_channels=4, **of) for n in (2, 1)]
    >>> what_it_adds(Part("part_0.bin", (*shapes, *symbols)))
    'features: channels 0 to 3 of levels 2 to 1; where level 0 is'
    """
    told = []
    for grid in ("densities", "features"):
        found = [section for section in part.sections if section.grid == grid]
        symbols = [section for section in found if section.kind == "symbols"]
        words = _of_densities(symbols) if grid == "densities" else _of_features(symbols)
        filled = {section.level for section in symbols}
        bare = [s.level for s in found if s.kind == "structure" and s.level not in filled]
        if bare:
            words.append(f"where {_levels(bare)} {'is' if len(bare) == 1 else 'are'}")
        if words:
            told.append(f"{grid}: {'; '.join(words)}")
    return ". ".join(told)


def _of_densities(symbols: Sequence[Section]) -> list[str]:
    return [_levels([section.level for section in symbols])] if symbols else []


def _of_features(symbols: Sequence[Section]) -> list[str]:
    """Describe levels and their channels; levels that get the same channels are joined."""
    channels: dict[int, tuple[int, int]] = {}
    for section in symbols:
        first, _ = channels.get(section.level, (section.first_channel, 0))
        channels[section.level] = (min(first, section.first_channel), section.end_channel - 1)
    rows = sorted(channels.items(), reverse=True)
    return [
        f"channel{'s' * (last > first)} {first}{f' to {last}' * (last > first)} of "
        f"{_levels([level for level, _ in some])}"
        for (first, last), some in groupby(rows, key=lambda row: row[1])
    ]


def _levels(levels: Sequence[int]) -> str:
    most, least = max(levels), min(levels)
    return f"level {least}" if most == least else f"levels {most} to {least}"
