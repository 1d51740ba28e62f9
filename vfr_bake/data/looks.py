"""Find out what has to be known of each photograph before its camera can be estimated."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from PIL import Image

from player.errors import FormatError
from vfr_bake.data import threads
from vfr_bake.data.features import MAX_SIDE, Features, find_features
from vfr_bake.data.files.masks import apply_mask
from vfr_bake.data.files.opening import exif_of, open_photograph
from vfr_bake.data.files.pictures import (
    decoding_bytes,
    enough_for,
    opencv,
    picture_size,
    read_picture,
    sharpness,
)
from vfr_bake.data.kept_matches import SIDE, KeptFeatures, KeptMatches, stamp
from vfr_bake.data.mapping import Sensor


@dataclass(frozen=True)
class Look:
    """The features and measurements of one picture, turned upright and without what is masked."""

    sensor: Sensor
    features: Features
    thumbnail: np.ndarray
    """[n_pixels] float32 grey levels."""
    sharpness: float


def look_at(
    pictures: Sequence[tuple[Path, Path | None]], kept: KeptMatches, progress: threads.Progress | None
) -> list[Look]:
    """Return the look of each picture. `pictures`: each with its mask, if it has one. `kept`: has what is
    known of some of them; what is found in the others is added to it. Raises DataError."""

    def look(picture: tuple[Path, Path | None]) -> Look:
        path, mask = picture
        of = stamp(path, mask)
        found = kept.look(of)
        if found is None:
            found = _found_in(path, mask)
            kept.keep_look(of, found)
        sensor = sensor_of(path, found.width, found.height)
        return Look(sensor, found.features, found.thumbnail.astype(np.float32), found.sharpness)

    sides = (MAX_SIDE if mask is None else None for _, mask in pictures)
    most = max(map(decoding_bytes, (path for path, _ in pictures), sides), default=1)
    return threads.in_threads(look, pictures, progress, most)


def _found_in(path: Path, mask: Path | None) -> KeptFeatures:
    width, height = picture_size(path, upright=True)
    # A picture with a mask is decoded at its full size, because its mask has that size.
    rgba = read_picture(path, True, None if mask is not None else enough_for((width, height), MAX_SIDE))
    if mask is not None:
        rgba = apply_mask(rgba, path, mask, upright=True)
    grey = Image.fromarray(rgba).convert("L").resize((SIDE, SIDE), Image.Resampling.BOX)
    cv2 = opencv(f"{path}: picture: expected OpenCV to look at it")
    found = find_features(rgba)
    # A JPEG decoder reduces by a whole factor, and rounds up at the edge.
    points = found.points * max(1, round(width / rgba.shape[1]))
    found = replace(found, points=points.clip(0, (width, height)))
    return KeptFeatures(width, height, found, np.asarray(grey).reshape(-1), sharpness(cv2, rgba))


def sensor_of(path: Path, width: int, height: int) -> Sensor:
    """Return the sensor that took a picture, from EXIF; `width`, `height`: of the picture turned upright."""
    try:
        with open_photograph(path) as file:
            exif = exif_of(file)
            details = exif.get_ifd(0x8769)
    except (FormatError, struct.error, KeyError, IndexError):  # damaged EXIF is as good as none
        return Sensor(width, height, (), None)
    # The tags 271 maker, 272 model, 0x920A focal length; 0xA405 is the same as it would be on 35 mm film.
    device = tuple(str(tags.get(tag, "")) for tags, tag in ((exif, 271), (exif, 272), (details, 0x920A)))
    film = _positive(details.get(0xA405))
    # The standard (CIPA DC-008, 4.6.5) compares by diagonals; the diagonal of film is 43.27 mm.
    focal = film / 43.27 * float(np.hypot(width, height)) if film else None
    return Sensor(width, height, device, focal)


def _positive(value: object) -> float | None:
    try:
        number = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return number if 0 < number < 1e4 else None
