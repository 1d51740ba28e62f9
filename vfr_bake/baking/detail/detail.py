"""Reduce a refined grid to the detail that its pictures need.

After refinement, cells that hardly any ray sees are left out (`vfr_bake.baking.detail.seen`). Then, places
where a coarser level will do are shown by that level, first for the densities, then for the features
(`vfr_bake.baking.detail.shown`). How far each of these steps goes is decided by the loss on training pixels.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np

from player.asset.grid import SparseGrid
from player.cameras.camera import Camera
from player.progress import Progress
from vfr_bake.baking.detail.errors import (
    BrickLevels,
    density_errors,
    feature_errors,
    heavy_vertices,
    levels_of_densities,
    levels_of_features,
)
from vfr_bake.baking.detail.search import largest
from vfr_bake.baking.detail.seen import block_weights, heavy_blocks, live_of_blocks, thinned
from vfr_bake.baking.detail.shown import (
    COARSEST_SHOWN,
    Choice,
    Wanted,
    mean_values,
    take_rows,
    wanted_values,
)
from vfr_bake.baking.distillation import TeacherRays
from vfr_bake.baking.grids import Layout, whole_codes
from vfr_bake.baking.held_out import Head, HeldOut, Shown, Stage
from vfr_bake.training.length.witness_loss import Loss

N_SEEING = 4_000_000
"""Rough number of rays whose weights decide which cells are seen, if the views have as many pixels."""
N_COMPARED = 100_000
"""Rays on which coarser levels are compared with the finest one."""
LEAST_SHARE, MOST_SHARE = 1e-6, 0.05
"""Range of the share of all sample weight that is given up with cells that are hardly seen."""
SEEN_LOSS, DENSITY_LOSS, STEP_LOSS, FEATURE_LOSS = 0.25, 0.25, 0.5, 0.5
"""Shares of the allowed loss that may be caused by cells that are left out, by coarser densities, by longer
steps in them, and by coarser features."""
LONGEST_STEPS = (4, 2)
"""Most base steps that a sample in coarser densities stands for; the first value that loses little enough is
used. On level l the limit is also 2^l steps, as its cells are 2^l times as wide."""


@dataclass(frozen=True, eq=False)
class Levels:
    """A pyramid of features, the bricks that are dropped from it, and the values of all its levels."""

    choice: Choice
    dropped: list[np.ndarray]
    """The dropped bricks of each level, as returned by `Choice.dropped`."""
    values: list[np.ndarray]
    """For each level, [n_vertices, n_channels] int16 latent features, the finest first."""


@dataclass(eq=False)
class Needed:
    """The refined values that are to be stored."""

    layout: Layout
    """The layout of the whole finest level, some bricks of which are not shown."""
    density: np.ndarray
    """[n_densities] float32 density codes of all vertices of the finest level."""
    features: np.ndarray
    """[n_features, n_channels] int16 latent features of all vertices of the finest level."""
    wanted_densities: Wanted
    """The densities' cells that are shown, and their wanted values."""
    levels_of_features: Levels

    def take_features(self) -> Wanted:
        """Return the features' cells that are shown, and their wanted values. This empties `features` and
        `levels_of_features`, because there may be no memory for all of them."""
        levels = self.levels_of_features
        shown = levels.choice.shown(levels.dropped)
        wanted = wanted_values(levels.choice, levels.values, shown, sampled=False)
        self.features = self.features[:0].copy()
        levels.values.clear()
        return wanted


