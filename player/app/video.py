"""Encoding of pictures as a video: H.264 in MP4, which every browser and player shows."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from player.errors import FormatError, MissingExtraError, OutputError
from player.files.files import new_file, open_file
from player.files.images import KEY

QUALITY = 18
"""x264's constant rate factor: 0 is lossless, 18 looks lossless, 23 is x264's default."""

MOST_VIDEO_SIDE = 16384
"""Most pixels along a side of a picture that x264 encodes."""


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


def write_video(path: Path, pictures: Iterable[np.ndarray], fps: float, key: str) -> None:
    """Write an MP4; the file appears under its name when it is complete.

    Args:
        path: the file.
        pictures: [h, w, 3] uint8 each, all of one size. An odd width or height is extended by a copy of the
            last column or row: H.264 stores colour for two by two pixels.
        fps: frames a second.
        key: what the video shows (`player.app.frame_files`), stored in it as its comment.

    Raises:
        MissingExtraError: PyAV is not installed.
        OutputError: FFmpeg refuses, or the disk is full.
    """
    av = load_av()
    with new_file(path) as temporary:
        try:
            # FFmpeg takes what is before a colon in a relative name for a protocol.
            name = str(temporary.absolute())
            with av.open(name, "w", options={"movflags": "faststart"}) as container:
                container.metadata["comment"] = f"{KEY}={key}"
                _encode(av, container, pictures, fps)
        except (av.FFmpegError, OSError) as error:
            reason = getattr(error, "strerror", None) or str(error)
            raise OutputError(f"{path}: cannot write: {reason}") from error


def read_video_key(path: Path) -> str | None:
    """Return the key that a video was written with; None if it has none, or if it is no video.

    Raises MissingExtraError.
    """
    av = load_av()
    try:
        with open_file(path, "a video", sys.maxsize) as file, av.open(file, format="mp4") as container:
            comment = container.metadata.get("comment", "")
    except (av.FFmpegError, OSError, FormatError):
        return None
    return comment.removeprefix(f"{KEY}=") if comment.startswith(f"{KEY}=") else None


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
