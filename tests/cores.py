"""A process that runs tests beside others of its kind keeps to its share of the processor's cores.

Threads that wait for each other, a bake's and a training's, take up to half as long again where others of
their kind run on the same cores: each wait lasts until those have had their turn. Browsers mostly wait for
something else, and may use every core.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

CAN_CHOOSE = hasattr(os, "sched_setaffinity")
EVERY = sorted(os.sched_getaffinity(0)) if CAN_CHOOSE else []
"""The cores that this process found."""


def keep_to_a_share() -> None:
    """Every n-th core, where there are n processes and as many cores."""
    worker, n_workers = os.environ.get("PYTEST_XDIST_WORKER"), os.environ.get("PYTEST_XDIST_WORKER_COUNT")
    if worker and n_workers and len(EVERY) >= int(n_workers):
        os.sched_setaffinity(0, EVERY[int(worker.removeprefix("gw")) % int(n_workers) :: int(n_workers)])


@contextmanager
def every_core() -> Iterator[None]:
    """Programs that are started meanwhile may use every core."""
    if not CAN_CHOOSE:
        yield
        return
    own = os.sched_getaffinity(0)
    os.sched_setaffinity(0, EVERY)
    try:
        yield
    finally:
        os.sched_setaffinity(0, own)
