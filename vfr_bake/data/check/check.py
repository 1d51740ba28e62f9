"""Judge a set of pictures in seconds: what there is, what is likely to come out, and what to photograph."""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from player.cameras.camera import Camera
from player.cameras.colmap import colmap_folder
from player.errors import ConfigError, DataError
from player.progress import Progress
from vfr_bake.data.check.looks import (
    MIN_SHARED,
    PictureMeasures,
    Shared,
    compare,
    look_at,
    repeated_ones,
)
from vfr_bake.data.check.turning import share_turned
from vfr_bake.data.check.verdict import GOOD_SHARED, judged
from vfr_bake.data.files.archives import is_archive, unpack
from vfr_bake.data.files.estimate_record import read_record
from vfr_bake.data.files.listing import find_pictures, other_kinds
from vfr_bake.data.files.masks import mask_of
from vfr_bake.data.files.pictures import picture_size
from vfr_bake.data.files.video import extract_frames
from vfr_bake.data.folders import has_transforms, load_folder
from vfr_bake.data.poses import added_since, connected, is_video, places
from vfr_bake.data.quality.sharpness import blurred
from vfr_bake.data.store.reading import DescribingReader
from vfr_bake.data.store.working import WorkingSize

PLAIN_FEATURES = 30
"""A picture with fewer features, at the size of the check, shows nothing that could be recognised."""


@dataclass(frozen=True)
class CheckedPicture:
    """One picture of a set, and what the check found out about it."""

    name: str
    size: tuple[int, int] | None
    """Width and height in pixels, upright; None if the picture cannot be read."""
    used: tuple[int, int] | None
    """Width and height at the working size."""
    look: PictureMeasures | None
    """What was seen of the picture; None if there was no time to look at it, or if it cannot be read."""
    partners: int | None
    """Number of the pictures that share features with this one, of those that it was compared with; None if
    it was compared with none."""
    found: bool | None
    """Whether its camera is known; None where cameras have not been looked for yet."""
    why: str | None
    """The fault of the picture, or the reason why it has no camera; None if there is neither."""


@dataclass(frozen=True)
class Check:
    """The result of checking a set of pictures."""

    data: str
    kind: str
    """Source of the cameras: "transforms.json", "COLMAP", or "none yet"."""
    pictures: list[CheckedPicture]
    cameras: list[Camera]
    figures: dict[str, Any]
    verdict: str
    """GOOD, DOUBTFUL or BAD."""
    likely: list[str]
    """Sentences on what is likely to come out."""
    advice: list[str]
    """Sentences on what to photograph; empty if there is nothing to add."""
    seconds: float = 0.0

    def lines(self) -> list[str]:
        """Return the check in a few lines for people."""
        return [*_summary(self.figures), f"{self.verdict}: {' '.join(self.likely)}", *self.advice]

    def document(self) -> dict[str, Any]:
        """Return the check as data, for JSON."""
        return {
            "data": self.data,
            "cameras": self.kind,
            **self.figures,
            "verdict": self.verdict,
            "likely": self.likely,
            "advice": self.advice,
            "seconds": round(self.seconds, 2),
            "images": [_image(picture) for picture in self.pictures],
        }


@dataclass
class _Set:
    """The pictures of a data set, and the cameras that are known."""

    kind: str
    names: list[str]
    paths: list[Path]
    masks: list[Path | None]
    found: list[bool | None]
    cameras: list[Camera] = field(default_factory=list)
    why: dict[str, str] = field(default_factory=dict)
    """The reasons why pictures have no camera, by their names, as far as the estimation recorded them."""


