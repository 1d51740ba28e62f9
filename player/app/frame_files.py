"""Where frames go: a folder of pictures, one picture, or a video; and which of them are there already.

A picture carries a key: a digest of the asset, the camera and the settings that it was rendered with. To
resume is to leave away what is there with the right key, so that frames of two different runs are never
mixed.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from player.app.options import PICTURES, VIDEO
from player.app.video import load_av, write_video
from player.asset.asset import Asset
from player.asset.manifest import MAX_BYTES, NAME
from player.cameras.camera import Camera
from player.cameras.transforms import frame_names
from player.errors import ConfigError, OutputError
from player.files.files import check_target, read_bytes, write_bytes
from player.files.images import ENCODERS, open_picture, read_key
from player.files.replace import clear_up


@dataclass(frozen=True)
class Target:
    """What `--output` says."""

    path: Path
    folder: Path
    """Where the single pictures go; for a video a folder beside it, until it is complete."""
    suffix: str
    """Of the pictures, with its dot."""

    @property
    def is_video(self) -> bool:
        return self.path.suffix.lower() == VIDEO

    @property
    def is_picture(self) -> bool:
        return self.path.suffix.lower() in PICTURES

    @classmethod
    def of(cls, path: Path, form: str | None) -> Target:
        """`path`: a folder, or a file whose suffix says picture or video; `form`: png or webp, for a folder.

        >>> Target.of(Path("turn.mp4"), None).folder.as_posix(), Target.of(Path("out"), "webp").suffix
        ('turn.mp4.frames', '.webp')
        """
        suffix = path.suffix.lower()
        if suffix == VIDEO:
            return cls(path, path.with_name(f"{path.name}.frames"), ".png")
        if suffix in PICTURES:
            return cls(path, path.parent, suffix)
        return cls(path, path, f".{form or 'png'}")

    def paths(self, views: Sequence[Camera], part: slice) -> list[Path]:
        """The file of each view in the slice; names are those that all views together ask for."""
        if self.is_picture:
            if len(views[part]) != 1:
                raise ConfigError(
                    f"{self.path}: expected one view for one picture, got {len(views[part])}: "
                    "name a folder, or one view by --frames N"
                )
            return [self.path]
        return [self.folder / f"{name}{self.suffix}" for name in frame_names(views)[part]]

    def check(self, force: bool, resume: bool) -> None:
        """Raise OutputError for what would be overwritten, or cannot be written; MissingExtraError for a
        video without PyAV."""
        if self.is_picture or self.is_video:
            check_target(self.path, force or resume)
            if self.path.is_dir():
                raise OutputError(f"{self.path}: expected a file to write, got a folder")
        if self.is_video:
            load_av()
        if not self.is_picture:
            clear_up(self.folder)
            self._check_folder(force or resume)

    def _check_folder(self, allowed: bool) -> None:
        folder = self.folder
        try:
            taken = folder.exists() and (not folder.is_dir() or (not allowed and any(folder.iterdir())))
        except OSError as error:
            raise OutputError(f"{folder}: cannot read: {error.strerror}") from error
        if taken and not folder.is_dir():
            raise OutputError(f"{folder}: expected a folder for the pictures, got a file")
        if taken:
            raise OutputError(
                f"{folder}: not empty: add --force to write into it, replacing frames of equal name, "
                "or --resume to go on with a run that was interrupted"
            )

    def finish(self, paths: Sequence[Path], fps: float) -> None:
        """Make the video out of its pictures, which are then removed; nothing to do for pictures."""
        if not self.is_video:
            return
        write_video(self.path, (_pixels(path) for path in paths), fps)
        for path in paths:
            path.unlink()
        if not any(self.folder.iterdir()):
            self.folder.rmdir()


def frame_key(asset: Asset, camera: Camera, samples: int | None, background: object) -> str:
    """A digest of everything that the picture depends on."""
    k = asset.manifest.n_samples if samples is None else samples
    behind = asset.manifest.background if background is None else background
    lens = (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
    facts = json.dumps([camera.c2w.tolist(), lens, k, behind])
    manifest = read_bytes(asset.folder / NAME, "a manifest", MAX_BYTES, asset.folder)
    return hashlib.sha256(manifest + facts.encode()).hexdigest()


def unfinished(paths: Sequence[Path], keys: Sequence[str], cameras: Sequence[Camera]) -> list[int]:
    """Which frames are not there yet. Raises ConfigError for one that is there and shows something else."""
    missing = []
    for index, (path, key, camera) in enumerate(zip(paths, keys, cameras, strict=True)):
        if not path.exists():
            missing.append(index)
        elif read_key(path, (camera.width, camera.height)) != key:
            raise ConfigError(
                f"{path}: --resume: expected a frame of this asset, these views and these settings, "
                "got another: add --force instead to render everything anew"
            )
    return missing


def write_frame(path: Path, pixels: np.ndarray, key: str) -> None:
    """Write a picture in the format of its suffix."""
    write_bytes(path, encode_frame(path.suffix.lower(), pixels, key))


def encode_frame(suffix: str, pixels: np.ndarray, key: str) -> bytes:
    """The bytes of a picture in the format of `suffix`."""
    return ENCODERS[suffix](pixels, key)


def _pixels(path: Path) -> np.ndarray:
    with open_picture(path) as picture:
        return np.asarray(picture.convert("RGB"))
