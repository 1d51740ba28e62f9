"""Views between the training cameras: what the bake learns from and is measured on without a data set.

What each step of the bake loses, on views that nothing else in the bake looks at.

The model is the teacher, so that what is measured is the mean square difference e to its pictures. Against
photographs the model itself is off by E (its PSNR from training). The two errors have little to do with each
other, so that the baked pictures are off by e + E, which is 10 log10(1 + e / E) dB worse: the expected loss.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from player.asset.grid import SparseGrid
from player.cameras.camera import Camera, focus_point
from player.cameras.keyframes import smooth_path
from player.errors import TrainingError
from player.march.march import MIN_OPACITY, MarchResult
from player.render import choose_march
from vfr_bake.rendering.render import head_colours
from vfr_bake.training.model_file import Model

LARGEST_TURN = np.deg2rad(15.0)
"""Farther from a training camera than this nobody has taught the model anything."""
BETWEEN = 4
"""Views between for each training camera, where the number of rays does not depend on that of the views."""
NEIGHBOURS = 3
"""Training cameras that count as beside one: on a walk the next, the last and one more."""
PLACES = 64
"""On the way between two cameras, one of which is taken."""
MARGIN = 0.1
"""Of a picture of an unbounded scene, on every side: what the bake looks at beyond its border. Fox's held-out
views see there, and what was not stored cost them a decibel and more."""
ASIDE = 1.0
"""Of the way between two cameras: up to so far aside of it stand views of an unbounded scene. A held-out view
of can, which stands that far from the others, lost 5 dB to cells that came into sight and were not stored."""


def views_between(model: Model, n_views: int, seed: int, wide: bool = False) -> list[Camera]:
    """`n_views` cameras (model frame), each between a training camera, of which all have their turn, and one
    of its nearest: a quarter to half of the way there, and turned around what all cameras look at by up to a
    quarter of the angle between the two. `wide` ones also stand aside of that way and see beyond their
    borders (`widened`). The same seed gives the same views, another one others."""
    cameras = model.model_cameras()
    random = np.random.default_rng(seed)
    focus = focus_point(cameras)
    places = np.stack([camera.c2w[:3, 3] for camera in cameras])
    sides = (places - focus) / np.maximum(np.linalg.norm(places - focus, axis=1, keepdims=True), 1e-9)
    first = random.integers(0, len(cameras))
    chosen = (first + np.linspace(0, len(cameras), n_views, endpoint=False).astype(int)) % len(cameras)
    found = []
    for index in chosen:
        nearest = np.argsort(np.linalg.norm(places - places[index], axis=1))[1 : NEIGHBOURS + 1]
        other = random.choice(nearest) if len(nearest) else index
        angle = float(np.arccos(np.clip(sides[index] @ sides[other], -1, 1)))
        share = min(random.uniform(0.25, 0.5), LARGEST_TURN / max(angle, 1e-9))
        path = smooth_path([cameras[index], cameras[other]], PLACES)
        axis = random.normal(size=3)
        turn = _turn(axis / np.linalg.norm(axis), min(angle, LARGEST_TURN) / 4 * random.uniform(0.5, 1))
        move = np.eye(4)
        move[:3, :3] = turn
        move[:3, 3] = focus - turn @ focus
        camera = path[round(share * PLACES)]
        if wide:
            aside = random.normal(size=3)
            aside *= random.uniform(0, ASIDE) / np.linalg.norm(aside)
            move[:3, 3] += aside * np.linalg.norm(places[other] - places[index])
        found.append(replace(camera, name=f"{camera.name} turned", c2w=move @ camera.c2w))
    return [widened(camera) for camera in found] if wide else found


def _turn(axis: np.ndarray, angle: float) -> np.ndarray:
    """[3, 3] rotation by `angle` around the unit `axis` (Rodrigues)."""
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def widened(camera: Camera) -> Camera:
    """The camera with a border of MARGIN of its picture on every side.

    >>> wide = widened(Camera("a", np.eye(4), 100, 50, 80.0, 80.0, 50.0, 25.0))
    >>> wide.width, wide.height, wide.cx, wide.cy
    (120, 60, 60.0, 30.0)
    """
    x, y = round(MARGIN * camera.width), round(MARGIN * camera.height)
    size = {"width": camera.width + 2 * x, "height": camera.height + 2 * y}
    return replace(camera, **size, cx=camera.cx + x, cy=camera.cy + y)


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
        return choose_march("auto")[1].march(grid, self.rays_o, self.rays_d, n_fetches)

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
