"""The sections that the parts of an asset are made of, as the manifest lists them.

A section is either the *structure* of one level of one of the two pyramids (its bricks and live cells), or
the *symbols* of some channels of one level: by how many steps the values differ from what the next coarser
level predicts. Sections follow one another in the files `part_0.bin`, `part_1.bin`, ..., in an order in which
each can be decoded from those before it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from player.asset.pyramid import MAX_LEVELS
from player.errors import FormatError

Grid = Literal["densities", "features"]
Kind = Literal["structure", "symbols"]

MAX_ROWS = 2**31 - 1
"""The most vertices of all levels of a pyramid together: rows are numbered in int32."""
MAX_PARTS = 64
MAX_SECTIONS = 1024
"""The most sections of all parts together."""
MAX_CHANNELS = 1024


@dataclass(frozen=True)
class Section:
    """One section: its grid, level and kind, its sizes, and the bytes that it takes."""

    grid: Grid
    level: int
    bytes: int
    kind: Kind
    n_bricks: int = 0
    """For a structure: bricks of the level."""
    n_vertices: int = 0
    """For a structure: vertices of the level, those on the border included."""
    first_channel: int = 0
    n_channels: int = 0
    """For symbols: number of channels, from `first_channel` on."""

    @property
    def end_channel(self) -> int:
        return self.first_channel + self.n_channels

    @property
    def name(self) -> str:
        """Name of the section in messages.

        >>> Section("features", 2, 900, "symbols", first_channel=4, n_channels=4).name
        'features, level 2, symbols of channels 4 to 7'
        """
        if self.kind == "structure":
            return f"{self.grid}, level {self.level}, structure"
        return (
            f"{self.grid}, level {self.level}, symbols of channels {self.first_channel} to "
            f"{self.end_channel - 1}"
        )


@dataclass(frozen=True)
class Part:
    """A file of sections."""

    file: str
    sections: tuple[Section, ...]

    @property
    def bytes(self) -> int:
        return sum(section.bytes for section in self.sections)


def part_name(number: int) -> str:
    """Return the file name of a part.

    >>> part_name(0)
    'part_0.bin'
    """
    return f"part_{number}.bin"


PART_NAMES = tuple(map(part_name, range(MAX_PARTS)))


def parts_as_json(parts: Sequence[Part]) -> list[dict[str, Any]]:
    """Return the value of the manifest's key `parts`."""
    return [
        {"file": part.file, "sections": [_section_as_json(section) for section in part.sections]}
        for part in parts
    ]


_COMMON = ("grid", "level", "bytes", "kind")
_OF_KIND = {"structure": ("n_bricks", "n_vertices"), "symbols": ("first_channel", "n_channels")}


def _section_as_json(section: Section) -> dict[str, Any]:
    return {key: getattr(section, key) for key in (*_COMMON, *_OF_KIND[section.kind])}


def parse_parts(where: str, value: object, newer: bool = False) -> tuple[Part, ...]:
    """Parse the manifest's `parts`, and check that each number is within its bounds. Raises FormatError.

    `newer`: whether the manifest is of a newer minor version, whose unknown keys are ignored.
    `in_order` checks that the parts agree with each other and with the rest of the manifest.
    """
    if isinstance(value, tuple) and all(isinstance(part, Part) for part in value):
        value = parts_as_json(value)
    if not isinstance(value, list) or len(value) > MAX_PARTS:
        raise FormatError(f"{where}: expected a list of at most {MAX_PARTS} parts, got {shown(value)}")
    parts = tuple(_parse_part(f"{where}: {number}", number, part, newer) for number, part in enumerate(value))
    n_sections = sum(len(part.sections) for part in parts)
    if n_sections > MAX_SECTIONS:
        raise FormatError(f"{where}: expected at most {MAX_SECTIONS} sections, got {n_sections}")
    return parts


def _parse_part(where: str, number: int, value: object, newer: bool) -> Part:
    if not isinstance(value, dict) or not _has_keys(value, {"file", "sections"}, newer):
        raise FormatError(f"{where}: expected an object with file and sections, got {shown(value)}")
    if value["file"] not in PART_NAMES:
        raise FormatError(f"{where}: file: expected {part_name(number)}, got {shown(value['file'])}")
    sections = value["sections"]
    if not isinstance(sections, list) or not 1 <= len(sections) <= MAX_SECTIONS:
        raise FormatError(f"{where}: sections: expected a list of 1 to {MAX_SECTIONS}, got {shown(sections)}")
    found = (_parse_section(f"{where}: section {i}", section, newer) for i, section in enumerate(sections))
    return Part(value["file"], tuple(found))


def _has_keys(value: dict[str, Any], keys: set[str], newer: bool) -> bool:
    return keys <= set(value) if newer else keys == set(value)


