"""Three scenes in closed form that ask for different bakes: a matte ball, a glossy ball, and fog with wires.

Letters: `o` [3] and `d` [n, 3] are rays in the scene's own frame, and t distances along them. The frame is
that of the built-in scene, so that its cameras fit.
"""

from __future__ import annotations

import numpy as np
import torch

from player.cameras.camera import Camera
from vfr_bake.config import TrainConfig
from vfr_bake.data.demo import demo_cameras
from vfr_bake.data.demo_solids import CENTRE, SCALE
from vfr_bake.data.scene import Scene, build_scene
from vfr_bake.data.store.capture import Capture, PosedImages
from vfr_bake.training.model_file import Model, trained_model
from vfr_bake.training.trainer import Trainer

BALL = np.array([0.0, 0.0, -0.35])
RADIUS = 0.6
FOG = 1.3
"""Optical depth of the fog for each unit of length."""
WIRE = 0.03
WIRES = ((-0.25, 0), (0.0, 1), (0.25, 0))
"""For each wire, where it crosses the ball's middle, and the axis that it follows."""


def chord(o: np.ndarray, d: np.ndarray, centre: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the t at which rays enter and leave a ball; both are equal for rays that miss it."""
    middle = -((o - centre) * d).sum(axis=-1)
    apart = ((o - centre + middle[:, None] * d) ** 2).sum(axis=-1)
    half = np.sqrt(np.maximum(radius**2 - apart, 0))
    return middle - half, middle + half


def ball(o: np.ndarray, d: np.ndarray, glossy: bool) -> np.ndarray:
    """Return the premultiplied colour and opacity [n, 4] of a ball."""
    near, far = chord(o, d, BALL, RADIUS)
    n = (o + near[:, None] * d - BALL) / RADIUS
    if glossy:
        seen = d - 2 * (d * n).sum(axis=-1, keepdims=True) * n
        rgb = 0.5 + 0.45 * np.cos(4 * seen + np.array([0.0, 1.0, 2.0]))
    else:
        rgb = 0.5 + 0.4 * np.sin(5 * n + np.array([0.0, 1.0, 2.0]))
    return np.concatenate([rgb, np.ones((len(d), 1))], axis=-1) * (far > near)[:, None]


def fog_and_wires(o: np.ndarray, d: np.ndarray) -> np.ndarray:
    """Return the premultiplied colour and opacity [n, 4] of a ball of even fog with dark wires in it."""
    near, far = chord(o, d, BALL, RADIUS)
    end, is_wire = far.copy(), np.zeros(len(d), bool)
    for place, axis in WIRES:
        flat = [i for i in range(3) if i != axis]
        a, b = d[:, flat], (o - BALL)[flat] - np.array([place if i == 1 - axis else 0.0 for i in flat])
        square, cross = (a**2).sum(axis=-1), (a * b).sum(axis=-1)
        under = cross**2 - square * ((b**2).sum() - WIRE**2)
        t = (-cross - np.sqrt(np.maximum(under, 0))) / np.maximum(square, 1e-9)
        hit = (under > 0) & (t > near) & (t < end)
        end[hit], is_wire[hit] = t[hit], True
    fog = -np.expm1(-FOG * np.maximum(end - near, 0))
    rgb = fog[:, None] * np.array([0.85, 0.5, 0.3])
    rgb += (is_wire * (1 - fog))[:, None] * np.array([0.05, 0.1, 0.3])
    return np.concatenate([rgb, np.where(is_wire, 1.0, fog)[:, None]], axis=-1)


def picture(kind: str, camera: Camera) -> np.ndarray:
    """Return a picture [height, width, 4] uint8 with straight alpha, from four rays a pixel."""
    total = np.zeros((camera.height * camera.width, 4))
    for dx, dy in ((-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25)):
        shifted = Camera(
            camera.name, camera.c2w, camera.width, camera.height, camera.fx, camera.fy, camera.cx + dx,
            camera.cy + dy,
        )  # fmt: skip
        _, d = shifted.rays()
        o = (camera.c2w[:3, 3] - CENTRE) / SCALE
        total += (fog_and_wires(o, d) if kind == "fog" else ball(o, d, kind == "glossy")) / 4
    total[:, :3] /= np.maximum(total[:, 3:], 1e-6)
    return (total.clip(0, 1) * 255 + 0.5).astype(np.uint8).reshape(camera.height, camera.width, 4)


def analytic_scene(kind: str, size: int, n_train: int) -> Scene:
    """Return the scene "matte", "glossy" or "fog" in the model frame."""

    def views(cameras: list[Camera]) -> PosedImages:
        return PosedImages(cameras, [picture(kind, camera) for camera in cameras])

    test = demo_cameras(size, 2, phase=0.5, prefix="./test/r_")
    return build_scene(Capture(kind, views(demo_cameras(size, n_train)), views(test)))


def trained(scene: Scene, config: TrainConfig) -> Model:
    """Return the model that `vfr-train` would write, without a file in between."""
    trainer = Trainer(scene, config)
    trainer.field.head.products = torch.float32  # the same model on any machine
    for _ in trainer.run():
        pass
    return trained_model(trainer, scene, {})
