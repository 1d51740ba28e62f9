"""The order in which symbols are coded: rows are dealt to lanes that advance together.

The n rows of a block are cut into `n_lanes` runs of successive rows, the first `n % n_lanes` of them one
row longer than the others. At step t every lane codes the t-th row of its run, lane after lane. A symbol is
known to all lanes at every later step.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class RowsToLanes:
    """The dealing of n rows to lanes."""

    n: int
    n_lanes: int

    @property
    def n_steps(self) -> int:
        """Number of steps that all lanes make; the first `n_longer` lanes make one more."""
        return self.n // self.n_lanes

    @property
    def n_longer(self) -> int:
        return self.n % self.n_lanes

    def runs(self, by_row: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return two views of `by_row` [n] with a run in each line: [n_longer, n_steps + 1] and
        [n_lanes - n_longer, n_steps]."""
        n = self.n_longer * (self.n_steps + 1)
        return by_row[:n].reshape(-1, self.n_steps + 1), by_row[n:].reshape(-1, self.n_steps)

    def in_order(self, by_row: np.ndarray) -> np.ndarray:
        """Return the elements of `by_row` [n] in the order of coding.

        >>> RowsToLanes(7, 3).in_order(np.arange(7)).tolist()
        [0, 3, 5, 1, 4, 6, 2]
        """
        longer, shorter = self.runs(by_row)
        out = np.empty_like(by_row)
        steps = out[: self.n_steps * self.n_lanes].reshape(-1, self.n_lanes)
        steps[:, : self.n_longer], steps[:, self.n_longer :] = longer[:, :-1].T, shorter.T
        out[self.n_steps * self.n_lanes :] = longer[:, -1]
        return out

    def by_row(self, in_order: np.ndarray) -> np.ndarray:
        """Undo `in_order`."""
        out = np.empty_like(in_order)
        longer, shorter = self.runs(out)
        steps = in_order[: self.n_steps * self.n_lanes].reshape(-1, self.n_lanes)
        longer[:, :-1], shorter[:] = steps[:, : self.n_longer].T, steps[:, self.n_longer :].T
        longer[:, -1] = in_order[self.n_steps * self.n_lanes :]
        return out

    def step(self) -> np.ndarray:
        """Return the step [n] int32 at which each row is coded."""
        out = np.empty(self.n, np.int32)
        for runs in self.runs(out):
            runs[:] = np.arange(runs.shape[1], dtype=np.int32)
        return out


@dataclass(frozen=True, eq=False)
class Neighbours:
    """The three neighbours of each row, whose symbols tell most about the row's symbol.

    >>> rows = Neighbours(np.array([[-1, 0, 1, 2], [-1, -1, 0, 1], [-1, -1, -1, -1]], np.int32))
    >>> rows.in_order(RowsToLanes(4, 2))[0].tolist()
    [4, 1, 0, 2]
    """

    rows: np.ndarray
    """[3, n] int32: the rows of each row's neighbours, -1 for a neighbour that does not exist. In a grid they
    are the next vertices along -z, -y and -x."""

    @property
    def n(self) -> int:
        return self.rows.shape[1]

    def in_order(self, lanes: RowsToLanes) -> np.ndarray:
        """Return the neighbours [3, n] uint32 of the rows in the order of coding, n for a neighbour that does
        not exist."""
        found = np.stack([lanes.in_order(rows) for rows in self.rows]).view(np.uint32)
        return np.minimum(found, np.uint32(self.n), out=found)  # -1 is the largest uint32, and becomes n

    def known(self, lanes: RowsToLanes) -> np.ndarray:
        """Return [3, n] int32: each row's neighbours that are coded at an earlier step, n for others."""
        n, step = np.int32(self.n), np.append(lanes.step(), np.int32(self.n))
        return np.stack([np.where(step[rows] < step[:-1], rows, n) for rows in self.rows])
