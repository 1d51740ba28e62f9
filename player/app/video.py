"""Encoding of pictures as a video: H.264 in MP4, which every browser and player shows."""

from __future__ import annotations

import math
from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from player.errors import MissingExtraError, OutputError
from player.files.files import new_file

QUALITY = 18
"""x264's constant rate factor: 0 is lossless, 18 looks lossless, 23 is x264's default."""


def load_av() -> Any:
    """Import PyAV, which brings FFmpeg along. Raises MissingExtraError."""
    try:
        import av
    except ImportError as error:
        raise MissingExtraError(
            "video: expected the package av, which is not installed: pip install 'vfr-bake[video]'; "
            "or write pictures: --output DIR"
        ) from error
    return av


def write_video(path: Path, pictures: Iterable[np.ndarray], fps: float) -> None:
    """Write an MP4; the file appears under its name when it is complete.

    Args:
        path: the file.
        pictures: [h, w, 3] uint8 each, all of one size. An odd width or height is extended by a copy of the
            last column or row: H.264 stores colour for two by two pixels.
        fps: frames a second.

    Raises:
        MissingExtraError: PyAV is not installed.
        OutputError: FFmpeg refuses, or the disk is full.
    """
    av = load_av()
    with new_file(path) as temporary:
        try:
            with av.open(str(temporary), "w", options={"movflags": "faststart"}) as container:
                _encode(av, container, pictures, fps)
        except (av.FFmpegError, OSError) as error:
            reason = getattr(error, "strerror", None) or str(error)
            raise OutputError(f"{path}: cannot write: {reason}") from error


def _encode(av: Any, container: Any, pictures: Iterable[np.ndarray], fps: float) -> None:
    stream = None
    for pixels in pictures:
        height, width = (2 * math.ceil(n / 2) for n in pixels.shape[:2])
        padded = np.pad(
            pixels, [(0, height - pixels.shape[0]), (0, width - pixels.shape[1]), (0, 0)], mode="edge"
        )
        if stream is None:
            stream = container.add_stream("libx264", rate=Fraction(fps).limit_denominator(1001))
            stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
            stream.options = {"crf": str(QUALITY)}
            # Written into the file, too: otherwise players guess by the picture's size, and shift the
            # colours.
            stream.codec_context.colorspace = stream.codec_context.color_primaries = 1
            stream.codec_context.color_trc, stream.codec_context.color_range = 1, 1
        frame = av.VideoFrame.from_ndarray(padded, format="rgb24")
        frame = frame.reformat(format="yuv420p", dst_colorspace="ITU709", dst_color_range="MPEG")
        for packet in stream.encode(frame):
            container.mux(packet)
    if stream is not None:
        for packet in stream.encode():
            container.mux(packet)
