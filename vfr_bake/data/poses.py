"""Estimate the cameras of photographs or of a video, once, and keep them beside these as a COLMAP model,
`sparse/0`."""

from __future__ import annotations

import struct
import tempfile
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from player.cameras.colmap import FOLDERS, MAX_FILE_BYTES, colmap_folder, read_images
from player.cameras.rotations import OPENGL_FROM_OPENCV
from player.errors import DataError, FormatError, OutputError
from player.files.files import check_target, new_folder, read_bytes
from player.kept_code import user_folder
from player.progress import Report
from vfr_bake.data.features import Features, pairs_to_match
from vfr_bake.data.files import video
from vfr_bake.data.files.estimate_record import EstimateRecord, read_record, write_record
from vfr_bake.data.files.listing import find_pictures, other_kinds, passed_over, unread_cameras
from vfr_bake.data.files.masks import check_masks, mask_of, stray_masks
from vfr_bake.data.files.opening import SUFFIXES
from vfr_bake.data.kept_matches import KeptMatches, stamp
from vfr_bake.data.looks import Look, look_at
from vfr_bake.data.mapping import (
    FIRST_ATTEMPT,
    FURTHER_ATTEMPTS,
    Attempt,
    Pair,
    Sensor,
    map_pictures,
    match_pictures,
    pycolmap_module,
    refine_principal_points,
    write_database,
)
from vfr_bake.data.models.folds import agreeing_pairs, is_near, torn_neighbours
from vfr_bake.data.models.joining import joined
from vfr_bake.data.quality.repeats import repeats
from vfr_bake.data.world import find_up, turn_to_z

MODEL_FILES = ("cameras.bin", "images.bin", "points3D.bin")

MIN_PICTURES = 3
MIN_SHARE = 0.6
"""Share of the pictures that must be placed, that is, get a camera. If two in five are not placed, the
subject is seen from one side only, or is in two models of which one is lost: a field trained on the rest has
holes."""
MIN_REGISTERED = 8
"""Number of pictures that must be placed at least. Of fewer pictures all must be, because a handful can agree
on a wrong model."""
HANDFUL = 24
"""Up to this number of pictures, more attempts are made: whether so few are placed depends on which two of
them come first, and these are drawn by chance."""
MIN_FEATURES = 50
"""A picture with fewer features is blank, out of focus, or all blur."""

ADVICE = (
    "photograph with more overlap (a step of some 10 degrees from one picture to the next), move around the "
    "subject instead of turning on the spot, hold still while the shutter is open, leave zoom and focus as "
    "they are, and keep textured surroundings in the picture: a plain, shiny or transparent subject alone "
    "gives nothing to hold on to"
)


@dataclass(frozen=True)
class PoseReport:
    """A report on how well the cameras of a set of pictures are known."""

    folder: Path
    """The folder that holds `sparse/0` and the pictures: the given one, or a video's folder of frames."""
    n_pictures: int
    n_registered: int
    """Number of pictures that have got a camera."""
    mean_error: float
    """Reprojection error in pixels: the distance of a point's projections from where the pictures show it, as
    the mean over the points."""
    mean_track_length: float
    """Number of pictures that a point is seen in, on average."""
    record: EstimateRecord
    """What the estimate records of pictures that were left out or not placed."""

    def summary(self) -> str:
        """Return one sentence for the person who took the pictures.

        >>> PoseReport(Path("garden"), 50, 48, 0.61, 7.25, EstimateRecord(True)).summary()
        'garden: cameras of 48 of 50 pictures, off by 0.61 pixels, a point is seen in 7.2 pictures'
        """
        left_out = ""
        if repeated := self.record.repeated:
            n, (name, kept) = len(repeated), next(iter(repeated.items()))
            others = f"{name} and {n - 1} more show" if n > 1 else f"{name} shows"
            left_out = (
                f"; {others} what another picture ({kept}) does, and {'are' if n > 1 else 'is'} left out"
            )
        return (
            f"{self.folder}: cameras of {self.n_registered} of {self.n_pictures} pictures, "
            f"off by {self.mean_error:.2f} pixels, a point is seen in {self.mean_track_length:.1f} pictures"
            f"{left_out}{self._largest_taken()}"
        )

    def _largest_taken(self) -> str:
        if not (apart := self.record.apart):
            return ""
        groups = " and ".join(map(str, apart))
        return (
            f"; of {len(apart) + 1} groups of pictures that show too little in common the largest is "
            f"taken, the {'other has' if len(apart) == 1 else 'others have'} {groups}"
        )


