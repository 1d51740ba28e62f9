"""What `high` and `fast` pictures of an asset leave out: how nearly pixels have to agree for another to
become their mean, and at how many places a ray fetches features.

What that costs in decibels depends on the asset: the sharper it is and the nearer to the photographs, the
more the same levels lose. So both are chosen for each asset, by pixels of whole photographs that training has
not learned from (`vfr_bake.data.witnesses`). Where there are none, pictures between the training views are
compared with exact ones: these are off by E from photographs, and with a mean square difference e to them,
which has nothing to do with that, 10 log10(1 + e / E) dB are lost.

An interpolated picture is marched in stages, whose rays lie apart: they share neither steps nor cache lines,
and take about APART times as long. Where most of them are left to march, pictures with fewer fetches, all of
whose pixels are marched at once, are faster.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from player.asset.asset import Asset
from player.asset.manifest import AGREEMENT, Manifest
from player.cameras.camera import Camera
from player.files.images import to_8_bit
from player.head.head import read_head_file
from player.march.interpolation import Quality
from player.render import Renderer
from vfr_bake.baking.held_out import SEED, views_between
from vfr_bake.baking.limits import LOOKUPS
from vfr_bake.training.model_file import Model
from vfr_bake.training.scores.metrics import over_background

ALLOWED_DB: dict[Quality, float] = {"high": 0.03, "fast": 0.3}
"""Loss in dB of pictures, on average. `high` pictures may lose 0.05: a few views know that little only
roughly, and with 0.05 lego's test views lost 0.06."""
SPREADS, OF_ONE = 2.0, 1.5
"""How many standard errors above the mean of a few views' losses is allowed that; of one view, which has
none, so many times its loss."""
WORST = 3.0
"""How many times as much a single picture may lose."""
SHARES = tuple(0.85**n for n in range(16))
"""Shares of the usual levels that are tried; behind the last, every pixel is marched."""
MOST_PIXELS = 1_500_000
"""Pixels of all pictures that are compared, at most, but for the first picture."""
MARCH = 70_000
"""A ray takes about as long as a head of so many weights for a pixel."""
APART, FEWER = 2.0, 0.8
"""How many times as long it takes beside rays that lie apart, and with fewer fetches."""
LONGEST_SIDE = 640
"""Pixels along a side of pictures between views, at most: larger ones are smoother, and lose less."""


@dataclass(frozen=True, eq=False)
class View:
    """What a picture is compared at."""

    camera: Camera
    """WORLD frame."""
    pixels: np.ndarray
    """[n] numbers of pixels, row by row."""
    photograph: np.ndarray | None
    """[n, 3] their colours in the photograph, 0 to 1; None where there is none."""


def compared_views(model: Model, n_views: int) -> list[View]:
    """The whole witnesses; where there are none, `n_views` views between the training cameras."""
    witnesses = model.neutral_witnesses()
    if witnesses is None or not len(witnesses.whole):
        between = (view.transformed(model.world_from_model) for view in views_between(model, n_views, SEED))
        small = [camera.at_most(LONGEST_SIDE) for camera in between]
        return [View(camera, np.arange(camera.width * camera.height), None) for camera in small]
    found, numbers, n_pixels = [], witnesses.views(), 0
    for number in witnesses.whole:
        camera, rows = model.cameras[number], numbers == number
        n_pixels += camera.width * camera.height
        if found and n_pixels > MOST_PIXELS:
            break
        photograph = to_8_bit(over_background(witnesses.rgba[rows], model.background)) / 255
        found.append(View(camera, witnesses.pixels[rows], photograph))
    return found


class Qualities(NamedTuple):
    """What `high` and `fast` pictures leave out."""

    agreement: tuple[float, ...]
    """By how many 8-bit levels pixels may differ of which another becomes the mean; 0: all are marched."""
    fetches: tuple[int, ...]
    """Feature fetches of a ray, at most; 0: as many as in exact pictures."""


