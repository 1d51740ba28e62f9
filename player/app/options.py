"""The options of `vfr-play`: the settings of `play`, the command line, and the rules for which options go
together."""

from __future__ import annotations

import argparse
import math
import sys
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeVar, get_args

from player.app.option_types import (
    asset_folder,
    background,
    gigabytes,
    joined_negatives,
    number,
    part,
    positive,
    size,
    whole,
)
from player.errors import ConfigError
from player.files.json_files import brief

PICTURES = (".png", ".webp")
VIDEO = ".mp4"
NOT_WRITTEN = (
    *(".jpg", ".jpeg", ".gif", ".apng", ".avif", ".heic", ".bmp", ".tif", ".tiff", ".exr"),
    *(".mov", ".m4v", ".webm", ".mkv", ".avi"),
)
"""Suffixes of other pictures and videos: whoever writes one does not mean a folder."""

if TYPE_CHECKING:  # the command line answers `--help` without numpy
    from player.render import Background, March, Quality

Settings = TypeVar("Settings")

MOST_VIEWS = 100_000
"""Most pictures of an orbit: an hour of video at 30 frames per second has 108,000."""

QUALITY = (
    "exact renders every pixel (files); high interpolates pixels between neighbours that agree, or looks up "
    "less, and loses 0.05 dB on average, fast 0.3 dB, a single picture up to three times that (the viewer: "
    "fast while moving, exact when still)"
)

EXAMPLES = """examples:
  vfr-play demo                                                        the built-in scene, already baked
  vfr-play out/                                                        look at it in a browser
  vfr-play fidelity/ balanced/ fast/                                   and switch between bakes of a scene
  vfr-play out/ --info
  vfr-play out/ --check
  vfr-play out/ --view 3 --output view.png
  vfr-play out/ --orbit 60 --output frames/ --size 800x800 --background black
  vfr-play out/ --orbit 120 --output turn.mp4 --fps 30
  vfr-play out/ --orbit 120 --output draft.mp4 --quality fast
  vfr-play out/ --cameras transforms_test.json --output frames/ --frames 10:20
  vfr-play out/ --cameras camera_path.json --output turn.mp4 --resume

exit codes: 0 done, 1 an error in one line, 2 wrong usage, 130 interrupted, 141 unread output
"""


@dataclass(frozen=True)
class PlaySettings:
    """Settings of `player.play`: what it renders, besides the asset and the cameras, and where it writes
    pictures.

    Raises ConfigError for settings that are out of range or contradict each other.

    >>> PlaySettings(Path("turn.mp4"), background="transparent")
    Traceback (most recent call last):
    player.errors.ConfigError: --background: a video has no transparency
    """

    output: str | Path
    """A folder of pictures, one picture (.png, .webp), or a video (.mp4)."""
    format: Literal["png", "webp"] | None = None
    """Format of the pictures in a folder; PNG if None."""
    frames: slice | None = None
    """Which of the cameras are rendered; all of them if None. Pictures are named as if all were."""
    fps: float = 30.0
    """Frames a second of a video."""
    resume: bool = False
    """Leave out frames that are there already, if they show the same."""
    force: bool = False
    """Replace what is there."""
    dask: str | None = None
    """Address of the scheduler of a Dask cluster that renders, tcp://HOST:PORT; this machine if None."""
    samples: int | None = None
    """Feature fetches a ray; the asset's own number if None, every sample if 0."""
    quality: Quality = "exact"
    """"exact" marches and shades every pixel; "high" and "fast" interpolate pixels whose neighbours agree."""
    background: Background | None = None
    """Colour, 3 numbers 0..1, or "transparent"; the asset's own if None."""
    threads: int | None = None
    """Threads that render; one for each core if None."""
    march: March = "auto"
    """Implementation: "numba", "numpy", or numba where it is there ("auto")."""
    max_memory: float | None = None
    """Gigabytes that the asset may take on a worker of a cluster; half of its machine's if None."""

    def __post_init__(self) -> None:
        from player.files.memory import allowed_bytes
        from player.render import March, Quality, check_choice, checked_background, checked_samples
        from player.threads import bounded_threads

        object.__setattr__(self, "fps", _frame_rate(self.fps))
        if self.samples is not None:
            object.__setattr__(self, "samples", checked_samples(self.samples))
        if self.background is not None:
            object.__setattr__(self, "background", checked_background(self.background))
        check_choice("quality", self.quality, get_args(Quality))
        check_choice("march", self.march, get_args(March))
        if self.format is not None:
            check_choice("format", self.format, ("png", "webp"))
        if self.frames is not None:
            _check_slice(self.frames)
        for name in ("resume", "force"):
            if not isinstance(value := getattr(self, name), bool):
                raise ConfigError(f"{name}: expected True or False, got {brief(value)}")
        if self.threads is not None:
            bounded_threads(self.threads)
        if self.max_memory is not None:
            allowed_bytes(self.max_memory)
        output = Path(self.output)
        suffix = output.suffix.lower()
        if self.resume and self.force:
            raise ConfigError("--resume: not allowed with --force, which renders everything anew")
        if suffix in NOT_WRITTEN:
            raise ConfigError(
                f"--output: expected a folder, a picture ({', '.join(PICTURES)}) or a video ({VIDEO}), "
                f"got {output.name}"
            )
        if self.format is not None and suffix in (*PICTURES, VIDEO):
            raise ConfigError(f"--format: {output.name} says which format it is")
        if self.background == "transparent" and suffix == VIDEO:
            raise ConfigError("--background: a video has no transparency")


