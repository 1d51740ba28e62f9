"""Read described pictures as posed pictures at the working size, into memory or onto the disk."""

from __future__ import annotations

import atexit
import errno
import math
import os
import shutil
import tempfile
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from player.cameras.camera import Camera
from player.errors import OutputError
from player.files.memory import allowed_bytes
from player.files.replace import PART, held
from player.progress import Progress
from vfr_bake.data.files.pictures import DescribedView, viewed_size
from vfr_bake.data.store import cache
from vfr_bake.data.store.capture import PosedImages
from vfr_bake.data.store.stored import StoreLayout, in_order, write_picture
from vfr_bake.data.store.working import WorkingSize
from vfr_bake.data.threads import in_threads, n_threads, one_by_one

HELD_BYTES = 1_000_000_000
"""Pictures are held in memory if they take no more than this, and no more than a quarter of what the program
may use: the trainer has another copy of those that it learns from."""
LEAST_SIDE = 480
"""Pixels: the longest side is not made smaller than this for want of room."""
STEP = 16
"""Pixels: a side that is made smaller for want of room is a multiple of this."""
OPAQUE = (".jpg", ".jpeg", ".jpe", ".jfif", ".heic", ".heif", ".hif")
"""Suffixes of photographs that are expected to have no alpha: three channels are stored."""


class _TransparentError(Exception):
    """A picture has alpha where three channels were expected."""


