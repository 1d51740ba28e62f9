"""The cube that a scene fills, found from its cameras, and from its silhouettes where pictures have alpha."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from PIL import Image, ImageFilter

from player.cameras.camera import Camera, focus_point

N_CELLS = 64
MARGIN_CELLS = 1.5
MANY_VIEWS, MOST_BAD, BAD_SHARE = 24, 0.03, 0.1
"""With MANY_VIEWS or more, up to two of them, or MOST_BAD of them if that is more, may have been cut out
badly: a view that misses BAD_SHARE of what nearly all others show does not count. Of 30 or more good views
none was seen to miss more than 0.08. If there are fewer views, each has much to cut off by itself."""


def scene_box(
    cameras: Sequence[Camera], alphas: Sequence[np.ndarray] | None = None
) -> tuple[np.ndarray, float]:
    """Return the centre [3] and the half side of the scene's cube, in the cameras' frame.

    `cameras`: at least one. `alphas`: [height, width] each, above 0 where the picture shows something of the
    scene; None if the pictures have no alpha.

    Without silhouettes, the cube is centred where the optical axes meet, and is as large as what the cameras
    see there. With silhouettes, it is the box of the visual hull, with a margin of 1.5 cells of its grid. A
    few silhouettes of many may lack a part of the scene.

    >>> from vfr_bake.data.demo import demo_views
    >>> train, _ = demo_views(size=32, n_train=12, n_test=0)
    >>> centre, half = scene_box(train.cameras, [image[..., 3] for image in train.images])
    >>> centre.round(2).tolist(), round(half, 2)
    ([0.45, -0.29, -0.1], 1.08)
    """
    centre, half = _seen_box(cameras)
    if alphas is None:
        return centre, half
    # The second pass has smaller cells, so a tighter hull: the first box may be several times too large.
    for _ in range(2):
        kept = _visual_hull(cameras, alphas, centre, half)
        if len(kept) == 0:
            break
        cell = 2 * half / N_CELLS
        low, high = kept.min(axis=0), kept.max(axis=0)
        new_half = float((high - low).max() / 2 + (0.5 + MARGIN_CELLS) * cell)
        if new_half >= half:
            break
        centre, half = (low + high) / 2, new_half
    return centre, half


def _seen_box(cameras: Sequence[Camera]) -> tuple[np.ndarray, float]:
    centre = focus_point(cameras)
    distance = float(np.median([np.linalg.norm(camera.c2w[:3, 3] - centre) for camera in cameras]))
    tangent = float(np.median([max(c.width / c.fx, c.height / c.fy) / 2 for c in cameras]))
    half = distance * tangent
    return centre, half if half > 0 else 1.0


def _visual_hull(
    cameras: Sequence[Camera], alphas: Sequence[np.ndarray], centre: np.ndarray, half: float
) -> np.ndarray:
    """Return the centres [n, 3] of the grid cells that at least one view sees, and that lie in the silhouette
    of every view that sees them and is not cut out badly."""
    n_views = len(cameras)
    n_bad = max(2, int(MOST_BAD * n_views)) if n_views >= MANY_VIEWS else 0
    cell = 2 * half / N_CELLS
    axis = (np.arange(N_CELLS, dtype=np.float32) + 0.5) * np.float32(2 / N_CELLS) - 1
    points = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3) * np.float32(half)
    seen = np.zeros(len(points), bool)
    # The number of views that see a cell and miss it, and which these are; n_views stands for none.
    n_missed = np.zeros(len(points), np.int16)
    missed_by = np.full((n_bad + 1, len(points)), n_views, np.int16)
    # Distance from a cell's centre to its corners: a thin thing in the cell may be so far from the centre.
    reach = cell * np.sqrt(3) / 2
    for view, (camera, alpha) in enumerate(zip(cameras, alphas, strict=True)):
        rotation = camera.c2w[:3, :3]
        eye = camera.c2w[:3, 3] - centre
        near = max(float(np.linalg.norm(eye)) - half, cell)
        step = max(1, int(np.ceil(max(camera.fx, camera.fy) * reach / near)))
        mask = _dilated(alpha > 0, step)
        local = points @ rotation.astype(np.float32) - (eye @ rotation).astype(np.float32)
        depth = -local[:, 2]
        ahead = depth > cell / 2
        depth = np.where(ahead, depth, np.float32(1))
        column = np.float32(camera.fx) * local[:, 0] / depth + np.float32(camera.cx)
        row = np.float32(camera.cy) - np.float32(camera.fy) * local[:, 1] / depth
        inside = ahead & (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
        hit = np.zeros(len(points), bool)
        hit[inside] = mask[(row[inside] // step).astype(np.intp), (column[inside] // step).astype(np.intp)]
        missed = np.flatnonzero(inside & ~hit)
        missed_by[n_missed[missed], missed] = view
        n_missed[missed] += 1
        kept = n_missed <= n_bad
        points, seen = points[kept], (seen | inside)[kept]
        n_missed, missed_by = n_missed[kept], missed_by[:, kept]
        if len(points) == 0:
            break
    points, missed_by = points[seen], missed_by[:, seen]
    ignored = np.bincount(missed_by.reshape(-1), minlength=n_views + 1) >= BAD_SHARE * len(points)
    ignored[n_views] = True
    return points[ignored[missed_by].all(axis=0)].astype(np.float64) + centre


def _dilated(mask: np.ndarray, step: int) -> np.ndarray:
    """Reduce a mask to blocks of `step` pixels, true wherever the mask is true within about `step` pixels."""
    height, width = mask.shape
    rows, columns = -(-height // step), -(-width // step)
    padded = np.pad(mask, ((0, rows * step - height), (0, columns * step - width)))
    blocks = padded.reshape(rows, step, columns, step).any(axis=(1, 3))
    return np.asarray(Image.fromarray(blocks.astype(np.uint8)).filter(ImageFilter.MaxFilter(3))) > 0