def fitting_qualities(asset: Asset, views: Sequence[View], error: float) -> Qualities:
    """What `high` and `fast` pictures may leave out to lose what is allowed.

    Args:
        asset: which is played.
        views: what is compared.
        error: mean square error of exact pictures to photographs that are not there, above 0.
    """
    with Renderer(asset) as renderer:
        played = _Played(renderer, views, error)
        usual = AGREEMENT[asset.manifest.contracted]
        agreement = tuple(played.levels(*each) for each in zip(ALLOWED_DB, usual, strict=True))
        fetches = tuple(played.fetches(*each) for each in zip(ALLOWED_DB, agreement, strict=True))
        return Qualities(agreement, fetches)


class _Played:
    """An asset's pictures of some views, compared with its exact ones."""

    def __init__(self, renderer: Renderer, views: Sequence[View], error: float) -> None:
        self._renderer, self._asset, self._views, self._error = renderer, renderer.asset, views, error
        self._exact, self._n_exact = self._pictures("exact")
        self._errors = self._off(self._exact)
        self._head = read_head_file(self._asset.path("head.onnx"), self._manifest.n_channels)[1].n_parameters

    @property
    def _manifest(self) -> Manifest:
        return self._asset.manifest

    def levels(self, quality: Quality, usual: float) -> float:
        """The most levels with which pictures of the quality lose what is allowed, the fewer, the less; 0
        where so many pixels would be marched all the same that it does not pay."""
        tried = [round(usual * share, 1) for share in SHARES]
        found = [*tried, 0.0][bisect_left(tried, True, key=lambda levels: self._fits(quality, levels, 0))]
        self._leave_out(found, 0)
        _, n_marched = self._pictures(quality)
        pays = n_marched * (APART * MARCH + self._head) <= self._n_exact * (FEWER * MARCH + self._head)
        return found if pays else 0.0

    def fetches(self, quality: Quality, levels: float) -> int:
        """The fewest fetches of a ray with which pictures of the quality lose what is allowed, but no less
        than half of them; 0 where all lose more, because rays end earlier."""
        own = self._manifest.n_fetches
        tried = sorted({n for n in (*LOOKUPS, own) if own <= 2 * n and 0 < n <= own})
        return [*tried, 0][bisect_left(tried, True, key=lambda n: self._fits(quality, levels, n))]

    def _leave_out(self, levels: float, n_fetches: int) -> None:
        """Have pictures of either quality leave out so much."""
        manifest = replace(self._manifest, agreement=(levels,) * 2, quality_fetches=(n_fetches,) * 2)
        changed = replace(self._asset, manifest=manifest)
        vars(changed)["grid"] = self._asset.grid  # it need not be built again
        self._renderer.show(changed)

    def _fits(self, quality: Quality, levels: float, n_fetches: int) -> bool:
        """Whether pictures of a quality that leave out so much lose at most what is allowed."""
        self._leave_out(levels, n_fetches)
        errors = self._off(self._pictures(quality)[0])
        lost, allowed = 10 * np.log10(errors / self._errors), ALLOWED_DB[quality]
        most = OF_ONE * lost[0]
        if len(lost) > 1:
            most = lost.mean() + SPREADS * lost.std(ddof=1) / np.sqrt(len(lost))
        return bool(most <= allowed and lost.max() <= WORST * allowed)

    def _pictures(self, quality: Quality) -> tuple[list[np.ndarray], int]:
        """[n, 3] the colours of each view's pixels, rounded to 8 bits; and how many pixels of all views were
        marched, and met something."""
        colours, n_marched = [], 0
        for view in self._views:
            frame = self._renderer.render(view.camera, quality=quality)
            colours.append(frame.to_uint8().reshape(-1, 3)[view.pixels] / 255)
            n_marched += int((frame.n_density_samples > 0).sum())
        return colours, n_marched

    def _off(self, pictures: Sequence[np.ndarray]) -> np.ndarray:
        """[n_views] the mean square errors of pictures to photographs."""
        found = []
        for view, exact, picture in zip(self._views, self._exact, pictures, strict=True):
            if view.photograph is None:
                found.append(self._error + float(np.mean((picture - exact) ** 2)))
            else:
                found.append(float(np.mean((picture - view.photograph) ** 2)))
        return np.maximum(found, 1e-9)