def _check_slice(frames: Any) -> None:
    try:
        slice.indices(frames, 0)
    except (TypeError, ValueError):
        raise ConfigError(
            f"frames: expected a slice of whole numbers, such as slice(10, 20), got {brief(frames)}"
        ) from None


def _frame_rate(value: Any) -> float:
    from player.cameras.nerfstudio import LEAST_FPS, MOST_FPS

    try:
        fps = float(value)
    except (TypeError, ValueError, OverflowError):
        fps = math.nan
    if not LEAST_FPS <= fps <= MOST_FPS:
        raise ConfigError(f"--fps: expected {LEAST_FPS} to {MOST_FPS} frames a second, got {brief(value)}")
    return fps


MODES = {
    "viewer": "the viewer, which opens without views and --output",
    "files": "pictures and videos, with --output and --cameras, --orbit or --view",
    "info": "--info",
    "check": "--check",
}
"""The modes of `vfr-play`, in words."""

_FILES = ("files",)
USED_BY = {
    "others": ("viewer",),
    **dict.fromkeys(("cameras", "orbit", "view"), _FILES),
    "info": ("info",),
    "check": ("check",),
    **dict.fromkeys(("output", "format", "frames", "fps", "resume", "force"), _FILES),
    "json": ("files", "info", "check"),
    **dict.fromkeys(("dask", "size"), _FILES),
    **dict.fromkeys(("background", "samples", "quality", "threads", "march"), ("viewer", "files")),
    "max_memory": tuple(MODES),
    **dict.fromkeys(("host", "port"), ("viewer",)),
}
"""The modes in which each option has an effect."""


def parse(argv: list[str] | None) -> argparse.Namespace:
    """Read the command line. Wrong usage raises SystemExit, as argparse does."""
    parser = make_parser()
    words = joined_negatives(sys.argv[1:] if argv is None else argv, "--frames")
    arguments = parser.parse_intermixed_args(words)  # assets may stand between options
    _check_together(parser, arguments)
    return arguments


def settings_of(kind: type[Settings], arguments: argparse.Namespace) -> Settings:
    """Make settings of a `kind`, a dataclass, from the options of the same names; fields that were not given
    keep their defaults.

    >>> settings_of(PlaySettings, make_parser().parse_args(["out/", "--output", "turn"])).samples is None
    True
    """
    names: Any = fields(kind)  # pyright: ignore[reportArgumentType]
    given = {field.name: getattr(arguments, field.name) for field in names}
    return kind(**{name: value for name, value in given.items() if value is not None})


