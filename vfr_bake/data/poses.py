"""Photographs or a video without cameras -> a COLMAP model beside them, `sparse/0`, estimated once."""

from __future__ import annotations

import struct
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numba.misc.appdirs import AppDirs
from PIL import Image

from player.cameras.colmap import MAX_FILE_BYTES
from player.errors import DataError, FormatError
from player.files.files import new_folder, read_bytes
from player.files.images import open_picture
from vfr_bake.data import threads
from vfr_bake.data.features import Features, find_features, pairs_to_match
from vfr_bake.data.files import video
from vfr_bake.data.files.pictures import read_picture
from vfr_bake.data.folds import agreeing_pairs, near_pairs, torn_neighbours
from vfr_bake.data.kept_matches import SIDE, KeptMatches, Look, stamp
from vfr_bake.data.mapping import (
    Pair,
    Sensor,
    map_pictures,
    match_pictures,
    pycolmap_module,
    write_database,
)

SUFFIXES = (".jpg", ".jpeg", ".png")
MODEL_FILES = ("cameras.bin", "images.bin", "points3D.bin")

MIN_PICTURES = 3
MIN_SHARE = 0.6
"""Share of the pictures that must find a place. Where two in five find none, the subject is seen from one
side only, or in two models of which one is lost: a field trained on the rest has holes."""
MIN_REGISTERED = 8
"""If there are fewer pictures, all must be registered: a handful can agree on a wrong model."""
MIN_FEATURES = 50
"""Fewer than these, and a picture is blank, out of focus, or all blur."""
SAME = 1.5
"""Grey levels of 255, mean difference of thumbnails: what a camera's noise is below on a tripod."""

ADVICE = (
    "photograph with more overlap (a step of some 10 degrees from one picture to the next), move around the "
    "subject instead of turning on the spot, hold still while the shutter is open, leave zoom and focus as "
    "they are, and keep textured surroundings in the picture: a plain, shiny or transparent subject alone "
    "gives nothing to hold on to"
)

Progress = Callable[[str, int, int], object]


@dataclass(frozen=True)
class PoseReport:
    """How well the cameras of a set of pictures are known."""

    folder: Path
    """The folder that holds `sparse/0` and the pictures: the given one, or a video's folder of frames."""
    n_pictures: int
    n_registered: int
    """The pictures that have got a camera."""
    mean_error: float
    """Pixels: mean over the points of how far their projections are from where the pictures show them."""
    mean_track_length: float
    """Pictures a point is seen in, on average."""
    unplaced: Mapping[str, str] = field(default_factory=dict)
    """Why a picture found no place, by its name; empty where the cameras were there already."""

    def summary(self) -> str:
        """One sentence for whoever took the pictures.

        >>> PoseReport(Path("garden"), 50, 48, 0.61, 7.25).summary()
        'garden: cameras of 48 of 50 pictures, off by 0.61 pixels, a point is seen in 7.2 pictures'
        """
        return (
            f"{self.folder}: cameras of {self.n_registered} of {self.n_pictures} pictures, "
            f"off by {self.mean_error:.2f} pixels, a point is seen in {self.mean_track_length:.1f} pictures"
        )


def is_video(path: Path) -> bool:
    """Whether `path` is a file that goes by the name of a video.

    >>> is_video(Path("surely/not/there.mp4"))
    False
    """
    return path.suffix.lower() in video.SUFFIXES and path.is_file()


def has_pictures(folder: Path) -> bool:
    """Whether `estimate_cameras` finds pictures in `folder` itself or in its `images/`."""
    return bool(list_pictures(folder))


