"""The files that frames are written to (a folder of pictures, one picture, or a video), and which of them
exist already.

A picture carries a key: a digest of the asset, the camera and the settings that it was rendered with. A
resumed run skips the frames that exist with the right key, so that frames of two different runs, or of an
incomplete copy and a whole one, are never mixed. A video carries a digest of the keys of its frames.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from player.app.options import PICTURES, VIDEO, PlaySettings
from player.app.video import load_av, read_video_key, write_video
from player.asset.asset import Asset
from player.cameras.camera import Camera
from player.cameras.transforms import frame_names
from player.errors import ConfigError, OutputError
from player.files.content import content_of
from player.files.files import check_target
from player.files.images import open_picture, read_key
from player.files.replace import clear_up


@dataclass(frozen=True)
class Target:
    """The files that frames are written to."""

    path: Path
    """The folder, the picture or the video that was asked for."""
    folder: Path
    """Folder of the single pictures; those of a video are in a folder beside it until the video is
    complete."""
    suffix: str
    """File name ending of the pictures, with its dot."""

    @property
    def is_video(self) -> bool:
        return self.path.suffix.lower() == VIDEO

    @property
    def is_picture(self) -> bool:
        return self.path.suffix.lower() in PICTURES

    @classmethod
    def of(cls, settings: PlaySettings) -> Target:
        """Find the files for `settings.output`. A suffix of a picture or a video means one file; anything
        else is a folder.

        >>> Target.of(PlaySettings(Path("turn.mp4"))).folder.as_posix()
        'turn.mp4.frames'
        >>> Target.of(PlaySettings(Path("out"), format="webp")).suffix
        '.webp'
        """
        path = Path(settings.output)
        suffix = path.suffix.lower()
        if suffix == VIDEO:
            return cls(path, path.with_name(f"{path.name}.frames"), ".png")
        if suffix in PICTURES:
            return cls(path, path.parent, suffix)
        return cls(path, path, f".{settings.format or 'png'}")

    def paths(self, views: Sequence[Camera], part: slice) -> list[Path]:
        """Return the file of each view in the slice `part`; the name of a file does not depend on the slice.

        Raises ConfigError: one picture is to hold several views.
        """
        if self.is_picture:
            if len(views[part]) != 1:
                raise ConfigError(
                    f"{self.path}: expected one view for one picture, got {len(views[part])}: "
                    "name a folder, or one view by --frames N"
                )
            return [self.path]
        return [self.folder / f"{name}{self.suffix}" for name in frame_names(views)[part]]

    def check(self, settings: PlaySettings) -> None:
        """Raise OutputError if a file would be overwritten or cannot be written; MissingExtraError for a
        video without PyAV."""
        allowed = settings.force or settings.resume
        if self.is_picture or self.is_video:
            check_target(self.path, allowed, is_file=True)
        if self.is_video:
            load_av()
        if not self.is_picture:
            clear_up(self.folder)
            self._check_folder(allowed)

    def _check_folder(self, allowed: bool) -> None:
        folder = self.folder
        found = content_of(folder)
        if folder.exists() and not folder.is_dir():
            raise OutputError(f"{folder}: expected a folder for the pictures, got a file")
        if found and not allowed:
            raise OutputError(
                f"{folder}: not empty: add --force to write into it, replacing frames of equal name, "
                "or --resume to go on with a run that was interrupted"
            )

    def is_complete(self, paths: Sequence[Path], key: str) -> bool:
        """Return whether the video is there already, so that a resumed run has nothing to do.

        Raises ConfigError: there is another video, and no frame (`paths`) of an interrupted run that was to
        replace it.
        """
        if not self.is_video or not self.path.exists() or any(path.exists() for path in paths):
            return False
        if read_video_key(self.path) != key:
            raise _another(self.path, "a video")
        return True

    def finish(self, paths: Sequence[Path], fps: float, key: str) -> None:
        """For a video, join its pictures and then remove them; for pictures, do nothing."""
        if not self.is_video:
            return
        write_video(self.path, (_pixels(path) for path in paths), fps, key)
        for path in paths:
            path.unlink()
        if not any(self.folder.iterdir()):
            self.folder.rmdir()


def frame_key(asset: Asset, camera: Camera, settings: PlaySettings) -> str:
    """Return a digest of everything that the picture depends on. The march of `settings` is not "auto"."""
    k = asset.manifest.n_fetches if settings.samples is None else settings.samples
    behind = asset.manifest.background if settings.background is None else settings.background
    lens = (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
    facts = [camera.c2w.tolist(), lens, k, behind, settings.quality, settings.march]
    if asset.n_parts < len(asset.manifest.parts):  # the picture is coarser than one of the whole asset
        facts.append(asset.n_parts)
    return hashlib.sha256(json.dumps([asset.digest, facts]).encode()).hexdigest()


def video_key(keys: Sequence[str], fps: float) -> str:
    """Return a digest of everything that a video depends on: the keys of its frames and their rate."""
    return hashlib.sha256(json.dumps([list(keys), fps]).encode()).hexdigest()


def unfinished(paths: Sequence[Path], keys: Sequence[str], cameras: Sequence[Camera]) -> list[int]:
    """Return the indices of the frames that do not exist yet. Raises ConfigError for one that shows something
    else."""
    missing = []
    for index, (path, key, camera) in enumerate(zip(paths, keys, cameras, strict=True)):
        if not path.exists():
            missing.append(index)
        elif read_key(path, (camera.width, camera.height)) != key:
            raise _another(path, "a frame")
    return missing


def _another(path: Path, what: str) -> ConfigError:
    return ConfigError(
        f"{path}: --resume: expected {what} of this asset, these views and these settings, "
        "got another: add --force instead to render everything anew"
    )


def _pixels(path: Path) -> np.ndarray:
    with open_picture(path) as picture:
        return np.asarray(picture.convert("RGB"))
