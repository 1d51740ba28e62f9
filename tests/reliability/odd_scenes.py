"""Scenes that no preset was tuned for, traced from planes, boxes and balls.

Letters: rays start at `o` [n, 3] with unit directions `d` [n, 3], and `t` [n] is the distance along them,
infinite if they meet nothing. A *tracer* takes o and d and returns premultiplied colour and opacity [n, 4]
float64, 0 to 1.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from player.cameras.camera import Camera
from tests.vfr_bake.baking.scenes import chord, fog_and_wires
from vfr_bake.data.demo import demo_cameras, demo_views
from vfr_bake.data.demo_solids import CENTRE, SCALE
from vfr_bake.data.store.capture import Capture, PosedImages, held_out

Tracer = Callable[[np.ndarray, np.ndarray], np.ndarray]

ROOM = np.array([[-3.0, -2.0, 0.0], [3.0, 2.0, 2.5]])
"""Lower and upper corner of the room."""
WINDOW = (-1.2, 1.2, 0.9, 2.0)
"""Opening in the wall at the largest x: least and greatest y, least and greatest z."""
SUN = np.array([0.48, 0.36, 0.8])


def sky(d: np.ndarray) -> np.ndarray:
    """Return the sky's colours [n, 3]: blue above, hazy at the horizon."""
    up = np.clip(d[:, 2:], 0, 1) ** 0.5
    return (1 - up) * np.array([0.85, 0.88, 0.9]) + up * np.array([0.25, 0.45, 0.8])


def checker(a: np.ndarray, b: np.ndarray, tile: float) -> np.ndarray:
    """Return the pattern of a checkerboard, [n] with values 0 or 1."""
    return (np.floor(a / tile) + np.floor(b / tile)) % 2


class Nearest:
    """The nearest surface that each ray has met so far, and its colour."""

    def __init__(self, o: np.ndarray, d: np.ndarray) -> None:
        self.o, self.d = o, d
        self.t, self.rgb = np.full(len(d), np.inf), sky(d)

    def meet(self, t: np.ndarray, normal: np.ndarray, rgb: np.ndarray) -> None:
        """Let rays meet a surface at t, with unit normals [n, 3] and colours [n, 3], where it is nearer."""
        near = (t > 1e-6) & (t < self.t)
        light = 0.55 + 0.45 * np.clip(normal @ SUN, 0, 1)
        self.rgb = np.where(near[:, None], rgb * light[:, None], self.rgb)
        self.t = np.where(near, t, self.t)

    def ball(self, centre: Sequence[float], radius: float, rgb: Sequence[float]) -> None:
        near, far = chord(self.o, self.d, np.array(centre), radius)
        t = np.where(far > near, near, np.inf)
        met = self.o + np.where(np.isfinite(t), t, 0)[:, None] * self.d
        stripes = 0.75 + 0.25 * np.sin(9 * met[:, :1] + 7 * met[:, 2:])
        self.meet(t, (met - np.array(centre)) / radius, stripes * np.array(rgb))

    def box(self, low: Sequence[float], high: Sequence[float], rgb: Sequence[float]) -> None:
        with np.errstate(divide="ignore", invalid="ignore"):
            ways = np.sort([(np.array(side) - self.o) / self.d for side in (low, high)], axis=0)
        axis = np.nanargmax(ways[0], axis=1)
        enter, leave = np.nanmax(ways[0], axis=1), np.nanmin(ways[1], axis=1)
        normal = -np.sign(self.d) * np.eye(3)[axis]
        self.meet(np.where(enter < leave, enter, np.inf), normal, np.tile(rgb, (len(self.d), 1)))


