"""Work on many pictures, or pairs of them, at a time."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

from player.threads import default_threads

Item = TypeVar("Item")
Result = TypeVar("Result")
Progress = Callable[[int, int], object]
"""Called with how many things are done and how many there are."""


def n_threads() -> int:
    """As many as the cores that this process may use, up to eight: each holds a decoded picture and a block
    of products."""
    return min(8, default_threads())


def in_threads(
    function: Callable[[Item], Result], items: Sequence[Item], progress: Progress | None
) -> list[Result]:
    """Call `function` for every item, and return what it returned in the order of the items.

    What it raises ends the others, as does an interruption.

    >>> in_threads(str, [1, 2], None)
    ['1', '2']
    """
    results = []
    for result in one_by_one(function, items, n_threads()):
        results.append(result)
        if progress is not None:
            progress(len(results), len(items))
    return results


def one_by_one(function: Callable[[Item], Result], items: Sequence[Item], n_threads: int) -> Iterator[Result]:
    """What `function` returns for every item, in the order of the items; no more are worked on, or done and
    not yet taken, than `n_threads` and one.

    What it raises ends the others, as does an interruption.

    >>> list(one_by_one(str, [1, 2], 1))
    ['1', '2']
    """
    waiting: deque[Future[Result]] = deque()
    with ThreadPoolExecutor(n_threads) as pool:
        try:
            for item in items:
                waiting.append(pool.submit(function, item))
                if len(waiting) > n_threads:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
