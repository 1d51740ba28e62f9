"""Views between the training cameras, which a bake is trained and measured on without a data set, and what
each of its steps loses on some of them that nothing else looks at.

The full model is the teacher, so that what is measured is the mean square difference e to its pictures.
Against photographs the model itself is off by E (its PSNR from training). The two errors have little to do
with each other, so that the baked pictures are off by e + E, which is 10 log10(1 + e / E) dB worse: the
expected loss.
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
"""Largest angle between a view and a training camera: farther away the model is not trained."""
BETWEEN = 4
"""Views between for each training camera, where the number of rays does not depend on that of the views."""
NEIGHBOURS = 3
"""Training cameras that count as beside one: on a walk the next, the last and one more."""
PLACES = 64
"""Places on the way between two cameras, one of which is taken."""
MARGIN = 0.1
"""Border that the bake adds on every side of a picture of an unbounded scene, as a share of its size. Fox's
held-out views see there, and what was not stored cost them a decibel and more."""
ASIDE = 1.0
"""Views of an unbounded scene stand aside of the way between two cameras, by up to this share of its length.
A held-out view of can, which stands that far from the others, lost 5 dB to cells that came into sight and
were not stored."""
RAYS_OF_A_VIEW = 20_000
"""Most rays of a view that is measured."""
N_DIRECTIONS = 6
"""Other directions from which a colour is looked at, to see whether it depends on them."""
SEED = 2
"""Seed of the views that are kept for measuring; training uses others."""
DEFAULT_PSNR = 30.0
"""PSNR that is assumed for a model whose training has measured nothing."""

Head = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Composited features [n, n_channels] and unit dirs [n, 3] to colours [n, 3]."""


def views_between(model: Model, n_views: int, seed: int, wide: bool = False) -> list[Camera]:
    """`n_views` cameras (model frame) between the training cameras.

    Each stands a quarter to half of the way from a training camera, of which all have their turn, to one of
    its nearest, and is turned around what all cameras look at by up to a quarter of the angle between the
    two. With `wide` they also stand aside of that way and see beyond their borders (`widened`). The views
    follow from the seed.
    """
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


@dataclass(frozen=True)
class Stage:
    """The pictures after a step of the bake, compared with the model's."""

    name: str
    psnr: float
    """PSNR in dB against the model's pictures, not rounded to 8 bits."""
    loss_db: float
    """Expected loss in dB against photographs, compared with the trained model."""
    samples_median: float
    """Median number of density samples of a ray that hits."""
    samples_p95: float
    """95th percentile of the same."""


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
        return self._loss_of_colours(self._colours((self._features @ kept.T).astype(np.float32)))

    def direction_loss(self) -> float:
        """Expected loss in dB if every colour were the mean of those seen from N_DIRECTIONS other rays'
        directions."""
        random = np.random.default_rng(SEED)
        mean = np.zeros((len(self._hits), 3), np.float32)
        for _ in range(N_DIRECTIONS):
            others = self.rays_d[random.permutation(self._hits)]
            mean += head_colours(self._field, self._features, others) / N_DIRECTIONS
        return self._loss_of_colours(mean)

    def _loss_of_colours(self, colours: np.ndarray) -> float:
        """Expected loss in dB if the rays that hit had these colours [n_hits, 3] instead of the model's."""
        off = self._opacity * (colours - self._colours(self._features))
        error = float(np.sum(off.astype(np.float64) ** 2)) / self.wanted.size
        return expected_loss(error, self.model_psnr)

    def loss_of(self, features: np.ndarray, opacity: np.ndarray) -> float:
        """Expected loss in dB if every ray had composited `features` [n, n_channels] and `opacity` [n], and
        the model's own head."""
        met = np.flatnonzero(opacity > 0)
        colours = head_colours(self._field, features[met], self.rays_d[met])
        return expected_loss(self._error(met, colours, opacity), self.model_psnr)

    def _error(self, hits: np.ndarray, colours: np.ndarray, opacity: np.ndarray) -> float:
        """Mean square error of pictures with `colours` [n_hits, 3] at the rays `hits`, and `opacity` [n]."""
        rgb = (1 - opacity[:, None]) * self.background
        rgb[hits] += colours * opacity[hits, None]
        return float(np.mean((rgb.astype(np.float64) - self.wanted) ** 2))

    def march(self, grid: SparseGrid, n_fetches: int) -> MarchResult:
        """What the player composes on the rays."""
        return choose_march("auto")[1].march(grid, self.rays_o, self.rays_d, n_fetches)

    def measure(self, name: str, grid: SparseGrid, head: Head, n_fetches: int) -> Stage:
        """Play `grid` with `head`, and keep the result under `name`."""
        return self.measure_march(name, self.march(grid, n_fetches), head)

    def measure_march(self, name: str, played: MarchResult, head: Head) -> Stage:
        """Show what was composed, and keep the result under `name`."""
        self.stages.append(self._stage(name, played, head))
        return self.stages[-1]

    def look(self, name: str, grid: SparseGrid, head: Head, n_fetches: int) -> Stage:
        """Play `grid` with `head`, without keeping the result."""
        return self._stage(name, self.march(grid, n_fetches), head)

    def _stage(self, name: str, played: MarchResult, head: Head) -> Stage:
        hits = played.hits
        error = self._error(hits, head(played.features, self.rays_d[hits]), played.opacity)
        samples = played.n_density_samples[hits] if len(hits) else np.zeros(1)
        return Stage(
            name,
            -10 * float(np.log10(max(error, 1e-12))),
            expected_loss(error, self.model_psnr),
            float(np.median(samples)),
            float(np.percentile(samples, 95)),
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
