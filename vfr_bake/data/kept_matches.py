"""Features and matches of pictures, kept on the disk until the cameras of the pictures are known.

An estimation that was interrupted continues where it stopped, and one with additional pictures begins with
the features and matches that are known. If the disk refuses to keep more, the estimation goes on without.

There are two files of records, one record after the other, little-endian. A last record that is cut short
does not count, and the next one takes its place. Of several processes that write to the same files, all but
one stop when they notice.

- `features.bin`: stamp of the picture (16 bytes), sharpness (float64), width, height and number of features n
  (uint32 each), thumbnail (32 x 32 bytes, grey), n points (2 float32), n descriptors (128 bytes).
- `matches.bin`: stamps of the two pictures, number of matches n (uint32), n pairs of indices (2 uint32).
"""

from __future__ import annotations

import hashlib
import os
import shutil
import struct
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np

from vfr_bake.data.features import MAX_FEATURES, Features

VERSION = b"5"
"""Version of the records. It changes whenever the same picture would give other features or matches."""
SIDE = 32
"""Pixels along a side of a thumbnail."""
STAMP = 16
MOST_SECONDS = 30 * 24 * 3600
"""Seconds after which records are deleted if no features were added to them."""
_LOOK = struct.Struct(f"<{STAMP}sdIII")
_MATCHES = struct.Struct(f"<{STAMP}s{STAMP}sI")
_BYTES_A_FEATURE, _BYTES_A_MATCH = 8 + 128, 8


class KeptFeatures(NamedTuple):
    """The features and measurements of one picture, turned upright."""

    width: int
    height: int
    features: Features
    thumbnail: np.ndarray
    """[32 * 32] uint8, grey."""
    sharpness: float


def stamp(*files: Path | None) -> bytes:
    """Return 16 bytes that change with the path, the size or the modification time of any of the `files`.
    None stands for a file that a picture does not have."""
    told = hashlib.blake2b(VERSION, digest_size=STAMP)
    for path in files:
        if path is None:
            continue
        found = path.stat()
        told.update(os.fsencode(path.resolve()) + f"\0{found.st_size}\0{found.st_mtime_ns}\0".encode())
    return told.digest()


