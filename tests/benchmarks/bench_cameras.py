"""Compare cameras that are estimated from pictures alone with known ones.

    python -m tests.benchmarks.bench_cameras ring RING --views 300 --size 4000 3000
    python -m tests.benchmarks.bench_cameras compare DATA

`ring` renders the built-in scene in a textured room: `--views` pictures in three turns at heights of 12, 30
and 50 degrees, with their cameras in `transforms.json`. `compare` estimates the cameras of DATA's pictures
(of the train split if there are two) without using those in the transforms.json. It prints seconds of every
stage, processor time, peak memory, the number of pictures that were placed, the error of rotations in
degrees, and the error of positions in per cent of the spread of all positions. Before that, the estimated
cameras are moved by the similarity that brings their positions nearest to the known ones.
"""

from __future__ import annotations

import argparse
import json
import resource
import shutil
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageFilter

from player.cameras import colmap
from player.cameras.camera import Camera
from player.cameras.transforms import read_cameras, write_cameras
from player.progress import Bar
from tests.vfr_bake.data.test_poses import similarity
from vfr_bake.data.demo import trace
from vfr_bake.data.demo_solids import CENTRE, SCALE
from vfr_bake.data.poses import estimate_cameras
from vfr_bake.data.threads import in_threads

HEIGHTS = (12.0, 30.0, 50.0)
DISTANCE = 3.0
ROOM = np.array([[-7.0, -7.0, -1.2], [7.0, 7.0, 4.0]])
"""Two corners of the room in the scene's own frame, in which the scene's box is about [-1, 1]³."""
TEXTURE_SIDE = 4096
ENLARGED = 2.5
"""Factor by which traced pictures are enlarged on each side: a phone's 12 megapixels show no more."""


def ring_cameras(n_views: int, width: int, height: int) -> list[Camera]:
    """Return cameras in three turns around the scene, in the world's frame; upper ones look down more."""
    cameras = []
    for number in range(n_views):
        turn, part = divmod(number * len(HEIGHTS) / n_views, 1.0)
        elevation = np.deg2rad(HEIGHTS[int(turn)])
        azimuth = 2 * np.pi * part
        level = np.cos(elevation)
        back = np.array([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)])
        right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
        place = CENTRE + SCALE * (DISTANCE * back + [0, 0, -0.3])
        c2w = np.eye(4)
        c2w[:3] = np.stack([right, np.cross(back, right), back, place], axis=-1)
        name = f"images/{number:04d}.jpg"
        cameras.append(Camera(name, c2w, width, height, 0.9 * width, 0.9 * width, width / 2, height / 2))
    return cameras


def wall_texture(seed: int) -> np.ndarray:
    """Return blotches of all sizes with rectangles upon them, [side, side, 3] uint8, without repetition."""
    rng = np.random.default_rng(seed)
    texture = np.zeros((TEXTURE_SIDE, TEXTURE_SIDE, 3), np.float32)
    for level in range(3, 12):
        noise = Image.fromarray(rng.integers(0, 256, (2**level, 2**level), np.uint8))
        texture += np.asarray(noise.resize(texture.shape[:2], Image.Resampling.BILINEAR))[..., None]
    texture = (texture - texture.mean()) / texture.std() * 40 + 120
    for _ in range(400):
        x, y = rng.integers(0, TEXTURE_SIDE, 2)
        w, h = rng.integers(12, 220, 2)
        texture[y : y + h, x : x + w] = 0.35 * texture[y : y + h, x : x + w] + rng.uniform(0, 160, 3)
    return texture.clip(0, 255).astype(np.uint8)


def room_picture(camera: Camera, walls: np.ndarray) -> np.ndarray:
    """Return a picture of the room alone, [height, width, 3] uint8; `walls`: [6, side, side, 3]."""
    rays_o, rays_d = camera.rays()
    origin, d = ((rays_o[:1] - CENTRE) / SCALE).astype(np.float32).T, rays_d.T
    corner = np.where(d < 0, ROOM[0][:, None], ROOM[1][:, None]).astype(np.float32)
    with np.errstate(divide="ignore"):
        t = (corner - origin) / d
    axis = t.argmin(axis=0)
    place = (origin + t.min(axis=0) * d - ROOM[0][:, None]) / (ROOM[1] - ROOM[0])[:, None]
    rays = np.arange(d.shape[1])
    wall = 2 * axis + (d[axis, rays] > 0)
    texel = (place * (TEXTURE_SIDE - 1)).astype(np.int32).clip(0, TEXTURE_SIDE - 1)
    u, v = texel[(axis + 1) % 3, rays], texel[(axis + 2) % 3, rays]
    return walls[wall, v, u].reshape(camera.height, camera.width, 3)


def render_ring(folder: Path, n_views: int, width: int, height: int) -> None:
    """Write `images/` and `transforms.json` into a new folder."""
    (folder / "images").mkdir(parents=True)
    walls = np.stack([wall_texture(seed) for seed in range(6)])

    def render(camera: Camera) -> None:
        small = camera.resized(round(width / ENLARGED), round(height / ENLARGED))
        rgba, _ = trace(small)
        alpha = rgba[..., 3:]
        rgb = rgba[..., :3] * 255 * alpha + room_picture(small, walls) * (1 - alpha)
        picture = Image.fromarray((rgb + 0.5).astype(np.uint8))
        picture = picture.filter(ImageFilter.GaussianBlur(0.5))
        picture = picture.resize((width, height), Image.Resampling.BICUBIC)
        picture.save(folder / camera.name, quality=90)

    cameras = ring_cameras(n_views, width, height)
    with Bar("pictures") as bar:
        in_threads(render, cameras, bar.count)
    (folder / "transforms.json").write_bytes(write_cameras(cameras))