def estimate_cameras(photos: Path, progress: Progress) -> PoseReport:
    """Estimate the camera of every picture, and keep the result as `sparse/0` beside the pictures.

    `photos`: a folder with JPEG or PNG pictures in `images/` or in itself, or a video, whose frames are
    first written to `<stem>_frames/images/` beside it. A `sparse/0` that is there is reported and left as it
    is; a new one appears when it is complete. `progress`: called with a stage (`frames` for a video, then
    `features`, `matches`, `cameras`; where those are folded also `walk`, `turns`, `cameras again`), how much
    of it is done and how much there is.

    Pictures of one size, and of one maker, model and focal length where EXIF tells, share one camera (model
    RADIAL), which begins with EXIF's focal length. The model's unit and axes are arbitrary: pictures alone
    do not tell them. A subject that looks the same from two sides is folded into one, as if walked around
    half, where nothing but it is matched. Pictures of one walk, named in its order, are unfolded
    (`vfr_bake.data.folds`); pictures in no order are not, unless their surroundings prevent it.

    Raises DataError (nothing that can be used; what to photograph differently), FormatError (a damaged
    `sparse/0`), OutputError, MissingExtraError.
    """
    if is_video(photos):
        photos = video.extract_frames(photos, lambda done, of: progress("frames", done, of))
    if not photos.is_dir():
        found = "a file of another kind" if photos.exists() else "nothing"
        raise DataError(f"{photos}: expected a folder of pictures or a video, got {found}")
    pictures = list_pictures(photos)
    model = photos / "sparse" / "0"
    if model.exists():
        return _read_report(model, photos, len(pictures))
    if len(pictures) < MIN_PICTURES:
        raise DataError(
            f"{photos}: pictures ({', '.join(SUFFIXES)}): expected at least {MIN_PICTURES}, "
            f"got {len(pictures)}{_other_kinds(photos)}"
        )
    pycolmap_module()  # said at once if it is missing, not after minutes
    kept = KeptMatches.of(photos, cache_root())
    stamps = [stamp(path) for path in pictures]
    sensors, features = _look_at(pictures, photos, kept, stamps, lambda *n: progress("features", *n))

    def known(i: int, j: int) -> np.ndarray | None:
        return kept.matches(stamps[i], stamps[j], len(features[i].points), len(features[j].points))

    pairs = match_pictures(
        sensors,
        features,
        pairs_to_match(features),
        lambda *n: progress("matches", *n),
        known,
        lambda i, j, matches: kept.keep_matches(stamps[i], stamps[j], matches),
    )
    models = _placed(pictures, sensors, features, pairs, progress)
    n_registered = models[0].num_reg_images() if models else 0
    if n_registered < _n_needed(len(pictures)):
        raise DataError(
            f"{photos}: cameras: expected to find those of at least {_n_needed(len(pictures))} of "
            f"{len(pictures)} pictures, got {n_registered}{_in_groups(models)}: {ADVICE}"
        )
    with new_folder(model) as new:
        models[0].write_binary(str(new))
    kept.remove()
    reasons = why_unplaced([path.name for path in pictures], features, pairs, models)
    return replace(_read_report(model, photos, len(pictures)), unplaced=reasons)


def cache_root() -> Path:
    """The user's folder of what is kept of sets of pictures whose cameras are not known yet."""
    return Path(AppDirs("vfr-bake", appauthor=False).user_cache_dir) / "matches"


def _in_groups(models: Sequence[Any]) -> str:
    """How the pictures fall apart, where they do.

    >>> _in_groups([])
    ''
    """
    sizes = [str(model.num_reg_images()) for model in models]
    if len(sizes) < 2:
        return ""
    return f" (they fall into groups of {', '.join(sizes)} that have nothing in common: two places?)"


def why_unplaced(
    names: Sequence[str], features: Sequence[Features], pairs: Sequence[Pair], models: Sequence[Any]
) -> dict[str, str]:
    """Why pictures are not in the first of the `models`, by their names."""
    placed = _names_in(models[0])
    partners: dict[str, set[str]] = {name: set() for name in names}
    for pair in pairs:
        partners[names[pair.i]].add(names[pair.j])
        partners[names[pair.j]].add(names[pair.i])
    reasons = {}
    for name, found in zip(names, features, strict=True):
        others = [len(group) for group in map(_names_in, models[1:]) if name in group]
        if name in placed:
            continue
        if len(found.points) < MIN_FEATURES:
            reasons[name] = f"blank, blurred or out of focus: {len(found.points)} features"
        elif not partners[name]:
            reasons[name] = "nothing in common with any other picture"
        elif others:
            reasons[name] = f"in a group of {others[0]} with too little in common with the others"
        elif partners[name] & placed:
            reasons[name] = f"too little in common with {min(partners[name] & placed)}"
        else:
            reasons[name] = f"something in common with {min(partners[name])} alone, which has no place either"
    return reasons


def _names_in(model: Any) -> set[str]:
    return {image.name for image in model.images.values() if image.has_pose}


def _placed(
    pictures: Sequence[Path],
    sensors: Sequence[Sensor],
    features: Sequence[Features],
    pairs: Sequence[Pair],
    progress: Progress,
) -> list[Any]:
    """The `pycolmap.Reconstruction`s of the pictures, the largest first; if that is folded, others."""
    names = [path.name for path in pictures]

    def place(some: Sequence[Pair], stage: str) -> list[Any]:
        with tempfile.TemporaryDirectory(prefix="vfr-poses-", ignore_cleanup_errors=True) as name:
            database = Path(name) / "database.db"
            write_database(database, names, sensors, features, some)
            return map_pictures(
                database, pictures[0].parent, Path(name), len(names), lambda *n: progress(stage, *n)
            )

    def n_torn(models: list[Any]) -> int:
        return len(torn_neighbours(models[0], names, pairs))

    def enough(models: list[Any]) -> bool:
        return bool(models) and models[0].num_reg_images() >= _n_needed(len(names))

    models = place(pairs, "cameras")
    if not models or not n_torn(models):
        return models
    walk = place(near_pairs(pairs), "walk")
    if not enough(walk) or n_torn(walk) >= n_torn(models):
        return models  # no walk
    agreeing = agreeing_pairs(walk[0], names, features, pairs, lambda *n: progress("turns", *n))
    closed = place(agreeing, "cameras again")
    return closed if enough(closed) and n_torn(closed) <= n_torn(walk) else walk


