"""Encoding of bytes as text in an HTML page: seven characters for six bytes, a sixth more.

Six bytes, the lowest first, are a number below 2^48, which is less than 116^7. Its seven digits in base 116,
the lowest first, are written as seven characters of `ALPHABET`. The alphabet has only ASCII characters, so
that the text is the same in every charset that a page may be taken for. It has none that HTML, JavaScript or
the line ends of text files give a meaning to. The last group of bytes is padded with zeros to six; the reader
must know the number of bytes.
"""

from __future__ import annotations

import numpy as np

_LEFT_OUT = b"\x00\n\r\x0b\x0c\x1a\x1b\"&'<\x7f"
"""Characters that are left out of the alphabet: line ends and spaces that a reader may change, ends of files
and of elements, quotes, and the first character of entities."""
ALPHABET = bytes(code for code in range(128) if code not in _LEFT_OUT)
BASE = len(ALPHABET)
"""Number of characters in the alphabet: 116."""
N_BYTES, N_CHARACTERS = 6, 7
_AT_ONCE = 1 << 18
"""Groups of bytes that are turned into text at a time, which takes some megabytes."""


def text_of_bytes(data: bytes) -> bytes:
    """Encode any bytes as ASCII text.

    >>> text_of_bytes(b"\\x00\\x00\\x00\\x00\\x00\\x00\\x01")
    b'\\x01\\x01\\x01\\x01\\x01\\x01\\x01\\x02\\x01\\x01\\x01\\x01\\x01\\x01'
    >>> bytes_of_text(text_of_bytes(b"any bytes")) [:9]
    b'any bytes'
    """
    groups = np.frombuffer(data + bytes(-len(data) % N_BYTES), np.uint8).reshape(-1, N_BYTES)
    characters = np.frombuffer(ALPHABET, np.uint8)
    text = np.empty((len(groups), N_CHARACTERS), np.uint8)
    for first in range(0, len(groups), _AT_ONCE):
        some = slice(first, first + _AT_ONCE)
        number = (groups[some].astype(np.uint64) << (8 * np.arange(N_BYTES, dtype=np.uint64))).sum(axis=1)
        for place in range(N_CHARACTERS):
            number, digit = np.divmod(number, np.uint64(BASE))
            text[some, place] = characters[digit]
    return text.tobytes()


def bytes_of_text(text: bytes) -> bytes:
    """Decode the text of `text_of_bytes`; zeros that pad the last bytes stay. Raises ValueError for other
    text."""
    digits = np.frombuffer(text, np.uint8).reshape(-1, N_CHARACTERS)
    places = np.full(256, BASE, np.uint64)
    places[list(ALPHABET)] = np.arange(BASE)
    digits = places[digits]
    if (digits == BASE).any():
        raise ValueError("text: expected characters of the alphabet, got others")
    number = (digits * np.uint64(BASE) ** np.arange(N_CHARACTERS, dtype=np.uint64)).sum(axis=1)
    return number.astype("<u8").view(np.uint8).reshape(-1, 8)[:, :N_BYTES].tobytes()