_MOST = {
    "level": MAX_LEVELS - 1,
    "bytes": 1 << 40,
    "n_bricks": 1 << 28,
    "n_vertices": MAX_ROWS,
    "first_channel": MAX_CHANNELS - 1,
    "n_channels": MAX_CHANNELS,
}


def _parse_section(where: str, value: object, newer: bool) -> Section:
    if not isinstance(value, dict) or value.get("kind") not in ("structure", "symbols"):
        raise FormatError(f'{where}: expected an object of kind "structure" or "symbols", got {shown(value)}')
    keys = {*_COMMON, *_OF_KIND[value["kind"]]}
    if not _has_keys(value, keys, newer):
        raise FormatError(f"{where}: expected the keys {sorted(keys)}, got {shown(sorted(map(str, value)))}")
    if value["grid"] not in ("densities", "features"):
        raise FormatError(f'{where}: grid: expected "densities" or "features", got {shown(value["grid"])}')
    for key, most in _MOST.items():
        number = value[key] if key in keys else 0
        if isinstance(number, bool) or not isinstance(number, int) or not 0 <= number <= most:
            raise FormatError(f"{where}: {key}: expected an integer in 0..{most}, got {shown(number)}")
    return Section(**{key: value[key] for key in keys})


def in_order(
    where: str,
    parts: Sequence[Part],
    resolutions: dict[Grid, int],
    n_levels: dict[Grid, int],
    n_channels: int,
) -> Iterator[Part]:
    """Yield the parts whose sections can be decoded from those before them and fit into their pyramids.

    A structure comes after that of the next coarser level. Symbols come after the structure of their level,
    after those of the channels before them, and after those of the same channels on the next coarser level.

    Args:
        where: the manifest's name in error messages.
        parts: the parts, as `parse_parts` returns them.
        resolutions: cells along each axis of the finest level of each pyramid.
        n_levels: number of levels of each pyramid.
        n_channels: channels of the features.

    Raises FormatError, in place of the first part that cannot be decoded.
    """
    known = {grid: [-1] * n for grid, n in n_levels.items()}
    n_rows: dict[Grid, int] = {"densities": 0, "features": 0}
    for number, part in enumerate(parts):
        name = part_name(number)
        if part.file != name:
            raise FormatError(f"{where}: parts: {number}: file: expected {name}, got {part.file}")
        for section in part.sections:
            place = f"{where}: parts: {number}: {section.name}"
            if section.level >= n_levels[section.grid]:
                raise FormatError(f"{place}: expected a level below {n_levels[section.grid]}")
            if section.kind == "structure":
                _check_structure(section, resolutions[section.grid], place)
                n_rows[section.grid] += section.n_vertices
                if n_rows[section.grid] > MAX_ROWS:
                    raise FormatError(f"{place}: expected at most {MAX_ROWS} vertices, got more")
            elif not 1 <= section.n_channels <= _channels(section.grid, n_channels) - section.first_channel:
                raise FormatError(f"{place}: expected channels below {_channels(section.grid, n_channels)}")
            _check_order(section, known[section.grid], place)
        yield part


def _channels(grid: Grid, n_channels: int) -> int:
    return n_channels if grid == "features" else 1


def _check_structure(section: Section, resolution: int, where: str) -> None:
    n_cells = -(-resolution >> section.level)  # rounds up
    n_bricks = (-(-n_cells // 8)) ** 3
    if section.n_bricks > n_bricks:
        raise FormatError(f"{where}: n_bricks: expected at most {n_bricks}, got {section.n_bricks}")
    least, most = (8 * bool(section.n_bricks), min(729 * section.n_bricks, (n_cells + 1) ** 3))
    if not least <= section.n_vertices <= most:
        raise FormatError(
            f"{where}: n_vertices: expected {least} to {most} for {section.n_bricks} bricks, got "
            f"{section.n_vertices}"
        )


def _check_order(section: Section, known: list[int], where: str) -> None:
    """Raise FormatError if a section was there before, or comes before one that it needs.

    `known` has, for each level of the pyramid, the number of channels that the sections before have brought,
    or -1 as long as the level has no structure; it is brought up to date.
    """
    level, coarser = section.level, section.level + 1
    last = coarser == len(known)
    if section.kind == "structure":
        if known[level] >= 0:
            raise FormatError(f"{where}: expected each structure once")
        if not last and known[coarser] < 0:
            raise FormatError(f"{where}: expected the structure of level {coarser} before it")
        known[level] = 0
        return
    if known[level] != section.first_channel:
        before = "the structure of the level" if known[level] < 0 else f"channel {known[level]}"
        raise FormatError(f"{where}: expected {before} before it, each channel once")
    if not last and known[coarser] < section.end_channel:
        raise FormatError(f"{where}: expected these channels of level {coarser} before it")
    known[level] = section.end_channel


def shown(value: object) -> str:
    """Return a value as messages show it: short, in ASCII."""
    text = ascii(value)
    return text if len(text) < 80 else text[:77] + "..."
