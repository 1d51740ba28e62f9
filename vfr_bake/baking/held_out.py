"""Measure the stages of a bake: on the model's witnesses, on views between the training cameras, and on some
training pixels.

The *witnesses* are pixels of photographs that training has not learned from (`vfr_bake.data.witnesses`). The
loss of a bake is what the asset loses on them, compared with the model. The bake chooses by this loss.
What it leaves out bit by bit loses too little for that, and is measured on 20,000 *training pixels*.

On the *views between* the training cameras, the model's own pictures are the reference. The agreement of a
stage with them is reported as a PSNR. It decides between stages where the witnesses see no difference.

A model without witnesses was trained before they were introduced. Its loss can only be estimated: let e be
the mean square difference to the model's pictures, and E the model's own mean square error to photographs
(from its PSNR on the pictures it was trained on). If the two errors are independent, the baked pictures have
the error e + E, which is a loss of 10 log10(1 + e / E) dB.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from player.asset.asset import Asset, read_manifest
from player.asset.grid import SparseGrid
from player.cameras.camera import Camera, focus_point
from player.cameras.keyframes import camera_on_path
from player.cameras.rotations import rotation_matrix
from player.errors import ConfigError, TrainingError
from player.head.head import Head as AssetHead
from player.march.march import MIN_OPACITY, MarchResult
from player.render import choose_march
from vfr_bake.data.threads import in_threads
from vfr_bake.data.witnesses import Witnesses
from vfr_bake.rendering.render import head_colours
from vfr_bake.training.length.witness_loss import Loss, WitnessLoss
from vfr_bake.training.model_file import Model

LARGEST_TURN = np.deg2rad(15.0)
"""Largest angle between a view and a training camera: farther away the model is not trained."""
BETWEEN = 4
"""Views between cameras for each training camera, wherever more views do not mean more rays."""
NEIGHBOURS = 3
"""Training cameras that count as a camera's neighbours: on a walk the next, the previous and one more."""
PLACES = 64
"""Places on the way between two cameras, to which a view's place is rounded."""
MARGIN = 0.1
"""Border that the bake adds on every side of a picture of an unbounded scene, as a share of its size. Fox's
held-out views see beyond the training pictures, and lost more than a decibel to cells that were not stored
there."""
ASIDE = 1.0
"""Views of an unbounded scene are moved aside from the way between two cameras, by up to this share of its
length. A held-out view of can, which stands that far from the others, lost 5 dB to cells that came into sight
and were not stored."""
RAYS_OF_A_VIEW = 20_000
"""Most rays of a view between cameras."""
RAYS_BESIDE_WITNESSES = 5_000
"""Most rays of a view between cameras if the model has witnesses, whose rays make up for the difference."""
MOST_BETWEEN = 200_000
"""Most rays of all views between cameras together, however many views there are: each step of the bake plays
them."""
N_LEARNED = 20_000
"""Training pixels on which small changes are measured."""
RAYS_AT_ONCE = 1 << 13
"""Rays that a thread marches at a time."""
N_DIRECTIONS = 6
"""Number of other directions by which it is tested whether colours depend on the direction."""
SEED = 2
"""Seed of the views that are used for measuring only; views for training have other seeds."""
FAR_OFF = 0.1
"""Difference of a pixel in one of the three channels, 0 to 1, above which it stands out as a speck."""
EXPECTED_SPREAD = 0.5
"""Standard error of the expected loss of a small change, as a share of that loss."""
DEFAULT_PSNR = 30.0
"""PSNR in dB that is assumed for a model whose training has measured none."""

Head = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""A function from composited features [n, n_channels] and unit directions [n, 3] to colours [n, 3]."""


def views_between(model: Model, n_views: int, seed: int, wide: bool = False) -> list[Camera]:
    """Return `n_views` cameras (model frame) between the training cameras.

    Each stands a quarter to half of the way from a training camera to one of its nearest neighbours; the
    training cameras take turns. It is then turned around the point that all cameras look at, by up to a
    quarter of the angle between the two. With `wide`, cameras are also moved aside from that way, and see
    beyond their borders (`widened`). The views are determined by the seed.
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
        axis = random.normal(size=3)
        half = min(angle, LARGEST_TURN) / 8 * random.uniform(0.5, 1)
        turn = rotation_matrix(np.array([np.cos(half), *(np.sin(half) * axis / np.linalg.norm(axis))]))
        move = np.eye(4)
        move[:3, :3] = turn
        move[:3, 3] = focus - turn @ focus
        camera = camera_on_path([cameras[index], cameras[other]], 0, round(share * PLACES) / PLACES)
        if wide:
            aside = random.normal(size=3)
            aside *= random.uniform(0, ASIDE) / np.linalg.norm(aside)
            move[:3, 3] += aside * np.linalg.norm(places[other] - places[index])
        found.append(replace(camera, name=f"{camera.name} turned", c2w=move @ camera.c2w))
    return [widened(camera) for camera in found] if wide else found


