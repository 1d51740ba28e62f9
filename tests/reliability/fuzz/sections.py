"""Broken sections of the entropy coder: the symbols of a pyramid's levels, and their bricks and cells."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable
from unittest.mock import patch

import numpy as np

from player.asset.bricks import pack_vertices
from player.asset.coder import arrays, coder
from player.asset.pyramid import Bricks, whole_pyramid
from player.asset.structure import decode_structure, encode_structure
from player.asset.symbols import decode_level, encode_level, level_rows
from player.compiling import available
from player.errors import FormatError
from tests.reliability.fuzz.broken import broken_bytes
from tests.reliability.fuzz.targets import Target

HEADER = struct.Struct("<III")
"""Header of a section: numbers of lanes, of bytes of the tables, and of words."""


def _bricks(cells: np.ndarray) -> Bricks:
    coords, masks, _ = pack_vertices(cells)
    return Bricks(coords, masks)


def broken_section(data: bytes, random: np.random.Generator) -> bytes:
    """Return a section with another header, with tables broken before packing, or with broken bytes."""
    change = random.random()
    if len(data) < HEADER.size or change < 0.3:
        return broken_bytes(data, random)
    numbers = list(HEADER.unpack_from(data))
    if change < 0.5:
        which = int(random.integers(0, 3))
        numbers[which] = int(
            random.choice([0, 1, numbers[which] - 1, numbers[which] + 1, 4096, 2**31, 2**32 - 1])
        )
        return HEADER.pack(*(number % 2**32 for number in numbers)) + data[HEADER.size :]
    begin = HEADER.size + numbers[1]
    if change < 0.7:
        return data[:begin] + broken_bytes(data[begin:], random)
    packed = zlib.compress(broken_bytes(zlib.decompress(data[HEADER.size : begin]), random))
    return HEADER.pack(numbers[0], len(packed), numbers[2]) + packed + data[begin:]


def _by_both(read: Callable[[], np.ndarray]) -> None:
    """Decode with compiled code and with numpy, which must give the same result."""
    found: list[object] = []
    for compiled in (True, False) if available() else (False,):
        with patch.object(coder, "_twin", coder._twin if compiled else lambda: arrays):
            try:
                found.append(read().tobytes())
            except FormatError as error:
                found.append(str(error))
    if any(each != found[0] for each in found):
        raise AssertionError(f"expected the same of both decoders, got {[str(each)[:80] for each in found]}")
    if isinstance(found[0], str):
        raise FormatError(found[0])


def section_targets() -> list[Target]:
    """Return targets that break the symbols and structures of a ball on two levels."""
    cells = np.argwhere(np.ones((20, 20, 20)))
    away = np.linalg.norm((cells + 0.5) / 10 - 1, axis=1)
    fine, coarse = cells[(away < 0.8) & (cells[:, 0] < 8)], np.argwhere(np.ones((10, 10, 10)))
    pyramid = whole_pyramid(20, [_bricks(fine), _bricks(coarse)])
    random = np.random.default_rng(0)
    rows = level_rows(pyramid.vertices[0])
    symbols = np.rint(random.laplace(0, 2, (rows.neighbours.n, 3))).astype(np.int16)
    symbols[::100] *= 60
    whole = encode_level(np.clip(symbols, -255, 255), rows)
    structures = [encode_structure(pyramid, level) for level in (0, 1)]
    input_: dict[str, tuple[int, bytes]] = {}

    def prepare_symbols(random: np.random.Generator) -> None:
        input_["symbols"] = 0, broken_section(whole, random)

    def prepare_structure(random: np.random.Generator) -> None:
        level = int(random.integers(0, 2))
        data = structures[level]
        if random.random() < 0.3:
            data = broken_bytes(data, random)
        else:  # one of its sections, with its length
            parts, at = [], 0
            while at < len(data):
                (length,) = struct.unpack_from("<I", data, at)
                parts.append(data[at + 4 : at + 4 + length])
                at += 4 + length
            which = int(random.integers(0, len(parts)))
            parts[which] = broken_section(parts[which], random)
            data = b"".join(struct.pack("<I", len(part)) + part for part in parts)
        input_["structure"] = level, data

    def read_symbols() -> None:
        _by_both(lambda: decode_level(input_["symbols"][1], rows, 3, "part_1.bin"))

    def read_structure() -> None:
        level, data = input_["structure"]
        parent = pyramid.levels[1] if level == 0 else None
        n_bricks = len(pyramid.levels[level])
        n_cells = pyramid.cells_per_axis(level)
        _by_both(lambda: decode_structure(data, n_cells, parent, n_bricks, "part_0.bin").masks)

    return [
        Target("symbols of a level", prepare_symbols, read_symbols),
        Target("structure of a level", prepare_structure, read_structure),
    ]
