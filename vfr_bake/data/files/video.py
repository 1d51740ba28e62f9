"""Write the sharpest frames of a video into a folder, one each time that the camera has moved.

The video is read once, one frame at a time, however long it is. The movement of the camera is measured by
optical flow between small grey frames. Each time that the picture has moved by `STEP`, a stretch of the video
ends, and the sharpest frame of the stretch is kept. A camera that stands still gives one frame, and one that
hurries gives more. If there are too many stretches, every two become one, and the step doubles. So a walk of
an hour takes no more memory and no more disk than one of a minute.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from player.errors import DataError
from player.files.files import new_folder
from player.progress import Progress
from vfr_bake.data.files.pictures import opencv, sharpness, shrunk
from vfr_bake.data.files.source import check_source, note_source

SUFFIXES = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".3gp", ".mts")
STEP = 0.03
"""Movement of the picture in the shortest stretch, as a share of its longer side. A step of 4.5 degrees
around a subject moves the picture by some 0.05."""
MOST_FRAMES = 160
"""Number of frames at most, twice as many as are enough for a walk around a subject. If there are more, every
two stretches become one."""
MIN_READ = 0.9
"""Share of the frames that the header counts, which is a guess, that must be readable in a whole video."""
MAX_SIDE = 1920
"""Pixels of the longer side to which frames are reduced: a video's compression leaves nothing finer, and 160
frames of 4K are 5 GB."""
FLOW_SIDE = 160
"""Pixels of the longer side of the frames between which optical flow is measured."""


def frames_folder(video: Path) -> Path:
    """Return the folder in which the frames of a video are kept: `walk.mp4` -> `walk_frames`.

    >>> frames_folder(Path("a/walk.mp4")).name
    'walk_frames'
    """
    return video.with_name(f"{video.stem}_frames")


def extract_frames(video: Path, progress: Progress, say: Callable[[str], object] | None = None) -> Path:
    """Write at most `MOST_FRAMES` frames of `video` as JPEG files into `<stem>_frames/images/` beside it.

    Each is the sharpest of a stretch in which the picture has moved by the same share of its size, because a
    hand-held camera shakes, and one frame in three is blurred. `progress`: called with the number of frames
    looked at and to look at. `say`: called with a sentence if many frames cannot be read. The folder appears
    when it is complete; one that was made before is used as it is. Returns the folder.

    Raises DataError (not a video, no frames, a name that is not Unicode, a folder with the frames of another
    video), OutputError, MissingExtraError.
    """
    folder = frames_folder(video)
    if (folder / "images").is_dir():
        check_source(folder, video)
        return folder
    cv2 = opencv(f"{video}: video: expected OpenCV to read it")
    # FFmpeg takes what is before a colon in a relative name for a protocol.
    name = str(video.absolute())
    try:
        name.encode()  # OpenCV crashes at other names
    except UnicodeEncodeError:
        raise DataError(
            f"{name!a}: expected a name in UTF-8: give the video or its folder another one"
        ) from None
    # OpenCV turns the frames upright where the file says how the camera was held.
    capture = cv2.VideoCapture(name)
    try:
        # The count in a video's header is a guess, and some videos have none.
        n_frames = int(capture.get(cv2.CAP_PROP_FRAME_COUNT)) if capture.isOpened() else 0
        read, frame = capture.read() if capture.isOpened() else (False, None)
        if not read:
            raise DataError(f"{video}: video: expected one that OpenCV can read, with frames in it")
        with new_folder(folder) as new:
            (new / "images").mkdir()
            stretches = _Stretches(cv2, new / "images", _pixel_shape(cv2, capture))
            n_read = 0
            while read:
                stretches.add(frame)
                n_read += 1
                progress(n_read, max(n_frames, n_read + 1))
                read, frame = capture.read()
            stretches.finish()
            progress(n_read, n_read)
            note_source(new, video)
        if say is not None and n_read < MIN_READ * n_frames:
            say(
                f"{n_read} of about {n_frames} frames of {video.name} could be read: if it is longer "
                f"than that, copy it again, and remove {folder}"
            )
    finally:
        capture.release()
    return folder


def _pixel_shape(cv2: Any, capture: Any) -> float:
    """Return the width of a pixel of a video's upright frames divided by its height: in anamorphic videos
    pixels are no squares."""
    wide, high = capture.get(cv2.CAP_PROP_SAR_NUM), capture.get(cv2.CAP_PROP_SAR_DEN)
    if wide <= 0 or high <= 0:
        return 1.0  # the file does not tell
    on_its_side = capture.get(cv2.CAP_PROP_ORIENTATION_META) in (90, 270)
    return min(max(high / wide if on_its_side else wide / high, 0.25), 4.0)  # what is beyond is damaged


class _Stretches:
    """The sharpest frame of every stretch of a video so far, each in a file."""

    def __init__(self, cv2: Any, folder: Path, pixel_shape: float) -> None:
        """Begin with no frames. `pixel_shape`: the width of a pixel divided by its height."""
        self._cv2, self._folder, self._pixel_shape = cv2, folder, pixel_shape
        self._flow = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_FAST)
        self._before: np.ndarray | None = None
        self._step, self._moved = STEP, 0.0
        self._n_files = 0
        self._kept: list[tuple[float, Path]] = []
        self._best: tuple[float, np.ndarray] | None = None

    def add(self, frame: Any) -> None:
        """Add the next frame [height, width, 3], blue first."""
        cv2 = self._cv2
        small = shrunk(cv2, cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY), FLOW_SIDE)
        if self._before is not None and min(small.shape) >= 16 and small.shape == self._before.shape:
            flow = self._flow.calc(self._before, small, None)
            self._moved += float(np.median(np.linalg.norm(flow, axis=-1))) / max(small.shape)
        self._before = small
        if self._moved >= self._step and self._best is not None:
            self._end_stretch()
            self._moved = 0.0
        sharp = sharpness(cv2, cv2.cvtColor(frame, cv2.COLOR_BGR2RGB))
        if self._best is None or sharp > self._best[0]:
            self._best = sharp, frame

    def finish(self) -> None:
        """End the last stretch, and rename the frames that are kept to their numbers."""
        if self._best is not None:
            self._end_stretch()
        for number, (_, path) in enumerate(self._kept):
            path.rename(self._folder / f"{number:04d}.jpg")

    def _end_stretch(self) -> None:
        assert self._best is not None
        sharp, frame = self._best
        path = self._folder / f"stretch_{self._n_files:08d}.jpg"
        if self._pixel_shape != 1:
            height, width = frame.shape[:2]
            frame = self._cv2.resize(frame, (max(1, round(width * self._pixel_shape)), height))
        rgb = self._cv2.cvtColor(shrunk(self._cv2, frame, MAX_SIDE), self._cv2.COLOR_BGR2RGB)
        Image.fromarray(rgb).save(path, quality=95)
        self._n_files += 1
        self._kept.append((sharp, path))
        self._best = None
        if len(self._kept) > MOST_FRAMES:
            self._step *= 2
            pairs = [self._kept[start : start + 2] for start in range(0, len(self._kept), 2)]
            self._kept = [max(pair, key=lambda entry: entry[0]) for pair in pairs]
            chosen = {path for _, path in self._kept}
            for pair in pairs:
                for _, path in pair:
                    if path not in chosen:
                        path.unlink()
