"""Test that freed memory goes back to the machine."""

from __future__ import annotations

import os
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from player.files.memory import give_back

N_BYTES = 3_000_000
"""Size of a picture: small enough for the C library to keep its memory for the thread that read it."""


def held_bytes() -> int:
    """Return the bytes of memory that this process holds; 0 where the machine does not tell."""
    try:
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
        return pages * os.sysconf("SC_PAGE_SIZE")
    except OSError:
        return 0


def test_what_threads_have_read_is_given_back() -> None:
    with ThreadPoolExecutor(1) as pool:
        # Once a larger block was freed, glibc keeps freed blocks up to that size instead of unmapping them.
        pool.submit(lambda: np.full(2 * N_BYTES, 1, np.uint8).sum()).result()
        # Measured before the pictures exist: they may lie in memory that this process had free already.
        before = held_bytes()
        pictures = list(pool.map(lambda i: np.full(N_BYTES, i, np.uint8), range(60)))
        kept = pictures.pop()
        pictures.clear()
        give_back()
        more = held_bytes() - before
    assert (kept == 59).all()
    assert more < 9 * N_BYTES or sys.platform != "linux"
