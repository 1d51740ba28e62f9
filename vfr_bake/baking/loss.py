"""What each step of the bake loses, on views that nothing else in the bake looks at.

The model is the teacher, so that what is measured is the mean square difference e to its pictures. Against
photographs the model itself is off by E (its PSNR from training). The two errors have little to do with each
other, so that the baked pictures are off by e + E, which is 10 log10(1 + e / E) dB worse: the expected loss.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from player.asset.grid import SparseGrid
from player.errors import TrainingError
from player.march.march import MIN_OPACITY, MarchResult
from player.render import choose_march
from vfr_bake.baking.views import views_between
from vfr_bake.rendering.render import head_colours
from vfr_bake.training.model_file import Model

RAYS_OF_A_VIEW = 20_000
N_DIRECTIONS = 6
"""Other directions from which a colour is looked at, to see whether it depends on them."""
SEED = 2
"""Of the views that are kept for measuring; learning uses others."""
DEFAULT_PSNR = 30.0
"""Taken for the model where training has measured nothing."""

Head = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Composited features [n, n_channels] and unit dirs [n, 3] to colours [n, 3]."""


@dataclass(frozen=True)
class Stage:
    """The pictures after a step of the bake, compared with the model's."""

    name: str
    psnr: float
    """dB to the model's pictures, not rounded to 8 bits."""
    loss_db: float
    """Expected loss against photographs since the trained model."""
    samples_median: float
    """Density samples of a ray that hits."""
    samples_p95: float


class HeldOut:
    """Rays of views between the training cameras, with the model's colours over its background."""

    def __init__(self, model: Model, n_views: int) -> None:
        random = np.random.default_rng(SEED)
        rays = []
        for camera in views_between(model, n_views, SEED):
            rays_o, rays_d = camera.rays()
            some = random.choice(len(rays_o), min(RAYS_OF_A_VIEW, len(rays_o)), replace=False)
            rays.append((rays_o[some], rays_d[some]))
        self.rays_o, self.rays_d = (np.concatenate(column) for column in zip(*rays, strict=True))
        self.background = model.background
        features, opacity, _ = model.sampler.composited_features(model.field, self.rays_o, self.rays_d)
        self._hits = np.flatnonzero(opacity > 0)
        self._features, self._opacity = features[self._hits], opacity[self._hits, None]
        self._field = model.field
        if not (self._opacity > MIN_OPACITY).any():
            raise TrainingError(
                "model: expected something to see from its cameras, got nothing: train longer"
            )
        self.wanted = (1 - opacity[:, None]) * self.background
        self.wanted[self._hits] += self._opacity * self._colours(self._features)
        self.model_psnr = float(
            model.figures.get("test_psnr") or model.figures.get("training_psnr") or DEFAULT_PSNR
        )
        self.stages: list[Stage] = []

    def _colours(self, features: np.ndarray) -> np.ndarray:
        return head_colours(self._field, features, self.rays_d[self._hits])

    def channel_loss(self, kept: np.ndarray) -> float:
        """Expected loss in dB if the model's own rendered features x went through `kept` [n_channels,
        n_channels], a projection of them."""
        shown = self._colours((self._features @ kept.T).astype(np.float32))
        off = self._opacity * (shown - self._colours(self._features))
        return expected_loss(float(np.sum(off.astype(np.float64) ** 2)) / self.wanted.size, self.model_psnr)

    def loss_of(self, features: np.ndarray, opacity: np.ndarray) -> float:
        """Expected loss in dB if every ray had composited `features` [n, n_channels] and `opacity` [n], and
        the model's own head."""
        rgb = (1 - opacity[:, None]) * self.background
        met = np.flatnonzero(opacity > 0)
        rgb[met] += opacity[met, None] * head_colours(self._field, features[met], self.rays_d[met])
        return expected_loss(float(np.mean((rgb.astype(np.float64) - self.wanted) ** 2)), self.model_psnr)

    def direction_loss(self) -> float:
        """Expected loss in dB if every colour were the mean of those seen from N_DIRECTIONS other rays'
        directions."""
        random = np.random.default_rng(SEED)
        own = self._colours(self._features)
        mean = np.zeros_like(own)
        for _ in range(N_DIRECTIONS):
            others = self.rays_d[random.permutation(self._hits)]
            mean += head_colours(self._field, self._features, others) / N_DIRECTIONS
        off = self._opacity * (mean - own)
        return expected_loss(float(np.sum(off.astype(np.float64) ** 2)) / self.wanted.size, self.model_psnr)

    def march(self, grid: SparseGrid, n_fetches: int) -> MarchResult:
        """What the rays compose as played."""
        return choose_march("auto", grid.contracted)[1].march(grid, self.rays_o, self.rays_d, n_fetches)

    def measure(self, name: str, grid: SparseGrid, head: Head, n_fetches: int) -> Stage:
        """Play `grid` with `head`, and keep the result under `name`."""
        return self.measure_march(name, self.march(grid, n_fetches), head)

    def measure_march(self, name: str, played: MarchResult, head: Head) -> Stage:
        """Show what was composed, and keep the result under `name`."""
        stage = self._stage(name, played, head)
        self.stages.append(stage)
        return stage

    def look(self, name: str, grid: SparseGrid, head: Head, n_fetches: int) -> Stage:
        """Play `grid` with `head`, without keeping the result."""
        return self._stage(name, self.march(grid, n_fetches), head)

    def _stage(self, name: str, played: MarchResult, head: Head) -> Stage:
        rgb = (1 - played.opacity[:, None]) * self.background
        hits = played.hits
        rgb[hits] += head(played.features, self.rays_d[hits]) * played.opacity[hits, None]
        samples = played.n_density_samples[hits]
        error = float(np.mean((rgb.astype(np.float64) - self.wanted) ** 2))
        return Stage(
            name,
            -10 * float(np.log10(max(error, 1e-12))),
            expected_loss(error, self.model_psnr),
            float(np.median(samples)) if len(samples) else 0.0,
            float(np.percentile(samples, 95)) if len(samples) else 0.0,
        )

    def table(self) -> list[dict[str, Any]]:
        """The stages so far, for a report."""
        return [asdict(stage) for stage in self.stages]


def expected_loss(error: float, model_psnr: float) -> float:
    """dB that a mean square `error` to the model's pictures costs a model of `model_psnr` dB.

    >>> round(expected_loss(10 ** (-4.57), 29.53), 2)  # k = 5 of docs: 45.7 dB to the full render
    0.1
    """
    return 10 * float(np.log10(1 + error * 10 ** (model_psnr / 10)))
