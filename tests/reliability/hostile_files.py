"""Assets made to hang the reader, to fill the memory or to lead outside, and a process that opens one with
every command.

    python -m tests.reliability.hostile_files ASSET OUTPUT

This runs the commands in one process, with a budget of BUDGET gigabytes, and writes their outcomes as JSON.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import os
import resource
import socket
import sys
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from tests.version_3 import as_version_3, pack_codes, pack_masks

BUDGET = 0.3
"""Gigabytes of memory that the commands may take for the asset."""


def vouch(folder: Path, change: Callable[[dict[str, Any]], object] | None = None) -> None:
    """Put the right size and checksum of every readable file into the manifest."""
    path = folder / "manifest.json"
    document = json.loads(path.read_text())
    if change is not None:
        change(document)
    for name in document["files"]:
        if (folder / name).is_file() and (folder / name).stat().st_size < 1 << 30:
            data = (folder / name).read_bytes()
            document["files"][name] = {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}
    path.write_text(json.dumps(document))


def sparse(name: str, vouched: bool = False) -> Callable[[Path], None]:
    """Return a function that makes a file of a terabyte, which takes no room on the disk."""

    def make(folder: Path) -> None:
        with (folder / name).open("r+b") as file:
            file.truncate(1 << 40)
        if vouched:
            vouch(folder, lambda document: document["files"][name].update(bytes=1 << 40))

    return make


def device(name: str) -> Callable[[Path], None]:
    """Return a function that puts a link to a device without end in place of a file."""

    def make(folder: Path) -> None:
        (folder / name).unlink()
        (folder / name).symlink_to("/dev/zero")

    return make


def pipe(name: str) -> Callable[[Path], None]:
    """Return a function that puts a pipe to which nobody writes in place of a file."""

    def make(folder: Path) -> None:
        (folder / name).unlink()
        os.mkfifo(folder / name)

    return make


def unix_socket(name: str) -> Callable[[Path], None]:
    def make(folder: Path) -> None:
        (folder / name).unlink()
        before = Path.cwd()
        os.chdir(folder)  # an address is at most a hundred characters
        try:
            with socket.socket(socket.AF_UNIX) as listener:
                listener.bind(name)
        finally:
            os.chdir(before)

    return make


def elsewhere(name: str) -> Callable[[Path], None]:
    """Return a function that puts a link to the right content, outside the folder, in place of a file."""

    def make(folder: Path) -> None:
        away = folder.with_name(f"{folder.name}-away")
        (folder / name).rename(away)
        (folder / name).symlink_to(away)

    return make


def bomb(resolution: int, n_channels: int) -> Callable[[Path], None]:
    """Return a function that fills every brick: packed it is small, unpacked it is not, and all sizes and
    checksums are right."""

    def make(folder: Path) -> None:
        as_version_3(folder)
        n = -(-(resolution + 1) // 8)
        coords = np.stack(np.meshgrid(*[np.arange(n)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
        masks = np.full((len(coords), 8), 2**64 - 1, np.uint64)
        for prefix, names in (("brick", "density"), ("feature", "features")):
            np.save(folder / f"{prefix}_coords.npy", coords.astype(np.uint16))
            (folder / f"{prefix}_masks.bits").write_bytes(pack_masks(masks))
            zeros = 512 * len(coords) * (n_channels if prefix == "feature" else 1)
            stream, parts = zlib.compressobj(), []
            for _ in range(0, zeros, 1 << 24):
                parts.append(stream.compress(bytes(min(1 << 24, zeros))))
                zeros -= min(1 << 24, zeros)
            (folder / f"{names}.codes").write_bytes(b"".join([*parts, stream.flush()]))
        vouch(folder, lambda document: document.update(resolution=resolution, feature_resolution=resolution,
                                                       n_channels=n_channels))  # fmt: skip

    return make


def scattered(folder: Path) -> None:
    """Store one vertex in each brick of features: six bytes on the disk, 23 kB each in a march's lookup."""
    as_version_3(folder)
    resolution, n = 1023, 128
    axis = np.arange(0, n, 2)
    coords = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3) + 1
    coords = coords[(coords < n).all(axis=1)]
    masks = np.zeros((len(coords), 8), np.uint64)
    masks[:, 0] = 1
    np.save(folder / "feature_coords.npy", coords.astype(np.uint16))
    (folder / "feature_masks.bits").write_bytes(pack_masks(masks))
    (folder / "features.codes").write_bytes(pack_codes(np.zeros((len(coords), 4), np.int8)))
    vouch(folder, lambda document: document.update(feature_resolution=resolution))


