"""A video -> a folder of its sharpest frames, evenly spread."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from player.errors import DataError
from player.files.files import new_folder
from vfr_bake.data.files.pictures import opencv, shrunk
from vfr_bake.data.threads import Progress

SUFFIXES = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm")
N_FRAMES = 80
"""A walk around a subject at a frame every 4.5 degrees: neighbours share nearly everything, and their
matching still takes minutes."""
MAX_SIDE = 1920
"""Frames are reduced to this: a video's compression leaves nothing finer, and 80 frames of 4K are 2.7 GB."""
_SHARPNESS_SIDE = 960


def frames_folder(video: Path) -> Path:
    """The folder in which the frames of a video are kept: `walk.mp4` -> `walk_frames`.

    >>> frames_folder(Path("a/walk.mp4")).name
    'walk_frames'
    """
    return video.with_name(f"{video.stem}_frames")


def extract_frames(video: Path, progress: Progress) -> Path:
    """Write about `N_FRAMES` frames of `video` as JPEG files into `<stem>_frames/images/` beside it.

    The video is cut into stretches of equal length, and each gives its sharpest frame: a hand-held camera
    shakes, and one frame in three is blurred. A short video gives all its frames. `progress`: called with
    the number of frames looked at and to look at. The folder appears when it is complete; one that is there
    is taken as it is. Returns it.

    Raises DataError (not a video, no frames), OutputError, MissingExtraError.
    """
    folder = frames_folder(video)
    if (folder / "images").is_dir():
        return folder
    cv2 = opencv(f"{video}: video: expected OpenCV to read it")
    # Turned upright by OpenCV where the file says how the camera was held.
    capture = cv2.VideoCapture(str(video))
    try:
        n_frames = int(capture.get(cv2.CAP_PROP_FRAME_COUNT)) if capture.isOpened() else 0
        if n_frames < 1:
            raise DataError(f"{video}: video: expected one that OpenCV can read, with frames in it")
        with new_folder(folder) as new:
            (new / "images").mkdir()
            _write_sharpest(cv2, capture, n_frames, new / "images", progress)
            if not any((new / "images").iterdir()):
                raise DataError(f"{video}: video: expected {n_frames} frames, none of them can be read")
    finally:
        capture.release()
    return folder


def _write_sharpest(cv2: Any, capture: Any, n_frames: int, folder: Path, progress: Progress) -> None:
    n_kept = min(N_FRAMES, n_frames)
    best: np.ndarray | None = None
    best_sharpness = -1.0
    for index in range(n_frames):
        read, frame = capture.read()
        if read:
            sharpness = _sharpness(cv2, frame)
            if sharpness > best_sharpness:
                best, best_sharpness = frame, sharpness
        stretch = index * n_kept // n_frames
        if best is not None and (not read or (index + 1) * n_kept // n_frames > stretch):
            _write(cv2, best, folder / f"{stretch:04d}.jpg")
            best, best_sharpness = None, -1.0
        progress(index + 1, n_frames)
        if not read:  # the count in a video's header is a guess
            break


def _sharpness(cv2: Any, frame: np.ndarray) -> float:
    """Mean square of the second derivative: blur of any direction lowers it."""
    grey = shrunk(cv2, cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY), _SHARPNESS_SIDE)
    return float(np.square(cv2.Laplacian(grey, cv2.CV_32F)).mean())


def _write(cv2: Any, frame: np.ndarray, path: Path) -> None:
    rgb = cv2.cvtColor(shrunk(cv2, frame, MAX_SIDE), cv2.COLOR_BGR2RGB)
    Image.fromarray(rgb).save(path, quality=95)
