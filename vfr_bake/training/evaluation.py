"""The full model against photographs."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from vfr_bake.data.capture import PosedImages
from vfr_bake.field.field import VfrField
from vfr_bake.rendering.render import Sampler, render_image
from vfr_bake.training.metrics import over_background, psnr, to_8_bit


@dataclass(frozen=True)
class ViewScore:
    """One view's agreement with its photograph."""

    name: str
    psnr: float
    """dB, on 8-bit pictures over the background."""


def evaluate(
    field: VfrField, sampler: Sampler, views: PosedImages, background: np.ndarray, n_views: int = 0
) -> Iterator[ViewScore]:
    """Render views (model frame) with the full model and compare; `n_views` of them spread evenly, 0 for
    all."""
    chosen = np.arange(len(views.cameras))
    if 0 < n_views < len(chosen):
        chosen = np.linspace(0, len(chosen) - 1, n_views).round().astype(int)
    for index in chosen:
        camera = views.cameras[index]
        rgb = to_8_bit(render_image(field, sampler, camera, background)) / 255
        photograph = to_8_bit(over_background(views.images[index], background)) / 255
        yield ViewScore(camera.name, psnr(rgb, photograph))
