"""The full model against photographs, over its own background."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from vfr_bake.data.capture import PosedImages
from vfr_bake.rendering.render import render_image
from vfr_bake.training.metrics import Distance, ViewScore, over_background, score_view
from vfr_bake.training.model_file import Model


@dataclass(frozen=True)
class RenderedView:
    """The full model's picture of a view, and the photograph."""

    name: str
    """The camera's."""
    rgb: np.ndarray
    """[height, width, 3] float32 in [0, 1], over the background, not rounded."""
    photograph: np.ndarray
    """[height, width, 3] float32 in [0, 1], over the same background; as rendered where it is masked."""
    seen: float = 1.0
    """Share of the pixels that is not masked."""


def render_views(
    model: Model, views: PosedImages, n_views: int = 0, masked: bool = False
) -> Iterator[RenderedView]:
    """Views (model frame) rendered with the full model; `n_views` of them spread evenly, 0 for all.

    `masked`: whether pixels that are not opaque are masked.
    """
    chosen = np.arange(len(views.cameras))
    if 0 < n_views < len(chosen):
        chosen = np.linspace(0, len(chosen) - 1, n_views).round().astype(int)
    for index in chosen:
        camera = views.cameras[index]
        rgb = render_image(model.field, model.sampler, camera, model.background)
        image = views.images[index]
        photograph, seen = over_background(image, model.background), 1.0
        if masked:
            opaque = image[..., 3] == 255
            photograph, seen = np.where(opaque[..., None], photograph, rgb), float(opaque.mean())
        yield RenderedView(camera.name, rgb, photograph, seen)


def evaluate(
    model: Model,
    views: PosedImages,
    n_views: int = 0,
    lpips: Distance | None = None,
    masked: bool = False,
) -> Iterator[ViewScore]:
    """The scores of `render_views`' pictures; with `lpips`, that distance as well.

    Raises ShapeError: a picture is smaller than SSIM's window.
    """
    for view in render_views(model, views, n_views, masked):
        yield score_view(view.name, view.rgb, view.photograph, lpips, view.seen)
