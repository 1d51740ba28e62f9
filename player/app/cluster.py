"""Rendering of frames on the workers of an existing Dask cluster: each frame is a task, which returns the
bytes of the frame's file.

Workers open the asset at the path that the client was given, made absolute: it must be on a shared disk, or a
copy must be at the same place. Each worker checks that it has the same asset and as many of its parts, so
that no frame of another asset or of an incomplete copy slips in.
"""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Iterator, Sequence
from functools import lru_cache
from typing import Any

from player.app.jobs import Done, Job, render_job
from player.app.options import PlaySettings
from player.asset.asset import Asset
from player.errors import ConfigError, FormatError, IntegrityError, MissingExtraError, VfrError
from player.render import March, Renderer

CONNECT_SECONDS = 10
POLL_SECONDS = 5
PATIENCE = 12
"""Polls without any worker after which the cluster counts as gone: they take a minute, within which a worker
may restart."""

_OPENING = threading.Lock()
"""Held while a worker opens an asset: its threads begin at once, and would each open it."""


def render_on_cluster(
    address: str, asset: Asset, jobs: Sequence[Job], settings: PlaySettings
) -> Iterator[Done]:
    """Yield every job once, in the order in which they are finished.

    If a worker dies, another worker does its job again.

    Args:
        address: the address of the scheduler, for example tcp://10.0.0.1:8786.
        asset: the open asset, whose folder the workers see at the same path.
        jobs: the frames to render.
        settings: how the frames are rendered; `threads` and `max_memory` are those of one worker.

    Raises:
        MissingExtraError: dask.distributed is not installed.
        IntegrityError: a worker has another asset at that path, or another number of its parts.
        VfrError: no scheduler answers, no worker is left, or a frame fails on its worker.
    """
    try:
        import distributed
    except ImportError as error:
        raise MissingExtraError(
            "--dask: expected the package distributed, which is not installed: "
            "pip install 'vfr-bake[cluster]'"
        ) from error
    try:
        client = distributed.Client(address, timeout=CONNECT_SECONDS)
    except (OSError, TimeoutError, ValueError) as error:
        raise ConfigError(f"--dask: {address}: expected a scheduler to answer, got none: {error}") from error
    which = str(asset.folder.resolve()), asset.digest, asset.n_parts
    how = settings.threads, settings.march, settings.max_memory
    with client:
        futures = {client.submit(_task, job, *which, *how, pure=False): job for job in jobs}
        alone = 0
        while futures:
            try:
                ready: Any = distributed.wait(
                    list(futures), timeout=POLL_SECONDS, return_when="FIRST_COMPLETED"
                )
            except (TimeoutError, asyncio.TimeoutError):  # two classes before Python 3.11
                alone = 0 if client.scheduler_info()["workers"] else alone + 1
                if alone == PATIENCE:
                    raise VfrError(f"--dask: {address}: expected workers, got none for a minute") from None
                continue
            while ready.done:  # a worker keeps a frame for as long as anything here refers to its future
                future = ready.done.pop()
                yield _result(future, address, futures.pop(future))


def _result(future: Any, address: str, job: Job) -> Done:
    try:
        return future.result()
    except VfrError:
        raise
    except Exception as error:  # any error of a worker, or Dask's own for a worker that kept dying
        raise VfrError(f"--dask: {address}: {job.camera.name}: {type(error).__name__}: {error}") from error


def _task(job: Job, folder: str, digest: str, n_parts: int, *how: Any) -> Done:
    """Render a frame on a worker; `how` are the last arguments of `_renderer`. The settings are not passed as
    a whole, because a path in them would not reach a worker of another system."""
    with _OPENING:
        renderer = _renderer(folder, digest, n_parts, *how)
    return render_job(renderer, job)


@lru_cache(maxsize=1)
def _renderer(
    folder: str, digest: str, n_parts: int, threads: int | None, march: March, max_memory: float | None
) -> Renderer:
    """Return the worker's renderer, which is kept for the next frames; the digest tells a new asset from an
    old one.

    Raises IntegrityError unless the asset is the client's, with `n_parts` parts: with fewer, frames would be
    coarser.

    Compiled code is proven first, because wrong code would end the worker's process.
    """
    if march != "numpy":
        from player.proof import prove

        prove(lambda text: None)
    try:
        asset = Asset.open(folder, max_memory=max_memory)
    except FormatError as error:
        raise IntegrityError(f"{error}: expected the asset at the same path on every worker") from error
    if asset.digest != digest:
        raise IntegrityError(f"{folder}: on a worker: expected the asset of the client, got another")
    if asset.n_parts != n_parts:
        raise IntegrityError(
            f"{folder}: on a worker: parts: expected {n_parts} as on the client, got {asset.n_parts}: "
            "copy the whole asset to every machine"
        )
    return Renderer(asset, threads, march)
