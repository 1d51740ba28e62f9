"""Work on many pictures, or pairs of them, at a time."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")
Progress = Callable[[int, int], object]
"""Called with how many things are done and how many there are."""


def n_threads() -> int:
    """As many threads as cores, up to eight: each holds a decoded picture and a block of products."""
    return min(8, os.cpu_count() or 1)


def in_threads(
    function: Callable[[Item], Result], items: Sequence[Item], progress: Progress | None
) -> list[Result]:
    """Call `function` for every item, and return what it returned in the order of the items.

    What it raises ends the others, as does an interruption.

    >>> in_threads(str, [1, 2], None)
    ['1', '2']
    """
    results = []
    with ThreadPoolExecutor(n_threads()) as pool:
        futures = [pool.submit(function, item) for item in items]
        try:
            for done, future in enumerate(futures):
                results.append(future.result())
                if progress is not None:
                    progress(done + 1, len(items))
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    return results
