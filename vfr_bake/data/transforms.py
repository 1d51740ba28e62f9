"""Folders of pictures with a transforms.json: NeRF-synthetic (Blender), instant-ngp and nerfstudio forms."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from player.cameras import Camera
from player.errors import DataError, MissingExtraError
from player.transforms import load_transforms, transforms_cameras, transforms_number
from vfr_bake.data.scene import PosedImages, Scene, build_scene

SUFFIXES = (".png", ".jpg", ".jpeg")
HOLD_OUT_EVERY = 8
DISTORTION_KEYS = ("k1", "k2", "k3", "k4", "p1", "p2")

Progress = Callable[[int, int], object]


def load_folder(folder: Path, progress: Progress | None = None) -> Scene:
    """The scene in `folder`: `transforms_train.json` and `transforms_test.json`, or one `transforms.json`.

    Without a test file every eighth view is held out, the first one included; fewer than eight views are all
    trained on, and `test` is empty.

    Raises DataError (folder, pictures) or FormatError (JSON, cameras), in one line that names the file.
    """
    if not folder.exists():
        raise DataError(
            f"{folder}: no such folder: expected a folder with a transforms.json, or the word demo"
        )
    if not folder.is_dir():
        raise DataError(f"{folder}: expected a folder with a transforms.json, got a file")
    train_file, test_file = folder / "transforms_train.json", folder / "transforms_test.json"
    if not train_file.exists():
        train_file = folder / "transforms.json"
    if not train_file.exists():
        empty = "an empty folder" if not any(folder.iterdir()) else "neither"
        raise DataError(f"{folder}: expected transforms_train.json or transforms.json in it, got {empty}")
    jobs = [_Job(train_file)]
    if train_file.name == "transforms_train.json" and test_file.exists():
        jobs.append(_Job(test_file))
    n_pictures = sum(len(job.paths) for job in jobs)
    if len(jobs[0].paths) < 2:
        raise DataError(f"{train_file}: training views: expected at least 2, got {len(jobs[0].paths)}")
    done = 0

    def count(_: object) -> None:
        nonlocal done
        done += 1
        if progress is not None:
            progress(done, n_pictures)

    train, *rest = [job.read(count) for job in jobs]
    test = rest[0] if rest else None
    if test is None:
        held = np.zeros(len(train.cameras), bool)
        if len(held) >= HOLD_OUT_EVERY:
            held[::HOLD_OUT_EVERY] = True
        train, test = _subset(train, ~held), _subset(train, held)
    return build_scene(folder.resolve().name or "scene", train, test)


class _Job:
    """One transforms file: everything that can be wrong is found before the first picture is decoded."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.document = load_transforms(path)
        self.frames: list[dict[str, Any]] = self.document["frames"]
        self.paths = [_picture_path(path, index, frame) for index, frame in enumerate(self.frames)]
        self.size = _picture_size(self.paths[0])
        self.cameras = transforms_cameras(self.document, path, self.size)
        self.distortions = [self._distortion(index, frame) for index, frame in enumerate(self.frames)]
        for picture in self.paths[1:]:
            size = _picture_size(picture)
            if size != self.size:
                raise DataError(
                    f"{picture}: size: expected {self.size[0]}x{self.size[1]} like {self.paths[0]}, "
                    f"got {size[0]}x{size[1]}"
                )

    def _distortion(self, index: int, frame: dict[str, Any]) -> dict[str, float]:
        where = f"{self.path}: frame {index} ({frame['file_path']})"
        values = {key: transforms_number(self.document, frame, key, where) for key in DISTORTION_KEYS}
        return {key: value or 0.0 for key, value in values.items()}

    def read(self, count: Callable[[object], None]) -> PosedImages:
        width, height = self.size
        cameras = [camera.resized(width, height) for camera in self.cameras]
        images = np.empty((len(cameras), height, width, 4), np.uint8)

        def load(index: int) -> None:
            image = read_picture(self.paths[index])
            distortion = self.distortions[index]
            if any(distortion.values()):
                image = undistort(image, cameras[index], **distortion)
            images[index] = image

        with ThreadPoolExecutor(min(8, os.cpu_count() or 1)) as pool:
            futures = [pool.submit(load, index) for index in range(len(cameras))]
            try:
                for future in futures:
                    count(future.result())
            except BaseException:
                pool.shutdown(cancel_futures=True)
                raise
        return PosedImages(cameras, images)


