"""Evaluation of the full model against photographs, over the model's own background.

If the exposure of a capture changes, the exposure of a view that was not learned from is unknown. It is then
fitted on the left half of the view (`vfr_bake.training.captures`), and only the right half is scored, as is
usual since Martin-Brualla et al., "NeRF in the wild", 2021.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from player.progress import Progress
from vfr_bake.data.scene import Scene, evenly
from vfr_bake.data.store.capture import PosedImages
from vfr_bake.data.view_pixels import ViewPixels
from vfr_bake.rendering.render import render_camera, render_rays
from vfr_bake.training.captures.picture_colours import fitted
from vfr_bake.training.model_file import Model
from vfr_bake.training.scores.metrics import Distance, ViewScore, decibels, over_background, score_view
from vfr_bake.training.scores.views import hidden_lines, seen_views, spread_order


@dataclass(frozen=True)
class RenderedView:
    """The full model's picture of a view, and the photograph."""

    name: str
    """Name of the camera."""
    rgb: np.ndarray
    """[height, width, 3] float32 in [0, 1], over the background, not rounded."""
    photograph: np.ndarray
    """[height, width, 3] float32 in [0, 1], over the same background; equal to `rgb` where it is masked."""
    seen: np.ndarray | None = None
    """[height, width] bool: the pixels that are not masked; None for all."""
    first_column: int = 0
    """First column that is scored; on the columns before it the exposure was fitted."""

    def score(self, lpips: Distance | None = None) -> ViewScore:
        """Return the scores of the columns from `first_column` on; with `lpips`, that distance as well."""
        scored = np.s_[:, self.first_column :]
        seen = None if self.seen is None else self.seen[scored]
        return score_view(self.name, self.rgb[scored], self.photograph[scored], lpips, seen)


def render_views(
    model: Model, views: PosedImages, chosen: Iterable[int] | None = None, masked: bool = False
) -> Iterator[RenderedView]:
    """Render views (model frame) with the full model: those with the numbers `chosen`, or all.

    `masked`: whether pixels that are not opaque are masked.
    """
    for index in range(len(views.cameras)) if chosen is None else chosen:
        camera, rgba = views.cameras[index], views.images[int(index)]
        colours, opacity = render_camera(model.field, model.sampler, camera)
        rgb = colours + (1 - opacity[:, None]) * model.background
        rendered = rgb.reshape(camera.height, camera.width, 3), opacity
        exposure = model.exposure is not None
        yield beside_photograph(camera.name, *rendered, rgba, model.background, exposure, masked)


def beside_photograph(
    name: str,
    rgb: np.ndarray,
    opacity: np.ndarray,
    rgba: np.ndarray,
    background: np.ndarray,
    exposure: bool,
    masked: bool,
) -> RenderedView:
    """Return a picture and its photograph as they are compared.

    Args:
        name: name of the camera.
        rgb: [height, width, 3] in [0, 1], over the background.
        opacity: [n_pixels].
        rgba: [height, width, 4] uint8, the photograph.
        background: [3] in [0, 1].
        exposure: whether the exposure is to be fitted on the left half.
        masked: whether pixels that are not opaque are masked.
    """
    first_column = 0
    if exposure:
        width = rgba.shape[1]
        first_column = width // 2
        behind = (1 - opacity[:, None]) * background
        colours = rgb.reshape(-1, 3) - behind
        learned = np.arange(len(opacity)) % width < first_column
        left = np.flatnonzero(learned & (rgba[..., 3].reshape(-1) == 255) if masked else learned)
        gains, offsets = fitted(colours[left], opacity[left], rgba.reshape(-1, 4)[left])
        colours = (colours * gains + opacity[:, None] * offsets).clip(0, opacity[:, None])
        rgb = (colours + behind).reshape(rgb.shape)
    photograph, seen = over_background(rgba, background), None
    if masked:
        seen = rgba[..., 3] == 255
        photograph = np.where(seen[..., None], photograph, rgb)
    return RenderedView(name, rgb, photograph, seen, first_column)


def training_psnr(model: Model, pixels: ViewPixels) -> float | None:
    """Return the PSNR in dB of the model's colours at `pixels` of the pictures that it was trained on; None
    if there are none, or it has no bound."""
    wanted = over_background(model.neutral(pixels).rgba, model.background)
    colours, opacity = render_rays(model.field, model.sampler, *model.rays(pixels))
    errors = colours + (1 - opacity[:, None]) * model.background - wanted
    error = float((errors**2).sum()) / max(errors.size, 1)
    return decibels(error) if error > 0 else None


def quick_psnr(
    model: Model, scene: Scene, n_views: int, most_seconds: float, progress: Progress
) -> tuple[list[float], list[str]]:
    """Return the PSNR of `n_views` test views, spread evenly, and lines to print. No further view is begun
    that is not likely to end within `most_seconds`; one is always scored if something is seen in any.

    `progress`: called with the numbers of views done and to do.
    """
    views, hidden = seen_views(scene.test, scene.masked, model.exposure is not None)
    some = evenly(len(views.cameras), n_views)
    lines, scores = hidden_lines(hidden), []
    begin = time.monotonic()
    for view in render_views(model, views, some[spread_order(len(some))], scene.masked):
        scores.append(view.score().psnr)
        progress(len(scores), len(some))
        seconds = time.monotonic() - begin
        if len(scores) < len(some) and seconds * (len(scores) + 1) / len(scores) > most_seconds:
            lines.append(
                f"scored {len(scores)} of {len(some)} test views, because one takes "
                f"{seconds / len(scores) / 60:.1f} minutes: vfr-eval scores all"
            )
            break
    return scores, lines
