"""Choose what `high` and `fast` pictures of an asset leave out. There are two settings: by how much four
pixels may differ for the pixel between them to become their mean, and the number of feature lookups a ray.

The loss in decibels of such a setting depends on the asset: the sharper the asset is, and the closer to the
photographs, the more it loses by the same setting. So both settings are chosen for each asset, on pixels of
whole photographs that training has not learned from (`vfr_bake.data.witnesses`). Without such photographs,
pictures from between the training views are compared with exact pictures. If exact pictures have the mean
square error E to photographs, and the others differ from exact ones by the mean square e, independent of
those errors, then the loss is 10 log10(1 + e / E) dB.

An interpolated picture is marched in stages (`player.march.interpolation`). The rays of a stage lie apart, so
that they share neither steps nor cache lines, and take about APART times as long. If most pixels have to be
marched all the same, a picture with fewer lookups, all of whose pixels are marched at once, is faster.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from player.asset.asset import Asset
from player.asset.manifest import AGREEMENT, Manifest
from player.cameras.camera import Camera
from player.files.images import to_8_bit
from player.head.head import asset_head
from player.march.interpolation import Quality
from player.render import Renderer
from vfr_bake.baking.held_out import SEED, views_between
from vfr_bake.baking.limits import LOOKUPS
from vfr_bake.training.model_file import Model
from vfr_bake.training.scores.metrics import over_background

ALLOWED_DB: dict[Quality, float] = {"high": 0.03, "fast": 0.3}
"""Allowed mean loss of the compared pictures, dB. The aim for `high` is 0.05 dB. The limit is lower because a
few views measure so small a loss only roughly: with a limit of 0.05, lego's test views lost 0.06."""
SPREADS, OF_ONE = 2.0, 1.5
"""Safety margins on the loss that is compared with ALLOWED_DB. With several views, this is their mean loss
plus SPREADS standard errors; with one view, which has no standard error, OF_ONE times its loss."""
WORST = 3.0
"""The loss of a single picture may be this many times the allowed mean loss."""
SHARES = tuple(0.85**n for n in range(16))
"""Shares of the usual levels that are tried, in this order; if all lose too much, every pixel is marched."""
MOST_PIXELS = 1_500_000
"""Most pixels of all compared pictures together; the first picture is compared even if it has more."""
MOST_OF_PICTURE = 1600 * 1200
"""Most pixels that a compared picture is rendered at; of a larger one its middle is compared."""
MARCH = 70_000
"""Cost of marching a ray, in weights of a head: evaluating a head of this many weights takes as long."""
APART, FEWER = 2.0, 0.8
"""Factors on the time of a ray: if the rays around it lie apart, and with fewer feature lookups."""
LONGEST_SIDE = 640
"""Most pixels along a side of pictures between views: larger pictures are smoother, and lose less."""


