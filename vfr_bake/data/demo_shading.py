"""The lighting of the built-in scene: two lamps with soft shadows, a studio around it, and the colour of a
point.

Letters: `p` [3, n] points, `n` [3, n] unit normals and `d` [3, n] unit viewing directions, in the scene's own
frame. Highlights, reflections and the Fresnel term depend on the viewing direction. Light is linear until the
last lines of `shade`.
"""

from __future__ import annotations

import numpy as np

from vfr_bake.data.demo_solids import SOLIDS, Solid, enter, inverse, length3, mix, scene_distance


def _towards(x: float, y: float, z: float) -> np.ndarray:
    v = np.array([x, y, z])
    return (v / np.linalg.norm(v)).astype(np.float32)


_KEY = _towards(-0.55, -0.55, 0.95)
_RIM = _towards(0.70, 0.60, 0.45)
_KEY_COLOUR = np.array([[1.00], [0.93], [0.82]], np.float32) * 2.1
_RIM_COLOUR = np.array([[0.60], [0.76], [1.00]], np.float32) * 0.9


def shade(p: np.ndarray, d: np.ndarray, which: np.ndarray) -> np.ndarray:
    """Return the colours [3, n] in sRGB of the points `p` on the solids numbered `which` [n], seen along
    `d`."""
    n, albedo, material = np.empty_like(p), np.empty_like(p), np.empty((4, p.shape[1]), np.float32)
    for number, solid in enumerate(SOLIDS):
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
        middle /= np.maximum(length3(middle), np.float32(1e-6))
        highlight += colour * (gloss * lit * np.clip((middle * n).sum(axis=0), 0, 1) ** shine)
    reflected = _sky(d + 2 * facing * n) * (fresnel * (0.35 + 0.65 * open_sky))
    tint = 1 + metal * (albedo - 1)
    linear = (
        albedo * diffuse * (1 - metal * np.float32(0.55)) + (reflected + highlight * np.float32(0.6)) * tint
    )
    # A tone curve with a shoulder, instead of clipping: highlights keep their hue (Narkowicz 2015, a fit of
    # ACES).
    x = linear * np.float32(0.82)
    mapped = np.clip(x * (2.51 * x + 0.03) / (x * (2.43 * x + 0.59) + 0.14), 0, 1)
    return np.where(mapped <= 0.0031308, 12.92 * mapped, 1.055 * mapped ** np.float32(1 / 2.4) - 0.055)


def _sunlight(p: np.ndarray, towards: np.ndarray, sharpness: float) -> np.ndarray:
    """Return how much of a lamp the points `p` [3, n] see, 0 to 1. Shadows have soft edges: the narrowest
    pass of the ray by a solid, relative to the distance from `p`, decides."""
    light = np.ones(p.shape[1], np.float32)
    direction = towards[:, None]
    reciprocal = inverse(direction)
    for solid in SOLIDS[1:]:  # without the first, the plate, which lies under everything
        near, far = enter(*solid.box(0.06), p, reciprocal)
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
    """Return how much of the sky is seen, estimated from the free distance along the normal (Evans 2006)."""
    hidden = np.zeros(p.shape[1], np.float32)
    for step, weight in ((0.06, 5.0), (0.20, 1.4)):
        free = scene_distance(p + np.float32(step) * n)
        hidden += np.float32(weight) * np.maximum(np.float32(step) - free, 0)
    return np.clip(1 - hidden, 0.15, 1)


def _normals(solid: Solid, p: np.ndarray) -> np.ndarray:
    """Return unit normals [3, n], by differences between the corners of a tetrahedron around each point."""
    step = np.float32(1.5e-3)
    n = np.zeros_like(p)
    for corner in ((1, -1, -1), (-1, -1, 1), (-1, 1, -1), (1, 1, 1)):
        offset = np.asarray(corner, np.float32)[:, None]
        n += offset * solid.distance(p + step * offset)
    return n / np.maximum(length3(n), np.float32(1e-12))


def _sky(d: np.ndarray) -> np.ndarray:
    """Return the light [3, n] of the studio seen along `d`: a warm floor, a pale wall and a cool, bright
    ceiling."""
    up = d[2]
    ceiling = np.clip((up + np.float32(0.15)) * np.float32(1.2), 0, 1)
    ceiling = ceiling * ceiling * (3 - 2 * ceiling)
    floor = np.clip(-up * np.float32(2), 0, 1)
    return (
        mix((0.50, 0.48, 0.50), (0.78, 0.92, 1.15), ceiling) * (1 - floor)
        + mix((0.16, 0.14, 0.13), (0.16, 0.14, 0.13), floor) * floor
    )
