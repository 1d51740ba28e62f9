"""The built-in scene: analytic solids, ray traced in seconds, of known geometry and size.

A checkered plate carries a glossy ball, a textured cube, a slab with a hole through it, a golden ball, a ring
and a thin wire arch. Every solid is a signed distance function (Quilez, "Distance functions", 2008) that is
exact outside the solid, so `signed_distance` is the truth that meshes are compared with. Highlights,
reflections and the Fresnel term move with the view.

Letters: `p` [3, n] points and `n` normals in the scene's own frame, where its box is about [-1, 1]³; the
world differs from it by `CENTRE` and `SCALE`, on purpose neither 0 nor 1. Vectors are stored component first:
numpy is faster so.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from player.cameras import Camera
from vfr_bake.data.scene import PosedImages, Scene, build_scene

CENTRE = np.array([0.3, -0.2, 0.5])
SCALE = 0.8
WIRE_RADIUS = 0.02
"""In world units, like the ball's and the hole's below."""

BALL_CENTRE = CENTRE + SCALE * np.array([-0.42, -0.30, -0.28])
BALL_RADIUS = SCALE * 0.32
HOLE_CENTRE = CENTRE + SCALE * np.array([0.14, 0.44, -0.20])
HOLE_RADIUS = SCALE * 0.22
HOLE_ANGLE = 0.35
"""Radians about z; at 0 one would look through the hole along y."""

_MAX_ROUNDS = 32
_SKIN = 1e-5
_PRECISION = 1e-4
_RAYS_AT_ONCE = 65536

Distance = Callable[[np.ndarray], np.ndarray]
Colour = Callable[[np.ndarray], np.ndarray]


def signed_distance(points: np.ndarray) -> np.ndarray:
    """Distance to the nearest surface, negative inside.

    Exact outside; inside, where solids touch, a bound whose sign is right.

    `points`: [n, 3] world units. Returns [n] float64, world units.

    >>> ahead = BALL_CENTRE - [0, BALL_RADIUS + 0.1, 0]
    >>> signed_distance(np.stack([ahead, BALL_CENTRE])).round(6).tolist()
    [0.1, -0.256]
    """
    p = (np.asarray(points, np.float64).reshape(-1, 3).T - CENTRE[:, None]) / SCALE
    return _scene_distance(p) * SCALE


def trace(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Ray trace one view; edges and texture borders are sampled 2 x 2 times a pixel.

    `camera`: world frame. Returns `rgba` [height, width, 4] float32 in [0, 1], sRGB and straight alpha (the
    covered part of the pixel), and `distance` [height, width] float32 along the ray through the pixel's
    centre, in world units, infinite where nothing is hit.

    >>> camera, = demo_cameras(32, 1)
    >>> rgba, distance = trace(camera)
    >>> rgba.shape, bool((rgba[..., 3][np.isfinite(distance)] > 0).all())
    ((32, 32, 4), True)
    """
    height, width = camera.height, camera.width
    columns, rows = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    rgba, distance = _sample(camera, columns.ravel(), rows.ravel())
    # Premultiplied: the mean of samples is then the mean of what is seen, and hidden colours count for
    # nothing.
    rgba = rgba.reshape(height, width, 4)
    rough = np.flatnonzero(_rough(rgba))
    if len(rough):
        x = columns.ravel()[rough] + np.array([[-0.25], [0.25], [-0.25], [0.25]])
        y = rows.ravel()[rough] + np.array([[-0.25], [-0.25], [0.25], [0.25]])
        samples, _ = _sample(camera, x.ravel(), y.ravel())
        rgba.reshape(-1, 4)[rough] = samples.reshape(4, -1, 4).mean(axis=0)
    rgba[..., :3] /= np.maximum(rgba[..., 3:], 1e-6)
    return rgba.clip(0, 1), distance.reshape(height, width)


