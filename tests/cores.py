"""Share out the processor's cores among the processes that run tests side by side.

The threads of a bake or a training often wait for each other. If other processes with such threads run on the
same cores, a bake or a training takes up to half as long again, because each wait lasts until those threads
have had their turn. Browsers mostly wait for something else, and may use every core.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

CAN_CHOOSE = hasattr(os, "sched_setaffinity")
EVERY = sorted(os.sched_getaffinity(0)) if CAN_CHOOSE else []
"""The cores that this process may use when it starts; empty if the system offers no choice of cores."""


def keep_to_a_share() -> None:
    """Keep this process to every n-th core if n test processes run and there are at least n cores."""
    worker, n_workers = os.environ.get("PYTEST_XDIST_WORKER"), os.environ.get("PYTEST_XDIST_WORKER_COUNT")
    if worker and n_workers and len(EVERY) >= int(n_workers):
        os.sched_setaffinity(0, EVERY[int(worker.removeprefix("gw")) % int(n_workers) :: int(n_workers)])


@contextmanager
def every_core() -> Iterator[None]:
    """Let programs that are started within the `with` block use every core."""
    if not CAN_CHOOSE:
        yield
        return
    own = os.sched_getaffinity(0)
    os.sched_setaffinity(0, EVERY)
    try:
        yield
    finally:
        os.sched_setaffinity(0, own)
