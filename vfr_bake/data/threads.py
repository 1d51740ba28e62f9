"""Call a function for many pictures, or pairs of pictures, in several threads."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

from player.progress import Progress
from player.threads import default_threads

Item = TypeVar("Item")
Result = TypeVar("Result")

MOST_BYTES = 1_000_000_000
"""Most memory of all threads together."""


def n_threads(bytes_each: int = 1) -> int:
    """Return the number of threads: as many as the cores that this process may use, but at most eight, and
    so few that they take at most MOST_BYTES if each takes `bytes_each`. There is at least one.

    >>> n_threads(10**12)
    1
    """
    return max(1, min(8, default_threads(), MOST_BYTES // bytes_each))


def in_threads(
    function: Callable[[Item], Result],
    items: Sequence[Item],
    progress: Progress | None,
    bytes_each: int = 1,
) -> list[Result]:
    """Call `function` for every item, and return the results in the order of the items. `bytes_each`: memory
    that a call takes.

    An exception in one call, or an interruption, cancels the calls that have not begun.

    >>> in_threads(str, [1, 2], None)
    ['1', '2']
    """
    results = []
    for result in one_by_one(function, items, n_threads(bytes_each)):
        results.append(result)
        if progress is not None:
            progress(len(results), len(items))
    return results


def one_by_one(function: Callable[[Item], Result], items: Sequence[Item], n_threads: int) -> Iterator[Result]:
    """Yield the results of `function` for every item, in the order of the items. At most `n_threads` + 1
    items are in work, or finished and not yet taken, at a time.

    An exception in one call, or an interruption, cancels the calls that have not begun.

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
