"""Training in several processes, each with its share of every batch: `torchrun` starts the same command in
all of them.

This does by hand what DistributedDataParallel does. Its hooks would miss the gradient of the hash grid, which
is written in place by a kernel. Gradients are summed, so that the processes' shares count as one joint batch.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from datetime import timedelta
from typing import TypeVar

import torch
from torch import Tensor, distributed

from player.errors import ConfigError

T = TypeVar("T")

PATIENCE = timedelta(days=30)
"""How long a process waits for the others. gloo's own half an hour would end them while the first one
estimates the cameras of many photographs, or renders test views; torchrun ends them if one fails."""


class Processes:
    """This process among those that `torchrun` started; the only one if it was started without `torchrun`.

    >>> Processes.from_environment().size
    1
    """

    def __init__(self, rank: int, size: int) -> None:
        self.rank, self.size = rank, size

    @classmethod
    def from_environment(cls) -> Processes:
        """Join the process group that the environment variables RANK and WORLD_SIZE describe. Raises
        ConfigError if they, or those with the address of the first process, are missing or no numbers."""
        try:
            size = int(os.environ.get("WORLD_SIZE", "1"))
            if size <= 1:
                return cls(0, 1)
            if not distributed.is_initialized():
                distributed.init_process_group("gloo", timeout=PATIENCE)
            return cls(int(os.environ.get("RANK", "0")), size)
        except ValueError as error:
            message = f"expected those of torchrun, or no WORLD_SIZE: {error}"
            raise ConfigError(f"environment variables: {message}") from None

    @property
    def first(self) -> bool:
        """True for the process that reports and writes files."""
        return self.rank == 0

    def share(self, rows: Tensor) -> Tensor:
        """Return this process' rows of a joint batch: every `size`-th."""
        return rows[self.rank :: self.size].contiguous()

    def total(self, *values: float) -> list[float]:
        """Return the sum of each value over all processes."""
        if self.size == 1:
            return list(values)
        tensor = torch.tensor(values, dtype=torch.float64)
        distributed.all_reduce(tensor)
        return tensor.tolist()

    def agree(self, value: float) -> float:
        """Return the first process' value in all processes, for example because clocks differ."""
        return self.total(value if self.first else 0.0)[0]

    def add_up(self, gradients: Sequence[Tensor]) -> None:
        """Replace each tensor by its sum over all processes, in place."""
        if self.size > 1:
            for gradient in gradients:
                distributed.all_reduce(gradient)

    def take_largest(self, values: Tensor) -> None:
        """Replace each value by the largest of all processes, in place."""
        if self.size > 1:
            distributed.all_reduce(values, distributed.ReduceOp.MAX)

    def in_turn(self, work: Callable[[], T]) -> T:
        """Do `work` in the first process, then in the others, which find what it left on disk; return the
        result."""
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
        """Wait for the other processes, and leave the group."""
        self._wait()
        if self.size > 1:
            distributed.destroy_process_group()
