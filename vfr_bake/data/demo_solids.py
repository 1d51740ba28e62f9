"""The solids of the built-in scene: their distance functions, their colours and their positions.

Letters: `p` [3, n] are points in the scene's own frame, where its box is about [-1, 1]³. The world frame
differs from it by `CENTRE` and `SCALE`, which are on purpose neither 0 nor 1. Vectors are stored component
first, because numpy is faster that way. The distance functions (Quilez, "Distance functions", 2008) are exact
outside the solid.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

CENTRE = np.array([0.3, -0.2, 0.5])
SCALE = 0.8
WIRE_RADIUS = 0.02
"""World units, like the radii of the ball and of the hole below."""

BALL_CENTRE = CENTRE + SCALE * np.array([-0.42, -0.30, -0.28])
BALL_RADIUS = SCALE * 0.32
HOLE_CENTRE = CENTRE + SCALE * np.array([0.14, 0.44, -0.20])
HOLE_RADIUS = SCALE * 0.22
HOLE_ANGLE = 0.35
"""Angle of the slab about z, in radians; at 0 one would look through the hole along y."""

Distance = Callable[[np.ndarray], np.ndarray]
Colour = Callable[[np.ndarray], np.ndarray]


# --- distance functions of p [3, n] in the solid's own frame ---


def _rotated(p: np.ndarray, angle: float) -> np.ndarray:
    """Turn `p` about z by minus `angle`, into the frame in which a solid that is turned by `angle` stands
    straight."""
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


def length3(p: np.ndarray) -> np.ndarray:
    """Return the lengths [n] of `p` [3, n], in its dtype."""
    return np.sqrt(p[0] * p[0] + p[1] * p[1] + p[2] * p[2])


def _box(p: np.ndarray, half: tuple[float, float, float], rounding: float) -> np.ndarray:
    x, y, z = (np.abs(p[i]) - p.dtype.type(half[i] - rounding) for i in range(3))
    zero = p.dtype.type(0)
    outside = np.sqrt(np.maximum(x, zero) ** 2 + np.maximum(y, zero) ** 2 + np.maximum(z, zero) ** 2)
    return outside + np.minimum(np.maximum(x, np.maximum(y, z)), zero) - p.dtype.type(rounding)


def _pierced_slab(p: np.ndarray, half: tuple[float, float, float], hole: float) -> np.ndarray:
    """Return the distances [n] to a box with a round hole along y; exact, because the hole stays clear of the
    sides."""
    zero = p.dtype.type(0)
    x, z = np.abs(p[0]) - p.dtype.type(half[0]), np.abs(p[2]) - p.dtype.type(half[2])
    square = np.sqrt(np.maximum(x, zero) ** 2 + np.maximum(z, zero) ** 2) + np.minimum(np.maximum(x, z), zero)
    flat = np.maximum(square, p.dtype.type(hole) - _length2(p[0], p[2]))
    thick = np.abs(p[1]) - p.dtype.type(half[1])
    outside = np.sqrt(np.maximum(flat, zero) ** 2 + np.maximum(thick, zero) ** 2)
    return outside + np.minimum(np.maximum(flat, thick), zero)


def _arch(p: np.ndarray, radius: float, tube: float) -> np.ndarray:
    """Return the distances [n] to the upper half of a ring in the plane y = 0, with round ends."""
    ring = _length2(_length2(p[0], p[2]) - p.dtype.type(radius), p[1])
    x = np.abs(p[0]) - p.dtype.type(radius)
    ends = np.sqrt(x * x + p[1] * p[1] + p[2] * p[2])
    return np.where(p[2] >= 0, ring, ends) - p.dtype.type(tube)


def _ring(p: np.ndarray, radius: float, tube: float) -> np.ndarray:
    return _length2(_length2(p[0], p[1]) - p.dtype.type(radius), p[2]) - p.dtype.type(tube)


# --- colours: linear reflectance [3, n] of the same p ---


def mix(a: tuple[float, float, float], b: tuple[float, float, float], weight: np.ndarray) -> np.ndarray:
    """Return colours [3, n] interpolated from `a`, where `weight` [n] is 0, to `b`, where it is 1."""
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
    return mix((0.74, 0.68, 0.58), (0.07, 0.11, 0.20), _checker(p[0], p[1], tile=0.2377))


def _cube_colour(p: np.ndarray) -> np.ndarray:
    return mix((0.90, 0.27, 0.02), (0.90, 0.80, 0.58), _checker(*(p + p.dtype.type(0.235)), tile=0.1567))


def _slab_colour(p: np.ndarray) -> np.ndarray:
    wave = np.sin(24 * (p[0] + np.float32(0.12) * np.sin(9 * p[2])))
    return mix((0.01, 0.24, 0.30), (0.30, 0.78, 0.66), _stripes(3 * wave, p.dtype))


def _ring_colour(p: np.ndarray) -> np.ndarray:
    wave = np.sin(8 * np.arctan2(p[1], p[0]))
    return mix((0.30, 0.08, 0.55), (0.85, 0.65, 0.95), _stripes(4 * wave, p.dtype))


def _plain(r: float, g: float, b: float) -> Colour:
    return lambda p: np.repeat(np.asarray([[r], [g], [b]], p.dtype), p.shape[1], axis=1)


@dataclass(frozen=True)
class Solid:
    """A shape and its material. Attributes whose names begin with `own` describe the solid before it is
    turned about z by `angle` and moved to `centre`."""

    centre: tuple[float, float, float]
    angle: float
    own_half: tuple[float, float, float]
    """Half sides of the bounding box before the turn. The arch's box is larger than it, because the arch's
    centre is at its foot."""
    own_distance: Distance
    own_colour: Colour
    gloss: float
    """Strength of the highlight."""
    shine: float
    """Exponent of the highlight."""
    mirror: float
    """Share of the sky's light that is reflected when the surface is seen head on."""
    metal: bool = False
    """Whether reflections take the solid's colour."""

    def local(self, p: np.ndarray) -> np.ndarray:
        """Return points [3, n] of the scene's frame in the solid's own frame."""
        return self.turned(_moved(p, self.centre))

    def turned(self, d: np.ndarray) -> np.ndarray:
        """Return directions [3, n] of the scene's frame in the solid's own frame."""
        return _rotated(d, self.angle) if self.angle else d

    def distance(self, p: np.ndarray) -> np.ndarray:
        """Return the distances [n] from the solid to points [3, n] of the scene's frame."""
        return self.own_distance(self.local(p))

    def box(self, grow: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the low and the high corner [3] of the solid's bounding box, along the axes of the scene,
        `grow` larger on every side."""
        c, s = abs(np.cos(self.angle)), abs(np.sin(self.angle))
        x, y, z = self.own_half
        half = np.array([x * c + y * s, x * s + y * c, z]) + grow
        return np.array(self.centre) - half, np.array(self.centre) + half


def _scene() -> list[Solid]:
    def own(centre: np.ndarray) -> tuple[float, float, float]:
        x, y, z = (centre - CENTRE) / SCALE
        return (float(x), float(y), float(z))

    ball, hole, wire = BALL_RADIUS / SCALE, HOLE_RADIUS / SCALE, WIRE_RADIUS / SCALE
    plate, cube, slab = (0.95, 0.95, 0.05), (0.23, 0.23, 0.23), (0.44, 0.06, 0.40)
    return [
        Solid((0, 0, -0.65), 0, plate, lambda p: _box(p, plate, 0.03), _plate_colour, 0.10, 30, 0.015),
        Solid(
            own(BALL_CENTRE), 0, (ball, ball, ball),
            lambda p: length3(p) - p.dtype.type(ball), _plain(0.55, 0.008, 0.02), 1.3, 90, 0.035,
        ),
        Solid(
            (0.44, -0.40, -0.37), 0.45, cube,
            lambda p: _box(p, cube, 0.02), _cube_colour, 0.15, 30, 0.03,
        ),
        Solid(
            own(HOLE_CENTRE), HOLE_ANGLE, slab,
            lambda p: _pierced_slab(p, slab, hole), _slab_colour, 0.35, 40, 0.04,
        ),
        Solid(
            (0, 0.07, -0.6), -0.06, (0.86 + wire, wire, 0.86 + wire),
            lambda p: _arch(p, 0.86, wire), _plain(0.90, 0.45, 0.12), 0.7, 40, 0.3, True,
        ),
        Solid(
            (0.02, -0.70, -0.46), 0, (0.14, 0.14, 0.14),
            lambda p: length3(p) - p.dtype.type(0.14), _plain(0.95, 0.52, 0.10), 1.0, 60, 0.5, True,
        ),
        Solid(
            (-0.60, 0.56, -0.53), 0, (0.27, 0.27, 0.07),
            lambda p: _ring(p, 0.20, 0.07), _ring_colour, 0.6, 50, 0.05,
        ),
    ]  # fmt: skip


SOLIDS = _scene()
LOW = np.array([-0.95, -0.95, -0.70])
HIGH = np.array([0.95, 0.95, -0.6 + 0.86 + WIRE_RADIUS / SCALE])


def scene_distance(p: np.ndarray) -> np.ndarray:
    """Return the distances [n] from points `p` [3, n] to the nearest solid, in the scene's units."""
    distance = SOLIDS[0].distance(p)
    for solid in SOLIDS[1:]:
        np.minimum(distance, solid.distance(p), out=distance)
    return distance


# --- rays and boxes ---


def enter(
    low: np.ndarray, high: np.ndarray, origin: np.ndarray, reciprocal: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the t at which rays enter and leave the box from `low` [3] to `high` [3]; near > far if they
    miss it.

    `origin` [3, 1] or [3, n]; `reciprocal`: the `inverse` of the rays' directions.
    """
    near = np.zeros(1, np.float32)
    far = np.full(1, np.inf, np.float32)
    for axis in range(3):
        a = (np.float32(low[axis]) - origin[axis]) * reciprocal[axis]
        b = (np.float32(high[axis]) - origin[axis]) * reciprocal[axis]
        near = np.maximum(near, np.minimum(a, b))
        far = np.minimum(far, np.maximum(a, b))
    return near, far


def inverse(direction: np.ndarray) -> np.ndarray:
    """Return 1 / direction, made finite: a component that is nearly zero counts as a tiny one."""
    tiny = np.float32(1e-9)
    return 1 / np.where(np.abs(direction) < tiny, tiny, direction)