def is_video(path: Path) -> bool:
    """Return whether `path` is a file with the suffix of a video.

    >>> is_video(Path("surely/not/there.mp4"))
    False
    """
    return path.suffix.lower() in video.SUFFIXES and path.is_file()


def estimate_cameras(
    photos: Path, progress: Report, say: Callable[[str], object] | None = None
) -> PoseReport:
    """Estimate the camera of every picture, and keep the result as `sparse/0` beside the pictures.

    `photos`: a folder with pictures in `images/` or in itself, or in folders within these, or a video, whose
    frames are first written to `<stem>_frames/images/` beside it. A `sparse/0` that exists is reported and
    left as it is; a new one appears when it is complete. `progress`: called with the name of a stage, the
    number of its items that are done, and the number of all. The stages are `frames` for a video, then
    `features`, `pairs`, `matches` and `cameras`; then `cameras, attempt 2` and so on if too few of a handful
    of pictures were placed; then `walk`, `turns` and `cameras again` if the model is folded. `say`: called
    with a sentence if the folder has cameras of a form that is not read, masks of no picture or pictures that
    are not used, if a video can be read in part only, and if the disk refuses to keep features and matches
    until the end.

    Pictures are turned upright as EXIF says. Those that show what another one shows are left out
    (`vfr_bake.data.quality.repeats`). Pictures of one size, and of one maker, model and focal length where
    EXIF tells, share one camera (model RADIAL), which begins with EXIF's focal length. In the model the z
    axis is up (`vfr_bake.data.world`); the unit is arbitrary, because pictures alone do not tell it. A
    subject that looks the same from two sides is folded if nothing but the subject is matched: the two sides
    become one, as if the camera had gone half way around. Pictures of one walk, named in its order, are
    unfolded (`vfr_bake.data.models.folds`). Pictures in no order are not; only their surroundings can prevent
    the fold. Models that share pictures are joined (`vfr_bake.data.models.joining`); of others the largest
    is taken.

    Raises DataError (no pictures that can be used, with advice on what to photograph differently; a COLMAP
    model as text), FormatError (a damaged `sparse/0`), OutputError (the folder is read-only, or the disk of
    temporary files is full), MissingExtraError.
    """
    if is_video(photos):
        photos = video.extract_frames(photos, lambda done, of: progress("frames", done, of), say)
    if not photos.is_dir():
        found = "a file of another kind" if photos.exists() else "nothing"
        raise DataError(f"{photos}: expected a folder of pictures or a video, got {found}")
    place, pictures = find_pictures(photos)
    _refuse_text(photos)
    model = photos / "sparse" / "0"
    if model.exists():
        return _read_report(model, photos, len(pictures))
    if len(pictures) < MIN_PICTURES:
        raise DataError(
            f"{photos}: pictures ({', '.join(SUFFIXES)}): expected at least {MIN_PICTURES}, "
            f"got {len(pictures)}{other_kinds(photos)}"
        )
    pycolmap_module()  # reports at once that it is missing, not after minutes
    try:
        check_target(model)
    except OutputError as error:
        raise OutputError(f"{error}: copy the pictures to a folder that you can write to") from error
    if say is not None and (unread := unread_cameras(photos)):
        say(f"cameras of the form of {unread} are not read: cameras are estimated from the pictures alone")
    if say is not None and (others := passed_over(photos)):
        say(others)
    names = [path.relative_to(place).as_posix() for path in pictures]
    masked = [(path, mask_of(photos, name)) for path, name in zip(pictures, names, strict=True)]
    n_bytes = {name: path.stat().st_size for path, name in zip(pictures, names, strict=True)}
    masks = [mask for _, mask in masked if mask is not None]
    if say is not None and (strays := stray_masks(photos, {*masks})):
        say(strays)
    known = KeptMatches.of(photos, cache_root(), say)
    looks = look_at(masked, known, lambda done, of: progress("features", done, of))
    repeated = _repeated(photos, looks, masks)
    kept = [number for number in range(len(names)) if number not in repeated]
    left_out = {names[number]: names[other] for number, other in repeated.items()}
    stamps = [stamp(*masked[number]) for number in kept]
    names, looks = [names[number] for number in kept], [looks[number] for number in kept]
    sensors, features = [look.sensor for look in looks], [look.features for look in looks]
    pairs = match_pictures(
        sensors,
        features,
        pairs_to_match(features, lambda done, of: progress("pairs", done, of)),
        lambda done, of: progress("matches", done, of),
        lambda i, j: known.matches(stamps[i], stamps[j], len(features[i].points), len(features[j].points)),
        lambda i, j, matches: known.keep_matches(stamps[i], stamps[j], matches),
    )
    models = _placed(place, names, sensors, features, pairs, progress)
    n_registered = models[0].num_reg_images() if models else 0
    if n_registered < _n_needed(len(names)):
        raise DataError(
            f"{photos}: cameras: expected to find those of at least {_n_needed(len(names))} of "
            f"{len(names)} pictures, got {n_registered}: "
            + (f"{apart}: " if (apart := places(names, [(pair.i, pair.j) for pair in pairs])) else "")
            + _advice(photos, masks, len(pictures))
        )
    _turn_upright(models[0])
    placed = _names_in(models[0])
    apart = tuple(n for other in models[1:] if (n := len(_names_in(other) - placed)) >= MIN_PICTURES)
    reasons = why_unplaced(names, features, pairs, models)
    if not model.exists():  # another process may have been faster
        with new_folder(model) as new:
            models[0].write_binary(str(new))
            write_record(new, EstimateRecord(True, left_out, reasons, apart, n_bytes))
    known.remove()
    return _read_report(model, photos, len(pictures))


