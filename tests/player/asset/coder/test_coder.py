"""Tests of the entropy coder: a decoder of plain integers, the numpy and numba twins, and broken bytes."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable
from types import ModuleType

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from player import compiling
from player.asset.coder import arrays, coder
from player.asset.coder.coder import MAX_LANES, Decoder, decode, encode
from player.asset.coder.lanes import Neighbours, RowsToLanes
from player.asset.coder.tables import (
    CONTEXT_OF_SUM,
    END,
    MIXED,
    N_CONTEXTS,
    N_SYMBOLS,
    TOTAL,
    fit_tables,
    unpack_tables,
)
from player.errors import FormatError, ShapeError
from tests.numerics.bounds import Row
from tests.player.asset.coder.oracle import Oracle, context

CODER = "The entropy coder"
ROUND_TRIP = Row(
    CODER, "symbols, by both twins and an oracle of plain integers", "-255 to 255, none to 5,000 rows", 0,
    at_ends="symbols beyond ±62 take bytes of their own; no row or no channel is no byte",
)  # fmt: skip
TABLES = Row(
    CODER, "frequencies of a table", "any counts, contexts that never come", 0,
    at_ends="they add up to 4096, and every symbol that was seen has at least 1",
)  # fmt: skip
CONTEXTS = Row(
    CODER, "context from a sum of three neighbours, against that from themselves", "-63 to 63 each", 0,
    at_ends="all at one end: the last contexts",
)  # fmt: skip
SIZE = Row(
    CODER, "bytes, as a share of the entropy without contexts", "200,000 symbols that lean on neighbours",
    0.97,
)  # fmt: skip
OUT_OF_RANGE = Row(
    CODER, "symbols out of range, arrays that do not fit", unit="refused", at_ends="when encoding"
)
BROKEN_BYTES = Row(
    CODER, "broken bytes", "each field of the header, tables, states and words", unit="refused",
    at_ends="both twins with the same message; tables of 10 MB are not unpacked",
)  # fmt: skip
CHANGED = Row(
    CODER, "any changed or random bytes", "up to 4 bytes changed, cut or added; none to 300 random bytes",
    unit="the same from both twins",
)  # fmt: skip
DAMAGED_WORD = Row(CODER, "one bit changed in the states or words", "300 places", unit="refused")

TWINS = ["numpy", "numba"]


@pytest.fixture(params=TWINS)
def twin(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    return use(request.param, monkeypatch)


def use(name: str, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """Make the coder use the twin `name` ("numpy" or "numba") alone, and return the twin's module."""
    from player.asset.coder import compiled

    assert compiling.available()
    module = arrays if name == "numpy" else compiled
    monkeypatch.setattr(coder, "_twin", lambda: module)
    return module


def test_compiled_code_is_chosen_where_there_is_numba(monkeypatch: pytest.MonkeyPatch) -> None:
    assert coder._twin().__name__ == "player.asset.coder.compiled"
    monkeypatch.setattr(compiling, "numba", None)
    assert coder._twin() is arrays


def oracle(data: bytes, neighbours: Neighbours, classes: list[np.ndarray], n_classes: int) -> np.ndarray:
    read = Oracle(data, neighbours, len(classes), n_classes)
    found = [read.channel(i, each.tolist()) for i, each in enumerate(classes)]
    assert not read.words and not read.beyond and set(read.states) == {65536}
    return np.array(found).T


def case(
    n: int, n_channels: int, scale: float, seed: int = 0, n_classes: int = 3
) -> tuple[np.ndarray, Neighbours, list[np.ndarray], int]:
    """Return symbols that resemble their neighbours, and what `encode` takes beside them.

    Every tenth neighbour is missing, and some come later.
    """
    random = np.random.default_rng(seed)
    rows = np.arange(n)[None] - np.array([[1], [7], [40]])
    rows = np.where(random.random((3, n)) < 0.05, random.integers(0, max(n, 1), (3, n)), rows)
    rows = np.where((rows < 0) | (random.random((3, n)) < 0.1), -1, rows).astype(np.int32)
    classes = [random.integers(0, n_classes, n).astype(np.uint8) for _ in range(n_channels)]
    width = scale * (1 + 2 * np.stack(classes, axis=-1)) if n_channels else np.zeros((n, 0))
    smooth = np.cumsum(random.normal(0, 0.3, (n, n_channels)), axis=0)
    symbols = np.rint(random.laplace(0, 1, (n, n_channels)) * width + scale * np.sin(smooth))
    return np.clip(symbols, -255, 255).astype(np.int16), Neighbours(rows), classes, n_classes