def list_pictures(folder: Path) -> list[Path]:
    """The pictures in `images/`, or else in the folder itself, in the order of their names."""
    for place in (folder / "images", folder):
        if place.is_dir():
            # Names that begin with a dot are what systems leave behind (`._a.jpg` is no picture).
            found = [
                path
                for path in place.iterdir()
                if path.suffix.lower() in SUFFIXES and path.name[0] != "." and path.is_file()
            ]
            if found:
                return sorted(found)
    return []


def _other_kinds(folder: Path) -> str:
    kinds = {
        path.suffix.lower()
        for place in (folder, folder / "images")
        if place.is_dir()
        for path in place.iterdir()
        if path.suffix.lower()
        in (".heic", ".heif", ".avif", ".webp", ".tif", ".tiff", ".dng", ".bmp", ".gif")
    }
    return f"; there are {', '.join(sorted(kinds))} files: save them as JPEG" if kinds else ""


def _look_at(
    pictures: Sequence[Path],
    photos: Path,
    kept: KeptMatches,
    stamps: Sequence[bytes],
    progress: threads.Progress,
) -> tuple[list[Sensor], list[Features]]:
    """Sensor and features of every picture; raises DataError where they cannot be enough."""

    def look(number: int) -> tuple[Sensor, Look]:
        path = pictures[number]
        found = kept.look(stamps[number])
        if found is None:
            rgba = read_picture(path)
            grey = Image.fromarray(rgba).convert("L").resize((SIDE, SIDE), Image.Resampling.BOX)
            found = Look(rgba.shape[1], rgba.shape[0], find_features(rgba), np.asarray(grey))
            kept.keep_look(stamps[number], found)
        return _sensor(path, found.width, found.height), found

    looked = threads.in_threads(look, range(len(pictures)), progress)
    sensors, looks = (list(column) for column in zip(*looked, strict=True))
    features = [found.features for found in looks]
    thumbnails = [found.thumbnail.astype(np.float64) for found in looks]
    n_good = sum(len(found.points) >= MIN_FEATURES for found in features)
    if n_good < _n_needed(len(pictures)):
        raise DataError(
            f"{photos}: pictures with something to recognise (at least {MIN_FEATURES} features): expected at "
            f"least {_n_needed(len(pictures))} of {len(pictures)}, got {n_good}: the rest are blank, out of "
            f"focus or blurred: {ADVICE}"
        )
    if all(np.abs(thumbnail - thumbnails[0]).mean() < SAME for thumbnail in thumbnails):
        raise DataError(
            f"{photos}: expected pictures from different places, got {len(pictures)} times the same: {ADVICE}"
        )
    return sensors, features


def _sensor(path: Path, width: int, height: int) -> Sensor:
    try:
        with open_picture(path) as file:
            exif = file.getexif()
            details = exif.get_ifd(0x8769)
    except FormatError:  # damaged EXIF is as good as none
        return Sensor(width, height, (), None)
    # Maker, model; focal length, and the same as it would be on 35 mm film.
    device = tuple(str(tags.get(tag, "")) for tags, tag in ((exif, 271), (exif, 272), (details, 0x920A)))
    film = _positive(details.get(0xA405))
    # The standard (CIPA DC-008, 4.6.5) compares by diagonals; that of film is 43.27 mm.
    focal = film / 43.27 * float(np.hypot(width, height)) if film else None
    return Sensor(width, height, device, focal)


def _positive(value: object) -> float | None:
    try:
        number = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return number if 0 < number < 1e4 else None


def _n_needed(n_pictures: int) -> int:
    return max(int(np.ceil(MIN_SHARE * n_pictures)), min(MIN_REGISTERED, n_pictures))


def _read_report(model: Path, folder: Path, n_pictures: int) -> PoseReport:
    """What the files of a COLMAP model say of themselves (its scene/reconstruction_io.cc has the format)."""
    for name in MODEL_FILES:
        if not (model / name).is_file():
            raise FormatError(
                f"{model}: {name}: expected a complete COLMAP model, got no such file: "
                f"remove {model} to estimate the cameras anew"
            )
    points = read_bytes(model / "points3D.bin", "a COLMAP model", MAX_FILE_BYTES)
    n_registered = n_points = n_seen = 0
    error_sum = 0.0
    try:
        (n_registered,) = struct.unpack_from(
            "<Q", read_bytes(model / "images.bin", "a COLMAP model", MAX_FILE_BYTES)
        )
        (n_points,) = struct.unpack_from("<Q", points)
        at = 8
        for _ in range(n_points):
            error, length = struct.unpack_from("<dQ", points, at + 35)
            at += 51 + 8 * length
            n_seen += length
            error_sum += error
    except struct.error:
        at = -1
    if at != len(points):
        raise FormatError(f"{model}: cut short: remove {model} to estimate the cameras anew")
    return PoseReport(
        folder, n_pictures, n_registered, error_sum / max(n_points, 1), n_seen / max(n_points, 1)
    )