def demo_cameras(size: int, n_views: int, phase: float = 0.0, prefix: str = "./train/r_") -> list[Camera]:
    """`n_views` cameras around the scene, world frame: most above it, a few a little below the plate.

    They follow a Fibonacci spiral from above to below; another `phase`, in turns of its angle, gives other
    views.

    >>> [camera.name for camera in demo_cameras(8, 2, prefix="./test/r_")]
    ['./test/r_0', './test/r_1']
    """
    focal = 0.5 * size / np.tan(0.5 * np.deg2rad(38))
    distance = 3.4
    target = CENTRE + SCALE * np.array([0.0, 0.0, -0.38])
    cameras = []
    for index in range(n_views):
        z = np.interp((index + 0.5) / n_views, [0, 1], [np.sin(np.deg2rad(72)), np.sin(np.deg2rad(-12))])
        azimuth = np.pi * (3 - np.sqrt(5)) * (index + phase) - 0.5 * np.pi
        level = np.sqrt(1 - z * z)
        back = np.array([level * np.cos(azimuth), level * np.sin(azimuth), z])
        right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
        c2w = np.eye(4)
        c2w[:3, :4] = np.stack([right, np.cross(back, right), back, target + distance * back], axis=-1)
        cameras.append(
            Camera(f"{prefix}{index}", c2w, size, size, float(focal), float(focal), size / 2, size / 2)
        )
    return cameras


def demo_views(
    size: int = 256,
    n_train: int = 64,
    n_test: int = 16,
    progress: Callable[[int, int], object] | None = None,
) -> tuple[PosedImages, PosedImages]:
    """Training and test pictures of `size` x `size` pixels, with their cameras in the world frame.

    >>> train, test = demo_views(size=8, n_train=2, n_test=1)
    >>> train.images.shape, len(test.cameras)
    ((2, 8, 8, 4), 1)
    """
    train = demo_cameras(size, n_train)
    test = demo_cameras(size, n_test, phase=0.5, prefix="./test/r_")
    cameras = train + test
    images = np.empty((len(cameras), size, size, 4), np.uint8)
    with ThreadPoolExecutor(min(8, os.cpu_count() or 1)) as pool:
        for index, (rgba, _) in enumerate(pool.map(trace, cameras)):
            images[index] = (rgba * 255 + 0.5).astype(np.uint8)
            if progress is not None:
                progress(index + 1, len(cameras))
    return PosedImages(train, images[:n_train]), PosedImages(test, images[n_train:])


def demo_scene(
    size: int = 256,
    n_train: int = 64,
    n_test: int = 16,
    progress: Callable[[int, int], object] | None = None,
) -> Scene:
    """The built-in scene as a data set would give it: its box is found from the pictures like any other's.

    >>> demo_scene(size=16, n_train=6, n_test=1).name
    'demo'
    """
    return build_scene("demo", *demo_views(size, n_train, n_test, progress))


# --- solids: distance functions of p [3, n] ---


def _rotated(p: np.ndarray, angle: float) -> np.ndarray:
    """`p` turned about z by minus `angle`: a solid turned by `angle` is the straight one there."""
    c, s = p.dtype.type(np.cos(angle)), p.dtype.type(np.sin(angle))
    turned = np.empty_like(p)
    turned[0] = c * p[0] + s * p[1]
    turned[1] = c * p[1] - s * p[0]
    turned[2] = p[2]
    return turned


def _moved(p: np.ndarray, centre: tuple[float, float, float]) -> np.ndarray:
    return p - np.asarray(centre, p.dtype)[:, None]


