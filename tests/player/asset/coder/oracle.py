"""A slow decoder of the entropy coder's sections, written to be easy to read."""

from __future__ import annotations

import struct
import zlib

from player.asset.coder.lanes import Neighbours


def context(symbols: list[int]) -> int:
    """Return the context for the symbols of the neighbours, which are 0 where not known."""
    near = [max(-15, min(15, symbol)) for symbol in symbols]
    total, lean = sum(map(abs, near)), sum(near)
    side = sum(bound <= abs(lean) for bound in (1, 2, 4, 8)) * (1 if lean > 0 else -1)
    return sum(bound <= total for bound in (1, 2, 3, 5, 8, 12, 18, 30)) * 9 + side + 4


class Oracle:
    """Decoder of one section, symbol by symbol with Python's integers, written from `docs/format.md`."""

    def __init__(self, data: bytes, neighbours: Neighbours, n_channels: int, n_classes: int) -> None:
        self.n, self.rows = neighbours.n, neighbours.rows.tolist()
        self.n_lanes, n_packed, n_words = struct.unpack_from("<III", data)
        content = zlib.decompress(data[12 : 12 + n_packed])
        n_named = n_channels * n_classes * 81
        self.named, n_tables = content[:n_named], content[n_named]
        at = n_named + 1 + 2 * n_tables
        self.tables = []
        for table in range(n_tables):
            first, n_symbols = content[n_named + 1 + 2 * table : n_named + 3 + 2 * table]
            counts = struct.unpack_from(f"<{n_symbols}H", content, at)
            at += 2 * n_symbols
            places = [(first - 63 + i, place) for i, c in enumerate(counts) for place in range(c)]
            self.tables.append((places, {first - 63 + i: c for i, c in enumerate(counts)}))
        at = 12 + n_packed
        self.states = list(struct.unpack_from(f"<{self.n_lanes}I", data, at))
        at += 4 * self.n_lanes
        self.words = list(struct.unpack_from(f"<{n_words}H", data, at))[::-1]
        self.beyond = list(data[at + 2 * n_words :])[::-1]
        self.n_classes = n_classes

    def channel(self, number: int, classes: list[int]) -> list[int]:
        found: dict[int, int] = {}
        runs, row = [], 0
        for lane in range(self.n_lanes):
            length = self.n // self.n_lanes + (lane < self.n % self.n_lanes)
            runs.append(range(row, row + length))
            row += length
        for step in range(len(runs[0])):
            coded = {}
            for lane, run in enumerate(runs):
                if step < len(run):
                    coded[run[step]] = self.symbol(lane, number, run[step], classes, found)
            found |= coded
        for row in range(self.n):
            if abs(found[row]) == 63:
                found[row] += (1 if found[row] > 0 else -1) * self.beyond.pop()
        return [found[row] for row in range(self.n)]

    def symbol(self, lane: int, channel: int, row: int, classes: list[int], found: dict[int, int]) -> int:
        near = context([found.get(rows[row], 0) for rows in self.rows])
        name = (channel * self.n_classes + classes[row]) * 81 + near
        places, counts = self.tables[self.named[name]]
        x = self.states[lane]
        symbol, place = places[x % 4096]
        x = counts[symbol] * (x // 4096) + place
        if x < 65536:
            x = x * 65536 + self.words.pop()
        self.states[lane] = x
        return symbol