def widened(camera: Camera) -> Camera:
    """Return the camera with a border added on every side, MARGIN times the size of its picture.

    >>> wide = widened(Camera("a", np.eye(4), 100, 50, 80.0, 80.0, 50.0, 25.0))
    >>> wide.width, wide.height, wide.cx, wide.cy
    (120, 60, 60.0, 30.0)
    """
    x, y = round(MARGIN * camera.width), round(MARGIN * camera.height)
    size = {"width": camera.width + 2 * x, "height": camera.height + 2 * y}
    return replace(camera, **size, cx=camera.cx + x, cy=camera.cy + y)


class Shown(NamedTuple):
    """Pictures of all held-out rays, and their errors."""

    error: float
    """Mean square error to the model's pictures on the views between cameras; not rounded to 8 bits."""
    errors: np.ndarray | None
    """[n_witnesses] float64: mean square error of each witness to its photograph; None without witnesses."""
    rgb: np.ndarray
    """[n, 3] float32: the pictures' colours, 0 to 1."""
    learned: np.ndarray | None = None
    """[n_learned] float64: mean square errors at some training pixels; None for a model without them."""

    def far_off(self, other: Shown) -> float:
        """Return the share of the pixels that differ from those of `other` by more than FAR_OFF in a
        channel."""
        return float(np.mean(np.abs(self.rgb - other.rgb).max(axis=1) > FAR_OFF))


@dataclass(frozen=True)
class Stage:
    """The pictures after a step of the bake, and their errors compared with the model's."""

    name: str
    psnr: float
    """PSNR in dB against the model's pictures on the views between cameras, not rounded to 8 bits."""
    loss: Loss
    """Loss against photographs, compared with the trained model; estimated if there are no witnesses."""
    samples_median: float
    """Median number of density samples of the rays that hit something."""
    samples_p95: float
    """95th percentile of the same number."""
    shown: Shown
    """The pictures from which the figures were computed."""