def stated(folder: Path) -> None:
    """State bricks and vertices in the manifest that no section has, and that would fill any memory."""

    def many(document: dict[str, Any]) -> None:
        document.update(resolution=2048)
        section = document["parts"][0]["sections"][0]
        section.update(n_bricks=256**3, n_vertices=2**31 - 1)

    vouch(folder, many)


def nested(folder: Path) -> None:
    """Make a manifest of 15 MB that takes fifty times as much when it is parsed."""
    path = folder / "manifest.json"
    data = path.read_bytes()
    path.write_bytes(data.replace(b'"psnr": 30.5', b'"psnr": [' + b"{}," * (5 << 20) + b"{}]"))


TEXT = "\x1b[2J\x1b]0;owned\x07\u202e\n"
"""Text that clears a terminal, names its window, reverses the direction of writing and breaks the line."""


def obeyed(folder: Path) -> None:
    """Put TEXT into what `--info` shows."""
    vouch(folder, lambda document: document.update(generator=TEXT, provenance={TEXT: {TEXT: TEXT}}))


def obeyed_in_errors(folder: Path) -> None:
    """Put TEXT into what an error message repeats."""
    document = json.loads((folder / "cameras.json").read_text())
    document["frames"][0]["camera_model"] = TEXT
    document["frames"][0]["file_path"] = "a\u202eb\u200b"
    (folder / "cameras.json").write_text(json.dumps(document))
    vouch(folder)


RECIPES: dict[str, Callable[[Path], None]] = {
    "a terabyte of manifest": sparse("manifest.json"),
    "a terabyte of a part": sparse("part_0.bin"),
    "a terabyte of a part, vouched for": sparse("part_0.bin", vouched=True),
    "vertices that are only stated": stated,
    "a terabyte of mesh, vouched for": sparse("mesh.ply", vouched=True),
    "a manifest that never ends": device("manifest.json"),
    "a part that never ends": device("part_0.bin"),
    "a head that never ends": device("head.onnx"),
    "a manifest that is a pipe": pipe("manifest.json"),
    "cameras that are a pipe": pipe("cameras.json"),
    "a head that is a socket": unix_socket("head.onnx"),
    "a manifest outside": elsewhere("manifest.json"),
    "a head outside": elsewhere("head.onnx"),
    "full bricks that unpack to 450 MB": bomb(383, 8),
    "a thousand channels that unpack to 270 MB": bomb(63, 1024),
    "bricks with a vertex each": scattered,
    "a manifest of five million values": nested,
    "text that a terminal obeys": obeyed,
    "text that a terminal obeys, in a message": obeyed_in_errors,
}


def run_all(asset: Path, output: Path) -> dict[str, Any]:
    """Return exit codes and output by command, and the largest amount of memory that was taken."""
    from exporters.cli import main as export
    from player.app.cli import main as play

    budget = ["--max-memory", str(BUDGET)]
    commands: dict[str, tuple[Callable[[list[str]], int], list[str]]] = {
        "info": (play, [str(asset), "--info", *budget]),
        "check": (play, [str(asset), "--check", *budget]),
        "play": (play, [str(asset), "--view", "0", "--output", str(output / "a.png"), *budget]),
        "export": (export, [str(asset), str(output / "a.json"), *budget]),
        "export of the mesh": (export, [str(asset), str(output / "a.ply"), *budget]),
    }
    results: dict[str, Any] = {}
    for name, (command, arguments) in commands.items():
        printed, told = io.StringIO(), io.StringIO()
        with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(told):
            code = command(arguments)
        results[name] = {"code": code, "out": printed.getvalue(), "err": told.getvalue()}
    results["peak_mb"] = _peak_mb()
    return results


def _peak_mb() -> float:
    """Return this program's peak memory in MB; Linux's `getrusage` also counts the program's parent."""
    status = Path("/proc/self/status")
    if status.exists():
        return int(status.read_text().partition("VmHWM:")[2].split()[0]) / 1000
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6


if __name__ == "__main__":
    sys.stdout.write(json.dumps(run_all(Path(sys.argv[1]), Path(sys.argv[2]))))
