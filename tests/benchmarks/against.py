"""Compare frames of another version of the player with this one's; each version may play an asset of its own.

The other version and each quality of this one run in processes of their own. They take turns frame by frame,
so that other work of the machine affects all of them alike. The views are a walk through some training views
and a slow turn around the scene. Ratios are medians over the frames, of elapsed time and of processor time;
on a machine that does other work, trust the second. Pictures are compared with the exact ones of the same
asset: the error of pictures, and the error of the difference between each picture and the one before it,
which measures flicker.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np

from player.asset.asset import Asset
from player.cameras.camera import Camera, orbit
from player.cameras.keyframes import smooth_path
from player.cameras.views import asset_cameras

QUALITIES = ("exact", "high", "fast")
TURN = 240
"""Number of views in a whole turn; a slow turn shows only the first of them."""

_WORKER = """
import json, resource, sys, time
import numpy as np
from pathlib import Path
try:
    from player.asset.asset import Asset
    from player.cameras.camera import Camera
except ImportError:  # a version whose modules all lie in one folder
    from player.asset import Asset
    from player.cameras import Camera
from player.render import Renderer
folder, threads, march, quality, picture = sys.argv[1:]
def peak_mb():
    try:  # a process inherits ru_maxrss from the one that started it
        with open("/proc/self/status") as status:
            return next(int(line.split()[1]) for line in status if line.startswith("VmHWM")) / 1024
    except OSError:
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
renderer = Renderer(Asset.open(Path(folder)), int(threads), march)
settings = {} if quality == "exact" else {"quality": quality}
for line in sys.stdin:
    c2w, lens = json.loads(line)
    camera = Camera("view", np.array(c2w), *lens)
    wall, used = time.perf_counter(), time.process_time()
    frame = renderer.render(camera, **settings)
    wall, used = time.perf_counter() - wall, time.process_time() - used
    np.save(picture, frame.to_uint8())
    print(json.dumps([wall, used, peak_mb()]), flush=True)
"""


class Player:
    """A process that renders with one version of the player."""

    def __init__(
        self, checkout: Path, folder: Path, threads: int, march: str, quality: str, picture: Path
    ) -> None:
        self._checkout, self._picture = checkout, picture
        self._process = subprocess.Popen(
            [
                sys.executable,
                "-c",
                _WORKER,
                str(folder.resolve()),
                str(threads),
                march,
                quality,
                str(picture),
            ],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            cwd=checkout,
            env=os.environ | {"PYTHONPATH": str(checkout.resolve()), "OPENBLAS_NUM_THREADS": "1"},
        )

    def frame(self, camera: Camera) -> tuple[list[float], np.ndarray]:
        """Return (seconds, seconds of processor time, peak megabytes), and the picture [h, w, 3] in 0..1."""
        requests, answers = self._process.stdin, self._process.stdout
        assert requests is not None and answers is not None
        lens = (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
        requests.write(json.dumps([camera.c2w.tolist(), lens]) + "\n")
        requests.flush()
        if not (answer := answers.readline()):
            raise SystemExit(f"{self._checkout}: expected a picture, got an end: see what it has said above")
        return json.loads(answer), np.load(self._picture) / 255

    def close(self) -> None:
        self._process.kill()
        self._process.communicate()


def views(asset: Asset, size: tuple[int, int], n_frames: int) -> list[Camera]:
    """Return views, half of them on a walk between training views, and half on a slow turn."""
    trained = [camera.resized(*size) for camera in asset_cameras(asset)]
    chosen = [trained[i] for i in np.linspace(0, len(trained) - 1, 4).round().astype(int)]
    walk = smooth_path(chosen, max(n_frames // 6, 1))[: n_frames - n_frames // 2]
    return walk + orbit(trained, TURN, size)[: n_frames // 2]


def compare(
    folder: Path,
    other: tuple[Path, Path],
    size: tuple[int, int],
    n_frames: int,
    threads: int,
    march: str,
    scratch: Path,
) -> list[dict[str, Any]]:
    """Return a row for the other version (`other`: its checkout and its asset), and for each quality of this
    one.

    Pictures are written to the folder `scratch` meanwhile.
    """  # fmt: skip
    here = Path(__file__).parents[2]
    kinds = [(other[0], other[1], "exact"), *((here, folder, quality) for quality in QUALITIES)]
    players = [
        Player(*kind[:2], threads, march, kind[2], scratch / f"{number}.npy")
        for number, kind in enumerate(kinds)
    ]
    try:
        cameras = views(Asset.open(folder), size, n_frames)
        for player in players:
            player.frame(cameras[0])
        found = [[player.frame(camera) for player in players] for camera in cameras]
    finally:
        for player in players:
            player.close()
    times = np.array([[figures for figures, _ in frames] for frames in found])
    rows = []
    for number, (_, asset, quality) in enumerate(kinds):
        row: dict[str, Any] = {"asset": str(asset), "quality": quality if number else "the other version"}
        row["ms"] = 1000 * float(np.median(times[:, number, 0]))
        row["times_as_fast"] = float(np.median(times[:, 0, 0] / times[:, number, 0]))
        row["by_processor_time"] = float(np.median(times[:, 0, 1] / times[:, number, 1]))
        row["peak_mb"] = float(times[:, number, 2].max())
        if number > 1:
            errors = np.array([frames[number][1] - frames[1][1] for frames in found])
            row["psnr_to_exact"] = _psnr(errors)
            row["psnr_of_differences"] = _psnr(np.diff(errors, axis=0))
        rows.append(row)
    return rows


def lines(rows: list[dict[str, Any]]) -> list[str]:
    """Return a table in Markdown."""
    said = [
        "| | ms a frame | times as fast | by processor time | peak MB | to exact, dB | of differences, dB |"
    ]
    said.append("|---|---|---|---|---|---|---|")
    for row in rows:
        cells = [row["quality"], f"{row['ms']:.0f}", f"{row['times_as_fast']:.2f}",
                 f"{row['by_processor_time']:.2f}", f"{row['peak_mb']:.0f}"]  # fmt: skip
        cells += [f"{row[key]:.1f}" if key in row else "" for key in ("psnr_to_exact", "psnr_of_differences")]
        said.append(f"| {' | '.join(cells)} |")
    return said


def _psnr(errors: np.ndarray) -> float:
    return float(-10 * np.log10(max(np.mean(np.square(errors)), 1e-12)))
