"""Frames on the workers of a Dask cluster that exists: each frame is a task, its file's bytes come back.

Workers open the asset at the path that the client was given, made absolute: a shared disk, or a copy at the
same place. That it is the same asset is checked on the worker, so that no frame of another one slips in.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

from player.app.play import Done, Job, PlaySettings, render_job
from player.asset.asset import Asset
from player.asset.manifest import MAX_BYTES, NAME
from player.errors import ConfigError, FormatError, IntegrityError, MissingExtraError, VfrError
from player.files.files import read_bytes
from player.render import Renderer

CONNECT_SECONDS = 10
POLL_SECONDS = 5
PATIENCE = 12
"""Polls without any worker after which a cluster counts as gone: a minute, in which one may be restarted."""


def render_on_cluster(
    address: str, folder: Path, jobs: Sequence[Job], settings: PlaySettings
) -> Iterator[Done]:
    """Yield every job once, in the order in which they are finished.

    A job whose worker dies is done again by another one.

    Args:
        address: of the scheduler, for example tcp://10.0.0.1:8786.
        folder: the asset, which the workers see at the same path.
        jobs: what to render.
        settings: with how many threads on a worker, and over which background.

    Raises:
        MissingExtraError: dask.distributed is not installed.
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
    digest = _digest(folder)
    with client:
        futures = {
            client.submit(_task, str(folder.resolve()), digest, job, index, settings, pure=False): index
            for index, job in enumerate(jobs)
        }
        pending, alone = set(futures), 0
        while pending:
            try:
                ready: Any = distributed.wait(pending, timeout=POLL_SECONDS, return_when="FIRST_COMPLETED")
            except TimeoutError:
                alone = 0 if client.scheduler_info()["workers"] else alone + 1
                if alone == PATIENCE:
                    raise VfrError(f"--dask: {address}: expected workers, got none for a minute") from None
                continue
            for future in ready.done:
                pending.discard(future)
                yield _result(future, address, jobs[futures[future]])


def _result(future: Any, address: str, job: Job) -> Done:
    try:
        return future.result()
    except VfrError:
        raise
    except (
        Exception
    ) as error:  # whatever a worker raises, and Dask's own for workers that died again and again
        raise VfrError(f"--dask: {address}: {job.camera.name}: {type(error).__name__}: {error}") from error


def _task(folder: str, digest: str, job: Job, index: int, settings: PlaySettings) -> Done:
    if _digest(Path(folder)) != digest:
        raise IntegrityError(f"{folder}: on a worker: expected the asset of the client, got another")
    return render_job(_renderer(folder, digest, replace(settings, samples=None, background=None)), job, index,
                      settings)  # fmt: skip


@lru_cache(maxsize=1)
def _renderer(folder: str, digest: str, settings: PlaySettings) -> Renderer:
    """The worker's renderer, kept for its next frames. What would end the worker is found out before."""
    if settings.march != "numpy":
        from player.proof import prove

        prove(lambda _: None)
    return Renderer(Asset.open(folder, max_memory=settings.max_memory), settings.threads, settings.march)


def _digest(folder: Path) -> str:
    try:
        return hashlib.sha256(read_bytes(folder / NAME, "a manifest", MAX_BYTES, folder)).hexdigest()
    except FormatError as error:
        raise IntegrityError(f"{error}: expected the asset at the same path on every worker") from error