def read_picture(path: Path) -> np.ndarray:
    """A picture as [height, width, 4] uint8, sRGB and straight alpha; grey, palette and 16-bit pictures too.

    Raises DataError for what Pillow cannot read to its end, and for floating-point pictures.
    """
    try:
        with Image.open(path) as file:
            file.load()
            if file.mode == "I" or file.mode.startswith("I;16"):
                # Pillow's own conversion clips 16-bit greys at 255.
                grey = np.asarray(file.convert("I"), np.int64).clip(0, 65535)
                rgba = np.full((*grey.shape, 4), 255, np.uint8)
                rgba[..., :3] = ((grey * 255 + 32767) // 65535)[..., None]
                return rgba
            if file.mode == "F":
                raise DataError(f"{path}: picture: expected 8 or 16 bits a channel, got floating point")
            return np.asarray(file.convert("RGBA"))
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        if isinstance(error, DataError):
            raise
        raise DataError(f"{path}: picture: cannot be read to its end: {_first_line(error)}") from error


def undistort(
    image: np.ndarray,
    camera: Camera,
    k1: float = 0.0,
    k2: float = 0.0,
    k3: float = 0.0,
    k4: float = 0.0,
    p1: float = 0.0,
    p2: float = 0.0,
) -> np.ndarray:
    """The picture that `camera` would have taken without lens distortion; same size, same intrinsics.

    The lens model is OpenCV's with nerfstudio's fourth radial term: with r² = x² + y² at x, y = ray / depth,
    x' = x (1 + k1 r² + k2 r⁴ + k3 r⁶ + k4 r⁸) + 2 p1 x y + p2 (r² + 2 x²), y' the like with p1, p2 exchanged.
    (`cv2.undistort` has no k4 of this meaning.) Pixels that the lens never saw repeat the picture's edge.

    `image`: [height, width, 4] uint8. Raises MissingExtraError without OpenCV.
    """
    try:
        import cv2
    except ImportError as error:
        raise MissingExtraError(
            f"{camera.name}: lens distortion: expected OpenCV to undo it: pip install 'vfr-bake[train]'"
        ) from error
    x = (np.arange(camera.width) + 0.5 - camera.cx)[None, :] / camera.fx
    y = (np.arange(camera.height) + 0.5 - camera.cy)[:, None] / camera.fy
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * k4)))
    column = camera.fx * (x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)) + camera.cx - 0.5
    row = camera.fy * (y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y) + camera.cy - 0.5
    # Colours under zero alpha mean nothing, so it is the premultiplied picture that can be interpolated.
    weighted = image.astype(np.float32)
    weighted[..., :3] *= weighted[..., 3:] / 255
    result = cv2.remap(
        weighted,
        column.clip(-1e6, 1e6).astype(np.float32),
        row.clip(-1e6, 1e6).astype(np.float32),
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    )
    result[..., :3] /= np.maximum(result[..., 3:], 1e-6) / 255
    return (result + 0.5).clip(0, 255).astype(np.uint8)


def _picture_path(transforms: Path, index: int, frame: dict[str, Any]) -> Path:
    name: str = frame["file_path"]
    for form in (name, name.replace("\\", "/")):
        path = transforms.parent / form
        for candidate in (path, *(path.with_name(path.name + suffix) for suffix in SUFFIXES if path.name)):
            if _is_file(candidate):
                return candidate
    expected = f"expected {transforms.parent / name}"
    if not name.lower().endswith(SUFFIXES):
        expected += f" with one of {', '.join(SUFFIXES)}"
    raise DataError(f"{transforms}: frame {index} ({name}): picture is missing: {expected}")


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except OSError:  # a name that is too long; before Python 3.14 this raises
        return False


def _picture_size(path: Path) -> tuple[int, int]:
    try:
        with Image.open(path) as file:
            return file.size
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise DataError(f"{path}: picture: expected a PNG or JPEG file: {_first_line(error)}") from error


def _first_line(error: BaseException) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]


def _subset(views: PosedImages, which: Sequence[bool] | np.ndarray) -> PosedImages:
    return PosedImages(
        [camera for camera, keep in zip(views.cameras, which, strict=True) if keep], views.images[which]
    )