def room(o: np.ndarray, d: np.ndarray) -> np.ndarray:
    """Trace a white room: checkered floor, brick lines on one wall, window, table, ball and railing."""
    seen = Nearest(o, d)
    with np.errstate(divide="ignore"):
        walls = np.max([(side - o) / d for side in ROOM], axis=0)
    axis, t = walls.argmin(axis=1), walls.min(axis=1)
    met = o + t[:, None] * d
    rgb = np.full_like(met, 0.86)
    floor = (axis == 2) & (d[:, 2] < 0)
    rgb[floor] = 0.35 + 0.3 * checker(met[floor, :1], met[floor, 1:2], 0.5)
    bricks = (axis == 0) & (d[:, 0] < 0)
    rgb[bricks] = np.where((met[bricks, 2:] * 4) % 1 < 0.12, 0.6, 0.86) * np.array([1.0, 0.9, 0.85])
    left, right, least, most = WINDOW
    opening = (axis == 0) & (d[:, 0] > 0) & (met[:, 1] > left) & (met[:, 1] < right)
    opening &= (met[:, 2] > least) & (met[:, 2] < most)
    normal = -np.sign(d) * np.eye(3)[axis]
    seen.meet(np.where(opening, np.inf, t), normal, rgb)
    seen.box((-0.5, -0.4, 0.6), (0.5, 0.4, 0.68), (0.5, 0.3, 0.15))
    seen.ball((0.1, 0.1, 0.9), 0.22, (0.9, 0.25, 0.2))
    for place in np.linspace(-1.6, 1.6, 12):
        seen.box((-2.0, place - 0.015, 0.0), (-1.97, place + 0.015, 1.0), (0.05, 0.05, 0.06))
    return np.concatenate([seen.rgb, np.ones((len(d), 1))], axis=-1)


def horizon(o: np.ndarray, d: np.ndarray) -> np.ndarray:
    """Trace an endless plain with pillars at distances from 1 to 400."""
    seen = Nearest(o, d)
    with np.errstate(divide="ignore"):
        t = np.where(d[:, 2] < 0, -o[:, 2] / d[:, 2], np.inf)
    met = o + np.where(np.isfinite(t), t, 0)[:, None] * d
    haze = np.exp(-np.where(np.isfinite(t), t, 0) / 150)[:, None]
    ground = (0.3 + 0.25 * checker(met[:, :1], met[:, 1:2], 0.7)) * np.array([0.8, 1.0, 0.6])
    rgb = haze * ground + (1 - haze) * np.array([0.85, 0.88, 0.9])
    seen.meet(t, np.tile([0.0, 0.0, 1.0], (len(d), 1)), rgb)
    for n, distance in enumerate((1, 3, 8, 25, 80, 400)):
        x, y = distance * np.cos(2.4 * n), distance * np.sin(2.4 * n)
        half, high = 0.12 * distance**0.8, 0.5 * distance**0.8
        seen.box((x - half, y - half, 0), (x + half, y + half, high), (0.7, 0.3 + 0.1 * n, 0.2))
    return np.concatenate([seen.rgb, np.ones((len(d), 1))], axis=-1)


def glass(o: np.ndarray, d: np.ndarray) -> np.ndarray:
    """Trace a ball of glass, clear in the middle and bright at its rim, in front of a checkered wall, with a
    dark grid of wires beneath it and nothing around them."""
    seen = Nearest(o, d)
    seen.t, out = np.full(len(d), np.inf), np.zeros((len(d), 4))
    with np.errstate(divide="ignore", invalid="ignore"):
        t = (0.6 - o[:, 1]) / d[:, 1]
    met = o + t[:, None] * d
    wall = (t > 0) & (np.abs(met[:, [0, 2]]) < 0.7).all(axis=1)
    seen.rgb = np.zeros((len(d), 3))
    value = 0.25 + 0.6 * checker(met[:, 0], met[:, 2], 0.2)[:, None]
    seen.meet(np.where(wall, t, np.inf), np.tile([0.0, -1.0, 0.0], (len(d), 1)), value * np.ones(3))
    for place in np.linspace(-0.6, 0.6, 7):
        seen.box((place - 0.012, -0.6, -0.72), (place + 0.012, 0.6, -0.7), (0.04, 0.04, 0.05))
    out[:, :3], out[:, 3] = seen.rgb, np.isfinite(seen.t)
    near, far = chord(o, d, np.zeros(3), 0.4)
    met = o + near[:, None] * d
    facing = np.clip(-(met / 0.4 * d).sum(axis=-1), 0, 1)
    rim = np.where((far > near) & (near < seen.t), 0.08 + 0.8 * (1 - facing) ** 4, 0)[:, None]
    return rim * np.array([0.8, 0.95, 1.0, 1.0]) + (1 - rim) * out