CASES = {
    "nothing": (0, 3, 1.0),
    "no channels": (5, 0, 1.0),
    "one": (1, 1, 1.0),
    "fewer rows than lanes would be": (255, 2, 1.0),
    "a row more than lanes": (513, 2, 1.0),
    "zeros": (3000, 2, 0.0),
    "few": (3000, 3, 0.1),
    "many": (5000, 2, 3.0),
    "ends and beyond": (2000, 2, 120.0),
}


@pytest.mark.parametrize("name", CASES)
def test_what_was_encoded_is_decoded(name: str, twin: ModuleType) -> None:
    symbols, neighbours, classes, n_classes = case(*CASES[name])
    data = encode(symbols, neighbours, classes, n_classes)
    found = decode(data, neighbours, classes, n_classes, "here")
    assert found.dtype == np.int16
    ROUND_TRIP.check(found, symbols)
    if symbols.size:
        ROUND_TRIP.check(oracle(data, neighbours, classes, n_classes), symbols)
    else:
        assert data == b""


@pytest.mark.parametrize("name", CASES)
def test_both_twins_write_the_same_bytes(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    found = []
    for twin in TWINS:
        use(twin, monkeypatch)
        found.append(encode(*case(*CASES[name])))
    assert found[0] == found[1]


@pytest.mark.parametrize("value", [-255, -64, -63, -62, 62, 63, 64, 255])
def test_ends(value: int, twin: ModuleType) -> None:
    symbols, neighbours, classes, n_classes = case(700, 2, 1.0)
    symbols[::9, 0], symbols[5:9, 1] = value, value
    data = encode(symbols, neighbours, classes, n_classes)
    ROUND_TRIP.check(decode(data, neighbours, classes, n_classes, "here"), symbols)
    ROUND_TRIP.check(oracle(data, neighbours, classes, n_classes), symbols)


@given(
    n=st.integers(1, 900),
    n_channels=st.integers(1, 3),
    scale=st.sampled_from([0.01, 0.3, 2.0, 30.0]),
    seed=st.integers(0, 1000),
)
@example(n=512, n_channels=1, scale=0.3, seed=0)
@settings(max_examples=60, deadline=None)
def test_any_symbols(n: int, n_channels: int, scale: float, seed: int) -> None:
    symbols, neighbours, classes, n_classes = case(n, n_channels, scale, seed)
    data = encode(symbols, neighbours, classes, n_classes)
    for name in TWINS:
        with pytest.MonkeyPatch.context() as patch:
            use(name, patch)
            ROUND_TRIP.check(decode(data, neighbours, classes, n_classes, "here"), symbols)
    ROUND_TRIP.check(oracle(data, neighbours, classes, n_classes), symbols)


def test_bytes_are_as_few_as_the_contexts_allow() -> None:
    symbols, neighbours, classes, n_classes = case(200_000, 1, 1.0)
    data = encode(symbols, neighbours, classes, n_classes)
    share = np.bincount(symbols[:, 0] + 255) / len(symbols)
    order_0 = -(share[share > 0] * np.log2(share[share > 0])).sum() * len(symbols) / 8
    SIZE.check(len(data), of=order_0)
    # a section of only one symbol costs its tables and four bytes per lane
    zeros = encode(np.zeros_like(symbols), neighbours, classes, n_classes)
    assert len(zeros) < 4 * (200_000 >> 12) + 80


def test_contexts_by_their_sums() -> None:
    random = np.random.default_rng(0)
    symbols = random.integers(-END, END + 1, (3, 10000)) // random.integers(1, 40, 10000)
    sums = MIXED[symbols + END].astype(int).sum(axis=0)
    CONTEXTS.check(CONTEXT_OF_SUM[sums + 64], [context(near) for near in symbols.T.tolist()])
    assert context([END] * 3) == 80 and context([-END] * 3) == 72


def test_tables_cost_what_they_say() -> None:
    random = np.random.default_rng(0)
    seen = random.poisson(3 * np.exp(-np.abs(np.arange(-END, END + 1)) / 2), (2, 3, N_CONTEXTS, N_SYMBOLS))
    seen[:, 1] = 0  # contexts that never occur
    seen[0, 0, 5, 0] = 10**6  # and one whose symbols are nearly all the same
    filled = np.flatnonzero(seen.any(axis=-1))
    tables, n_bits = fit_tables(seen.reshape(-1, N_SYMBOLS)[filled], filled, (2, 3))
    assert TOTAL == 4096
    TABLES.check(tables.counts.sum(axis=1), TOTAL)
    counts = tables.counts[tables.of_context].astype(float)
    assert (counts[seen > 0] > 0).all()
    assert n_bits == pytest.approx((seen[seen > 0] * (12 - np.log2(counts[seen > 0]))).sum())
    again = unpack_tables(tables.packed(), 2, 3, "here")
    assert all(np.array_equal(*pair) for pair in zip(again, tables, strict=True))


def test_lanes_are_runs_of_rows() -> None:
    for n, n_lanes in ((1, 1), (7, 3), (9, 3), (10, 10), (11, 10), (4096, 1)):
        lanes = RowsToLanes(n, n_lanes)
        order = lanes.in_order(np.arange(n))
        assert np.array_equal(lanes.by_row(order), np.arange(n))
        assert np.array_equal(lanes.step()[order], np.arange(n) // n_lanes)


@pytest.mark.parametrize(
    "wrong",
    [
        lambda s, n, c: (s[:-1], n, c, 3),
        lambda s, n, c: (s, n, c[:-1], 3),
        lambda s, n, c: (s, n, [each[:-1] for each in c], 3),
        lambda s, n, c: (s, n, c, 2),
        lambda s, n, c: (s + 256, n, c, 3),
        lambda s, n, c: (s - 256, n, c, 3),
        lambda s, n, c: (s[:, 0], n, c, 3),
    ],
)
def test_what_cannot_be_encoded(wrong: Callable[..., tuple]) -> None:
    symbols, neighbours, classes, _ = case(100, 2, 1.0)
    with pytest.raises(ShapeError, match="coder: "):
        encode(*wrong(symbols, neighbours, classes))
    OUT_OF_RANGE.holds()


# ---------------------------------------------------------------------------------------------- broken bytes

SYMBOLS, ROWS, CLASSES, N_CLASSES = case(1500, 2, 0.8)
SYMBOLS[3:2000:50] *= 60
SYMBOLS.clip(-255, 255, out=SYMBOLS)
WHOLE = encode(SYMBOLS, ROWS, CLASSES, N_CLASSES)
N_LANES, N_PACKED, N_WORDS = struct.unpack_from("<III", WHOLE)
STATES = 12 + N_PACKED


def outcome(data: bytes, name: str) -> str | bytes:
    """Return what the twin `name` decodes: the symbols' bytes, or the message of the error."""
    with pytest.MonkeyPatch.context() as patch:
        use(name, patch)
        try:
            return decode(data, ROWS, CLASSES, N_CLASSES, "here").tobytes()
        except FormatError as error:
            assert str(error).startswith("here: ")
            return str(error)


def refused(data: bytes) -> str:
    """Return the message with which both twins refuse broken bytes."""
    found, other = (outcome(data, name) for name in TWINS)
    assert found == other and isinstance(found, str)
    return found


def with_tables(change: Callable[[bytearray], None]) -> bytes:
    content = bytearray(zlib.decompress(WHOLE[12:STATES]))
    change(content)
    packed = zlib.compress(bytes(content))
    return struct.pack("<III", N_LANES, len(packed), N_WORDS) + packed + WHOLE[STATES:]


N_NAMED = 2 * N_CLASSES * N_CONTEXTS


def _put(at: int, value: int) -> Callable[[bytearray], None]:
    return lambda content: content.__setitem__(at, value)


BROKEN = {
    "nothing": (b"", "header"),
    "a byte": (b"\x01", "header"),
    "no lanes": (struct.pack("<I", 0) + WHOLE[4:], "lanes: expected 1 to 1500, got 0"),
    "more lanes than rows": (struct.pack("<I", 1501) + WHOLE[4:], "lanes: expected 1 to 1500"),
    "4294967295 lanes": (struct.pack("<I", 2**32 - 1) + WHOLE[4:], "lanes: "),
    "another number of lanes": (struct.pack("<I", N_LANES - 1) + WHOLE[4:], ""),
    "more words than bytes": (WHOLE[:8] + struct.pack("<I", 2**32 - 1) + WHOLE[12:], "expected at least"),
    "longer tables than bytes": (WHOLE[:4] + struct.pack("<I", 2**32 - 1) + WHOLE[8:], "expected at least"),
    "a word less": (WHOLE[:8] + struct.pack("<I", N_WORDS - 1) + WHOLE[12:], ""),
    "cut": (WHOLE[:-200], ""),
    "a byte more": (WHOLE + b"\0", "symbols beyond 63: expected"),
    "a byte less": (WHOLE[:-1], "symbols beyond 63: expected more than"),
    "far beyond": (WHOLE[:-1] + b"\xc1", "symbols: expected magnitudes up to 255"),
    "a low state": (WHOLE[:STATES] + struct.pack("<I", 65535) + WHOLE[STATES + 4 :], "states: "),
    "another state": (WHOLE[:STATES] + struct.pack("<I", 65536) + WHOLE[STATES + 4 :], ""),
    "another word": (WHOLE[: STATES + 4 * N_LANES + 40] + b"\x55" + WHOLE[STATES + 4 * N_LANES + 41 :], ""),
    "no zlib": (WHOLE[:12] + b"\0" + WHOLE[13:], "tables: expected a zlib stream"),
    "counts that add up to less": (with_tables(_put(-2, 0)), "tables: "),
    "no tables": (with_tables(_put(N_NAMED, 0)), "tables: "),
    "65 tables": (with_tables(_put(N_NAMED, 65)), "tables: "),
    "a table of no symbols": (with_tables(_put(N_NAMED + 2, 0)), "tables: "),
    "a symbol too large": (with_tables(_put(N_NAMED + 1, 127)), "tables: "),
    "a context of no table": (with_tables(_put(7, 200)), "tables: "),
    "fewer contexts": (with_tables(lambda content: content.__delitem__(slice(0, 1))), "tables: "),
    "a table's byte more": (with_tables(lambda content: content.append(0)), "tables: "),
    "tables without end": (with_tables(lambda content: content.extend(bytes(10**7))), "tables: "),
}


@pytest.mark.parametrize("name", BROKEN)
def test_broken_bytes(name: str) -> None:
    data, said = BROKEN[name]
    BROKEN_BYTES.holds(said in refused(data))


@given(
    cut=st.integers(0, len(WHOLE)),
    changes=st.lists(st.tuples(st.integers(0, len(WHOLE) - 1), st.integers(1, 255)), max_size=4),
    more=st.binary(max_size=20),
)
@settings(max_examples=200, deadline=None)
def test_changed_bytes(cut: int, changes: list[tuple[int, int]], more: bytes) -> None:
    """Both twins agree about any changed bytes. If a changed header passes, the symbols are right."""
    data = bytearray(WHOLE)
    for at, by in changes:
        data[at] ^= by
    data = bytes(data if cut % 3 else data[:cut]) + more
    found, other = (outcome(data, name) for name in TWINS)
    CHANGED.holds(found == other)
    if isinstance(found, bytes) and data[: len(data) - 40] != WHOLE[: len(data) - 40]:
        assert found == SYMBOLS.tobytes() or data[:12] == WHOLE[:12]


@given(st.binary(max_size=300), st.integers(1, 60))
@settings(max_examples=200, deadline=None)
def test_random_bytes(content: bytes, n_lanes: int) -> None:
    packed = WHOLE[12:STATES]
    for data in (content, struct.pack("<III", n_lanes, N_PACKED, 7) + packed + content):
        found, other = (outcome(data, name) for name in TWINS)
        CHANGED.holds(found == other)


def test_no_damaged_word_passes() -> None:
    begin = STATES
    end = len(WHOLE) - int((np.abs(SYMBOLS) >= END).sum())
    random = np.random.default_rng(0)
    for _ in range(300):
        data = bytearray(WHOLE)
        data[random.integers(begin, end)] ^= 1 << random.integers(0, 8)
        refused(bytes(data))
    DAMAGED_WORD.holds()


def test_channels_are_read_one_by_one_and_all_of_them(twin: ModuleType) -> None:
    decoder = Decoder(WHOLE, ROWS, 2, N_CLASSES, "here")
    assert np.array_equal(decoder.channel(CLASSES[0]), SYMBOLS[:, 0])
    with pytest.raises(FormatError, match="words: expected"):
        decoder.finish()
    assert np.array_equal(decoder.channel(CLASSES[1]), SYMBOLS[:, 1])
    decoder.finish()


def test_nothing_is_written_for_nothing() -> None:
    none = Neighbours(np.zeros((3, 0), np.int32))
    assert decode(b"", none, [np.zeros(0, np.uint8)], 1, "here").shape == (0, 1)
    with pytest.raises(FormatError, match="here: expected no bytes for no symbols, got 1"):
        decode(b"\0", none, [np.zeros(0, np.uint8)], 1, "here")
    assert MAX_LANES == 4096