@dataclass(frozen=True, eq=False)
class ComparedView:
    """A camera and those of its pixels at which pictures are compared."""

    camera: Camera
    """WORLD frame."""
    pixels: np.ndarray
    """[n] numbers of the compared pixels, counted row by row."""
    photograph: np.ndarray | None
    """[n, 3] colours of these pixels in the photograph, 0 to 1; None if there is no photograph."""

    def middle(self) -> ComparedView:
        """Return the middle of the view, MOST_OF_PICTURE pixels, or the view itself if it has no more."""
        camera = self.camera
        share = math.sqrt(MOST_OF_PICTURE / (camera.width * camera.height))
        if share >= 1:
            return self
        width, height = max(int(share * camera.width), 1), max(int(share * camera.height), 1)
        x, y = (camera.width - width) // 2, (camera.height - height) // 2
        rows, columns = self.pixels // camera.width - y, self.pixels % camera.width - x
        seen = (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
        part = replace(camera, width=width, height=height, cx=camera.cx - x, cy=camera.cy - y)
        photograph = None if self.photograph is None else self.photograph[seen]
        return ComparedView(part, (rows * width + columns)[seen], photograph)


def compared_views(model: Model, n_views: int) -> list[ComparedView]:
    """Return the views whose whole pictures are witnesses, as many as MOST_PIXELS allows. If there are none
    that show anything, return `n_views` views between the training cameras, or as many as it takes for
    MOST_PIXELS."""
    if found := _photographed_views(model):
        return found
    sizes = [camera.at_most(LONGEST_SIDE) for camera in model.cameras]
    enough = math.ceil(MOST_PIXELS / max(camera.width * camera.height for camera in sizes))
    between = views_between(model, min(n_views, enough), SEED)
    small = [camera.transformed(model.world_from_model).at_most(LONGEST_SIDE) for camera in between]
    return [ComparedView(camera, np.arange(camera.width * camera.height), None) for camera in small]


def _photographed_views(model: Model) -> list[ComparedView]:
    witnesses = model.neutral_witnesses()
    if witnesses is None:
        return []
    found, n_pixels, numbers = [], 0, witnesses.views()
    for number in witnesses.whole[np.isin(witnesses.whole, numbers)]:
        rows = numbers == number
        photograph = to_8_bit(over_background(witnesses.rgba[rows], model.background)) / 255
        view = ComparedView(model.cameras[number], witnesses.pixels[rows], photograph).middle()
        n_pixels += view.camera.width * view.camera.height
        if found and n_pixels > MOST_PIXELS:
            break
        if len(view.pixels):
            found.append(view)
    return found


class Qualities(NamedTuple):
    """The settings of `high` and `fast` pictures, in this order."""

    agreement: tuple[float, ...]
    """By how many 8-bit levels four pixels may differ for another one to become their mean; 0: all pixels are
    marched."""
    fetches: tuple[int, ...]
    """Most feature lookups of a ray; 0: as many as in exact pictures."""


def fitting_qualities(asset: Asset, views: Sequence[ComparedView], error: float) -> Qualities:
    """Choose the settings with which `high` and `fast` pictures lose at most ALLOWED_DB.

    Args:
        asset: the asset to play.
        views: views at which pictures are compared.
        error: expected mean square error of exact pictures to photographs, above 0; used for views without a
            photograph.
    """
    with Renderer(asset) as renderer:
        played = _Played(renderer, views, error)
        usual = AGREEMENT[asset.manifest.contracted]
        agreement = tuple(played.levels(*each) for each in zip(ALLOWED_DB, usual, strict=True))
        fetches = tuple(played.fetches(*each) for each in zip(ALLOWED_DB, agreement, strict=True))
        return Qualities(agreement, fetches)


class _Played:
    """Pictures of an asset from some views, compared with its exact pictures."""

    def __init__(self, renderer: Renderer, views: Sequence[ComparedView], error: float) -> None:
        self._renderer, self._asset, self._views, self._error = renderer, renderer.asset, views, error
        self._exact, self._n_exact = self._pictures("exact")
        self._errors = self._off(self._exact)
        self._head = asset_head(self._asset).n_parameters

    @property
    def _manifest(self) -> Manifest:
        return self._asset.manifest

    def levels(self, quality: Quality, usual: float) -> float:
        """Return the largest tried number of 8-bit levels whose pictures lose no more than is allowed;
        fewer levels are taken to lose less. Returns 0 if so many pixels would have to be marched all the
        same that interpolation saves no time."""
        tried = [round(usual * share, 1) for share in SHARES]
        found = [*tried, 0.0][bisect_left(tried, True, key=lambda levels: self._fits(quality, levels, 0))]
        self._leave_out(found, 0)
        _, n_marched = self._pictures(quality)
        pays = n_marched * (APART * MARCH + self._head) <= self._n_exact * (FEWER * MARCH + self._head)
        return found if pays else 0.0

    def fetches(self, quality: Quality, levels: float) -> int:
        """Return the fewest feature lookups a ray whose pictures lose no more than is allowed, but at least
        half of the asset's own. Returns 0 if all of them lose more, which can be because rays of this quality
        end earlier."""
        own = self._manifest.n_fetches
        tried = sorted({n for n in (*LOOKUPS, own) if own <= 2 * n and 0 < n <= own})
        return [*tried, 0][bisect_left(tried, True, key=lambda n: self._fits(quality, levels, n))]

    def _leave_out(self, levels: float, n_fetches: int) -> None:
        """Let the renderer use these settings for both qualities."""
        manifest = replace(self._manifest, agreement=(levels,) * 2, quality_fetches=(n_fetches,) * 2)
        changed = replace(self._asset, manifest=manifest)
        vars(changed)["grid"] = self._asset.grid  # reuse the grid, which need not be built again
        self._renderer.show(changed)

    def _fits(self, quality: Quality, levels: float, n_fetches: int) -> bool:
        """Return whether pictures of the quality with these settings lose no more than is allowed."""
        self._leave_out(levels, n_fetches)
        errors = self._off(self._pictures(quality)[0])
        lost, allowed = 10 * np.log10(errors / self._errors), ALLOWED_DB[quality]
        most = OF_ONE * lost[0]
        if len(lost) > 1:
            most = lost.mean() + SPREADS * lost.std(ddof=1) / np.sqrt(len(lost))
        return bool(most <= allowed and lost.max() <= WORST * allowed)

    def _pictures(self, quality: Quality) -> tuple[list[np.ndarray], int]:
        """Render all views. Returns for each view its pixels' colours [n, 3], rounded to 8 bits, and the
        number of pixels of all views that were marched and met something."""
        colours, n_marched = [], 0
        for view in self._views:
            frame = self._renderer.render(view.camera, quality=quality)
            colours.append(frame.to_uint8().reshape(-1, 3)[view.pixels] / 255)
            n_marched += int((frame.n_density_samples > 0).sum())
        return colours, n_marched

    def _off(self, pictures: Sequence[np.ndarray]) -> np.ndarray:
        """Return the mean square errors [n_views] of pictures to photographs, expected where there are
        none."""
        found = []
        for view, exact, picture in zip(self._views, self._exact, pictures, strict=True):
            if view.photograph is None:
                found.append(self._error + float(np.mean((picture - exact) ** 2)))
            else:
                found.append(float(np.mean((picture - view.photograph) ** 2)))
        return np.maximum(found, 1e-9)
