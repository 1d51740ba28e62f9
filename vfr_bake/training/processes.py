"""Several processes, each with its share of every batch: `torchrun` starts the same command in all of them.

What DistributedDataParallel does, by hand: the hash grid's gradient is written in place by its own kernel, so
its hooks would not see it. Gradients are summed, so that the processes' batches count as one joint batch.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from typing import TypeVar

import torch
from torch import Tensor, distributed

T = TypeVar("T")


class Processes:
    """This process among those that `torchrun` started; one alone where it did not.

    >>> Processes.from_environment().size
    1
    """

    def __init__(self, rank: int, size: int) -> None:
        self.rank, self.size = rank, size

    @classmethod
    def from_environment(cls) -> Processes:
        """Joins the group that the environment variables RANK and WORLD_SIZE speak of."""
        size = int(os.environ.get("WORLD_SIZE", "1"))
        if size > 1 and not distributed.is_initialized():
            distributed.init_process_group("gloo")
        return cls(int(os.environ.get("RANK", "0")) if size > 1 else 0, size)

    @property
    def first(self) -> bool:
        """Whether this is the process that reports and writes."""
        return self.rank == 0

    def share(self, rows: Tensor) -> Tensor:
        """This process' rows of a joint batch: every `size`-th."""
        return rows[self.rank :: self.size].contiguous()

    def total(self, *values: float) -> list[float]:
        """The sum of each value over all processes."""
        if self.size == 1:
            return list(values)
        tensor = torch.tensor(values, dtype=torch.float64)
        distributed.all_reduce(tensor)
        return tensor.tolist()

    def agree(self, value: float) -> float:
        """The first process' value, for all: clocks differ."""
        return self.total(value if self.first else 0.0)[0]

    def add_up(self, gradients: Sequence[Tensor]) -> None:
        """Replace each tensor by its sum over all processes."""
        if self.size > 1:
            for gradient in gradients:
                distributed.all_reduce(gradient)

    def take_largest(self, values: Tensor) -> None:
        """Replace each value by the largest that some process has."""
        if self.size > 1:
            distributed.all_reduce(values, distributed.ReduceOp.MAX)

    def in_turn(self, work: Callable[[], T]) -> T:
        """The result of `work`, done by the first process before the others: they find what it left."""
        if self.first:
            result = work()
            self._wait()
            return result
        self._wait()
        return work()

    def _wait(self) -> None:
        if self.size > 1:
            distributed.barrier()

    def leave(self) -> None:
        """Wait for the others and end the group."""
        self._wait()
        if self.size > 1:
            distributed.destroy_process_group()
