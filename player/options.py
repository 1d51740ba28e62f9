"""The command line of `vfr-play`: its options, and what each of them must be."""

from __future__ import annotations

import argparse
from pathlib import Path

COLOURS = {"white": (1.0, 1.0, 1.0), "black": (0.0, 0.0, 0.0)}
PICTURES = (".png", ".webp")
VIDEO = ".mp4"

MAX_MEMORY = "gigabytes of memory that an asset may take when it is opened (half of the machine's)"

MOST_VIEWS = 100_000
"""Pictures of an orbit: an hour of a video at 30 frames a second has 108,000."""

EXAMPLES = """examples:
  vfr-play out/                                                        look at it in a browser
  vfr-play fidelity/ balanced/ fast/                                   and switch between bakes of a scene
  vfr-play out/ --info
  vfr-play out/ --check
  vfr-play out/ --view 3 --output view.png
  vfr-play out/ --orbit 60 --output frames/ --size 800x800 --background black
  vfr-play out/ --orbit 120 --output turn.mp4 --fps 30
  vfr-play out/ --cameras transforms_test.json --output frames/ --frames 10:20
  vfr-play out/ --cameras camera_path.json --output turn.mp4 --resume

exit codes: 0 done, 1 an error in one line, 2 wrong usage, 130 interrupted
"""


