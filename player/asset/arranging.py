"""Arrange the sections of a new asset in parts, of which the first is a whole, coarser picture.

Sections are sorted by what they show: first all that the coarsest picture needs, then what makes it sharper,
with densities before features and the first channels before the others. They are cut into parts so that the
first picture, head and cameras included, needs only a few hundredths of the asset's bytes and appears at
once. Further parts end at about a tenth, a quarter and half of the bytes (`SHARES`). If head and cameras take
so many of them that nothing can be shown within one of these shares, the first part ends at a later one.
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
"""The largest share of all bytes that is read up to the end of the first part, of the second, ..."""
OTHERS = 9
"""Bytes of the other files for each byte of a mesh that a bake makes: the mesh takes at most a tenth of the
asset's bytes."""
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
        groups = list(pairwise(channel_groups(stored.n_channels)))
        some = [symbols[level][:, first:end] for first, end in groups]
        coded = threads.map(encode_level, some, repeat(rows))
        for (first, end), data in zip(groups, coded, strict=True):
            channels = {"first_channel": first, "n_channels": end - first}
            yield WrittenSection(Section(grid, level, len(data), "symbols", **channels), data)


def channel_groups(n_channels: int) -> list[int]:
    """Return where each group of channels begins, and last the number of channels. Each group doubles the
    number of channels up to its end.

    >>> channel_groups(1), channel_groups(8), channel_groups(10)
    ([0, 1], [0, 2, 4, 8], [0, 2, 4, 8, 10])
    """
    return [0, *(1 << n for n in range(1, n_channels.bit_length()) if 1 << n < n_channels), n_channels]


def _turn(written: WrittenSection) -> tuple[float, ...]:
    """Return the key by which the sections of an asset are sorted.

    A level comes after the coarser one. Later channels come together with the first channels of finer levels:
    each group of channels from the third on is delayed by half a level.
    """
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
    """Yield parts made of successive sections, none of them empty."""
    ends = n_before + np.cumsum([len(written.data) for written in sections])
    firsts = [0]
    kinds = [(section.grid, section.kind) for section, _ in sections]
    whole = kinds.index(("features", "symbols")) + 1  # the fewest sections that can be shown
    for share in SHARES:
        most = share * (ends[-1] + n_behind)
        n = int(np.searchsorted(ends, most, side="right"))
        if n > firsts[-1] and n >= whole:
            firsts.append(n)
    for number, (first, end) in enumerate(pairwise(firsts)):
        some = sections[first:end]
        part = Part(part_name(number), tuple(written.section for written in some))
        yield WrittenPart(part, b"".join(written.data for written in some))
