"""Arrange the sections of a new asset in parts, of which the first is a whole, coarser picture.

Sections are sorted by what they show: first all that the coarsest picture needs, then what makes it sharper,
with densities before features and the first channels before the others. Parts end at a few hundredths, about
a tenth, a quarter and half of the bytes, head and cameras included (`SHARES`). Each takes the sections that
still fit, in this order, and leaves the others to later parts; so a single large section does not keep small
ones waiting, and every part ends near its share. If head and cameras take so many bytes that nothing can be
shown within one of these shares, the first part ends at a later one.

docs/notes/2026-11-30-order-of-parts.md compares orders.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise, repeat
from math import log2
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
"""The largest share of all bytes that is read up to the end of the first part, of the second, ..."""
OTHERS = 9
"""Bytes of the other files for each byte of a mesh that a bake makes: the mesh takes at most a tenth of the
asset's bytes."""
MOST_SINGLE = 64
"""The most channels that are coded one by one, because parts have at most 1024 sections."""
THREADS = 2
"""Number of sections that are encoded at a time: each takes memory of its own."""


class WrittenSection(NamedTuple):
    """A section with its bytes."""

    section: Section
    data: bytes


class WrittenPart(NamedTuple):
    """A part with the content of its file."""

    part: Part
    data: bytes


def write_parts(
    densities: PyramidValues, features: PyramidValues, manifest: Manifest, n_before: int, n_behind: int | None
) -> list[WrittenPart]:
    """Encode an asset's values as parts.

    Args:
        densities, features: the codes to store.
        manifest: has the quantization steps of the levels.
        n_before: bytes of the files that are read before the first part.
        n_behind: bytes of the mesh, which is read after the last part; None if it is not made yet, and will
            take at most a byte for OTHERS bytes of the other files.

    Raises FormatError: there are values that the steps of the manifest cannot reach.
    """
    with ThreadPoolExecutor(THREADS) as threads:
        sections = [
            *_sections("densities", densities, manifest.density_steps, threads),
            *_sections("features", features, manifest.feature_steps, threads),
        ]
    if n_behind is None:
        n_behind = (n_before + sum(len(written.data) for written in sections)) // OTHERS
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
    del again  # it takes as many bytes as the symbols
    for level, bricks in enumerate(pyramid.levels):
        if not len(bricks):
            continue
        data = encode_structure(pyramid, level)
        vertices = pyramid.vertices[level]
        counts = {"n_bricks": len(bricks), "n_vertices": vertices.n}
        yield WrittenSection(Section(grid, level, len(data), "structure", **counts), data)
        rows = level_rows(vertices)
        groups = list(pairwise(channel_groups(stored.n_channels, level)))
        some = [symbols[level][:, first:end] for first, end in groups]
        coded = threads.map(encode_level, some, repeat(rows))
        for (first, end), data in zip(groups, coded, strict=True):
            channels = {"first_channel": first, "n_channels": end - first}
            yield WrittenSection(Section(grid, level, len(data), "symbols", **channels), data)


def channel_groups(n_channels: int, level: int) -> list[int]:
    """Return where each group of channels of a level begins, and last the number of channels.

    The channels of levels 1 and 2 are small enough to fill a part up, and take fewer bytes one by one. On
    other levels, each group doubles the number of channels, because each takes some bytes of its own.

    >>> channel_groups(1, 0), channel_groups(6, 0), channel_groups(6, 1)
    ([0, 1], [0, 1, 2, 4, 6], [0, 1, 2, 3, 4, 5, 6])
    """
    if level in (1, 2) and n_channels <= MOST_SINGLE:
        return list(range(n_channels + 1))
    return [0, *(1 << n for n in range(n_channels.bit_length()) if 1 << n < n_channels), n_channels]


def _turn(written: WrittenSection) -> tuple[float, ...]:
    """Return the key by which the sections of an asset are sorted.

    A level comes after the coarser one. Later channels come together with the first channels of finer levels:
    twice as many channels are delayed by one level. No section comes before one that it needs.
    """
    section = written.section
    late = log2(section.end_channel) if section.kind == "symbols" else 0
    return (
        late - section.level,
        section.grid != "densities",
        section.kind != "structure",
        -section.level,
        section.first_channel,
    )


def _place_in_part(written: WrittenSection) -> tuple[int, ...]:
    """Return the key by which the sections of a part are sorted: level by level, because a reader prepares
    the rows of a level for all of its sections that follow one another."""
    section = written.section
    return -section.level, section.grid != "densities", section.kind != "structure", section.first_channel


def _needs(section: Section, other: Section) -> bool:
    """Return whether a section cannot be decoded before another one that comes before it by `_turn`."""
    if section.grid != other.grid or other.level < section.level:
        return False
    if other.kind == "structure":
        return True
    return section.kind == "symbols" and other.first_channel < section.end_channel


def _that_fit(
    sections: Sequence[WrittenSection], most: float
) -> tuple[list[WrittenSection], list[WrittenSection]]:
    """Return the sections that fit into `most` bytes, taken in turn unless they need one that does not fit,
    and the others."""
    fit: list[WrittenSection] = []
    others: list[WrittenSection] = []
    for written in sections:
        left_out = any(_needs(written.section, other.section) for other in others)
        if left_out or len(written.data) > most:
            others.append(written)
        else:
            fit.append(written)
            most -= len(written.data)
    return fit, others


def _cut(sections: Sequence[WrittenSection], n_before: int, n_behind: int) -> Iterator[WrittenPart]:
    """Yield parts, none of them empty."""
    sizes = [len(written.data) for written in sections]
    total = n_before + sum(sizes) + n_behind
    kinds = [(section.grid, section.kind) for section, _ in sections]
    n_shown = kinds.index(("features", "symbols")) + 1  # the fewest sections that can be shown
    n_read, number = n_before, 0
    for share in SHARES:
        if n_before + sum(sizes[:n_shown]) > share * total:
            continue
        fit, sections = _that_fit(sections, share * total - n_read)
        if fit:
            fit.sort(key=_place_in_part)
            data = b"".join(written.data for written in fit)
            yield WrittenPart(Part(part_name(number), tuple(written.section for written in fit)), data)
            n_read, number = n_read + len(data), number + 1
