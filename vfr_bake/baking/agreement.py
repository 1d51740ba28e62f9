"""How nearly pixels have to agree for another to become their mean, in `high` and `fast` pictures.

What that costs in decibels depends on the asset: the sharper it is and the nearer to the photographs, the
more the same levels lose. So the levels are chosen for each asset, by pixels of whole photographs that
training has not learned from (`vfr_bake.data.witnesses`). Where there are none, pictures between the training
views are compared with exact ones: these are off by E from photographs, and with a mean square difference e
to them, which has nothing to do with that, 10 log10(1 + e / E) dB are lost.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from player.asset.asset import Asset
from player.asset.manifest import AGREEMENT
from player.cameras.camera import Camera
from player.files.images import to_8_bit
from player.march.interpolation import Quality
from player.render import Renderer
from vfr_bake.baking.held_out import SEED, views_between
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
MOST_MARCHED = 0.9
"""Share of the pixels that show anything which may be left to march: marched in stages, more of them would
take longer than all do at once, and lose something for it."""
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


def fitting_agreement(asset: Asset, views: Sequence[View], error: float) -> tuple[float, float]:
    """The levels for `high` and `fast` pictures with which they lose what is allowed.

    Args:
        asset: which is played.
        views: what is compared.
        error: mean square error of exact pictures to photographs that are not there, above 0.
    """
    with Renderer(asset) as renderer:
        played = _Played(renderer, views, error)
        high, fast = (played.levels(quality, usual) for quality, usual in zip(
            ALLOWED_DB, AGREEMENT[asset.manifest.contracted], strict=True
        ))  # fmt: skip
        return high, fast


class _Played:
    """An asset's pictures of some views, compared with its exact ones."""

    def __init__(self, renderer: Renderer, views: Sequence[View], error: float) -> None:
        self._renderer, self._asset, self._views, self._error = renderer, renderer.asset, views, error
        self._exact, self._n_exact = self._pictures("exact")
        self._errors = self._off(self._exact)

    def levels(self, quality: Quality, usual: float) -> float:
        """The most levels with which pictures of the quality lose what is allowed, the fewer, the less; 0
        where nearly all pixels would be marched all the same."""
        tried = [round(usual * share, 1) for share in SHARES]
        found = [*tried, 0.0][bisect_left(tried, True, key=lambda levels: self._fits(quality, levels))]
        self._agree_within(found)
        _, n_marched = self._pictures(quality)
        return found if n_marched <= MOST_MARCHED * self._n_exact else 0.0

    def _agree_within(self, levels: float) -> None:
        """Have pixels become the mean of others that differ by so many levels."""
        manifest = replace(self._asset.manifest, agreement=(levels, levels))
        changed = replace(self._asset, manifest=manifest)
        vars(changed)["grid"] = self._asset.grid  # it need not be built again
        self._renderer.show(changed)

    def _fits(self, quality: Quality, levels: float) -> bool:
        """Whether pictures of a quality lose at most what is allowed, with so many levels."""
        self._agree_within(levels)
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