def check_data(
    data: str,
    size: WorkingSize,
    seconds: float = 8.0,
    progress: Progress | None = None,
    most: int | None = None,
) -> Check:
    """Check the pictures that `data` names.

    Args:
        data: a folder of pictures with or without cameras, or a video, as for `load_scene`.
        size: the working size.
        seconds: about how long to look; if the time is over before all pictures are seen, those seen are a
            sample.
        progress: called with the number of pictures seen and to see, and before that, of the files of a ZIP
            that are unpacked, or the frames of a video that are read.
        most: number of pictures to look at, at most.

    Raises DataError, FormatError: there is no such folder, or no picture in it. ConfigError: the built-in
    scene has no pictures. MissingExtraError: a package that reads pictures is missing.
    """
    begin = time.monotonic()
    pictures = _listed(data, progress or (lambda done, of: None))
    looks = look_at(list(zip(pictures.paths, pictures.masks, strict=True)), 0.8 * seconds, progress, most)
    seen = [look if isinstance(look, PictureMeasures) else None for look in looks]
    shared = compare(seen, 0.2 * seconds)
    repeated = repeated_ones(seen)
    blurry = _blurred(seen)
    partners = _partners(len(seen), shared)
    checked: list[CheckedPicture] = []
    wrong_masks: list[str] = []
    for number, (name, look) in enumerate(zip(pictures.names, looks, strict=True)):
        why = look if isinstance(look, str) else _fault(seen[number], number in blurry, partners[number])
        if pictures.found[number] is False and why is None:
            why = pictures.why.get(name, "the estimation of cameras found no place for it")
        if isinstance(look, PictureMeasures):
            full = look.size
        elif isinstance(look, str) and not look.startswith(f"{pictures.masks[number]}: "):
            full = None  # the pixels cannot be read, although the header may be whole
        else:
            full = _size(pictures.paths[number])
            if isinstance(look, str) and pictures.found[number] is not False:
                wrong_masks.append(look)
        checked.append(
            CheckedPicture(
                name,
                full,
                size.size(*full) if full else None,
                seen[number],
                partners[number],
                pictures.found[number],
                why,
            )
        )
    figures = _figures(checked, shared, repeated)
    unreadable = [picture.name for picture in checked if picture.size is None and picture.found is not False]
    verdict, likely, advice = judged(
        figures, pictures.cameras, unreadable, wrong_masks, _places(pictures.names, shared)
    )
    return Check(
        *(data, pictures.kind, checked, pictures.cameras, figures, verdict, likely, advice),
        time.monotonic() - begin,
    )


def _listed(data: str, progress: Progress) -> _Set:
    folder = Path(data)
    if data == "demo":
        raise ConfigError("demo: expected a folder of pictures or a video to check, got the built-in scene")
    if is_archive(folder):
        folder = unpack(folder, progress)
    if is_video(folder):
        folder = extract_frames(folder, progress)
    model = colmap_folder(folder) if folder.is_dir() else None
    if folder.is_dir() and (has_transforms(folder) or model is not None):
        reader = DescribingReader()
        load_folder(folder, None, reader)
        paths = [view.path for view in reader.described]
        masks = [view.mask for view in reader.described]
        cameras = [view.camera for view in reader.described]
        names = [camera.name for camera in cameras]
        kind = "transforms.json" if has_transforms(folder) else "COLMAP"
        found: list[bool | None] = [True] * len(paths)
        why: dict[str, str] = {}
        if kind == "COLMAP":
            assert model is not None
            place, there = find_pictures(folder)
            known = set(paths)
            others = [path for path in there if path not in known]
            new_names = [path.relative_to(place).as_posix() for path in others]
            names, paths = names + new_names, paths + others
            masks += [mask_of(folder, name) for name in new_names]
            found += [False] * len(others)
            why = read_record(model).why_without_camera()
            new = f"added after the cameras were estimated: remove {folder / 'sparse'} to use it"
            why |= dict.fromkeys(added_since(folder), new)
        return _Set(kind, names, paths, masks, found, cameras, why)
    place, paths = find_pictures(folder)
    if not paths:
        raise DataError(f"{folder}: expected a folder of pictures or a video, got none{other_kinds(folder)}")
    names = [path.relative_to(place).as_posix() for path in paths]
    return _Set("none yet", names, paths, [mask_of(folder, name) for name in names], [None] * len(paths))


def _size(path: Path) -> tuple[int, int] | None:
    try:
        return picture_size(path, upright=True)
    except DataError:
        return None


def _blurred(looks: Sequence[PictureMeasures | None]) -> set[int]:
    """Return the numbers of the pictures that training would leave out as blurred, of those that were looked
    at."""
    there = [i for i, look in enumerate(looks) if look is not None]
    return {there[n] for n in blurred([look.blur for look in looks if look is not None])}


def _partners(n: int, shared: dict[tuple[int, int], Shared]) -> list[int | None]:
    compared, partners = np.zeros(n, int), np.zeros(n, int)
    for pair, number in shared.items():
        compared[list(pair)] += 1
        partners[list(pair)] += number.n_features >= MIN_SHARED
    return [int(p) if c else None for p, c in zip(partners, compared, strict=True)]


