"""The built-in scene: analytic solids of known geometry and size, ray traced in seconds.

A checkered plate carries a glossy ball, a textured cube, a slab with a hole through it, a golden ball, a ring
and a thin wire arch. The solids are defined in `demo_solids`, and their lighting in `demo_shading`.

The world frame differs from the scene's own frame, where its box is about [-1, 1]³, by `CENTRE` and `SCALE`.
Vectors in the scene's own frame are stored component first, [3, n].
"""

from __future__ import annotations

import numpy as np

from player.cameras.camera import Camera
from player.progress import Progress
from vfr_bake.data.demo_shading import shade
from vfr_bake.data.demo_solids import CENTRE, HIGH, LOW, SCALE, SOLIDS, enter, inverse
from vfr_bake.data.scene import Scene, build_scene
from vfr_bake.data.store.capture import Capture, PosedImages
from vfr_bake.data.threads import in_threads

_MAX_ROUNDS = 32
_SKIN = 1e-5
_PRECISION = 1e-4
_RAYS_AT_ONCE = 65536


def trace(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Ray trace one view; pixels at edges and texture borders are sampled 2 x 2 times.

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
    # Colours are premultiplied until the end, so that in the mean of samples each counts by its coverage.
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
    """Place cameras around the scene, world frame: most above it, a few a little below the plate.

    They follow a Fibonacci spiral from above to below. Another `phase`, as a fraction of the angle from one
    camera to the next, gives other views.

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
    progress: Progress | None = None,
) -> tuple[PosedImages, PosedImages]:
    """Return training and test pictures of `size` x `size` pixels, with their cameras in the world frame.

    >>> train, test = demo_views(size=8, n_train=2, n_test=1)
    >>> len(train.images), train.images[0].shape, len(test.cameras)
    (2, (8, 8, 4), 1)
    """
    train = demo_cameras(size, n_train)
    test = demo_cameras(size, n_test, phase=0.5, prefix="./test/r_")
    cameras = train + test

    def picture(camera: Camera) -> np.ndarray:
        return (trace(camera)[0] * 255 + 0.5).astype(np.uint8)

    images = in_threads(picture, cameras, progress)
    return PosedImages(train, images[:n_train]), PosedImages(test, images[n_train:])


def demo_capture(
    size: int = 256,
    n_train: int = 64,
    n_test: int = 16,
    progress: Progress | None = None,
) -> Capture:
    """Return the built-in scene as a data set would give it, in the world frame.

    >>> demo_capture(size=16, n_train=6, n_test=1).name
    'demo'
    """
    return Capture("demo", *demo_views(size, n_train, n_test, progress))


def demo_scene(size: int = 256, n_train: int = 64, n_test: int = 16) -> Scene:
    """Return the built-in scene in the model frame. Its box is found from the pictures, like any other
    scene's.

    >>> demo_scene(size=16, n_train=6, n_test=1).has_alpha
    True
    """
    return build_scene(demo_capture(size, n_train, n_test))


def _sample(camera: Camera, columns: np.ndarray, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return premultiplied sRGB and coverage [n, 4], and distances [n] in world units, at points of the
    picture."""
    rgba = np.zeros((len(columns), 4), np.float32)
    distance = np.full(len(columns), np.inf, np.float32)
    origin = ((camera.c2w[:3, 3] - CENTRE) / SCALE).astype(np.float32)[:, None]
    for start in range(0, len(columns), _RAYS_AT_ONCE):
        part = slice(start, start + _RAYS_AT_ONCE)
        x = (columns[part] - camera.cx) / camera.fx
        y = -(rows[part] - camera.cy) / camera.fy
        d = camera.c2w[:3, :3] @ np.stack([x, y, -np.ones_like(x)])
        d = (d / np.linalg.norm(d, axis=0)).astype(np.float32)
        near, far = enter(LOW, HIGH, origin, inverse(d))
        rays = np.flatnonzero(near < far)
        d = d[:, rays]
        t, which = _first_hits(origin, d)
        hits = np.flatnonzero(which >= 0)
        rays, d, t = rays[hits], d[:, hits], t[hits]
        if len(rays):
            rgba[start + rays, :3] = shade(origin + t * d, d, which[hits]).T
            rgba[start + rays, 3] = 1
            distance[start + rays] = t * np.float32(SCALE)
    return rgba, distance


def _first_hits(origin: np.ndarray, direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Find t [n] (infinite where nothing is hit) and the number of the solid [n] (-1 there) by sphere
    tracing, solid after solid.

    `origin` [3, 1], `direction` [3, n], float32. A ray that still grazes a solid when its steps run out
    misses it.
    """
    n = direction.shape[1]
    t = np.full(n, np.inf, np.float32)
    which = np.full(n, -1, np.int8)
    reciprocal = inverse(direction)
    for number, solid in enumerate(SOLIDS):
        near, far = enter(*solid.box(_SKIN), origin, reciprocal)
        far = np.minimum(far, t)
        index = np.flatnonzero(near < far)
        o, d = solid.local(origin), solid.turned(direction[:, index])
        here, end = near[index], far[index]
        if solid.angle:
            # The box in the solid's own frame fits a flat side exactly. A march along that side would take
            # endless steps, and ends at once if the ray is clipped to this box.
            half = np.array(solid.own_half) + _SKIN
            near, far = enter(-half, half, o, inverse(d))
            near = np.maximum(near, here)
            met = near < np.minimum(far, end)
            index, here, end, d = index[met], near[met], end[met], d[:, met]
        for _ in range(_MAX_ROUNDS):
            if not len(index):
                break
            # Dropping rays that have ended costs as much as a step, so it is done after every third. Further
            # steps do a ray that has arrived no harm.
            for _ in range(3):
                h = solid.own_distance(o + here * d)
                here = here + h
            hit = (h < _PRECISION) & (here < end)
            t[index[hit]] = here[hit]
            which[index[hit]] = number
            going = (h >= _PRECISION) & (here < end)
            index, here, end, d = index[going], here[going], end[going], d[:, going]
    return t, which


def _rough(rgba: np.ndarray) -> np.ndarray:
    """Return a mask [height, width] of the pixels that differ from a neighbour by more than a tenth."""
    rough = np.zeros(rgba.shape[:2], bool)
    for a, b in (
        ((slice(None), slice(1, None)), (slice(None), slice(-1))),
        ((slice(1, None),), (slice(-1),)),
    ):
        differs = np.abs(rgba[a] - rgba[b]).max(axis=-1) > 0.1
        rough[a] |= differs
        rough[b] |= differs
    return rough