class PictureReader:
    """A reader of the pictures of a data set at the working size.

    >>> PictureReader(WorkingSize(1600)).size.size(4000, 3000)
    (1600, 1200)
    """

    def __init__(
        self,
        size: WorkingSize | None = None,
        model: Path | None = None,
        on_disk: bool = False,
        kept: bool = False,
        may_shrink: bool = False,
        say: Callable[[str], object] | None = None,
    ) -> None:
        """Make a reader.

        Args:
            size: the working size; None for pictures as they are.
            model: the model that is trained on them; pictures that are kept are removed once it is gone.
            on_disk: whether pictures that would take too much memory are written to the disk and read from
                it.
            kept: whether they stay on the disk for the next run.
            may_shrink: whether the working size may become smaller if the disk has no room.
            say: called with a sentence on what was chosen.
        """
        self.size = size or WorkingSize()
        """The working size; after `read`, the one that was used."""
        self._model, self._on_disk, self._kept = model, on_disk, kept
        self._may_shrink = may_shrink
        self.say = say or (lambda text: None)
        """Called with a sentence on what was chosen or found."""

    def read(self, described: Sequence[DescribedView], progress: Progress | None) -> PosedImages:
        """Read the pictures, with the pinhole cameras that would have taken them.

        Raises DataError (a picture), OutputError (a disk without room for them, or that cannot be written
        to).
        """
        sizes = in_threads(viewed_size, described, None)
        if not self._on_disk or _n_bytes(sizes, self.size, 4) <= held_bytes():
            self._tell(sizes, "")
            return self._held(described, sizes, progress)
        root = cache.cache_folder()
        candidates = [self.size, *self._smaller(sizes)]
        folders = [root / name for name in cache.digests(described, candidates)]
        if not self._kept and self._model is not None:
            for each in folders:
                shutil.rmtree(each, ignore_errors=True)
        n_channels, free = _n_channels(described), cache.free_bytes(root)
        found, folder = None, folders[0]
        # If the disk has no room at one size, an earlier run may have kept the pictures at a smaller one.
        for size, folder in zip(candidates, folders, strict=True):
            found = cache.opened(folder, described)
            if found is not None:
                self.size = size
            if found is not None or _n_bytes(sizes, size, n_channels) <= free:
                break
        if found is None:
            cache.remove_unused(root, _n_bytes(sizes, self.size, n_channels), folders[0])
            self._fit(sizes, root, n_channels)
            if _n_bytes(sizes, self.size, 4) <= held_bytes():
                self._tell(sizes, "")
                return self._held(described, sizes, progress)
            folder = folders[candidates.index(self.size)]
            self._tell(sizes, f" on the disk ({'' if self._kept else 'for this run, '}in {root})")
            try:
                found = self._stored(described, sizes, folder, 3, progress)
            except _TransparentError:
                found = self._stored(described, sizes, folder, 4, progress)
        else:
            self._tell(sizes, f" as they were kept in {folder}")
            if progress is not None:
                progress(len(described), len(described))
        if self._model is not None and folder.is_dir():
            cache.note_use(folder, self._model)
        return found

    def _longest(self, sizes: Sequence[tuple[int, int]]) -> int:
        return max(max(self.size.size(*size)) for size in sizes)

    def _smaller(self, sizes: Sequence[tuple[int, int]]) -> list[WorkingSize]:
        """Return the working sizes that `_fit` may choose, the largest first."""
        if not self._may_shrink:
            return []
        sides = range((self._longest(sizes) - 1) // STEP * STEP, LEAST_SIDE - 1, -STEP)
        return [replace(self.size, max_side=side, downscale=None) for side in sides]

    def _tell(self, sizes: Sequence[tuple[int, int]], where: str) -> None:
        targets = [self.size.size(*size) for size in sizes]
        smaller = "" if targets == list(sizes) else f", reduced to {_named(targets)}"
        self.say(f"{len(sizes)} pictures of {_named(sizes)}{smaller}{where}")

    def _threads(self, described: Sequence[DescribedView], sizes: Sequence[tuple[int, int]]) -> int:
        return n_threads(max(map(self.size.reading_bytes, described, sizes), default=1))

    def _held(
        self, described: Sequence[DescribedView], sizes: Sequence[tuple[int, int]], progress: Progress | None
    ) -> PosedImages:
        cameras: list[Camera] = []
        images: list[np.ndarray] = []
        for camera, image in one_by_one(self.size.read, described, self._threads(described, sizes)):
            cameras.append(camera)
            images.append(image)
            if progress is not None:
                progress(len(images), len(described))
        return PosedImages(cameras, images)

    def _fit(self, sizes: Sequence[tuple[int, int]], root: Path, n_channels: int) -> None:
        """Make the working size smaller if the disk has too little room. Raises OutputError if it cannot."""
        free, needed = cache.free_bytes(root), _n_bytes(sizes, self.size, n_channels)
        if needed <= free:
            return
        longest = self._longest(sizes)
        side = int(longest * math.sqrt(free / needed)) // STEP * STEP
        if not self._may_shrink or side < LEAST_SIDE:
            raise OutputError(_no_room(root, needed, free))
        self.say(
            f"{root}: {needed / 1e9:.1f} GB for pictures of {longest} pixels, {free / 1e9:.1f} GB are free: "
            f"the longest side is {side} instead; free some room for more"
        )
        self.size = replace(self.size, max_side=side, downscale=None)

    def _stored(
        self,
        described: Sequence[DescribedView],
        sizes: Sequence[tuple[int, int]],
        folder: Path,
        n_channels: int,
        progress: Progress | None,
    ) -> PosedImages:
        layout = StoreLayout.of(self.size.size(*size) for size in sizes)
        n_bytes = int(layout.chunks[-1]) * n_channels
        try:
            if self._kept:
                with cache.new_set(folder) as new:
                    self._fill(new, layout, described, sizes, n_channels, progress)
                return _whole(folder, described)
            folder.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
            with held(folder.parent):
                new = Path(tempfile.mkdtemp(prefix=".pictures.", suffix=PART, dir=folder.parent))
                try:
                    self._fill(new, layout, described, sizes, n_channels, progress)
                    return _whole(new, described)
                finally:
                    # Where the system allows it, the file is deleted now and stays mapped until the process
                    # ends. Windows cannot delete it now, so it is tried again at the end.
                    shutil.rmtree(new, ignore_errors=True)
                    if os.name == "nt":
                        atexit.register(shutil.rmtree, new, ignore_errors=True)
        except OSError as error:
            said = error.__cause__ if isinstance(error, OutputError) else error
            if not isinstance(said, OSError):
                raise
            if said.errno in (errno.ENOSPC, errno.EDQUOT):
                no_room = _no_room(folder.parent, n_bytes, cache.free_bytes(folder.parent))
                raise OutputError(f"{no_room} ({said})") from error
            raise OutputError(
                f"{folder.parent}: cannot keep the pictures: {said.strerror or said}: "
                "set XDG_CACHE_HOME to a folder that you can write to"
            ) from error

    def _fill(
        self,
        folder: Path,
        layout: StoreLayout,
        described: Sequence[DescribedView],
        sizes: Sequence[tuple[int, int]],
        n_channels: int,
        progress: Progress | None,
    ) -> None:
        """Read every picture once, and write it into the new set in `folder`. Raises OSError."""

        def load(view: DescribedView) -> tuple[Camera, bool, np.ndarray]:
            camera, image = self.size.read(view)
            opaque = bool((image[..., 3] == 255).all())
            if not opaque and n_channels == 3:
                raise _TransparentError
            return camera, opaque, in_order(image, n_channels)

        cameras: list[Camera] = []
        transparent: set[int] = set()
        cache.reserve(folder / cache.PIXELS, int(layout.chunks[-1]) * n_channels)
        with (folder / cache.PIXELS).open("r+b") as file:
            for camera, opaque, pixels in one_by_one(load, described, self._threads(described, sizes)):
                write_picture(file, layout, len(cameras), pixels)
                if not opaque:
                    transparent.add(len(cameras))
                cameras.append(camera)
                if progress is not None:
                    progress(len(cameras), len(described))
        (folder / cache.INDEX).write_bytes(cache.index_bytes(layout, cameras, n_channels, transparent))


class DescribingReader(PictureReader):
    """A reader that takes note of what is to be read, and reads nothing: all pictures are black."""

    described: Sequence[DescribedView] = ()

    def read(self, described: Sequence[DescribedView], progress: Progress | None) -> PosedImages:
        self.described = described
        cameras = [view.camera for view in described]
        blank = np.zeros((1, 1, 4), np.uint8)
        return PosedImages(
            cameras, [np.broadcast_to(blank, (camera.height, camera.width, 4)) for camera in cameras]
        )


def held_bytes() -> int:
    """Return the number of bytes of pictures that may be held in memory."""
    return min(HELD_BYTES, allowed_bytes() // 4)


def _n_bytes(sizes: Sequence[tuple[int, int]], size: WorkingSize, n_channels: int) -> int:
    """Return the bytes that pictures of these sizes take at the working size."""
    return sum(math.prod(size.size(*each)) for each in sizes) * n_channels


def _n_channels(described: Sequence[DescribedView]) -> int:
    """Return the number of channels that the pictures are likely to need, as far as their names and masks
    tell."""
    opaque = all(view.mask is None and view.path.suffix.lower() in OPAQUE for view in described)
    return 3 if opaque else 4


def _whole(folder: Path, described: Sequence[DescribedView]) -> PosedImages:
    found = cache.opened(folder, described)
    if found is None:
        raise OutputError(f"{folder}: pictures: what was written cannot be read again")
    return found


def _no_room(folder: Path, needed: int, free: int) -> str:
    return (
        f"{folder}: expected {needed / 1e9:.2f} GB of free disk for the pictures, got {free / 1e9:.2f} GB: "
        "free some, pass a smaller --max-side, or set XDG_CACHE_HOME to a folder of another disk"
    )


def _named(sizes: Sequence[tuple[int, int]]) -> str:
    """Return sizes in words, the most frequent first.

    >>> _named([(4, 3), (3, 4), (4, 3)]), _named([(1, 1), (2, 2), (3, 3), (4, 4)])
    ('4x3 and 3x4', '1x1 and 3 other sizes')
    """
    counts = [f"{width}x{height}" for (width, height), _ in Counter(sizes).most_common()]
    return " and ".join(counts) if len(counts) < 4 else f"{counts[0]} and {len(counts) - 1} other sizes"