def picture(tracer: Tracer, camera: Camera, centre: np.ndarray, scale: float) -> np.ndarray:
    """Return a picture [height, width, 4] uint8 with straight alpha, from four rays a pixel. The tracer's
    frame has its origin at `centre` in the world, and the unit `scale`."""
    total = np.zeros((camera.height * camera.width, 4))
    for dx, dy in ((-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25)):
        shifted = Camera(
            camera.name, camera.c2w, camera.width, camera.height, camera.fx, camera.fy, camera.cx + dx,
            camera.cy + dy,
        )  # fmt: skip
        o, d = (part.astype(np.float64) for part in shifted.rays())
        total += tracer((o - centre) / scale, d) / 4
    total[:, :3] /= np.maximum(total[:, 3:], 1e-6)
    return (total.clip(0, 1) * 255 + 0.5).astype(np.uint8).reshape(camera.height, camera.width, 4)


def looking(name: str, place: np.ndarray, at: np.ndarray, size: int, degrees: float) -> Camera:
    """Return a camera at `place` that looks at `at`, with z up."""
    back = (place - at) / np.linalg.norm(place - at)
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    c2w = np.eye(4)
    c2w[:3, :4] = np.stack([right, np.cross(back, right), back, place], axis=-1)
    focal = float(0.5 * size / np.tan(np.deg2rad(degrees) / 2))
    return Camera(name, c2w, size, size, focal, focal, size / 2, size / 2)


def inside_views(size: int, n_views: int) -> list[Camera]:
    """Return cameras on a walk around the table of the room, which look past it at the opposite wall."""
    cameras = []
    for n in range(n_views):
        angle = 2 * np.pi * n / n_views
        place = np.array([1.9 * np.cos(angle), 1.3 * np.sin(angle), 1.4 + 0.3 * np.sin(5 * angle)])
        at = np.array([-0.5 * np.cos(angle + 0.7), -0.5 * np.sin(angle + 0.7), 0.9])
        cameras.append(looking(f"view_{n}", place, at, size, 75))
    return cameras


def outside_views(size: int, n_views: int) -> list[Camera]:
    """Return a ring of cameras that look a little above its centre."""
    angles = 2 * np.pi * np.arange(n_views) / n_views
    places = np.stack([2 * np.cos(angles), 2 * np.sin(angles), 0.9 + 0.3 * np.sin(3 * angles)], axis=-1)
    at = np.array([0.0, 0.0, 0.6])
    return [looking(f"view_{n}", place, at, size, 60) for n, place in enumerate(places)]


def odd_capture(name: str, size: int, n_views: int) -> Capture:
    """Return one of the scenes ODD, in pictures of `size` x `size` pixels.

    >>> odd_capture("two views", 8, 40).train.cameras[0].width
    8
    """
    if name == "two views":
        views, test = demo_views(size, 2, 1)
        return Capture(name, views, test)
    if name in ("room", "horizon"):
        tracer, cameras = {
            "room": (room, inside_views(size, n_views)),
            "horizon": (horizon, outside_views(size, n_views)),
        }[name]
        images = [picture(tracer, camera, np.zeros(3), 1.0) for camera in cameras]
        return Capture(name, *held_out(PosedImages(cameras, images)))
    tracer = {"fog": lambda o, d: fog_and_wires(o[0], d), "glass": glass}[name]

    def taken(cameras: list[Camera]) -> PosedImages:
        return PosedImages(cameras, [picture(tracer, camera, CENTRE, SCALE) for camera in cameras])

    test = demo_cameras(size, 2, phase=0.5, prefix="./test/r_")
    return Capture(name, taken(demo_cameras(size, n_views)), taken(test))


ODD = ("room", "horizon", "fog", "glass", "two views")