class KeptMatches:
    """The records of one set of pictures, in a folder of their own. Its methods may be called from several
    threads."""

    def __init__(self, folder: Path, say: Callable[[str], object] | None = None) -> None:
        """Open the records in `folder`, which is made if it is missing. `say`: called once, with a sentence,
        if no more can be kept."""
        self._folder = folder
        self._say = say or (lambda text: None)
        self._lock = threading.Lock()
        self._looks: dict[bytes, int] = {}
        self._matches: dict[bytes, int] = {}
        self._ends: dict[Path, tuple[int, int]] = {}
        """By file, where the next record goes, and the size that the file has unless another process has
        written to it."""
        self._keeps = True
        try:
            self._open()
        except OSError as error:
            self._give_up(error.strerror or str(error))

    def _open(self) -> None:
        self._folder.mkdir(parents=True, exist_ok=True)
        for path, header, index, n_bytes in (
            (self._looks_path, _LOOK, self._looks, lambda n: SIDE * SIDE + n * _BYTES_A_FEATURE),
            (self._matches_path, _MATCHES, self._matches, lambda n: n * _BYTES_A_MATCH),
        ):
            end = size = 0
            if path.exists():
                with path.open("rb") as file:
                    size = path.stat().st_size
                    while (record := _header(file, end, header)) is not None:
                        next_end = end + header.size + n_bytes(record[-1])
                        if record[-1] > MAX_FEATURES or next_end > size:
                            break
                        index[b"".join(part for part in record if isinstance(part, bytes))] = end
                        end = next_end
            self._ends[path] = end, size

    def _give_up(self, reason: str) -> None:
        self._keeps = False
        self._say(
            f"{self._folder}: cannot write: {reason}: no more features and matches are "
            "kept: if the estimation of cameras is interrupted, it looks for them again"
        )

    @classmethod
    def of(cls, photos: Path, root: Path, say: Callable[[str], object] | None = None) -> KeptMatches:
        """Open the records of the pictures in the folder `photos`, in a subfolder of `root`. Subfolders to
        which no features were added for a month are deleted."""
        with suppress(OSError):  # it belongs to another user, or is gone by now
            for path in root.glob("*/features.bin"):
                if time.time() - path.stat().st_mtime > MOST_SECONDS:
                    shutil.rmtree(path.parent, ignore_errors=True)
        name = hashlib.blake2b(os.fsencode(photos.resolve()), digest_size=STAMP).hexdigest()
        return cls(root / name, say)

    @property
    def _looks_path(self) -> Path:
        return self._folder / "features.bin"

    @property
    def _matches_path(self) -> Path:
        return self._folder / "matches.bin"

    def look(self, of: bytes) -> KeptFeatures | None:
        """Return what was found in the picture with the stamp `of`; None if nothing is kept."""
        file = self._at(self._looks_path, self._looks, of)
        if file is None:
            return None
        with file:
            _, sharpness, width, height, n = _LOOK.unpack(file.read(_LOOK.size))
            thumbnail = np.frombuffer(file.read(SIDE * SIDE), np.uint8)
            points = np.frombuffer(file.read(8 * n), "<f4").reshape(n, 2).astype(np.float64)
            sift = np.frombuffer(file.read(128 * n), np.uint8).reshape(n, 128)
        return KeptFeatures(width, height, Features(points, sift), thumbnail, sharpness)

    def keep_look(self, of: bytes, look: KeptFeatures) -> None:
        """Keep what was found in the picture with the stamp `of`."""
        points, sift = look.features.points.astype("<f4"), look.features.sift
        header = _LOOK.pack(of, look.sharpness, look.width, look.height, len(points))
        record = b"".join((header, look.thumbnail.tobytes(), points.tobytes(), sift.tobytes()))
        self._append(self._looks_path, self._looks, of, record)

    def matches(self, a: bytes, b: bytes, n_a: int, n_b: int) -> np.ndarray | None:
        """Return the matches [n, 2] uint32 of the pictures with the stamps `a` and `b`, which have `n_a` and
        `n_b` features; None if none are kept."""
        file = self._at(self._matches_path, self._matches, a + b)
        if file is None:
            return None
        with file:
            n = _MATCHES.unpack(file.read(_MATCHES.size))[-1]
            found = np.frombuffer(file.read(_BYTES_A_MATCH * n), "<u4").reshape(n, 2)
        return found if (found < (n_a, n_b)).all() else None

    def keep_matches(self, a: bytes, b: bytes, matches: np.ndarray) -> None:
        """Keep the `matches` [n, 2] of the pictures with the stamps `a` and `b`."""
        record = _MATCHES.pack(a, b, len(matches)) + matches.astype("<u4").tobytes()
        self._append(self._matches_path, self._matches, a + b, record)

    def _at(self, path: Path, index: dict[bytes, int], key: bytes) -> BinaryIO | None:
        """Open a file at the record of `key`; None if there is no such record, or the file cannot be opened,
        for example because another process, which is done with the same pictures, has deleted it."""
        if key not in index:
            return None
        try:
            file = path.open("rb")
        except OSError:
            return None
        file.seek(index[key])
        return file

    def _append(self, path: Path, index: dict[bytes, int], key: bytes, record: bytes) -> None:
        with self._lock:
            if not self._keeps:
                return
            at, size = self._ends[path]
            try:
                with path.open("ab") as file:
                    if file.tell() != size:
                        self._give_up("another process writes there")
                        return
                    file.truncate(at)
                    file.write(record)
            except OSError as error:
                self._give_up(error.strerror or str(error))
                return
            end = at + len(record)
            index[key], self._ends[path] = at, (end, end)

    def remove(self) -> None:
        """Delete the folder."""
        shutil.rmtree(self._folder, ignore_errors=True)


def _header(file: BinaryIO, at: int, header: struct.Struct) -> tuple | None:
    file.seek(at)
    content = file.read(header.size)
    return header.unpack(content) if len(content) == header.size else None
