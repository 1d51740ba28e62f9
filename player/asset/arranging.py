"""Which sections the parts of a new asset hold: the first part is a whole, coarser picture.

The order of the sections is that of what they show: first all that the coarsest picture needs, then what
makes it sharper, the density before the features and the first channels before the others. It is cut where
the first part would take more than a tenth of the bytes, and where those up to the middle would take more
than half.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from player.asset.manifest import Manifest
from player.asset.parts import LIMITS
from player.asset.pyramid import PyramidValues, symbols_of, values_of
from player.asset.sections import Grid, Part, Section, part_name
from player.asset.standin import encode_structure
from player.asset.symbols import encode_level, level_rows
from player.errors import FormatError

SHARES = (0.1, 0.25, 0.5, 1.0)
"""The most of all bytes that the first part takes, the first two together, ..."""
N_GROUPS = 4
"""Groups of channels that features are stored in, as far as there are so many channels."""


class WrittenSection(NamedTuple):
    """A section with its bytes."""

    section: Section
    data: bytes


class WrittenPart(NamedTuple):
    """A part with the content of its file."""

    part: Part
    data: bytes


def write_parts(densities: PyramidValues, features: PyramidValues, manifest: Manifest) -> list[WrittenPart]:
    """The parts of an asset.

    Raises FormatError: values that the steps of the manifest do not reach.
    """
    sections = [
        *_sections("densities", densities, manifest.density_steps),
        *_sections("features", features, manifest.feature_steps),
    ]
    return list(_cut(sorted(sections, key=_turn)))


def _sections(grid: Grid, stored: PyramidValues, steps: Sequence[int]) -> Iterator[WrittenSection]:
    pyramid = stored.pyramid
    symbols = symbols_of(pyramid.vertices, stored.values, steps, LIMITS[grid])
    again = values_of(pyramid.vertices, symbols, steps, LIMITS[grid])
    for level, (wanted, got) in enumerate(zip(stored.values, again, strict=True)):
        if not np.array_equal(wanted, got):
            row, channel = np.argwhere(wanted != got)[0].tolist()
            raise FormatError(
                f"{grid}, level {level}: expected values that follow from steps of {steps[level]} and, on "
                f"the border, from the next coarser level: {got[row, channel]} at row {row}, channel "
                f"{channel}, got {wanted[row, channel]}"
            )
    for level, bricks in enumerate(pyramid.levels):
        coarser = pyramid.levels[level + 1] if level + 1 < len(pyramid.levels) else None
        vertices = pyramid.vertices[level]
        data = encode_structure(bricks, coarser)
        counts = {"n_bricks": len(bricks), "n_vertices": vertices.n}
        yield WrittenSection(Section(grid, level, len(data), "structure", **counts), data)
        rows = level_rows(vertices)
        bounds = channel_groups(stored.n_channels)
        for first, end in pairwise(bounds):
            data = encode_level(symbols[level][:, first:end], rows)
            channels = {"first_channel": first, "n_channels": end - first}
            yield WrittenSection(Section(grid, level, len(data), "symbols", **channels), data)


def channel_groups(n_channels: int) -> list[int]:
    """Where the groups of channels begin, and the number of channels.

    >>> channel_groups(1), channel_groups(8), channel_groups(10)
    ([0, 1], [0, 2, 4, 6, 8], [0, 2, 5, 7, 10])
    """
    n_groups = min(N_GROUPS, n_channels)
    return [n_channels * i // n_groups for i in range(n_groups + 1)]


def _turn(written: WrittenSection) -> tuple[int, ...]:
    """By what the sections of an asset are sorted."""
    section = written.section
    return (-section.level, section.kind != "structure", section.grid != "densities", section.first_channel)


def _cut(sections: Sequence[WrittenSection]) -> Iterator[WrittenPart]:
    """Parts of sections that follow each other, none of them empty."""
    ends = np.cumsum([len(written.data) for written in sections])
    firsts = [0]
    kinds = [(section.grid, section.kind) for section, _ in sections]
    whole = kinds.index(("features", "symbols")) + 1  # the least that can be shown
    for share in SHARES:
        n = int(np.searchsorted(ends, share * ends[-1], side="right")) if share < 1 else len(sections)
        if n > firsts[-1] and n >= whole:
            firsts.append(n)
    for number, (first, end) in enumerate(pairwise(firsts)):
        some = sections[first:end]
        part = Part(part_name(number), tuple(written.section for written in some))
        yield WrittenPart(part, b"".join(written.data for written in some))
