"""One frame to render, as it goes to this machine's renderer or to a cluster's worker, and the rendered frame
that comes back."""

from __future__ import annotations

import time
from dataclasses import dataclass

from player.cameras.camera import Camera
from player.files.images import ENCODERS
from player.render import Background, Quality, Renderer


@dataclass(frozen=True)
class Job:
    """One frame to render."""

    index: int
    """Its index among all jobs."""
    camera: Camera
    samples: int | None
    """Feature lookups per ray, as in `PlaySettings`."""
    background: Background | None
    """The background, as in `PlaySettings`."""
    quality: Quality
    """The quality of the picture, as in `PlaySettings`."""
    key: str
    """Digest of what the picture depends on; its file carries it."""
    suffix: str
    """Format of the picture's file, ".png" or ".webp"."""


@dataclass(frozen=True)
class Done:
    """One rendered frame."""

    index: int
    """The index of its job among all jobs."""
    data: bytes
    """The picture's file."""
    milliseconds: float
    """Time that rendering took, without the encoding of the file."""
    march: str
    threads: int


def render_job(renderer: Renderer, job: Job) -> Done:
    """Render the frame of a job and encode its file."""
    start = time.perf_counter()
    frame = renderer.render(job.camera, job.samples, job.background, quality=job.quality)
    milliseconds = (time.perf_counter() - start) * 1000
    pixels = frame.to_uint8()
    del frame  # frees its memory before the encoder takes as much or more
    data = ENCODERS[job.suffix](pixels, job.key)
    return Done(job.index, data, milliseconds, renderer.march, renderer.n_threads)
