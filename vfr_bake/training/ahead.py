"""Sampling of the next step while this step is learned from, each on half of the threads.

Between a step's samples and its gradients there are a few dozen matrix products of a few hundred rows each.
These are too short to be split among threads: a waiting thread sleeps, to leave the processor to others, and
waking it takes as long as half a product. Drawing and marching the next batch takes about as long as all of
them, and needs no result of this step if it may use the field from before the step. So the two are done side
by side, and the threads wait for each other only once a step.
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
        """Return the batch and its samples as tensors and plain values."""
        return {"batch": vars(self.batch), "samples": vars(self.samples)}

    @classmethod
    def restored(cls, state: dict[str, Any]) -> Sampled:
        """Return the batch with its samples that `state` was made from."""
        return cls(Batch(**state["batch"]), RaySamples(**state["samples"]))


class SecondThread:
    """Second thread, which does one piece of work at a time beside the thread that owns it."""

    def __init__(self) -> None:
        n_threads = min(get_num_threads(), torch.get_num_threads())
        self.is_there = n_threads > 1
        """True if there is more than one thread to split between the two."""
        self._n_torch, n_numba = n_threads // 2, n_threads - n_threads // 2
        self._pool = ThreadPoolExecutor(1, "ahead", lambda: set_num_threads(n_numba))
        self._work: Future[Any] | None = None

    @contextmanager
    def meanwhile(self, work: Callable[[], T]) -> Iterator[Future[T]]:
        """Do `work` on one half of the threads while this context lasts; torch has the other half.

        Until `wait` has returned, the caller must not run a parallel kernel: not every threading layer of
        numba allows kernels to run in two threads at once.
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
        """Wait until the work is done, if there is any."""
        if self._work is not None:
            wait([self._work])
            self._work = None
