"""The folder of the pictures that are kept between runs: its sets are found, made and removed here.

There is one folder for each set of pictures, named by a digest of everything that the pixels depend on:
paths, sizes and times of the files, cameras (without their poses) and lenses, and the working size. If a
picture changes, its set is therefore not found, and the pictures are read again. `index.json` says what is in
`pixels.bin`. `models.txt` names the models that were trained on the set, and its modification time is the
time of the last use. A set is removed once its models are gone, or if its room is needed.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

from player.cameras.camera import Camera
from player.errors import FormatError, OutputError
from player.files.files import new_folder
from player.files.json_files import parse_json, read_json
from player.kept_code import user_folder
from vfr_bake.data.files.pictures import DescribedView
from vfr_bake.data.store.capture import PosedImages
from vfr_bake.data.store.stored import StoreLayout, map_pictures
from vfr_bake.data.store.working import WorkingSize

VERSION = 4
MOST_BYTES = 64_000_000_000
"""Bytes that all sets may take together; the sets that were not used for longest are removed first."""
GRACE = 600.0
"""Seconds after its last use in which a set is not removed: its model may be about to be written."""
RESERVE = 500_000_000
"""Bytes that stay free on the disk."""
INDEX, PIXELS, MODELS = "index.json", "pixels.bin", "models.txt"


def cache_folder() -> Path:
    """Return the user's folder of kept pictures: `$XDG_CACHE_HOME/vfr-bake/pictures`, by default in
    `~/.cache` on Linux, and where macOS and Windows have such folders."""
    return user_folder() / "pictures"


def digests(described: Sequence[DescribedView], sizes: Sequence[WorkingSize]) -> list[str]:
    """Return the names of the sets of these pictures, one for each of the sizes. Raises OSError: a picture is
    gone."""
    parts = [_described(part) for view in described for part in view]
    told = "".join(map(repr, parts)).encode(errors="surrogateescape")
    heads = [json.dumps([VERSION, asdict(size)]).encode() for size in sizes]
    return [hashlib.sha256(head + told).hexdigest()[:32] for head in heads]


def _described(part: object) -> object:
    if isinstance(part, Path):
        found = part.stat()
        return str(part.resolve()), found.st_size, found.st_mtime_ns
    if isinstance(part, Camera):
        return {key: value for key, value in asdict(part).items() if key != "c2w"}
    return part


def opened(folder: Path, described: Sequence[DescribedView]) -> PosedImages | None:
    """Open the set in `folder`, with the poses of the pictures as they are `described`; None if there is no
    set, or none that is whole."""
    try:
        index = parse_json(read_json(folder / INDEX, "an index of pictures"), str(folder))
        if index["version"] != VERSION or len(index["intrinsics"]) != len(described):
            return None
        layout = StoreLayout.of(index["sizes"])
        if (folder / PIXELS).stat().st_size != int(layout.chunks[-1]) * index["n_channels"]:
            return None
        images = map_pictures(folder / PIXELS, layout, index["n_channels"], frozenset(index["transparent"]))
        cameras = [
            Camera(view.camera.name, view.camera.c2w, *size, *numbers)
            for view, size, numbers in zip(described, index["sizes"], index["intrinsics"], strict=True)
        ]
        return PosedImages(cameras, images)
    except (FormatError, OSError, ValueError, LookupError, ArithmeticError, TypeError):
        return None


def index_bytes(
    layout: StoreLayout, cameras: Sequence[Camera], n_channels: int, transparent: set[int]
) -> bytes:
    """Return the content of a set's `index.json`."""
    document: dict[str, Any] = {
        "version": VERSION,
        "n_channels": n_channels,
        "sizes": layout.sizes.tolist(),
        "intrinsics": [[camera.fx, camera.fy, camera.cx, camera.cy] for camera in cameras],
        "transparent": sorted(transparent),
    }
    return json.dumps(document).encode()


@contextmanager
def new_set(folder: Path) -> Iterator[Path]:
    """Yield a temporary folder that becomes `folder` when the block ends well. Raises OutputError."""
    try:
        folder.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
    except OSError as error:
        raise OutputError(f"{folder.parent}: cannot write: {error.strerror or error}") from error
    with new_folder(folder, force=True) as new:
        yield new


def reserve(path: Path, n_bytes: int) -> None:
    """Make a file of `n_bytes`, and reserve its room on the disk if the system can. Raises OSError: there is
    no room."""
    with path.open("wb") as file:
        if hasattr(os, "posix_fallocate"):
            os.posix_fallocate(file.fileno(), 0, n_bytes)
        else:
            file.truncate(n_bytes)


def free_bytes(folder: Path) -> int:
    """Return the number of bytes, beyond RESERVE, that may be written into `folder`, which need not exist.
    Raises OSError."""
    there = next(place for place in (folder, *folder.absolute().parents) if place.is_dir())
    return max(0, shutil.disk_usage(there).free - RESERVE)


def note_use(folder: Path, model: Path) -> None:
    """Record that `model` is trained on the set in `folder`, now."""
    with suppress(OSError):
        known = _models(folder)
        name = str(model.absolute())
        text = "\n".join([*(known - {name}), name])
        (folder / MODELS).write_text(text, encoding="utf-8", errors="surrogateescape")


def remove_unused(root: Path, wanted: int, keep: Path) -> None:
    """Remove the sets in `root` whose models are all gone, and the oldest others until `wanted` more bytes
    are allowed and the disk has them. `keep`, and sets that were used just now, are never removed."""
    now = time.time()
    sets = []
    with suppress(OSError):
        for folder in root.iterdir():
            if folder != keep and (folder / INDEX).is_file():
                sets.append((_last_use(folder), _size(folder), folder))
    sets = sorted((entry for entry in sets if now - entry[0] > GRACE), key=lambda entry: entry[0])
    total = sum(entry[1] for entry in sets)
    for _, n_bytes, folder in sets:
        gone = not any(_is_there(Path(name)) for name in _models(folder))
        if gone or total + wanted > MOST_BYTES or free_bytes(root) < wanted:
            shutil.rmtree(folder, ignore_errors=True)
            total -= n_bytes


def _is_there(model: Path) -> bool:
    return model.exists() or model.with_name(model.name + ".checkpoint").exists()


def _models(folder: Path) -> set[str]:
    with suppress(OSError):
        return set((folder / MODELS).read_text(encoding="utf-8", errors="surrogateescape").splitlines())
    return set()


def _last_use(folder: Path) -> float:
    with suppress(OSError):
        return (folder / MODELS).stat().st_mtime
    with suppress(OSError):
        return folder.stat().st_mtime
    return 0.0


def _size(folder: Path) -> int:
    with suppress(OSError):
        return (folder / PIXELS).stat().st_size
    return 0
