"""Which sections the parts of a new asset hold: the first part is a whole, coarser picture.

The order of the sections is that of what they show: first all that the coarsest picture needs, then what
makes it sharper, the density before the features and the first channels before the others. It is cut so that
what the first picture needs, head and cameras with it, is a few hundredths of the bytes of the asset, so that
it is there at once; a tenth and half of the bytes end with a part, too.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise, repeat
from typing import NamedTuple

import numpy as np

from player.asset.manifest import Manifest
from player.asset.parts import LIMITS
from player.asset.pyramid import PyramidValues, symbols_of, values_of
from player.asset.sections import Grid, Part, Section, part_name
from player.asset.structure import encode_structure
from player.asset.symbols import encode_level, level_rows
from player.errors import FormatError

SHARES = (0.025, 0.1, 0.25, 0.5, 1.0)
"""The most of all bytes that are read with the first part, with the first two, ..."""
THREADS = 2
"""Sections that are encoded at a time: each takes memory of its own."""


class WrittenSection(NamedTuple):
    """A section with its bytes."""

    section: Section
    data: bytes


class WrittenPart(NamedTuple):
    """A part with the content of its file."""

    part: Part
    data: bytes


def write_parts(
    densities: PyramidValues, features: PyramidValues, manifest: Manifest, n_before: int, n_behind: int
) -> list[WrittenPart]:
    """The parts of an asset.

    Args:
        densities, features: what is stored.
        manifest: resolutions and steps.
        n_before: bytes of what is read before the first part.
        n_behind: bytes of what is read behind the last part.

    Raises FormatError: values that the steps of the manifest do not reach.
    """
    with ThreadPoolExecutor(THREADS) as threads:
        sections = [
            *_sections("densities", densities, manifest.density_steps, threads),
            *_sections("features", features, manifest.feature_steps, threads),
        ]
    return list(_cut(sorted(sections, key=_turn), n_before, n_behind))


def _sections(
    grid: Grid, stored: PyramidValues, steps: Sequence[int], threads: ThreadPoolExecutor
) -> Iterator[WrittenSection]:
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
    del again  # as many bytes as the symbols
    for level, bricks in enumerate(pyramid.levels):
        if not len(bricks):
            continue
        data = encode_structure(pyramid, level)
        vertices = pyramid.vertices[level]
        counts = {"n_bricks": len(bricks), "n_vertices": vertices.n}
        yield WrittenSection(Section(grid, level, len(data), "structure", **counts), data)
        rows = level_rows(vertices)
        groups = list(pairwise(channel_groups(stored.n_channels)))
        some = [symbols[level][:, first:end] for first, end in groups]
        coded = threads.map(encode_level, some, repeat(rows))
        for (first, end), data in zip(groups, coded, strict=True):
            channels = {"first_channel": first, "n_channels": end - first}
            yield WrittenSection(Section(grid, level, len(data), "symbols", **channels), data)


def channel_groups(n_channels: int) -> list[int]:
    """Where the groups of channels begin, and the number of channels: each group doubles those before it.

    >>> channel_groups(1), channel_groups(8), channel_groups(10)
    ([0, 1], [0, 2, 4, 8], [0, 2, 4, 8, 10])
    """
    return [0, *(1 << n for n in range(1, n_channels.bit_length()) if 1 << n < n_channels), n_channels]


def _turn(written: WrittenSection) -> tuple[float, ...]:
    """By what the sections of an asset are sorted: a level after the coarser one, but later channels when
    finer levels have their first ones, half a level for each group of channels from the third on."""
    section = written.section
    late = max((section.end_channel - 1).bit_length() - 2, 0) if section.kind == "symbols" else 0
    return (
        late / 2 - section.level,
        section.grid != "densities",
        section.kind != "structure",
        -section.level,
        section.first_channel,
    )


def _cut(sections: Sequence[WrittenSection], n_before: int, n_behind: int) -> Iterator[WrittenPart]:
    """Parts of sections that follow each other, none of them empty."""
    ends = n_before + np.cumsum([len(written.data) for written in sections])
    firsts = [0]
    kinds = [(section.grid, section.kind) for section, _ in sections]
    whole = kinds.index(("features", "symbols")) + 1  # the least that can be shown
    for share in SHARES:
        most = share * (ends[-1] + n_behind)
        n = int(np.searchsorted(ends, most, side="right"))
        if n > firsts[-1] and n >= whole:
            firsts.append(n)
    for number, (first, end) in enumerate(pairwise(firsts)):
        some = sections[first:end]
        part = Part(part_name(number), tuple(written.section for written in some))
        yield WrittenPart(part, b"".join(written.data for written in some))
