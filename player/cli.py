"""`vfr-play`: an asset to pictures, or to words."""

from __future__ import annotations

import argparse
import json
import math
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from player.errors import ConfigError, OutputError, VfrError

if TYPE_CHECKING:
    from player.asset import Asset
    from player.cameras import Camera
    from player.manifest import Manifest
    from player.render import Renderer

COLOURS = {"white": (1.0, 1.0, 1.0), "black": (0.0, 0.0, 0.0)}

EXAMPLES = """examples:
  vfr-play out/ --cameras transforms_test.json --output frames/
  vfr-play out/ --orbit 60 --output frames/ --size 800x800 --background black
  vfr-play out/ --info
  vfr-play out/ --check
"""


def main(argv: list[str] | None = None) -> int:
    """Run `vfr-play`; returns the exit code: 0 done, 1 an error in one line, 2 usage, 130 Ctrl-C."""
    try:
        arguments = _parse(argv)
    except SystemExit as leave:  # argparse has printed why
        return leave.code if isinstance(leave.code, int) else 2
    try:
        if arguments.check:
            return _check(arguments)
        if arguments.info:
            return _info(arguments)
        return _play(arguments)
    except VfrError as error:
        print(f"vfr-play: error: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("vfr-play: stopped; the frames that were finished are kept", file=sys.stderr)
        return 130


def _parse(argv: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="vfr-play",
        description="Render pictures of a baked asset on the CPU.",
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("asset", type=Path, help="folder of the asset")
    views = parser.add_mutually_exclusive_group()
    views.add_argument(
        "--cameras", type=Path, metavar="FILE", help="views of a transforms.json, one picture each"
    )
    views.add_argument("--orbit", type=_positive, metavar="N", help="a turn around the scene in N pictures")
    views.add_argument("--info", action="store_true", help="say what is in the asset")
    views.add_argument("--check", action="store_true", help="compare every file with its checksum")
    add("--output", type=Path, metavar="DIR", help="folder for the pictures, one PNG a frame")
    add("--size", type=_size, metavar="WxH", help="size of the pictures (the camera file's, else as trained)")
    add(
        "--background",
        type=_background,
        metavar="COLOUR",
        help="white, black, transparent or R,G,B in 0..255",
    )
    add(
        "--samples",
        type=_count,
        metavar="K",
        help="feature fetches a ray (the asset's own); 0 for every sample",
    )
    add(
        "--frames", type=_slice, default=slice(None), metavar="A:B", help="a slice of the views, as in Python"
    )
    add("--threads", type=_positive, metavar="N", help="threads (one for each core)")
    add(
        "--march",
        choices=("auto", "numpy", "numba"),
        default="auto",
        help="implementation (numba if installed)",
    )
    add("--json", metavar="FILE", help="write figures as JSON; - is standard output")
    add(
        "--force",
        action="store_true",
        help="write into a folder that is not empty, replacing frames of equal name",
    )
    arguments = parser.parse_args(argv)
    if not (arguments.info or arguments.check):
        has_views = arguments.cameras is not None or arguments.orbit is not None
        if not has_views and arguments.output is None:
            parser.error(
                "nothing to do: add --cameras FILE --output DIR, --orbit N --output DIR, --info or --check"
            )
        if arguments.output is None:
            parser.error("--output: add the folder for the pictures: --output DIR")
        if not has_views:
            parser.error("--output: add the views: --cameras FILE or --orbit N")
    return arguments


def _positive(text: str) -> int:
    value = int(text)
    if value < 1:
        raise ValueError
    return value


def _count(text: str) -> int:
    value = int(text)
    if value < 0:
        raise ValueError
    return value


def _size(text: str) -> tuple[int, int]:
    """Width and height.

    >>> _size("800x600")
    (800, 600)
    """
    width, height = text.lower().split("x")
    return _positive(width), _positive(height)


def _background(text: str) -> str | tuple[float, float, float]:
    """A colour 0..1 or "transparent".

    >>> _background("255,0,51"), _background("white")
    ((1.0, 0.0, 0.2), (1.0, 1.0, 1.0))
    """
    if text == "transparent":
        return text
    if text in COLOURS:
        return COLOURS[text]
    red, green, blue = (int(part) for part in text.split(","))
    if not all(0 <= value <= 255 for value in (red, green, blue)):
        raise ValueError
    return red / 255, green / 255, blue / 255


def _slice(text: str) -> slice:
    """A slice as Python writes it; one number is one view.

    >>> _slice("0:40"), _slice("::2"), _slice("3")
    (slice(0, 40, None), slice(None, None, 2), slice(3, 4, None))
    """
    parts = [int(part) if part.strip() else None for part in text.split(":")]
    if len(parts) == 1 and parts[0] is not None:
        return slice(parts[0], parts[0] + 1 or None)
    if not 2 <= len(parts) <= 3 or (len(parts) == 3 and parts[2] == 0):
        raise ValueError
    return slice(*parts)


def _play(arguments: argparse.Namespace) -> int:
    from player.asset import Asset
    from player.images import write_png
    from player.render import Renderer, check_size
    from player.transforms import frame_names

    output: Path = arguments.output
    _check_output(output, arguments.force)
    asset = Asset.open(arguments.asset)
    every = _views(asset, arguments)
    cameras, names = every[arguments.frames], frame_names(every)[arguments.frames]
    if not cameras:
        raise ConfigError(f"--frames: expected at least one of the {len(every)} views, got none")
    for camera in cameras:
        check_size(camera.width, camera.height)
    choice = {"n_samples": arguments.samples, "background": arguments.background}
    times: list[float] = []
    begin = time.perf_counter()
    with Renderer(asset, arguments.threads, arguments.march) as renderer, _Bar(len(cameras)) as bar:
        renderer.render(cameras[0].resized(64, 64), **choice)  # compiles, or reads what was compiled before
        for camera, name in zip(cameras, names, strict=True):
            start = time.perf_counter()
            frame = renderer.render(camera, **choice)
            times.append((time.perf_counter() - start) * 1000)
            write_png(output / f"{name}.png", frame.to_uint8())
            bar.advance(times)
        figures = _figures(renderer, cameras, times, arguments.samples)
    _write_json(arguments.json, figures)
    seconds = time.perf_counter() - begin
    if arguments.json != "-":
        print(
            f"{output}: {len(times)} picture{'s' * (len(times) != 1)} of "
            f"{figures['width']}x{figures['height']} "
            f"in {seconds:.1f} s; rendering {figures['ms_median']:.0f} ms a frame "
            f"({1000 / figures['ms_median']:.1f} frames/s, {figures['march']}, {figures['threads']} threads)"
        )
    return 0


def _check_output(output: Path, force: bool) -> None:
    try:
        taken = output.exists() and (not output.is_dir() or (not force and any(output.iterdir())))
    except OSError as error:
        raise OutputError(f"{output}: cannot read: {error.strerror}") from error
    if taken and not output.is_dir():
        raise OutputError(f"{output}: expected a folder for the pictures, got a file")
    if taken:
        raise OutputError(
            f"{output}: not empty: add --force to write into it, replacing frames of equal name"
        )


def _views(asset: Asset, arguments: argparse.Namespace) -> list[Camera]:
    from player.cameras import orbit
    from player.transforms import read_cameras

    width, height = asset.manifest.view_size
    if arguments.orbit is not None:
        trained = read_cameras(asset.path("cameras.json"), (width, height))
        return orbit(trained, arguments.orbit, arguments.size or (width, height))
    cameras = read_cameras(arguments.cameras, (width, height))
    return cameras if arguments.size is None else [camera.resized(*arguments.size) for camera in cameras]


def _figures(
    renderer: Renderer, cameras: list[Camera], times: list[float], samples: int | None
) -> dict[str, Any]:
    ordered = sorted(times)
    return {
        "ms_median": statistics.median(times),
        "ms_p95": ordered[math.ceil(0.95 * len(ordered)) - 1],
        "frames": len(times),
        "width": cameras[0].width,
        "height": cameras[0].height,
        "threads": renderer.n_threads,
        "march": renderer.march,
        "peak_rss_mb": peak_rss_mb(),
        "samples": renderer.asset.manifest.n_samples if samples is None else samples,
    }


def peak_rss_mb() -> float | None:
    """Most memory that this process has had, in MB; None where the system does not tell."""
    try:
        import resource
    except ImportError:
        return None
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 1e6 if sys.platform == "darwin" else peak * 1024 / 1e6


def _write_json(target: str | None, document: dict[str, Any]) -> None:
    if target is None:
        return
    text = json.dumps(document, indent=1, sort_keys=True) + "\n"
    if target == "-":
        sys.stdout.write(text)
        return
    from player.files import write_bytes

    write_bytes(Path(target), text.encode())


class _Bar:
    """A progress bar on stderr, if that is a terminal: frame i of n, ms, time left."""

    def __init__(self, total: int) -> None:
        self._total = total
        self._shown = sys.stderr.isatty()
        self._begin = time.perf_counter()

    def __enter__(self) -> _Bar:
        return self

    def __exit__(self, *_: object) -> None:
        if self._shown:
            sys.stderr.write("\n")

    def advance(self, times: list[float]) -> None:
        if not self._shown:
            return
        done = len(times)
        left = (time.perf_counter() - self._begin) / done * (self._total - done)
        filled = "#" * (24 * done // self._total)
        sys.stderr.write(
            f"\r[{filled:24}] frame {done}/{self._total}  {times[-1]:.0f} ms  {left:.0f} s left   "
        )
        sys.stderr.flush()


def _check(arguments: argparse.Namespace) -> int:
    from player.asset import Asset, checksums, read_manifest

    manifest = read_manifest(arguments.asset)
    results = {}
    for name, error in checksums(arguments.asset, manifest):
        results[name] = "ok" if error is None else str(error)
        if arguments.json != "-":
            print(f"{'ok    ' if error is None else 'FAILED'}  {name}{'' if error is None else f'  {error}'}")
    failed = sum(result != "ok" for result in results.values())
    _write_json(arguments.json, {"ok": not failed, "files": results})
    if failed:
        raise VfrError(f"{arguments.asset}: {failed} of {len(results)} files failed")
    Asset.open(arguments.asset)  # the checksums hold; now the content
    return 0


def _info(arguments: argparse.Namespace) -> int:
    from player.asset import Asset
    from player.head import count_parameters
    from player.transforms import read_cameras

    asset = Asset.open(arguments.asset)
    m = asset.manifest
    facts = {
        "bytes": {name: entry.bytes for name, entry in sorted(m.files.items())},
        "bytes_total": sum(entry.bytes for entry in m.files.values()),
        "n_bricks": len(asset.arrays.brick_coords),
        "n_vertices": len(asset.arrays.density),
        "head_parameters": count_parameters(asset.path("head.onnx").read_bytes()),
        "n_cameras": len(read_cameras(asset.path("cameras.json"), (m.view_size[0], m.view_size[1]))),
        "world_box": _world_box(asset),
        "world_units_per_model_unit": asset.scale,
        **{key: getattr(m, key) for key in _MANIFEST_KEYS},
    }
    if arguments.json is not None:
        _write_json(arguments.json, facts)
    if arguments.json != "-":
        print("\n".join(_page(arguments.asset, m, facts)))
    return 0


_MANIFEST_KEYS = (
    "version", "generator", "resolution", "aabb", "world_from_model", "step", "n_samples", "density_range",
    "n_channels", "background", "colour_space", "view_size", "provenance",
)  # fmt: skip


def _world_box(asset: Asset) -> list[list[float]]:
    """Least and greatest world coordinates of the box's corners."""
    import numpy as np

    box = np.array(asset.manifest.aabb)
    corners = np.array([[box[i, 0], box[j, 1], box[k, 2], 1] for i, j, k in np.ndindex(2, 2, 2)])
    world = (corners @ asset.world_from_model.T)[:, :3]
    return [world.min(axis=0).tolist(), world.max(axis=0).tolist()]


def _page(folder: Path, m: Manifest, facts: dict[str, Any]) -> list[str]:
    def numbers(values: Any, form: Callable[[float], str] = "{:.4g}".format) -> str:
        return ", ".join(form(value) for value in values)

    low, high = facts["world_box"]
    scale = facts["world_units_per_model_unit"]
    lines = [
        f"{folder}: vfr-asset {m.version[0]}.{m.version[1]}, written by {m.generator}",
        "",
        f"size on disk       {facts['bytes_total'] / 1e6:.1f} MB",
        *(f"  {name:16} {size / 1e6:.3f} MB" for name, size in facts["bytes"].items()),
        f"grid               {m.resolution} cells per axis, {facts['n_vertices']:,} vertices stored "
        f"in {facts['n_bricks']:,} bricks of 8 x 8 x 8",
        f"features           {m.n_channels} channels of 8 bits, fetched "
        f"{f'at {m.n_samples} places a ray' if m.n_samples else 'at every sample'}",
        f"step               {m.step:.5g} model units, {m.step * scale:.5g} world units",
        f"head               {facts['head_parameters']:,} parameters",
        f"world box          from {numbers(low)} to {numbers(high)}",
        f"world units        {scale:.5g} in a model unit",
        f"colours            {m.colour_space}, over {numbers(m.background)}",
        f"training cameras   {facts['n_cameras']}, pictures of {m.view_size[0]}x{m.view_size[1]}",
    ]
    figures = [f"  {key:16} {json.dumps(value)}" for key, value in sorted(m.provenance.items())]
    return [*lines, *(["provenance", *figures] if figures else [])]


if __name__ == "__main__":
    sys.exit(main())