def _length2(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return np.sqrt(x * x + y * y)


def _length3(p: np.ndarray) -> np.ndarray:
    return np.sqrt(p[0] * p[0] + p[1] * p[1] + p[2] * p[2])


def _box(p: np.ndarray, half: tuple[float, float, float], rounding: float) -> np.ndarray:
    x, y, z = (np.abs(p[i]) - p.dtype.type(half[i] - rounding) for i in range(3))
    zero = p.dtype.type(0)
    outside = np.sqrt(np.maximum(x, zero) ** 2 + np.maximum(y, zero) ** 2 + np.maximum(z, zero) ** 2)
    return outside + np.minimum(np.maximum(x, np.maximum(y, z)), zero) - p.dtype.type(rounding)


def _pierced_slab(p: np.ndarray, half: tuple[float, float, float], hole: float) -> np.ndarray:
    """A box with a round hole along y; exact, for the hole stays clear of the sides."""
    zero = p.dtype.type(0)
    x, z = np.abs(p[0]) - p.dtype.type(half[0]), np.abs(p[2]) - p.dtype.type(half[2])
    square = np.sqrt(np.maximum(x, zero) ** 2 + np.maximum(z, zero) ** 2) + np.minimum(np.maximum(x, z), zero)
    flat = np.maximum(square, p.dtype.type(hole) - _length2(p[0], p[2]))
    thick = np.abs(p[1]) - p.dtype.type(half[1])
    outside = np.sqrt(np.maximum(flat, zero) ** 2 + np.maximum(thick, zero) ** 2)
    return outside + np.minimum(np.maximum(flat, thick), zero)


def _arch(p: np.ndarray, radius: float, tube: float) -> np.ndarray:
    """The upper half of a ring in the plane y = 0, with round ends."""
    ring = _length2(_length2(p[0], p[2]) - p.dtype.type(radius), p[1])
    x = np.abs(p[0]) - p.dtype.type(radius)
    ends = np.sqrt(x * x + p[1] * p[1] + p[2] * p[2])
    return np.where(p[2] >= 0, ring, ends) - p.dtype.type(tube)


def _ring(p: np.ndarray, radius: float, tube: float) -> np.ndarray:
    return _length2(_length2(p[0], p[1]) - p.dtype.type(radius), p[2]) - p.dtype.type(tube)


# --- colours: linear reflectance [3, n] of p in the solid's own frame ---


def _mix(a: tuple[float, float, float], b: tuple[float, float, float], weight: np.ndarray) -> np.ndarray:
    one, two = (np.asarray(c, weight.dtype)[:, None] for c in (a, b))
    return one + (two - one) * weight


def _checker(*coordinates: np.ndarray, tile: float) -> np.ndarray:
    tiles = np.zeros_like(coordinates[0])
    for c in coordinates:
        tiles += np.floor(c / c.dtype.type(tile))
    return tiles % 2


def _stripes(wave: np.ndarray, dtype: np.dtype) -> np.ndarray:
    return (0.5 + 0.5 * np.clip(wave, -1, 1)).astype(dtype)


def _plate_colour(p: np.ndarray) -> np.ndarray:
    return _mix((0.74, 0.68, 0.58), (0.07, 0.11, 0.20), _checker(p[0], p[1], tile=0.2377))


def _cube_colour(p: np.ndarray) -> np.ndarray:
    return _mix((0.90, 0.27, 0.02), (0.90, 0.80, 0.58), _checker(*(p + p.dtype.type(0.235)), tile=0.1567))


def _slab_colour(p: np.ndarray) -> np.ndarray:
    wave = np.sin(24 * (p[0] + np.float32(0.12) * np.sin(9 * p[2])))
    return _mix((0.01, 0.24, 0.30), (0.30, 0.78, 0.66), _stripes(3 * wave, p.dtype))


def _ring_colour(p: np.ndarray) -> np.ndarray:
    wave = np.sin(8 * np.arctan2(p[1], p[0]))
    return _mix((0.30, 0.08, 0.55), (0.85, 0.65, 0.95), _stripes(4 * wave, p.dtype))


def _plain(r: float, g: float, b: float) -> Colour:
    return lambda p: np.repeat(np.asarray([[r], [g], [b]], p.dtype), p.shape[1], axis=1)


@dataclass(frozen=True)
class _Solid:
    centre: tuple[float, float, float]
    angle: float
    own_half: tuple[float, float, float]
    """Of its box before the turn; the arch's centre is at its foot, its box larger than need be."""
    own_distance: Distance
    own_colour: Colour
    gloss: float
    """Strength of the highlight."""
    shine: float
    """Exponent of the highlight."""
    mirror: float
    """Reflected part of the sky when looked at head on."""
    metal: bool = False
    """Whether reflections take the solid's colour."""

    def local(self, p: np.ndarray) -> np.ndarray:
        return self.turned(_moved(p, self.centre))

    def turned(self, d: np.ndarray) -> np.ndarray:
        return _rotated(d, self.angle) if self.angle else d

    def distance(self, p: np.ndarray) -> np.ndarray:
        return self.own_distance(self.local(p))


def _scene() -> list[_Solid]:
    def own(centre: np.ndarray) -> tuple[float, float, float]:
        x, y, z = (centre - CENTRE) / SCALE
        return (float(x), float(y), float(z))

    ball, hole, wire = BALL_RADIUS / SCALE, HOLE_RADIUS / SCALE, WIRE_RADIUS / SCALE
    plate, cube, slab = (0.95, 0.95, 0.05), (0.23, 0.23, 0.23), (0.44, 0.06, 0.40)
    return [
        _Solid((0, 0, -0.65), 0, plate, lambda p: _box(p, plate, 0.03), _plate_colour, 0.10, 30, 0.015),
        _Solid(
            own(BALL_CENTRE), 0, (ball, ball, ball),
            lambda p: _length3(p) - p.dtype.type(ball), _plain(0.55, 0.008, 0.02), 1.3, 90, 0.035,
        ),
        _Solid(
            (0.44, -0.40, -0.37), 0.45, cube,
            lambda p: _box(p, cube, 0.02), _cube_colour, 0.15, 30, 0.03,
        ),
        _Solid(
            own(HOLE_CENTRE), HOLE_ANGLE, slab,
            lambda p: _pierced_slab(p, slab, hole), _slab_colour, 0.35, 40, 0.04,
        ),
        _Solid(
            (0, 0.07, -0.6), -0.06, (0.86 + wire, wire, 0.86 + wire),
            lambda p: _arch(p, 0.86, wire), _plain(0.90, 0.45, 0.12), 0.7, 40, 0.3, True,
        ),
        _Solid(
            (0.02, -0.70, -0.46), 0, (0.14, 0.14, 0.14),
            lambda p: _length3(p) - p.dtype.type(0.14), _plain(0.95, 0.52, 0.10), 1.0, 60, 0.5, True,
        ),
        _Solid(
            (-0.60, 0.56, -0.53), 0, (0.27, 0.27, 0.07),
            lambda p: _ring(p, 0.20, 0.07), _ring_colour, 0.6, 50, 0.05,
        ),
    ]  # fmt: skip


_SOLIDS = _scene()
_LOW = np.array([-0.95, -0.95, -0.70])
_HIGH = np.array([0.95, 0.95, -0.6 + 0.86 + WIRE_RADIUS / SCALE])
AABB = np.stack([CENTRE + SCALE * _LOW, CENTRE + SCALE * _HIGH])
"""[2, 3] the tight box of the whole scene, world units."""


def _scene_distance(p: np.ndarray) -> np.ndarray:
    distance = _SOLIDS[0].distance(p)
    for solid in _SOLIDS[1:]:
        np.minimum(distance, solid.distance(p), out=distance)
    return distance


# --- rays ---


def _enter(
    low: np.ndarray, high: np.ndarray, origin: np.ndarray, inverse: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Where rays enter and leave a box; entered after left if they miss it."""
    near = np.zeros(1, np.float32)
    far = np.full(1, np.inf, np.float32)
    for axis in range(3):
        a = (np.float32(low[axis]) - origin[axis]) * inverse[axis]
        b = (np.float32(high[axis]) - origin[axis]) * inverse[axis]
        near = np.maximum(near, np.minimum(a, b))
        far = np.minimum(far, np.maximum(a, b))
    return near, far


def _box_of(solid: _Solid, grow: float) -> tuple[np.ndarray, np.ndarray]:
    c, s = abs(np.cos(solid.angle)), abs(np.sin(solid.angle))
    x, y, z = solid.own_half
    half = np.array([x * c + y * s, x * s + y * c, z]) + grow
    return np.array(solid.centre) - half, np.array(solid.centre) + half


def _inverse(direction: np.ndarray) -> np.ndarray:
    tiny = np.float32(1e-9)
    return 1 / np.where(np.abs(direction) < tiny, tiny, direction)


def _first_hits(origin: np.ndarray, direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """`t` [n] (infinite: none) and the number of the solid [n] (-1), by sphere tracing solid after solid.

    `origin` [3, 1], `direction` [3, n], float32. A ray that grazes a solid until its steps run out passes it.
    """
    n = direction.shape[1]
    t = np.full(n, np.inf, np.float32)
    which = np.full(n, -1, np.int8)
    inverse = _inverse(direction)
    for number, solid in enumerate(_SOLIDS):
        near, far = _enter(*_box_of(solid, _SKIN), origin, inverse)
        far = np.minimum(far, t)
        index = np.flatnonzero(near < far)
        o, d = solid.local(origin), solid.turned(direction[:, index])
        here, end = near[index], far[index]
        if solid.angle:
            # Its own box fits a flat side exactly: the march along it, endless otherwise, is over at once.
            half = np.array(solid.own_half) + _SKIN
            near, far = _enter(-half, half, o, _inverse(d))
            near = np.maximum(near, here)
            met = near < np.minimum(far, end)
            index, here, end, d = index[met], near[met], end[met], d[:, met]
        for _ in range(_MAX_ROUNDS):
            if not len(index):
                break
            # Sorting out rays costs as much as a step. Another step does a ray that has arrived no harm.
            for _ in range(3):
                h = solid.own_distance(o + here * d)
                here = here + h
            hit = (h < _PRECISION) & (here < end)
            t[index[hit]] = here[hit]
            which[index[hit]] = number
            going = (h >= _PRECISION) & (here < end)
            index, here, end, d = index[going], here[going], end[going], d[:, going]
    return t, which


def _sunlight(p: np.ndarray, towards: np.ndarray, sharpness: float) -> np.ndarray:
    """How much of a lamp `p` [3, n] see, 0 to 1, with soft edges: the ray's narrowest pass decides."""
    light = np.ones(p.shape[1], np.float32)
    direction = towards[:, None]
    inverse = _inverse(direction)
    for solid in _SOLIDS[1:]:  # the plate lies under everything
        near, far = _enter(*_box_of(solid, 0.06), p, inverse)
        index = np.flatnonzero((near < far) & (light > 0))
        here, end = np.maximum(near[index], np.float32(0.02)), far[index]
        o, d = solid.local(p[:, index]), solid.turned(direction)
        for _ in range(6):
            if not len(index):
                break
            narrowest = light[index]
            for _ in range(3):
                h = solid.own_distance(o + here * d)
                narrowest = np.minimum(narrowest, sharpness * h / here)
                here = here + np.maximum(h, np.float32(0.02))
            light[index] = narrowest
            going = (here < end) & (narrowest > 0)
            index, here, end, o = index[going], here[going], end[going], o[:, going]
    light = np.clip(light, 0, 1)
    return light * light * (3 - 2 * light)


def _openness(p: np.ndarray, n: np.ndarray) -> np.ndarray:
    """How much of the sky is seen, guessed from the free distance along the normal (Evans 2006)."""
    hidden = np.zeros(p.shape[1], np.float32)
    for step, weight in ((0.06, 5.0), (0.20, 1.4)):
        free = _scene_distance(p + np.float32(step) * n)
        hidden += np.float32(weight) * np.maximum(np.float32(step) - free, 0)
    return np.clip(1 - hidden, 0.15, 1)


def _normals(solid: _Solid, p: np.ndarray) -> np.ndarray:
    """Unit normals [3, n] by central differences on the corners of a tetrahedron."""
    step = np.float32(1.5e-3)
    n = np.zeros_like(p)
    for corner in ((1, -1, -1), (-1, -1, 1), (-1, 1, -1), (1, 1, 1)):
        offset = np.asarray(corner, np.float32)[:, None]
        n += offset * solid.distance(p + step * offset)
    return n / np.maximum(_length3(n), np.float32(1e-12))


def _towards(x: float, y: float, z: float) -> np.ndarray:
    v = np.array([x, y, z])
    return (v / np.linalg.norm(v)).astype(np.float32)


_KEY = _towards(-0.55, -0.55, 0.95)
_RIM = _towards(0.70, 0.60, 0.45)
_KEY_COLOUR = np.array([[1.00], [0.93], [0.82]], np.float32) * 2.1
_RIM_COLOUR = np.array([[0.60], [0.76], [1.00]], np.float32) * 0.9


def _sky(d: np.ndarray) -> np.ndarray:
    """The studio [3, n] seen along `d`: a warm floor, a pale wall and a cool, bright ceiling."""
    up = d[2]
    ceiling = np.clip((up + np.float32(0.15)) * np.float32(1.2), 0, 1)
    ceiling = ceiling * ceiling * (3 - 2 * ceiling)
    floor = np.clip(-up * np.float32(2), 0, 1)
    return (
        _mix((0.50, 0.48, 0.50), (0.78, 0.92, 1.15), ceiling) * (1 - floor)
        + _mix((0.16, 0.14, 0.13), (0.16, 0.14, 0.13), floor) * floor
    )


def _shade(p: np.ndarray, d: np.ndarray, which: np.ndarray) -> np.ndarray:
    """Colours [3, n] in sRGB of the points `p` of the solids `which`, seen along `d`."""
    n, albedo, material = np.empty_like(p), np.empty_like(p), np.empty((4, p.shape[1]), np.float32)
    for number, solid in enumerate(_SOLIDS):
        index = np.flatnonzero(which == number)
        if len(index):
            points = p[:, index]
            n[:, index] = _normals(solid, points)
            albedo[:, index] = solid.own_colour(solid.local(points))
            material[:, index] = np.array(
                [[solid.gloss], [solid.shine], [solid.mirror], [solid.metal]], np.float32
            )
    gloss, shine, mirror, metal = material
    open_sky = _openness(p, n)
    ambient = _sky(n) * (open_sky * np.float32(0.36))
    facing = np.clip(-(d * n).sum(axis=0), 0, 1)
    fresnel = mirror + (1 - mirror) * np.float32(0.45) * (1 - facing) ** 5
    diffuse, highlight = ambient, np.zeros_like(p)
    for towards, colour, sharpness in ((_KEY, _KEY_COLOUR, 9.0), (_RIM, _RIM_COLOUR, 6.0)):
        cosine = np.clip(towards @ n, 0, 1)
        lit = np.zeros_like(cosine)
        index = np.flatnonzero(cosine > 0)
        lit[index] = _sunlight(p[:, index] + np.float32(2e-3) * n[:, index], towards, sharpness)
        diffuse = diffuse + colour * (cosine * lit * np.float32(0.42))
        middle = towards[:, None] - d
        middle /= np.maximum(_length3(middle), np.float32(1e-6))
        highlight += colour * (gloss * lit * np.clip((middle * n).sum(axis=0), 0, 1) ** shine)
    reflected = _sky(d + 2 * facing * n) * (fresnel * (0.35 + 0.65 * open_sky))
    tint = 1 + metal * (albedo - 1)
    linear = (
        albedo * diffuse * (1 - metal * np.float32(0.55)) + (reflected + highlight * np.float32(0.6)) * tint
    )
    # A shoulder instead of a clip: highlights keep their hue (Narkowicz 2015, a fit of ACES).
    x = linear * np.float32(0.82)
    mapped = np.clip(x * (2.51 * x + 0.03) / (x * (2.43 * x + 0.59) + 0.14), 0, 1)
    return np.where(mapped <= 0.0031308, 12.92 * mapped, 1.055 * mapped ** np.float32(1 / 2.4) - 0.055)


def _sample(camera: Camera, columns: np.ndarray, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Premultiplied sRGB and coverage [n, 4], distances [n] in the world, of points of the picture."""
    rgba = np.zeros((len(columns), 4), np.float32)
    distance = np.full(len(columns), np.inf, np.float32)
    origin = ((camera.c2w[:3, 3] - CENTRE) / SCALE).astype(np.float32)[:, None]
    for start in range(0, len(columns), _RAYS_AT_ONCE):
        part = slice(start, start + _RAYS_AT_ONCE)
        x = (columns[part] - camera.cx) / camera.fx
        y = -(rows[part] - camera.cy) / camera.fy
        d = camera.c2w[:3, :3] @ np.stack([x, y, -np.ones_like(x)])
        d = (d / np.linalg.norm(d, axis=0)).astype(np.float32)
        near, far = _enter(_LOW, _HIGH, origin, _inverse(d))
        rays = np.flatnonzero(near < far)
        d = d[:, rays]
        t, which = _first_hits(origin, d)
        hits = np.flatnonzero(which >= 0)
        rays, d, t = rays[hits], d[:, hits], t[hits]
        if len(rays):
            rgba[start + rays, :3] = _shade(origin + t * d, d, which[hits]).T
            rgba[start + rays, 3] = 1
            distance[start + rays] = t * np.float32(SCALE)
    return rgba, distance


def _rough(rgba: np.ndarray) -> np.ndarray:
    """The pixels [height, width] that differ from a neighbour by more than a tenth."""
    rough = np.zeros(rgba.shape[:2], bool)
    for a, b in (
        ((slice(None), slice(1, None)), (slice(None), slice(-1))),
        ((slice(1, None),), (slice(-1),)),
    ):
        differs = np.abs(rgba[a] - rgba[b]).max(axis=-1) > 0.1
        rough[a] |= differs
        rough[b] |= differs
    return rough