class Stages:
    """Elapsed and processor seconds of every stage of an estimation, each printed when its stage ends."""

    def __init__(self) -> None:
        self._stage, self._start = "", (time.perf_counter(), time.process_time())
        self.seconds: dict[str, tuple[float, float]] = {}

    def __call__(self, stage: str, done: int, of: int) -> None:
        if stage != self._stage:
            self.end()
            self._stage = stage

    def end(self) -> None:
        now = (time.perf_counter(), time.process_time())
        if self._stage:
            wall, processor = now[0] - self._start[0], now[1] - self._start[1]
            before = self.seconds.get(self._stage, (0.0, 0.0))
            self.seconds[self._stage] = before[0] + wall, before[1] + processor
            print(f"{self._stage}: {wall:.0f} s, {processor:.0f} s of processor time", flush=True)
        self._start = now


def errors(estimated: np.ndarray, known: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the errors of rotations in degrees, and of positions as shares of their spread, after the best
    similarity.

    Both sets of cameras are [n, 4, 4], camera to world, n at least 3, with positions that are not all on one
    line.

    >>> rng = np.random.default_rng(0)
    >>> known = np.tile(np.eye(4), (5, 1, 1))
    >>> known[:, :3, 3] = rng.normal(size=(5, 3))
    >>> quarter = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    >>> moved = known.copy()
    >>> moved[:, :3] = quarter @ known[:, :3]
    >>> moved[:, :3, 3] = 2 * moved[:, :3, 3] + 7
    >>> [float(error.max().round(6)) for error in errors(moved, known)]
    [0.0, 0.0]
    """
    a, b = (cameras[:, :3, 3] - cameras[:, :3, 3].mean(axis=0) for cameras in (estimated, known))
    scale, turn = similarity(a, b)
    shares = np.linalg.norm(scale * a @ turn.T - b, axis=1) / np.sqrt((b**2).sum(axis=1).mean())
    # The mean rotation between the two sets is more exact than that of a similarity of positions alone.
    u, _, vt = np.linalg.svd((known[:, :3, :3] @ estimated[:, :3, :3].transpose(0, 2, 1)).sum(axis=0))
    common = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
    between = known[:, :3, :3].transpose(0, 2, 1) @ common @ estimated[:, :3, :3]
    cosine = (np.trace(between, axis1=1, axis2=2) - 1) / 2
    return np.rad2deg(np.arccos(cosine.clip(-1, 1))), shares


def compare(data: Path) -> dict[str, Any]:
    """Print and return what the estimation of a data set's cameras took, and the cameras' errors."""
    files = [data / name for name in ("transforms_train.json", "transforms.json") if (data / name).is_file()]
    cameras = {}
    with tempfile.TemporaryDirectory() as name:
        photos = Path(name)
        (photos / "images").mkdir()
        # Only positions and rotations are compared; NeRF-synthetic does not state the size of its pictures.
        for number, camera in enumerate(read_cameras(files[0], (1, 1))):
            names = (camera.name, f"{camera.name}.png")
            picture = next(path for name in names if (path := data / name).is_file())
            copy = f"{number:05d}{picture.suffix}"
            shutil.copyfile(picture, photos / "images" / copy)
            cameras[copy] = camera.c2w
        stages = Stages()
        start = time.perf_counter()
        report = estimate_cameras(photos, stages)
        stages.end()
        found: dict[str, Any] = {
            "seconds": time.perf_counter() - start,
            "processor_seconds": time.process_time(),
        }
        found["peak_mb"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e6
        print(f"all: {found['seconds']:.0f} s, {found['processor_seconds']:.0f} s of processor time")
        print(f"peak memory: {found['peak_mb'] / 1000:.2f} GB")
        print(report.summary())
        placed = colmap.read_views(photos / "sparse" / "0")
    known = np.stack([cameras[Path(camera.name).name] for camera in placed])
    degrees, shares = errors(np.stack([camera.c2w for camera in placed]), known)
    for what, off, unit in (("turns", degrees, "degrees"), ("places", 100 * shares, "% of their spread")):
        found[what] = {"root_mean_square": float(np.sqrt((off**2).mean())), "greatest": float(off.max())}
        print(f"{what}: off by {found[what]['root_mean_square']:.3f} {unit} (at most {off.max():.3f})")
    found |= {"n_placed": len(placed), "n_pictures": len(cameras), "stages": stages.seconds}
    return found


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(dest="command", required=True)
    ring = commands.add_parser("ring", help="render a ring of pictures")
    ring.add_argument("folder", type=Path)
    ring.add_argument("--views", type=int, default=300)
    ring.add_argument("--size", type=int, nargs=2, default=(4000, 3000), metavar=("WIDTH", "HEIGHT"))
    comparing = commands.add_parser("compare", help="estimate cameras and compare them with the given ones")
    comparing.add_argument("data", type=Path)
    comparing.add_argument("--json", type=Path, help="file for the figures")
    arguments = parser.parse_args()
    if arguments.command == "ring":
        render_ring(arguments.folder, arguments.views, *arguments.size)
        return
    found = compare(arguments.data)
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(found), encoding="utf-8")


if __name__ == "__main__":
    main()