def added_since(photos: Path) -> list[str]:
    """Return the names of the pictures in a folder that `estimate_cameras` has not seen, because they were
    added later; empty if the cameras were not estimated by it.

    >>> added_since(Path("surely/not/there"))
    []
    """
    model = photos / "sparse" / "0"
    if not (model / "images.bin").is_file() or not (record := read_record(model)).upright:
        return []
    seen = {image.name for image in read_images(model / "images.bin")} | {*record.repeated, *record.unplaced}
    place, pictures = find_pictures(photos)
    return [name for path in pictures if (name := path.relative_to(place).as_posix()) not in seen]


def _refuse_text(photos: Path) -> None:
    """Raise DataError if the folder has a COLMAP model as text alone."""
    if colmap_folder(photos) is not None:
        return
    for model in (photos / name for name in FOLDERS):
        if (model / "images.txt").exists():
            raise DataError(
                f"{model}: cameras: expected a COLMAP model in binary form, got one as text: convert it with "
                "colmap model_converter --output_type BIN, or remove it to have the cameras estimated"
            )


def cache_root() -> Path:
    """Return the user's folder of features and matches of pictures whose cameras are not known yet."""
    return user_folder() / "matches"


def why_unplaced(
    names: Sequence[str], features: Sequence[Features], pairs: Sequence[Pair], models: Sequence[Any]
) -> dict[str, str]:
    """Return the reasons why pictures are not in the first of the `models`, by the pictures' names."""
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


def _turn_upright(model: Any) -> None:
    """Turn a `pycolmap.Reconstruction` of upright pictures so that its z axis is up."""
    poses = [image.cam_from_world().inverse().matrix() for image in model.images.values() if image.has_pose]
    c2w = np.concatenate([np.array(poses), np.tile([[[0.0, 0, 0, 1]]], (len(poses), 1, 1))], axis=1)
    points = np.array([point.xyz for point in model.points3D.values()]).reshape(-1, 3)
    turn = turn_to_z(find_up(c2w @ OPENGL_FROM_OPENCV, points))
    model.transform(pycolmap_module().Sim3d(1.0, pycolmap_module().Rotation3d(turn), np.zeros(3)))


def _placed(
    place: Path,
    names: Sequence[str],
    sensors: Sequence[Sensor],
    features: Sequence[Features],
    pairs: Sequence[Pair],
    progress: Report,
) -> list[Any]:
    """Return the `pycolmap.Reconstruction`s of the pictures in the folder `place`, the largest first, after
    joining those into it that fit. If the largest is folded, models built from a walk are returned instead,
    if they tear fewer neighbours apart."""

    def built(some: Sequence[Pair], stage: str, attempt: Attempt = FIRST_ATTEMPT) -> list[Any]:
        with tempfile.TemporaryDirectory(prefix="vfr-poses-", ignore_cleanup_errors=True) as name:
            database = Path(name) / "database.db"
            try:
                write_database(database, names, sensors, features, some)
                found = map_pictures(
                    database, place, Path(name), len(names), lambda *n: progress(stage, *n), attempt
                )
                found = joined(found, database, place)
            except RuntimeError as error:
                if "database" not in str(error):
                    raise
                reason = str(error).rpartition("] ")[2].rstrip(".")  # behind the place in COLMAP's source
                raise OutputError(
                    f"{database}: cannot write: {reason}: make room for temporary files there, or set TMPDIR "
                    "to a folder on another disk"
                ) from error
        if found:
            refine_principal_points(found[0])
        return found

    def n_torn(models: list[Any]) -> int:
        return len(torn_neighbours(models[0], names, pairs))

    def enough(models: list[Any]) -> bool:
        return bool(models) and models[0].num_reg_images() >= _n_needed(len(names))

    models = built(pairs, "cameras")
    if pairs and len(names) <= HANDFUL:
        for number, attempt in enumerate(FURTHER_ATTEMPTS, start=2):
            if enough(models):
                break
            again = built(pairs, f"cameras, attempt {number}", attempt)
            models = max(models, again, key=lambda found: found[0].num_reg_images() if found else 0)
    if not models or not n_torn(models):
        return models
    walk = built([pair for pair in pairs if is_near(pair)], "walk")
    if not enough(walk) or n_torn(walk) >= n_torn(models):
        return models  # the pictures are not of one walk
    agreeing = agreeing_pairs(walk[0], names, features, pairs, lambda *n: progress("turns", *n))
    closed = built(agreeing, "cameras again")
    return closed if enough(closed) and n_torn(closed) <= n_torn(walk) else walk


