"""Pinhole cameras, their rays, and an orbit around the point that a set of cameras looks at.

Conventions: `c2w` [4, 4] maps camera to world, OpenGL/Blender axes (x right, y up, the camera looks along
-z). Pixel (column i, row j) has its centre at (i + 0.5, j + 0.5); `fx fy cx cy` are in pixels. `rays_d` has
unit length, so `t` is a distance in scene units.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from player.errors import FormatError
from player.files.json_files import brief


@dataclass(frozen=True)
class Camera:
    """One pinhole camera. Raises FormatError for values that no pinhole camera has.

    >>> camera = Camera("front", np.eye(4), width=2, height=2, fx=1.0, fy=1.0, cx=1.0, cy=1.0)
    >>> rays_o, rays_d = camera.rays()
    >>> rays_d.shape, bool(np.allclose(np.linalg.norm(rays_d, axis=-1), 1))
    ((4, 3), True)
    """

    name: str
    """The picture's path as the data set writes it, for example `./test/r_0`."""
    c2w: np.ndarray
    """[4, 4] float64, camera to world, rigid: a copy of what was given, and read-only."""
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float

    def __post_init__(self) -> None:
        for key, (convert, expected) in _CONVERSIONS.items():
            value = getattr(self, key)
            try:
                converted = convert(value)
            except (TypeError, ValueError, OverflowError):
                raise FormatError(f"{self.name}: {key}: expected {expected}, got {brief(value)}") from None
            object.__setattr__(self, key, converted)
        check_pose(self.c2w, self.name)
        if self.width < 1 or self.height < 1:
            raise FormatError(f"{self.name}: size: expected at least 1x1, got {self.width}x{self.height}")
        for key in ("fx", "fy"):
            if not (np.isfinite(getattr(self, key)) and getattr(self, key) > 0):
                raise FormatError(
                    f"{self.name}: {key}: expected a positive focal length, got {getattr(self, key)}"
                )
        if not np.isfinite([self.cx, self.cy]).all():
            raise FormatError(f"{self.name}: cx, cy: expected finite numbers, got {self.cx}, {self.cy}")

    def _values(self) -> tuple[object, ...]:
        lens = self.width, self.height, self.fx, self.fy, self.cx, self.cy
        return self.name, *lens, *self.c2w.ravel().tolist()

    def __eq__(self, other: object) -> bool:
        return self._values() == other._values() if isinstance(other, Camera) else NotImplemented

    def __hash__(self) -> int:
        return hash(self._values())

    def resized(self, width: int, height: int) -> Camera:
        """Return the same view on a grid of `width` x `height` pixels."""
        sx, sy = width / self.width, height / self.height
        return replace(
            self,
            width=width,
            height=height,
            fx=self.fx * sx,
            fy=self.fy * sy,
            cx=self.cx * sx,
            cy=self.cy * sy,
        )

    def fitted(self, width: int, height: int) -> Camera:
        """Return the view on a grid of `width` x `height` pixels that keep their shape: nothing is lost, and
        a grid of another aspect ratio shows more at two sides. With the same aspect ratio, of which one side
        may be rounded to whole pixels, this is `resized`.

        >>> square = Camera("a", np.eye(4), 400, 400, 500.0, 500.0, 200.0, 200.0)
        >>> wide = square.fitted(1600, 800)
        >>> wide.fx, wide.fy, wide.cx, wide.cy
        (1000.0, 1000.0, 800.0, 400.0)
        """
        if 2 * abs(width * self.height - height * self.width) <= max(self.width, self.height):
            return self.resized(width, height)
        return _fitted(self, width, height)

    def at_most(self, longest: int) -> Camera:
        """Return the same view with at most `longest` pixels along each side: this camera itself if it has no
        more.

        >>> small = Camera("a", np.eye(4), 1600, 1200, 800.0, 800.0, 800.0, 600.0).at_most(640)
        >>> small.width, small.height, small.fx
        (640, 480, 320.0)
        """
        share = longest / max(self.width, self.height)
        return self if share >= 1 else self.scaled(share)

    def scaled(self, share: float) -> Camera:
        """Return the same view with `share` times as many pixels along each side, but at least one."""
        return self.resized(max(round(self.width * share), 1), max(round(self.height * share), 1))

    def transformed(self, matrix: np.ndarray) -> Camera:
        """Return the camera in another frame; `matrix` [4, 4] is a similarity (rotation, uniform scale,
        translation).
        """
        scale = np.cbrt(np.linalg.det(matrix[:3, :3]))
        c2w = matrix @ self.c2w
        c2w[:3, :3] /= scale
        return replace(self, c2w=c2w)

    def rays(self) -> tuple[np.ndarray, np.ndarray]:
        """Make rays through the centres of all pixels in row-major order.

        Returns `rays_o`, `rays_d` [n_rays, 3] float32, `rays_d` of unit length.
        """
        return self.rays_through(np.arange(self.width * self.height))

    def rays_through(self, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Make rays through the centres of `pixels` [n], numbers in row-major order, in the form that `rays`
        returns.

        >>> camera = Camera("a", np.eye(4), 4, 3, 5.0, 5.0, 2.0, 1.5)
        >>> bool(np.allclose(camera.rays_through(np.array([7, 2]))[1], camera.rays()[1][[7, 2]], atol=1e-7))
        True
        """
        rows, columns = np.divmod(pixels, self.width)
        x = (columns + 0.5 - self.cx) / self.fx
        y = -(rows + 0.5 - self.cy) / self.fy
        rays_d = np.stack([x, y, -np.ones_like(x)], axis=-1) @ self.c2w[:3, :3].T
        rays_d /= np.linalg.norm(rays_d, axis=-1, keepdims=True)
        rays_o = np.broadcast_to(self.c2w[:3, 3], rays_d.shape)
        return rays_o.astype(np.float32, order="C"), rays_d.astype(np.float32)


def _own_pose(c2w: object) -> np.ndarray:
    own = np.array(c2w, np.float64)
    own.flags.writeable = False
    return own


def _whole(number: Any) -> int:
    if number != int(number):
        raise ValueError(number)
    return int(number)


_CONVERSIONS: dict[str, tuple[Callable[[Any], object], str]] = {
    "c2w": (_own_pose, "4 rows of 4 numbers"),
    **dict.fromkeys(("width", "height"), (_whole, "a whole number")),
    **dict.fromkeys(("fx", "fy", "cx", "cy"), (float, "a number")),
}
"""What a camera makes of what it is given, which may be a list or numbers of numpy: a copy, and numbers that
can be written as JSON. With each, what is expected."""


def check_pose(c2w: np.ndarray, where: str, what: str = "camera matrix") -> None:
    """Raise FormatError unless `c2w` [4, 4] is finite and rigid (right-handed, orthonormal within 1e-3); the
    message calls it `what`."""
    if c2w.shape != (4, 4):
        raise FormatError(f"{where}: {what}: expected 4 rows of 4 numbers, got shape {list(c2w.shape)}")
    rotation = c2w[:3, :3]
    rigid = (
        np.isfinite(c2w).all()
        and np.abs(c2w).max() <= 1e12  # further away, float32 rays are too coarse, and squares overflow
        and np.allclose(c2w[3], [0, 0, 0, 1], atol=1e-6)
        and np.allclose(rotation.T @ rotation, np.eye(3), atol=1e-3)
        and np.linalg.det(rotation) > 0
    )
    if not rigid:
        raise FormatError(f"{where}: {what}: expected a rotation and a translation, got {c2w.tolist()}")


def focus_point(cameras: Sequence[Camera]) -> np.ndarray:
    """Return the point [3] that is nearest to all optical axes, in the least-squares sense.

    Where the axes do not determine a point (they are parallel, or there is one camera), or meet behind the
    cameras, the point is ahead of the mean camera, at a distance equal to the spread of the cameras.

    >>> pose = np.eye(4)
    >>> pose[:3, 3] = 0, 0, 4
    >>> side = np.array([[0.0, 0, 1, 4], [0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 0, 1]])
    >>> cameras = [Camera(name, m, 1, 1, 1.0, 1.0, 0.5, 0.5) for name, m in [("front", pose), ("side", side)]]
    >>> bool(np.allclose(focus_point(cameras), 0, atol=1e-4))
    True
    """
    c2w = np.stack([camera.c2w for camera in cameras])
    origins = c2w[:, :3, 3]
    forwards = -c2w[:, :3, 2] / np.linalg.norm(c2w[:, :3, 2], axis=-1, keepdims=True)
    middle = origins.mean(axis=0)
    spread = float(np.sqrt(((origins - middle) ** 2).sum(axis=-1).mean()))
    # Positions are in units of the cameras' spread around their mean, so that the solution does not depend on
    # the scene's unit and origin.
    unit = spread if spread > 0 else 1.0
    ahead = _unit(forwards.mean(axis=0), np.zeros(3))
    across = np.eye(3) - forwards[:, :, None] * forwards[:, None, :]
    a = across.mean(axis=0)
    b = (across @ ((origins - middle) / unit)[:, :, None]).mean(axis=0)[:, 0]
    # The weight of the point ahead is far below what axes one degree apart determine (eigenvalue 1e-4), and
    # far above rounding errors.
    weight = 1e-7
    point = np.linalg.solve(a + weight * np.eye(3), b + weight * ahead)
    in_front = np.median(((point - (origins - middle) / unit) * forwards).sum(axis=-1)) > -1e-6
    return middle + unit * (point if in_front else ahead)


def orbit(cameras: Sequence[Camera], n_frames: int, size: tuple[int, int] | None = None) -> list[Camera]:
    """Return views in a circle around what `cameras` look at, at their median distance and elevation,
    beginning beside the first camera.

    `n_frames`: number of views, in equal steps. `size`: (width, height) of the pictures; the first camera's
    field of view is kept as large as fits, with its pixel shape. Raises FormatError for no cameras or no
    frames.

    >>> pose = np.eye(4)
    >>> pose[:3, 3] = 0, 0, 4
    >>> turn = orbit([Camera("a", pose, 8, 6, 9.0, 9.0, 4.0, 3.0)], 3, size=(4, 3))
    >>> [(c.name, c.width, c.fx) for c in turn]
    [('orbit_000', 4, 4.5), ('orbit_001', 4, 4.5), ('orbit_002', 4, 4.5)]
    """
    if not cameras:
        raise FormatError("orbit: cameras: expected at least one, got none")
    if n_frames < 1:
        raise FormatError(f"orbit: frames: expected at least 1, got {n_frames}")
    focus = focus_point(cameras)
    up = world_up(cameras)
    arms = np.stack([camera.c2w[:3, 3] for camera in cameras]) - focus
    radii = np.linalg.norm(arms, axis=-1)
    radius = float(np.median(radii))
    sines = arms @ up / np.maximum(radii, 1e-12)
    limit = np.deg2rad(85)  # straight above, left and right are undefined
    elevation = float(np.clip(np.median(np.arcsin(np.clip(sines, -1, 1))), -limit, limit))
    start = _unit(arms[0] - (arms[0] @ up) * up, np.cross(up, np.eye(3)[np.argmin(np.abs(up))]))
    left = np.cross(up, start)
    first = cameras[0] if size is None else _fitted(cameras[0], *size)
    n_digits = max(3, len(str(n_frames - 1)))  # the names sort as the views do
    views = []
    for index in range(n_frames):
        azimuth = 2 * np.pi * index / n_frames
        level = np.cos(azimuth) * start + np.sin(azimuth) * left
        back = np.cos(elevation) * level + np.sin(elevation) * up
        right = _unit(np.cross(up, back), left)
        c2w = np.eye(4)
        c2w[:3, :4] = np.stack([right, np.cross(back, right), back, focus + radius * back], axis=-1)
        views.append(replace(first, name=f"orbit_{index:0{n_digits}d}", c2w=c2w))
    return views


def world_up(cameras: Sequence[Camera]) -> np.ndarray:
    """Estimate the world's up direction [3], of unit length.

    Cameras are rarely tilted sideways for long. So up is the direction most nearly at right angles to the
    cameras' right-hand directions. Where these do not determine it, up is the mean of the cameras' own up
    directions, which leans when all cameras stand on one side.
    """
    c2w = np.stack([camera.c2w for camera in cameras])
    rights, ups = c2w[:, :3, 0], c2w[:, :3, 1]
    mean = _unit(ups.mean(axis=0), ups[0])
    spread = rights.T @ rights / len(rights)
    weight = 1e-3  # as much as right-hand directions that vary by two degrees count
    return _unit(np.linalg.solve(spread + weight * np.eye(3), weight * mean), mean)


def _unit(vector: np.ndarray, otherwise: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(vector)
    if length > 1e-9:
        return vector / length
    length = np.linalg.norm(otherwise)
    return otherwise / length if length > 0 else otherwise


def _fitted(camera: Camera, width: int, height: int) -> Camera:
    scale = min(width / camera.width, height / camera.height)
    return replace(
        camera,
        width=width,
        height=height,
        fx=camera.fx * scale,
        fy=camera.fy * scale,
        cx=width / 2 + (camera.cx - camera.width / 2) * scale,
        cy=height / 2 + (camera.cy - camera.height / 2) * scale,
    )