class HeldOut:
    """The rays on which a bake is measured, with the model's colours over its background: first those of
    views between the training cameras, then those of the witnesses, then those of some training pixels."""

    def __init__(self, model: Model, n_views: int) -> None:
        witnesses = model.neutral_witnesses()
        if witnesses is not None and not len(witnesses.pixels):
            witnesses = None
        n_of_view = RAYS_OF_A_VIEW if witnesses is None else RAYS_BESIDE_WITNESSES
        n_of_view = min(n_of_view, MOST_BETWEEN // n_views)
        random = np.random.default_rng(SEED)
        rays = []
        for camera in views_between(model, n_views, SEED):
            n_pixels = camera.width * camera.height
            rays.append(camera.rays_through(random.choice(n_pixels, min(n_of_view, n_pixels), replace=False)))
        self._n_between = sum(len(rays_o) for rays_o, _ in rays)
        learned = None if witnesses is None else _some_learned(model)
        for pixels in (witnesses, learned):
            if pixels is not None:
                rays.append(model.rays(pixels))
        self._n_learned = 0 if learned is None else len(learned.pixels)
        self.rays_o, self.rays_d = (np.concatenate(column) for column in zip(*rays, strict=True))
        self.background = model.background
        features, opacity = model.sampler.composited_features(model.field, self.rays_o, self.rays_d)
        self._hits = np.flatnonzero(opacity > 0)
        self._features, self._opacity = features[self._hits], opacity[self._hits, None]
        self._head = model.field.head
        if not (self._opacity > MIN_OPACITY).any():
            raise TrainingError(
                "model: expected something to see from its cameras, got nothing: train longer"
            )
        self.wanted = (1 - opacity[:, None]) * self.background
        self.wanted[self._hits] += self._opacity * self._colours(self._features)
        self._witnesses, self._learned = (
            None if pixels is None else WitnessLoss(pixels, self.background)
            for pixels in (witnesses, learned)
        )
        self.own = self._compared(self.wanted)
        """The model's own pictures, with their errors."""
        psnr = float(model.figures.get("training_psnr") or DEFAULT_PSNR)
        self._model_psnr = psnr if np.isfinite(psnr) else DEFAULT_PSNR
        self.stages: list[Stage] = []

    @property
    def model_error(self) -> float:
        """Mean square error of the model's pictures to the pictures that it learned from."""
        return 10 ** (-self._model_psnr / 10)

    def measured_on(self) -> str:
        """Describe in a sentence or two what losses are measured on, or estimated from."""
        if self._witnesses is None:
            return (
                "The model has no witnesses, which are pixels that it did not learn from. So the loss is "
                "estimated from its own pictures: train again to have it measured."
            )
        return self._witnesses.described()

    def lost(self, before: Shown, after: Shown) -> Loss:
        """Return the loss of `after`, compared with `before`."""
        if self._witnesses is not None and before.errors is not None and after.errors is not None:
            return self._witnesses.loss(before.errors, after.errors)
        first, second = (expected_loss(shown.error, self._model_psnr) for shown in (before, after))
        return Loss(second - first, None)

    def lost_by_leaving_out(self, before: Shown, after: Shown) -> Loss:
        """Return the loss of `after`, from which something small was left out, measured on training pixels.

        They are many, each from another place, and the model shows them better than views that it does not
        know. So a loss is seen there that witnesses would hardly show
        (docs/notes/2026-11-29-patches-of-witnesses.md). For a model without training pixels, the loss is that
        of `lost`.
        """
        if self._learned is None or before.learned is None or after.learned is None:
            return self.lost(before, after)
        return self._learned.loss(before.learned, after.learned)

    def loss_of_change(self, before: Shown, after: Shown) -> float:
        """Return the loss in dB of a small change of the pictures that does not depend on the photographs,
        such as rounding.

        The errors of such a change are independent of the errors that the pictures already have, so their
        squares are expected to add up. The loss expected from this has a standard error of half its size
        (EXPECTED_SPREAD). It varies far less from pixel to pixel than the measured loss, which contains the
        product of the two errors. Returns the mean of both losses, each weighted with 1 / spread^2.
        """
        measured = self.lost_by_leaving_out(before, after)
        if self._learned is None or before.learned is None or not measured.spread:
            return measured.db
        a, b = (np.clip(shown.rgb[-self._n_learned :], 0.0, 1.0, dtype=float) for shown in (before, after))
        expected = self._learned.loss(before.learned, before.learned + ((b - a) ** 2).mean(axis=1)).db
        noise = measured.spread**2
        share = noise / (noise + (EXPECTED_SPREAD * expected) ** 2)
        return measured.db + share * (expected - measured.db)

    def is_better(self, before: Shown, after: Shown) -> bool:
        """Return whether `after` loses less than `before`. If the witnesses see no difference beyond chance,
        return whether it agrees better with the model's pictures."""
        loss = self.lost(before, after)
        measured = loss.spread is None or abs(loss.db) > loss.spread
        return loss.db < 0 if measured else after.error < before.error

    def _colours(self, features: np.ndarray) -> np.ndarray:
        return head_colours(self._head, features, self.rays_d[self._hits])

    def channel_loss(self, kept: np.ndarray) -> Loss:
        """Return the loss if the model's own rendered features were multiplied by `kept` [n_channels,
        n_channels], a projection."""
        return self._loss_of_colours(self._colours((self._features @ kept.T).astype(np.float32)))

    def direction_loss(self) -> Loss:
        """Return the loss if every colour were the mean of its colours along N_DIRECTIONS random other rays'
        directions."""
        random = np.random.default_rng(SEED)
        mean = np.zeros((len(self._hits), 3), np.float32)
        for _ in range(N_DIRECTIONS):
            others = self.rays_d[random.permutation(self._hits)]
            mean += head_colours(self._head, self._features, others) / N_DIRECTIONS
        return self._loss_of_colours(mean)

    def _loss_of_colours(self, colours: np.ndarray) -> Loss:
        """Return the loss if the rays that hit something had these `colours` [n_hits, 3] instead of the
        model's."""
        rgb = self.wanted.copy()
        rgb[self._hits] += self._opacity * (colours - self._colours(self._features))
        return self.lost(self.own, self._compared(rgb))

    def compare(self, features: np.ndarray, opacity: np.ndarray) -> Shown:
        """Return the pictures that the model's own head makes of the rays' composited `features` [n,
        n_channels] and `opacity` [n]."""
        met = np.flatnonzero(opacity > 0)
        colours = head_colours(self._head, features[met], self.rays_d[met])
        return self._compared(self._pictures(met, colours, opacity))

    def _pictures(self, hits: np.ndarray, colours: np.ndarray, opacity: np.ndarray) -> np.ndarray:
        """Return colours [n, 3] over the background: those of the rays numbered `hits` are `colours`
        [n_hits, 3] with `opacity` [n]."""
        rgb = (1 - opacity[:, None]) * self.background
        rgb[hits] += colours * opacity[hits, None]
        return rgb

    def _compared(self, rgb: np.ndarray) -> Shown:
        """Compute the errors of the colours [n, 3] of all rays."""
        end = len(rgb) - self._n_learned
        between, of_witnesses = slice(self._n_between), slice(self._n_between, end)
        error = float(np.mean((rgb[between].astype(np.float64) - self.wanted[between]) ** 2))
        errors = None if self._witnesses is None else self._witnesses.errors(rgb[of_witnesses])
        learned = None if self._learned is None else self._learned.errors(rgb[end:])
        return Shown(error, errors, rgb, learned)

    def march(self, grid: SparseGrid, n_fetches: int) -> MarchResult:
        """March the rays through `grid` as the player does, with `n_fetches` feature lookups a ray."""
        march = choose_march("auto")[1].march

        def some(first: int) -> MarchResult:
            rows = slice(first, first + RAYS_AT_ONCE)
            return march(grid, self.rays_o[rows], self.rays_d[rows], n_fetches)

        firsts = range(0, len(self.rays_o), RAYS_AT_ONCE)
        parts = in_threads(some, firsts, None)
        hits = [first + part.hits for first, part in zip(firsts, parts, strict=True)]
        return MarchResult(*map(np.concatenate, zip(*parts, strict=True)))._replace(hits=np.concatenate(hits))

    def measure(self, name: str, grid: SparseGrid, head: Head, n_fetches: int) -> Stage:
        """Play `grid` with `head`, and append the result to the stages as `name`."""
        return self.measure_march(name, self.march(grid, n_fetches), head)

    def measure_march(self, name: str, played: MarchResult, head: Head) -> Stage:
        """Evaluate `head` on the composites of a march, and append the result to the stages as `name`."""
        self.stages.append(self._stage(name, played, head))
        return self.stages[-1]

    def look(self, name: str, grid: SparseGrid, head: Head, n_fetches: int) -> Stage:
        """Play `grid` with `head`, without appending the result to the stages."""
        return self._stage(name, self.march(grid, n_fetches), head)

    def first_parts(self, folder: Path, n_fetches: int, max_memory: float) -> list[Shown]:
        """Play the first part of the asset in `folder`, then the first two, and so on up to the last but one,
        as far as each fits into `max_memory` gigabytes."""
        found = []
        for n_parts in range(1, len(read_manifest(folder).parts)):
            try:
                asset = Asset.open(folder, max_memory=max_memory, parts=n_parts)
            except ConfigError:
                break  # the symbols that later parts add to take memory that the whole asset does not
            found.append(self.look("first parts", asset.grid, AssetHead.of(asset), n_fetches).shown)
        return found

    def _stage(self, name: str, played: MarchResult, head: Head) -> Stage:
        hits = played.hits
        colours = head(played.features, self.rays_d[hits])
        shown = self._compared(self._pictures(hits, colours, played.opacity))
        samples = played.n_density_samples[hits] if len(hits) else np.zeros(1)
        return Stage(
            name,
            -10 * float(np.log10(max(shown.error, 1e-12))),
            self.lost(self.own, shown),
            float(np.median(samples)),
            float(np.percentile(samples, 95)),
            shown,
        )

    def table(self) -> list[dict[str, Any]]:
        """Return the figures of the stages so far, for a report."""
        return [
            {
                "name": stage.name,
                "psnr": stage.psnr,
                "loss_db": stage.loss.db,
                "loss_db_spread": stage.loss.stated,
                "samples_median": stage.samples_median,
                "samples_p95": stage.samples_p95,
            }
            for stage in self.stages
        ]


def _some_learned(model: Model) -> Witnesses | None:
    """Return about N_LEARNED of a model's training pixels, spread evenly, with the colours that the field
    should show; None if it has none."""
    if model.training_pixels is None or not len(model.training_pixels.pixels):
        return None
    some = model.neutral(model.training_pixels.some(N_LEARNED))
    return Witnesses(some.counts, some.pixels, some.rgba, np.zeros(0, np.int32))


def expected_loss(error: float, model_psnr: float) -> float:
    """Return the loss in dB by a mean square `error` to the pictures of a model of `model_psnr` dB, if the
    model's own errors are independent of it.

    >>> round(expected_loss(10 ** (-4.57), 29.53), 2)  # k = 5 of docs: 45.7 dB to the full render
    0.1
    """
    return 10 * float(np.log10(1 + error * 10 ** (model_psnr / 10)))