@dataclass(frozen=True, eq=False)
class Detail:
    """The choice of the detail to store, with the settings for the pictures by which it is made."""

    held_out: HeldOut
    head: Head
    n_fetches: int
    """Feature lookups of a ray, 0 for every sample."""
    most_db: float
    """Allowed loss in dB."""
    progress: Progress
    left_out: dict[str, str] = field(default_factory=dict)
    """Descriptions, by topic, of what is not stored and what that changed; filled by `needed`."""

    def needed(
        self,
        layout: Layout,
        density: np.ndarray,
        features: np.ndarray,
        cameras: list[Camera],
        teacher: TeacherRays,
    ) -> Needed:
        """Choose the values to store.

        Args:
            layout: the layout of the finest level.
            density: [n_densities] density codes, which need not be whole.
            features: [n_features, n_channels] int16 latent features, changed in place.
            cameras: views in the model frame that decide which cells are seen; if there are none, every cell
                is stored.
            teacher: rays of such views.
        """
        if cameras:
            layout, density, features = self._without_unseen(layout, density, features, cameras)
        grid = layout.grid(density, features)
        rays = teacher.some(N_COMPARED)
        densities, grid = self._densities(layout, density, grid, rays)
        # Free the grid's feature codes: they are computed again, together with those of the coarser levels.
        grid = replace(grid, features=grid.features[:0].copy())
        return Needed(layout, density, features, densities, self._features(layout, features, grid, rays))

    def level_steps(self, grid: SparseGrid, max_loss_db: float | None) -> tuple[int, ...]:
        """Choose the base steps that a sample stands for in each level of the densities of `grid`, which is
        the grid of the stored values.

        They are the longest steps that lose little enough, and with which the asset loses at most
        `max_loss_db`, if that was given. Long steps can lose something, because coarser bricks also lie in
        empty space, and a long step from there may end in finer bricks.
        """
        before = self._look(replace(grid, level_steps=np.ones(grid.n_levels, np.int32)))
        for longest in LONGEST_STEPS:
            steps = np.minimum(1 << np.arange(grid.n_levels), longest).astype(np.int32)
            after = self._stage(replace(grid, level_steps=steps))
            fits = max_loss_db is None or after.loss.db <= max_loss_db
            lost = self.held_out.lost_by_leaving_out(before, after.shown)
            if fits and lost.most <= STEP_LOSS * self.most_db:
                return tuple(steps.tolist())
        return (1,) * grid.n_levels

    def _look(self, grid: SparseGrid) -> Shown:
        return self._stage(grid).shown

    def _stage(self, grid: SparseGrid) -> Stage:
        return self.held_out.look("detail", grid, self.head, self.n_fetches)

    def _without_unseen(
        self, layout: Layout, density: np.ndarray, features: np.ndarray, cameras: list[Camera]
    ) -> tuple[Layout, np.ndarray, np.ndarray]:
        """Return layout, densities and features without the cells in which the samples of all views together
        weigh next to nothing."""
        grid = layout.grid(density, features)
        weights = block_weights(grid, cameras, N_SEEING, self.progress)
        before = self._look(grid)

        def lost(share: float) -> Loss:
            live = live_of_blocks(heavy_blocks(weights, float(np.exp(share)))).astype("<u8")
            seen = replace(grid, live=grid.live & live.view(np.uint8).reshape(-1))
            return self.held_out.lost_by_leaving_out(before, self._look(seen))

        found = largest(lost, np.log(LEAST_SHARE), np.log(MOST_SHARE), SEEN_LOSS * self.most_db)
        if found is None:
            return layout, density, features
        share = float(np.exp(found.amount))
        left = thinned(layout, heavy_blocks(weights, share))
        layout.forget()
        n, n_left = len(layout.densities), len(left.layout.densities)
        self.left_out["hardly seen"] = (
            f"{1 - n_left / n:.0%} of the densities' vertices, and the features there: of all that the views "
            f"see, {share:.2%} is there; {found.loss}"
        )
        return left.layout, density[left.densities], take_rows(features, left.features)

    def _densities(
        self, layout: Layout, density: np.ndarray, grid: SparseGrid, rays: TeacherRays
    ) -> tuple[Wanted, SparseGrid]:
        """Choose the densities' cells to show. Returns them with their wanted values, and a grid that shows
        nearly those values. Values of coarser levels are means of densities, not of their logarithms."""
        pyramid = layout.pyramids.densities
        low, high = layout.density_range
        slope = (high - low) / 255
        finest = np.clip(density, 0, 255).astype(np.float32)[:, None]
        means = mean_values(pyramid, np.exp(slope * finest), np.ones(len(finest)))
        values = [finest, *(np.log(mean) / slope for mean in means[1:])]
        codes = [np.clip(np.rint(of_level), 0, 255).astype(np.uint8) for of_level in values]
        levels = levels_of_densities(grid, pyramid, codes[: COARSEST_SHOWN + 1])
        choice = Choice(pyramid, tuple(density_errors(levels, rays)))
        dropped = self._shown(choice, levels, DENSITY_LOSS, "densities' detail")
        shown = wanted_values(choice, values, choice.shown(dropped), sampled=True)
        return shown, levels.at(choice.levels(dropped))

    def _features(self, layout: Layout, features: np.ndarray, grid: SparseGrid, rays: TeacherRays) -> Levels:
        """Choose the levels that show the features. The values of coarser levels are means, in which each
        vertex counts by the weight with which rays see it."""
        pyramid = layout.pyramids.features
        n_levels = min(len(pyramid.levels), COARSEST_SHOWN + 1)
        ends = np.cumsum([vertices.n for vertices in pyramid.vertices[:n_levels]])
        codes = np.empty((ends[-1], features.shape[1]), np.int8)
        codes[: ends[0]] = whole_codes(features)
        heavy = heavy_vertices(levels_of_features(grid, pyramid, codes, 1), int(ends[0]), rays)
        values = mean_values(pyramid, features, heavy)
        values[1:] = [np.rint(of_level).astype(np.int16) for of_level in values[1:]]
        for level, (first, end) in enumerate(pairwise(ends), start=1):
            codes[first:end] = whole_codes(values[level])
        levels = levels_of_features(grid, pyramid, codes, n_levels)
        choice = Choice(pyramid, tuple(feature_errors(levels, rays)))
        return Levels(choice, self._shown(choice, levels, FEATURE_LOSS, "features' detail"), values)

    def _shown(self, choice: Choice, levels: BrickLevels, share: float, name: str) -> list[np.ndarray]:
        """Choose the bricks of each level to drop, for a loss of up to `share` of the allowed loss."""
        if len(choice.errors) == 1:
            return []
        before = self._look(levels.at(0))

        def lost(amount: float) -> Loss:
            shown = choice.levels(choice.dropped(choice.worth(amount)))
            return self.held_out.lost_by_leaving_out(before, self._look(levels.at(shown)))

        found = largest(lost, 0.0, 1.0, share * self.most_db)
        if found is None:
            return choice.dropped(-np.inf)
        dropped = choice.dropped(choice.worth(found.amount))
        n = np.bincount(choice.levels(dropped), minlength=COARSEST_SHOWN + 1) / len(choice.pyramid.levels[0])
        shares = ", ".join(f"{of_level:.0%} on level {level}" for level, of_level in enumerate(n))
        self.left_out[name] = f"all that the places of bricks do not need, shown {shares}; {found.loss}"
        return dropped