def make_parser() -> argparse.ArgumentParser:
    """Make the parser of the command line; the value of an option that is not given is None, False or an
    empty list."""
    parser = argparse.ArgumentParser(
        prog="vfr-play",
        description="Look at a baked asset in a browser, or render it to files, on the CPU.",
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("asset", type=asset_folder, help="folder of the asset, or the word demo: the built-in scene")
    add(
        "others",
        type=asset_folder,
        nargs="*",
        default=[],  # without a default, argparse would call them required
        metavar="asset",
        help="more folders, whose assets the viewer can switch to",
    )
    views = parser.add_argument_group("views").add_mutually_exclusive_group()
    views.add_argument(
        "--cameras",
        type=Path,
        metavar="FILE",
        help="the views of a transforms.json, a nerfstudio camera_path.json or a COLMAP folder",
    )
    views.add_argument(
        "--orbit", type=whole(1, MOST_VIEWS, 60), metavar="N", help="a turn around the scene in N pictures"
    )
    views.add_argument(
        "--view",
        type=whole(example=3),
        metavar="N",
        help="one of the training views, from 0; -1 is the last one",
    )
    views.add_argument("--info", action="store_true", help="no view: say what is in the asset")
    views.add_argument("--check", action="store_true", help="no view: compare every file with its checksum")
    _add_files(parser.add_argument_group("files"))
    add = parser.add_argument_group("pictures").add_argument
    add("--size", type=size, metavar="WxH", help="size of the pictures (the camera file's, else as trained)")
    add(
        "--background",
        type=background,
        metavar="COLOUR",
        help="white, black, transparent or R,G,B in 0..255",
    )
    add(
        "--samples",
        type=whole(0),
        metavar="K",
        help="feature lookups a ray (the asset's own number); 0: one at every sample",
    )
    add("--quality", choices=("exact", "high", "fast"), help=QUALITY)
    add("--threads", type=positive, metavar="N", help="threads of the processor (one for each core)")
    add(
        "--march",
        choices=("auto", "numpy", "numba"),
        help="what rays are marched with (numba if it is installed)",
    )
    memory = "gigabytes of memory that an asset may take when it is opened (half of the machine's)"
    add("--max-memory", type=gigabytes, metavar="GB", help=memory)
    add = parser.add_argument_group("viewer").add_argument
    add("--host", metavar="ADDRESS", help="address to serve at (127.0.0.1: this machine alone)")
    add("--port", type=whole(1, 65535, 8080), metavar="N", help="port (8080, or the next that is free)")
    return parser


def _add_files(group: argparse._ArgumentGroup) -> None:
    add = group.add_argument
    add("--output", type=Path, metavar="PATH", help="folder, or one picture (.png, .webp), or a video (.mp4)")
    add("--format", choices=("png", "webp"), help="format of the pictures in a folder (png)")
    add("--frames", type=part, metavar="A:B", help="only these of the views, as a slice in Python")
    add(
        "--fps",
        type=number("frames a second", "30"),
        metavar="N",
        help="frames a second of a video (the camera path's, else 30)",
    )
    add("--resume", action="store_true", help="go on where an interrupted run with these options stopped")
    add("--force", action="store_true", help="replace files that exist")
    add("--json", metavar="FILE", help="also write times and counts as JSON; - is standard output")
    add("--dask", metavar="ADDRESS", help="render on the Dask cluster whose scheduler is at tcp://HOST:PORT")


def given(arguments: argparse.Namespace) -> list[str]:
    """Return the names of the options that are on the command line, in the order of USED_BY."""
    values = vars(arguments)
    return [name for name in USED_BY if values[name] not in (None, []) and values[name] is not False]


def _mode(arguments: argparse.Namespace) -> str:
    if arguments.info or arguments.check:
        return "info" if arguments.info else "check"
    views = (arguments.cameras, arguments.orbit, arguments.view, arguments.output)
    return "viewer" if all(value is None for value in views) else "files"


def _check_together(parser: argparse.ArgumentParser, a: argparse.Namespace) -> None:
    mode = _mode(a)
    lost = [name for name in given(a) if mode not in USED_BY[name]]
    if lost and lost[0] == "others":
        parser.error(f"{a.others[0]}: one asset at a time, but in the viewer")
    if lost:
        parser.error(
            f"--{lost[0]}: does nothing for {MODES[mode].split(',')[0]}; it is for "
            + ", or for ".join(MODES[used] for used in USED_BY[lost[0]])
        )
    if mode == "files":
        _check_files(parser, a)


def _check_files(parser: argparse.ArgumentParser, a: argparse.Namespace) -> None:
    if a.output is None:
        parser.error("--output: add where the pictures go: --output DIR, FILE.png, FILE.webp or FILE.mp4")
    if a.cameras is None and a.orbit is None and a.view is None:
        parser.error("--output: add the views: --cameras FILE, --orbit N or --view N")
    if a.fps is not None and a.output.suffix.lower() != VIDEO:
        parser.error(f"--fps: expected a video, got --output {a.output}")
    try:
        settings_of(PlaySettings, a)
    except ConfigError as error:
        parser.error(str(error))