def connected(numbers: Iterable[int], pairs: Iterable[tuple[int, int]]) -> list[set[int]]:
    """Return the groups into which `pairs` connect `numbers`.

    >>> connected(range(4), [(0, 2), (3, 2)])
    [{0, 2, 3}, {1}]
    """
    groups = {number: {number} for number in numbers}
    for i, j in pairs:
        if groups[i] is not groups[j]:
            groups[i] |= groups[j]
            groups |= dict.fromkeys(groups[j], groups[i])
    return list({id(group): group for group in groups.values()}.values())


def places(names: Sequence[str], pairs: Iterable[tuple[int, int]]) -> str:
    """Return a clause on the groups that the pictures fall into if the groups have nothing in common; empty
    for one group. `pairs`: the numbers of pictures that have something in common."""
    groups = connected(range(len(names)), pairs)
    large = [group for group in groups if len(group) >= MIN_PICTURES]
    large.sort(key=lambda group: (-len(group), min(group)))
    if len(large) < 2:
        return ""
    named = " and ".join(f"{len(group)} ({names[min(group)]} to {names[max(group)]})" for group in large[:3])
    return (
        f"they show {len(large)} places that have nothing in common, in {named} pictures: name a folder of "
        "one place, or add pictures that lead from one to the other"
    )


def _advice(photos: Path, masks: Sequence[Path], n_pictures: int) -> str:
    """Return advice for pictures whose cameras were not found. Raises DataError: nearly everything is masked,
    which is why."""
    if not masks:
        return ADVICE
    if len(masks) == n_pictures:
        check_masks(str(photos), masks)
    return (
        f"{len(masks)} of {n_pictures} pictures have masks: check that these are white where the picture "
        f"counts and black where it is ignored; otherwise {ADVICE}"
    )


def _repeated(photos: Path, looks: Sequence[Look], masks: Sequence[Path]) -> dict[int, int]:
    """Return the numbers of the pictures that are left out, each with the number of the picture that is kept
    instead. Raises DataError if too few pictures would be left, or too few show anything."""
    n_good = sum(len(look.features.points) >= MIN_FEATURES for look in looks)
    if n_good < _n_needed(len(looks)):
        raise DataError(
            f"{photos}: pictures with something to recognise (at least {MIN_FEATURES} features): expected at "
            f"least {_n_needed(len(looks))} of {len(looks)}, got {n_good}: the rest are blank, out of "
            f"focus or blurred: {_advice(photos, masks, len(looks))}"
        )
    repeated = repeats(
        [look.features for look in looks],
        [(look.sensor.width, look.sensor.height) for look in looks],
        np.stack([look.thumbnail for look in looks]),
        [look.sharpness for look in looks],
    )
    n_left = len(looks) - len(repeated)
    if n_left < MIN_PICTURES:
        raise DataError(
            f"{photos}: expected pictures from different places, got {len(looks)} times the same"
            + (f" but for {n_left - 1}" if n_left > 1 else "")
            + f": {_advice(photos, masks, len(looks))}"
        )
    return repeated


def _n_needed(n_pictures: int) -> int:
    return max(int(np.ceil(MIN_SHARE * n_pictures)), min(MIN_REGISTERED, n_pictures))


def _read_report(model: Path, folder: Path, n_pictures: int) -> PoseReport:
    """Read the report on a COLMAP model from the model's files (COLMAP's scene/reconstruction_io.cc has their
    format)."""
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
    except (struct.error, OverflowError):
        at = -1
    if at != len(points):
        raise FormatError(f"{model}: cut short: remove {model} to estimate the cameras anew")
    record = read_record(model)
    return PoseReport(
        folder,
        n_pictures - len(record.repeated),
        n_registered,
        error_sum / max(n_points, 1),
        n_seen / max(n_points, 1),
        record,
    )
