"""The camera that a page begins with. `restOf` in `player/page/web/viewer/pose.js` is its twin."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from player.cameras.camera import Camera, focus_point, orbit, world_up

ON_ONE_SIDE = 0.2
"""Length of the mean of the cameras' directions from what they look at, seen from above, beyond which they
count as standing on one side."""


def rest_camera(cameras: Sequence[Camera]) -> Camera:
    """Return a level camera at the median distance and elevation of `cameras` from what they look at. Its
    direction from there is the mean of theirs if they stand on one side; it is beside the first camera if
    they stand all around. The lens is the first camera's, with its axis in the middle of the picture.

    Raises FormatError for no cameras.
    """
    (first,) = orbit(cameras, 1)
    focus, up = focus_point(cameras), world_up(cameras)
    arms = np.stack([camera.c2w[:3, 3] for camera in cameras]) - focus
    flat = arms - (arms @ up)[:, None] * up
    lengths = np.linalg.norm(flat, axis=-1, keepdims=True)
    middle = np.where(lengths > 1e-9, flat / np.maximum(lengths, 1e-9), 0).mean(axis=0)
    if np.linalg.norm(middle) > ON_ONE_SIDE:
        arm = first.c2w[:3, 3] - focus
        back = middle / np.linalg.norm(middle) * np.linalg.norm(arm - (arm @ up) * up) + (arm @ up) * up
        z = back / np.linalg.norm(back)
        right = np.cross(up, z) / np.linalg.norm(np.cross(up, z))
        c2w = np.eye(4)
        c2w[:3, :4] = np.stack([right, np.cross(z, right), z, focus + back], axis=-1)
        first = replace(first, c2w=c2w)
    return replace(first, name="rest", cx=first.width / 2, cy=first.height / 2)
