"""Taking the samples of the next step while this one is learned from, each on half of the threads.

What lies between a step's samples and its gradients is a few dozen matrix products of a few hundred rows:
too short to be shared out among threads one by one, for a thread that waits sleeps, so as to leave the
processor to others, and waking it takes as long as half a product. To draw and march the next batch is as
long a piece of work that needs no result of this one, if the field may be the one before this step. Two
threads then meet once a step.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from typing import Any, NamedTuple, TypeVar

import torch
from numba import get_num_threads, set_num_threads

from vfr_bake.rendering.compositing import RaySamples
from vfr_bake.training.rays import Batch

T = TypeVar("T")


class Sampled(NamedTuple):
    """A batch of rays with its samples."""

    batch: Batch
    samples: RaySamples

    def state(self) -> dict[str, Any]:
        """All of it, in tensors."""
        return {"batch": vars(self.batch), "samples": vars(self.samples)}

    @classmethod
    def restored(cls, state: dict[str, Any]) -> Sampled:
        """What gave that `state`."""
        return cls(Batch(**state["batch"]), RaySamples(**state["samples"]))


class SecondThread:
    """Does one piece of work at a time beside the thread that has it."""

    def __init__(self) -> None:
        n_threads = min(get_num_threads(), torch.get_num_threads())
        self.is_there = n_threads > 1
        """Whether there is more than one thread to share out."""
        self._n_torch, n_numba = n_threads // 2, n_threads - n_threads // 2
        self._pool = ThreadPoolExecutor(1, "ahead", lambda: set_num_threads(n_numba))
        self._work: Future[Any] | None = None

    @contextmanager
    def meanwhile(self, work: Callable[[], T]) -> Iterator[Future[T]]:
        """Within it `work` is done on one half of the threads, and torch has the other half.

        Until `wait` no parallel kernel may be called: not all of numba's threads can stand that.
        """
        n_threads = torch.get_num_threads()
        torch.set_num_threads(self._n_torch)
        self._work = result = self._pool.submit(work)
        try:
            yield result
        finally:
            self.wait()
            torch.set_num_threads(n_threads)

    def wait(self) -> None:
        """Until the work is done, if there is any."""
        if self._work is not None:
            wait([self._work])
            self._work = None
