"""Measures of views that the page's viewer draws with a stub renderer, in a scene of an arc of cameras."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from playwright.sync_api import Page

from player.cameras.camera import Camera, focus_point, world_up
from tests.player.page.test_pose import RINGS, as_json, cameras
from tests.player.page.viewer_page import c2w, page_files, stub_loader

VIEWS = cameras(RINGS["an arc in front"], (1, 2, 3))
FILES = page_files(stub_loader(as_json(VIEWS)))
UP = world_up(VIEWS)
TARGET = focus_point(VIEWS)
PHONE: dict[str, Any] = {
    "viewport": {"width": 360, "height": 640},
    "device_scale_factor": 2,
    "has_touch": True,
    "is_mobile": True,
}


def distance(view: dict[str, Any]) -> float:
    return float(np.linalg.norm(c2w(view)[:3, 3] - TARGET))


def elevation(view: dict[str, Any]) -> float:
    return math.asin(c2w(view)[:3, 2] @ UP)


def azimuth(one: dict[str, Any], two: dict[str, Any]) -> float:
    """Return the angle, in radians, from the first to the second camera around the world's up."""
    a, b = (back - (back @ UP) * UP for back in (c2w(one)[:3, 2], c2w(two)[:3, 2]))
    return math.atan2(np.cross(a, b) @ UP, a @ b)


def pixel(view: dict[str, Any], point: np.ndarray) -> np.ndarray:
    """Return the place [2] of a world point in the picture, in pixels from its upper left corner."""
    x, y, z = np.linalg.inv(c2w(view))[:3] @ [*point, 1]
    return np.array([view["cx"] + view["fx"] * x / -z, view["cy"] - view["fy"] * y / -z])


def matches(view: dict[str, Any], camera: Camera) -> bool:
    return bool(np.abs(c2w(view) - camera.c2w).max() < 1e-6)


def drag(page: Page, dx: int, dy: int, button: Any = "left") -> None:
    page.mouse.move(300, 200)
    page.mouse.down(button=button)
    page.mouse.move(300 + dx, 200 + dy, steps=5)
    page.mouse.up(button=button)


def height(page: Page) -> int:
    return page.evaluate("() => document.getElementById('canvas').clientHeight")