def _fault(look: PictureMeasures | None, blurry: bool, partners: int | None) -> str | None:
    if look is None:
        return None
    if blurry:
        return "blurred"
    if len(look.descriptors) < PLAIN_FEATURES:
        return "nothing to recognise: plain, dark or out of focus"
    return "nothing in common with the pictures around it" if partners == 0 else None


def _figures(
    pictures: Sequence[CheckedPicture], shared: dict[tuple[int, int], Shared], repeated: set[int]
) -> dict[str, Any]:
    looks = [picture.look for picture in pictures if picture.look is not None]
    next_ones = [both.n_features for (i, j), both in shared.items() if j == i + 1]
    changes = [abs(both.change) for both in shared.values() if both.n_features >= GOOD_SHARED]
    group = _largest_group(shared, repeated)
    turned = share_turned([both.points for both in shared.values() if both.points is not None])
    faults = Counter(picture.why for picture in pictures if picture.why)
    return {
        "n_pictures": len(pictures),
        "n_looked_at": len(looks),
        "n_found": sum(picture.found is True for picture in pictures),
        "n_repeated": len(repeated),
        "n_unreadable": sum(picture.size is None for picture in pictures),
        "sizes": _counted(picture.size for picture in pictures),
        "sizes_used": _counted(picture.used for picture in pictures),
        "sharpness": _rounded(np.median([look.sharpness for look in looks]) if looks else 0.0),
        "n_blurred": faults["blurred"],
        "n_plain": sum(n for why, n in faults.items() if str(why).startswith("nothing to recognise")),
        "exposure_spread": _rounded(np.quantile(changes, 0.95) if changes else 0.0),
        "shared_features": _rounded(np.median(next_ones) if next_ones else 0.0),
        "share_in_one_group": _rounded(group),
        "share_turned_on_the_spot": None if turned is None else _rounded(turned),
    }


def _connections(shared: dict[tuple[int, int], Shared]) -> list[tuple[int, int]]:
    return [pair for pair, both in shared.items() if both.n_features >= MIN_SHARED]


def _largest_group(shared: dict[tuple[int, int], Shared], repeated: set[int]) -> float:
    """Return the share of the compared pictures that are in the largest group that is connected by shared
    features. Those that are `repeated` do not count."""
    numbers = {number for pair in shared for number in pair}
    groups = connected(numbers, _connections(shared))
    n_counted = len(numbers - repeated)
    return max(len(group - repeated) for group in groups) / n_counted if n_counted else 0.0


def _places(names: Sequence[str], shared: dict[tuple[int, int], Shared]) -> str:
    """Return a clause on the groups that the pictures fall into if they have nothing in common; empty for one
    group, or unless each picture was compared with each other."""
    return places(names, _connections(shared)) if len(shared) == math.comb(len(names), 2) else ""


def _summary(figures: dict[str, Any]) -> list[str]:
    sizes = " and ".join(list(figures["sizes"])[:3])
    used = " and ".join(list(figures["sizes_used"])[:3])
    working = "" if sizes == used else f", used at {used}"
    looked = "" if figures["n_looked_at"] == figures["n_pictures"] else (
        f"; {figures['n_looked_at']} of them were looked at")  # fmt: skip
    return [
        f"{figures['n_pictures']} pictures of {sizes}{working}{looked}",
        f"sharpness {figures['sharpness']:.0f}, {figures['n_blurred']} blurred; brightness alike to "
        f"{2 ** figures['exposure_spread']:.1f} times; neighbours share {figures['shared_features']:.0f} "
        f"features, {figures['share_in_one_group']:.0%} hang together",
    ]


def _image(picture: CheckedPicture) -> dict[str, Any]:
    width, height = picture.used or (None, None)
    look = picture.look
    return {
        "name": picture.name,
        "width": width,
        "height": height,
        "full_size": list(picture.size) if picture.size else None,
        "sharpness": None if look is None else _rounded(look.sharpness),
        "blur": None if look is None else _rounded(look.blur),
        "exposure": None if look is None else _rounded(look.exposure),
        "n_features": None if look is None else len(look.descriptors),
        "n_partners": picture.partners,
        "found": picture.found,
        "why": picture.why,
    }


def _counted(sizes: Any) -> dict[str, int]:
    return dict(Counter(f"{size[0]}x{size[1]}" for size in sizes if size).most_common())


def _rounded(value: Any) -> float:
    number = float(value)
    return round(number, 3) if math.isfinite(number) else 0.0
