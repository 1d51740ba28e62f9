"""Many pictures, or pairs of them, at a time."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")


def n_threads() -> int:
    """As many as there are cores, up to eight: each holds a block of products and a decoded picture."""
    return min(8, os.cpu_count() or 1)


def in_threads(
    function: Callable[[Item], Result], items: Sequence[Item], progress: Callable[[int, int], object]
) -> list[Result]:
    """`function` of every item, in their order; what it raises ends the others, as does an interruption.

    `progress`: called with how many are done and how many there are.

    >>> in_threads(str, [1, 2], lambda done, of: None)
    ['1', '2']
    """
    results = []
    with ThreadPoolExecutor(n_threads()) as pool:
        futures = [pool.submit(function, item) for item in items]
        try:
            for done, future in enumerate(futures):
                results.append(future.result())
                progress(done + 1, len(items))
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    return results