def parse(argv: list[str] | None) -> argparse.Namespace:
    """The options; leaves by SystemExit as argparse does."""
    parser = argparse.ArgumentParser(
        prog="vfr-play",
        description="Look at a baked asset in a browser, or render it to files, on the CPU.",
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("asset", type=Path, help="folder of the asset")
    add("others", type=Path, nargs="*", metavar="asset", help="more of them, to switch to in the viewer")
    views = parser.add_argument_group("views").add_mutually_exclusive_group()
    views.add_argument(
        "--cameras",
        type=Path,
        metavar="FILE",
        help="those of a transforms.json, a nerfstudio camera_path.json or a COLMAP folder",
    )
    views.add_argument("--orbit", type=_orbit, metavar="N", help="a turn around the scene in N pictures")
    views.add_argument(
        "--view", type=_number, metavar="N", help="training view N, from 0; -1 is the last one"
    )
    views.add_argument("--info", action="store_true", help="no view: say what is in the asset")
    views.add_argument("--check", action="store_true", help="no view: compare every file with its checksum")
    _add_files(parser.add_argument_group("files"))
    add = parser.add_argument_group("pictures").add_argument
    add("--size", type=size, metavar="WxH", help="their size (the camera file's, else as trained)")
    add(
        "--background",
        type=_background,
        metavar="COLOUR",
        help="white, black, transparent or R,G,B in 0..255",
    )
    add("--samples", type=_count, metavar="K", help="fetches a ray (the asset's own); 0: at every sample")
    add("--threads", type=positive, metavar="N", help="threads (one for each core)")
    add("--march", choices=("auto", "numpy", "numba"), default="auto", help="implementation (numba if there)")
    add("--max-memory", type=gigabytes, metavar="GB", help=MAX_MEMORY)
    add = parser.add_argument_group("viewer").add_argument
    add("--host", metavar="ADDRESS", help="address to serve at (127.0.0.1: this machine alone)")
    add("--port", type=_port, metavar="N", help="port to serve at (8080, or the next that is free)")
    arguments = parser.parse_args(argv)
    _check_together(parser, arguments)
    return arguments


def _add_files(group: argparse._ArgumentGroup) -> None:
    add = group.add_argument
    add("--output", type=Path, metavar="PATH", help="folder, or one picture (.png, .webp), or a video (.mp4)")
    add("--format", choices=("png", "webp"), help="of the pictures in a folder (png)")
    add(
        "--frames", type=_slice, default=slice(None), metavar="A:B", help="a slice of the views, as in Python"
    )
    add("--fps", type=_fps, metavar="N", help="frames a second of a video (the camera path's, else 30)")
    add("--resume", action="store_true", help="go on where an interrupted run with these options stopped")
    add("--force", action="store_true", help="replace what is there")
    add("--json", metavar="FILE", help="write figures as JSON; - is standard output")
    add("--dask", metavar="ADDRESS", help="render on the Dask cluster whose scheduler is at tcp://HOST:PORT")


def _check_together(parser: argparse.ArgumentParser, a: argparse.Namespace) -> None:
    if a.others and (a.info or a.check or a.output is not None):
        parser.error(f"{a.others[0]}: one asset at a time, but in the viewer")
    if a.info or a.check:
        return
    output: Path | None = a.output
    has_views = a.cameras is not None or a.orbit is not None or a.view is not None
    if has_views and output is None:
        parser.error("--output: add where the pictures go: --output DIR, FILE.png, FILE.webp or FILE.mp4")
    if output is not None and not has_views:
        parser.error("--output: add the views: --cameras FILE, --orbit N or --view N")
    files = {"--size": a.size, "--format": a.format, "--fps": a.fps, "--resume": a.resume, "--json": a.json,
             "--force": a.force, "--dask": a.dask}  # fmt: skip
    if output is None:
        lost = [name for name, value in files.items() if value]
        if lost:
            parser.error(f"{lost[0]}: add the views and --output: the viewer has no use for it")
        return
    if a.host is not None or a.port is not None:
        parser.error("--host, --port: they are of the viewer, which opens without views and --output")
    if a.resume and a.force:
        parser.error("--resume: not allowed with --force, which renders everything anew")
    suffix = output.suffix.lower()
    if a.format is not None and suffix in (*PICTURES, VIDEO):
        parser.error(f"--format: {output.name} says which format it is")
    if a.fps is not None and suffix != VIDEO:
        parser.error(f"--fps: expected a video, got --output {output}")
    if a.background == "transparent" and suffix == VIDEO:
        parser.error("--background: a video has no transparency")


def _whole(text: str, least: int, what: str) -> int:
    try:
        value = int(text)
    except ValueError:
        value = least - 1
    if value < least:
        raise argparse.ArgumentTypeError(f"expected {what}, got {text!r}")
    return value


def positive(text: str) -> int:
    return _whole(text, 1, "a whole number from 1 on")


def _orbit(text: str) -> int:
    value = positive(text)
    if value > MOST_VIEWS:
        raise argparse.ArgumentTypeError(f"expected at most {MOST_VIEWS} pictures, got {text!r}")
    return value


def gigabytes(text: str) -> float:
    """An amount of memory.

    >>> gigabytes("1.5")
    1.5
    """
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0 < value < 1e9:
        raise argparse.ArgumentTypeError(f"expected gigabytes, more than 0, got {text!r}")
    return value


def _count(text: str) -> int:
    return _whole(text, 0, "a whole number from 0 on")


def _number(text: str) -> int:
    return _whole(text, -(1 << 31), "a whole number")


def _port(text: str) -> int:
    value = _whole(text, 1, "a port, 1 to 65535")
    if value > 65535:
        raise argparse.ArgumentTypeError(f"expected a port, 1 to 65535, got {text!r}")
    return value


def _fps(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0 < value <= 1000:
        raise argparse.ArgumentTypeError(f"expected 0 to 1000 frames a second, got {text!r}")
    return value


def size(text: str) -> tuple[int, int]:
    """Width and height.

    >>> size("800x600")
    (800, 600)
    """
    try:
        width, height = (int(part) for part in text.lower().split("x"))
    except ValueError:
        width = height = 0
    if width < 1 or height < 1:
        raise argparse.ArgumentTypeError(f"expected WIDTHxHEIGHT, from 1x1 on, got {text!r}")
    return width, height


def _background(text: str) -> str | tuple[float, float, float]:
    """A colour 0..1 or "transparent".

    >>> _background("255,0,51"), _background("white")
    ((1.0, 0.0, 0.2), (1.0, 1.0, 1.0))
    """
    if text == "transparent":
        return text
    if text in COLOURS:
        return COLOURS[text]
    try:
        red, green, blue = (int(part) for part in text.split(","))
    except ValueError:
        red = green = blue = -1
    if not all(0 <= value <= 255 for value in (red, green, blue)):
        raise argparse.ArgumentTypeError(
            f"expected white, black, transparent or R,G,B in 0..255, got {text!r}"
        )
    return red / 255, green / 255, blue / 255


def _slice(text: str) -> slice:
    """A slice as Python writes it; one number is one view.

    >>> _slice("0:40"), _slice("::2"), _slice("3")
    (slice(0, 40, None), slice(None, None, 2), slice(3, 4, None))
    """
    try:
        parts = [int(part) if part.strip() else None for part in text.split(":")]
    except ValueError:
        parts = []
    if len(parts) == 1 and parts[0] is not None:
        return slice(parts[0], parts[0] + 1 or None)
    if not 2 <= len(parts) <= 3 or (len(parts) == 3 and parts[2] == 0):
        raise argparse.ArgumentTypeError(f"expected START:STOP or START:STOP:STEP, got {text!r}")
    return slice(*parts)
