"""The bake, step by step: find the visible cells, choose the values to store, train the head, make the mesh,
and measure the loss of each step.

The loss of each step is measured on pixels of photographs that training has not learned from, and on views
between the training cameras. What may be left out brick by brick and code by code is decided on training
pixels (`vfr_bake.baking.held_out`). The final result is measured by playing the written files.
"""

from __future__ import annotations

import time
from bisect import bisect_left
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from exporters.formats.ply import small_ply_bytes
from exporters.head.onnx_head import HeadWeights, Range, head_onnx
from exporters.shapes.mesh import TriangleMesh
from exporters.surface.asset_surface import Removed
from player.asset.asset import Asset, GridArrays, write_asset
from player.asset.manifest import Manifest
from player.asset.target import check_asset_target
from player.cameras.transforms import write_cameras
from player.errors import TrainingError
from player.files.memory import give_back
from player.head.head import Head
from player.progress import Report
from vfr_bake import __version__
from vfr_bake.baking.cells import find_cells, fit_cells, lattice_step, marking_grid
from vfr_bake.baking.detail.detail import Detail, Needed
from vfr_bake.baking.distillation import (
    TeacherRays,
    teacher_rays,
    with_field_features,
)
from vfr_bake.baking.grids import (
    Layout,
    Parts,
    Projection,
    code_step,
    evaluate_densities,
    features_of_field,
    head_sensitivity,
    latent_features,
    make_layout,
    project,
    some_features,
)
from vfr_bake.baking.head import fold_head, runner, small_head
from vfr_bake.baking.held_out import BETWEEN, HeldOut, Shown, Stage, views_between
from vfr_bake.baking.limits import (
    MANIFEST_BYTES,
    LossMissedError,
    cells_that_fit,
    check_budget,
    file_sizes,
    frame_ms,
    keep_to_time,
    page_memory,
    unwritten_asset,
)
from vfr_bake.baking.mesh import bake_mesh, mesh_bytes
from vfr_bake.baking.plan import (
    check_bakeable,
    make_plan,
    other_bytes,
    refinement_seconds,
)
from vfr_bake.baking.qualities import Qualities, compared_views, fitting_qualities
from vfr_bake.baking.rate.importance import importance
from vfr_bake.baking.rate.price import Prices, PriceSearch
from vfr_bake.baking.refinement import Stored, Tuning
from vfr_bake.baking.report import BakeReport, BakeResult, side_by_side
from vfr_bake.config import BakeConfig
from vfr_bake.presets import BakeChoice
from vfr_bake.rendering.occupancy import OccupancyGrid
from vfr_bake.training.model_file import Model

N_PROJECTED = 100_000
"""Number of rays from which the projection to fewer feature channels is computed: they give the directions in
feature space that the colours depend on, and the second moment of the features."""
DETAIL_SHARE = 0.5
"""Share of what is left of the loss that was asked for, which giving up detail may lose at most; rounding the
values that stay loses the rest."""
COARSEST = 64
"""Cells along an axis below which grids do not become coarser for frames to take less time."""
LAST_PART = "writing and checking"
"""The part of a bake in which the report is made."""


def bake(model: Model, folder: Path, config: BakeConfig, report: Report, force: bool = False) -> BakeResult:
    """Bake `model` into the asset `folder`.

    Raises OutputError, ConfigError, or TrainingError; nothing is written then. A TrainingError means that
    nothing is visible, that the baked grid does not show what the model shows, or that the result misses
    `max_loss_db`, `max_mb` or `target_ms`. If no preset is given, and balanced misses `max_loss_db`, it
    begins again with fidelity.
    """
    check_asset_target(folder, force)
    check_bakeable(model, config)
    work = _Bake(model, config, report)
    try:
        return work.run(folder, force)
    except LossMissedError:
        if config.preset is not None:
            raise
    spent = sum(work.seconds.values())
    del work  # free its memory
    finer = _Bake(model, replace(config, preset="fidelity"), report)
    finer.left_out["preset"] = f"balanced: it loses more than {config.max_loss_db:g} dB"
    result = finer.run(folder, force)
    return replace(result, seconds=result.seconds + spent)


class _Bake:
    """One bake: the state that its steps share."""

    def __init__(self, model: Model, config: BakeConfig, report: Report) -> None:
        self.model, self.config = model, config
        self.choice = config.choice(model.field.config.unbounded)
        self.seconds: dict[str, float] = {}
        """Wall-clock seconds of each part of the bake."""
        self.left_out: dict[str, str] = {}
        """Descriptions, by topic, of what was left out of the asset and what that changed."""
        self.lookups: dict[str, float] = {}
        self.n_fetches = self.choice.n_fetches
        self.plan = make_plan(model, config)
        self._rendered: TeacherRays | None = None
        """Training rays that were made to find cells, until they are needed."""
        self._report = report
        self._begun = time.monotonic()
        with self._part("teacher"):
            self.held_out = HeldOut(model, config.check_views)

    def run(self, folder: Path, force: bool) -> BakeResult:
        layout, n_cells = self._cells()
        stored, teacher, again = self._store(layout, self.plan.n_rays(n_cells))
        while not self._is_in_time(stored, layout):
            del layout, stored, teacher, again  # free memory for the coarser ones
            self.plan = self.plan.coarser()
            self.held_out.stages.clear()
            layout, n_cells = self._cells()
            stored, teacher, again = self._store(layout, self.plan.n_rays(n_cells))
        left = refinement_seconds(self.choice, time.monotonic() - self._begun)
        most_kept = self.plan.kept_bytes(n_cells)
        tuning = Tuning(self.config, self.choice, self.held_out, self._report, left, most_kept)
        with self._part("refinement"):
            stored = tuning.run(stored, layout, teacher, again)
        limit, loss = self.config.max_loss_db, tuning.kept.loss
        if self.config.preset is None and limit is not None and loss.db > limit:
            raise LossMissedError(f"its refined values lose {loss}, more than {limit:g} dB")
        self.n_fetches, self.lookups = tuning.n_fetches, tuning.lookups
        self.left_out |= tuning.left_out
        head = head_onnx(stored.head, tuning.ranges)
        played = runner(stored.head, tuning.ranges)
        most_db = self.choice.detail_loss_db
        if limit is not None:
            left_db = limit - loss.db
            most_db = min(most_db, max(DETAIL_SHARE * left_db, 0.0))
        detail = Detail(self.held_out, played, self.n_fetches, most_db, partial(self._report, "detail"))
        with self._part("detail"):
            needed = self._needed(detail, layout, stored, teacher)
        self.left_out |= detail.left_out
        layout, weights = needed.layout, stored.head
        del stored, again  # free the features, and the cells that were just dropped
        with self._part("codes"):
            arrays = self._spend(weights, needed, teacher, tuning.ranges, len(head))
            level_steps = detail.level_steps(layout.played(arrays), self.config.max_loss_db)
        manifest = self._manifest(layout, arrays, level_steps)
        del teacher, needed, layout  # free memory for playing and meshing the asset
        with self._part("qualities"):
            found = self._qualities(manifest, arrays, head, tuning.kept)
            manifest = replace(manifest, agreement=found.agreement, quality_fetches=found.fetches)
        figures: dict[str, Any] = {
            "n_vertices": int(arrays.densities.first_rows[-1]),
            "n_feature_vertices": int(arrays.features.first_rows[-1]),
            "stages": self.held_out.table(),
        }
        made: list[BakeReport] = []

        def finish(new: Path) -> dict[str, bytes]:
            """Return the mesh and the report as files; the mesh comes last because its size limit depends on
            the other files. `figures` is part of the manifest, which is written again after this."""
            coarser = self.held_out.first_parts(new, self.n_fetches, self.config.memory)
            asset = Asset.open(new, verify=True, max_memory=self.config.memory)
            mesh, removed = self._mesh(asset, file_sizes(new))
            figures["mesh_faces"], figures["mesh_floaters_removed"] = len(mesh.faces), removed.floaters
            data = small_ply_bytes(mesh)
            report = self._judge(asset, coarser, file_sizes(new) | {"mesh.ply": len(data)}, folder.name)
            made.append(report)
            figures["parts"] = report.parts
            files = report.with_files(replace(asset.manifest, provenance=manifest.provenance), data)
            timed = self.config.target_ms is not None
            ms = frame_ms(asset, self.model.cameras[0], self.n_fetches) if timed else None
            loss, megabytes = self.held_out.stages[-1].loss, sum(report.n_bytes.values()) / 1e6
            check_budget(self.config, loss, megabytes, ms)
            return files

        with self._part(LAST_PART):
            manifest = replace(manifest, provenance=manifest.provenance | {"baked": figures})
            cameras = write_cameras(self.model.cameras)
            write_asset(folder, manifest, arrays, head, None, cameras, force, finish)
        last = self.held_out.stages[-1]
        figures |= {"psnr_to_full_model": last.psnr, "loss_db": last.loss.db, "time": self.seconds}
        figures |= {"loss_db_spread": last.loss.stated}
        figures |= {"stages": self.held_out.table(), "left_out": self.left_out}
        figures["gpu_bytes"] = made[0].gpu_bytes
        n_bytes, seconds = sum(file_sizes(folder).values()), sum(self.seconds.values())
        return BakeResult(figures["n_vertices"], n_bytes, seconds, last.loss, figures, made[0].missed)

    def _cells(self) -> tuple[Layout, int]:
        """Return the layout of the stored densities and features, and the number of the features' cells."""
        model, plan = self.model, self.plan
        marking = marking_grid(model, self.config, plan.resolutions.features)
        if marking is not None and plan.marks_with_rays:  # march the training rays once for both
            with self._part("teacher"):
                n_rays = plan.n_rays(plan.n_cells)
                self._rendered = teacher_rays(model, n_rays, False, self._report, marking)
        with self._part("visibility"):
            progress = partial(self._report, "visibility")
            visible, step, left_out = find_cells(
                model, self.config, plan.resolutions, self.held_out, marking, progress
            )
        del marking  # free its marks
        if left_out is not None:
            self.left_out["cells"] = left_out
        limits = list(self._room_for_cells())
        most, room = min(limits)
        fitted = fit_cells(visible, plan.resolutions, most)
        unbounded, resolutions = model.field.config.unbounded, fitted.resolutions
        if resolutions == plan.resolutions:
            _, room = limits[0]  # memory alone limits a plan, or the time of a frame
        if plan.longer > 1:
            room = f"frames of {self.config.target_ms:g} ms"
        if resolutions != plan.wanted:
            self.left_out["resolution"] = (
                f"{resolutions.densities} cells along an axis for densities, {resolutions.features} for "
                f"features, in place of {plan.wanted.densities} and {plan.wanted.features}: more do not fit "
                f"into {room}; part of the loss after 'grid'"
            )
            step = lattice_step(resolutions.densities) if unbounded else step * plan.longer
        near = 0.0 if isinstance(model.sampler, OccupancyGrid) else model.sampler.near
        layout = make_layout(fitted.cells, step, resolutions, unbounded, near, self.choice.density_step)
        return layout, fitted.n_cells

    def _room_for_cells(self) -> Iterator[tuple[int, str]]:
        """Yield pairs: the number of feature cells that fit, and the name of the limit they fit into."""
        config, choice, plan = self.config, self.choice, self.plan
        yield plan.most_cells, f"{config.memory:.3g} GB of memory"
        if config.max_mb is not None:
            others = other_bytes(self.model, choice, config.max_mb)
            yield cells_that_fit(config.max_mb, others), f"{config.max_mb:g} MB"
        if np.isfinite(plan.page_cells):
            yield int(plan.page_cells), f"a page that takes {choice.page_mb:g} MB of graphics memory"

    def _mesh(self, asset: Asset, sizes: dict[str, int]) -> tuple[TriangleMesh, Removed]:
        """Make the mesh of an asset that is complete but for it, and whose files have these `sizes`."""
        most = mesh_bytes(sum(sizes.values()) - sizes["mesh.ply"], self.config.max_mb)
        resolution = self.choice.mesh_resolution or asset.manifest.resolution
        with self._part("mesh"):
            baked = bake_mesh(asset, resolution, most, self.config.memory, self._report)
        if baked.left_out is not None:
            self.left_out["mesh"] = baked.left_out
        return baked.mesh, baked.removed

    def _store(self, layout: Layout, n_rays: int) -> tuple[Stored, TeacherRays, Callable[[], Parts]]:
        """Compute the values to store, before refinement.

        Returns the codes of the field's densities and projected features with the head that takes them, the
        training rays of the refinement (about `n_rays`, if they are not made yet), and a function that
        computes the unrefined feature codes again.
        """
        model, choice, held_out = self.model, self.choice, self.held_out
        teacher, self._rendered = self._rendered, None
        if teacher is None:
            with self._part("teacher"):
                teacher = teacher_rays(model, n_rays, layout.contracted, self._report)
        with self._part("grid"):
            density = evaluate_densities(model, layout, partial(self._report, "densities"))
            projection = self._projection(teacher)
            step = code_step(some_features(model, layout, projection.matrix), choice.code_levels)
            matrix = projection.matrix / step
            features = latent_features(model, layout, matrix, partial(self._report, "features"))
            first = model.field.head.first_weights().astype(np.float64)
            head = fold_head(model.field.head, first @ projection.back * step)
            grid = layout.grid(density, features)
            played = held_out.march(grid, 0)
            own = with_field_features(model, layout, grid, held_out.rays_o, held_out.rays_d, played)
            held_out.measure_march("grid", own, runner(fold_head(model.field.head, first)))
            projected = (own.features @ matrix.T).astype(np.float32)
            held_out.measure_march("rank", own._replace(features=projected), runner(head))
            held_out.measure_march("codes", played, runner(head))
        n_all = model.field.config.n_channels
        self.left_out["channels"] = (
            f"{n_all - features.shape[1]} of {n_all} feature channels: what the loss after 'rank' has more "
            "than that after 'grid', before refinement"
        )
        again = partial(features_of_field, model, layout, matrix)
        return Stored(head, features, density), teacher, again

    def _needed(self, detail: Detail, layout: Layout, stored: Stored, teacher: TeacherRays) -> Needed:
        """Drop the detail of the refined values that the pictures do not need. Changes the features of
        `stored` in place."""
        cameras = [] if self.config.no_cull else self.model.model_cameras()
        cameras += views_between(self.model, BETWEEN * len(cameras), seed=1, wide=layout.contracted)
        return detail.needed(layout, stored.density, stored.features, cameras, teacher)

    def _projection(self, teacher: TeacherRays) -> Projection:
        """Return the projection to the number of channels that was asked for, or to the fewest that lose no
        more than the preset allows."""
        head, most = self.model.field.head, self.choice.n_channels
        some = teacher.some(N_PROJECTED)
        features, opacity = self.model.sampler.composited_features(self.model.field, some.rays_o, some.rays_d)
        sensitivity = head_sensitivity(head, features, some.rays_d, opacity)
        every = project(sensitivity, features, most)
        if self.config.n_channels is not None:
            return every

        def enough(n: int) -> bool:
            some = every.first(n)
            return self.held_out.channel_loss(some.back @ some.matrix).most <= self.choice.channel_loss_db

        # The loss falls with every added channel, so bisect: each measurement runs the model's own slow head.
        return every.first(1 + bisect_left(range(1, most), True, key=enough))

    def _spend(
        self,
        weights: HeadWeights,
        needed: Needed,
        teacher: TeacherRays,
        ranges: tuple[Range, ...] | None,
        head_bytes: int,
    ) -> GridArrays:
        """Choose the codes to store: the fewest bits whose loss stays within the limit and that fit the bytes
        asked for."""
        held_out, config, layout = self.held_out, self.config, needed.layout
        head = runner(weights, ranges)
        stored = Stored(weights, needed.features, needed.density)
        grid = layout.grid(stored.density, stored.features)
        matters = importance(stored, layout, grid, teacher, ranges, self.model.background)
        refined = held_out.look("refined", grid, head, self.n_fetches)
        del grid, stored
        prices = Prices(layout, needed.wanted_densities, needed.take_features(), matters)
        layout.forget()
        del matters
        left = None if config.max_loss_db is None else config.max_loss_db - refined.loss.db

        def loss_db(arrays: GridArrays) -> float:
            after = held_out.look("codes", layout.played(arrays), head, self.n_fetches)
            if left is not None:
                return after.loss.db - refined.loss.db
            return held_out.loss_of_change(refined.shown, after.shown)

        search = PriceSearch(prices, loss_db, held_out.model_error, partial(self._report, "codes"))
        price = search.for_preset(self.choice.code_loss_db) if left is None else search.for_loss(left)
        if config.max_mb is not None:
            others = head_bytes + len(write_cameras(self.model.cameras)) + MANIFEST_BYTES

            def megabytes(values: float) -> float:
                return (others + values + mesh_bytes(round(others + values), None)) / 1e6

            price = search.for_bytes(price, megabytes, config.max_mb)
        return search.at(price).arrays

    def _qualities(self, manifest: Manifest, arrays: GridArrays, head: bytes, refined: Stage) -> Qualities:
        """Choose the settings of `high` and `fast` pictures of the asset."""
        views = compared_views(self.model, self.config.check_views)
        error = self.held_out.model_error * 10 ** (refined.loss.db / 10)
        with TemporaryDirectory() as folder:
            asset = unwritten_asset(Path(folder), manifest, arrays, {"head.onnx": head})
            return fitting_qualities(asset, views, error)

    def _is_in_time(self, stored: Stored, layout: Layout) -> bool:
        """Narrow the head and take fewer feature lookups, as far as it takes to render a frame in the time
        that was asked for. Return whether that is enough.

        Raises TrainingError if it is not, and the grids cannot become coarser.
        """
        config = self.config
        if config.target_ms is None:
            return True
        try:
            with self._part("pace"):
                self.choice = self._in_time(stored, layout, config.target_ms)
        except TrainingError:
            if config.resolution or config.feature_resolution or min(self.plan.resolutions) < COARSEST:
                raise
            return False
        return True

    def _in_time(self, stored: Stored, layout: Layout, target_ms: float) -> BakeChoice:
        """Return the preset's choice with the head narrowed and the feature lookups reduced as far as it
        takes to render a frame in `target_ms`. Raises TrainingError if it takes longer all the same."""
        arrays = layout.finest(stored.density, stored.features)
        scale = np.ones(arrays.features.n_channels)

        def head(width: int) -> bytes:
            shape = width, self.choice.head_layers, min(self.choice.head_bands, stored.head.sh_degree)
            weights = small_head(stored.head, *shape, scale) if width else stored.head
            any_ranges = [(0.0, 1.0)] * (2 + len(weights.directional)) if self.choice.head_bits == 8 else None
            return head_onnx(weights, any_ranges)

        manifest = self._manifest(layout, arrays, (1,))

        def measure(width: int, n_fetches: int) -> float:
            with TemporaryDirectory() as folder:
                asset = unwritten_asset(Path(folder), manifest, arrays, {"head.onnx": head(width)})
                return frame_ms(asset, self.model.cameras[0], n_fetches)

        same_head = self.config.head_width is not None or not self.choice.refine_steps
        return keep_to_time(self.choice, target_ms, measure, same_head, self.config.k != "auto")

    def _manifest(self, layout: Layout, arrays: GridArrays, level_steps: tuple[int, ...]) -> Manifest:
        """Build the manifest; the figures that the bake measures are added to it later."""
        model = self.model
        camera = model.cameras[0]
        return Manifest(
            generator=f"vfr-bake {__version__}",
            resolution=layout.densities.resolution,
            feature_resolution=layout.features.resolution,
            step=layout.step,
            aabb=layout.aabb,
            contracted=layout.contracted,
            near=layout.near,
            density_range=layout.density_range,
            level_steps=level_steps,
            density_steps=(layout.density_step,) * len(arrays.densities.values),
            feature_steps=(1,) * len(arrays.features.values),
            n_channels=arrays.features.n_channels,
            view_size=(camera.width, camera.height),
            world_from_model=tuple(tuple(row) for row in model.world_from_model.tolist()),
            n_fetches=self.n_fetches,
            background=tuple(model.background.tolist()),
            provenance={
                "bake": self._asked(),
                "train": model.train,
                "trained": model.figures,
            },
        )

    def _asked(self) -> dict[str, Any]:
        """Return the settings as resolved, among them the memory, which depends on the machine."""
        return asdict(self.config) | asdict(self.choice) | {"max_memory": self.config.memory}

    def _judge(
        self, asset: Asset, coarser: Sequence[Shown], n_bytes: dict[str, int], name: str
    ) -> BakeReport:
        """Play the written files, which have the sizes `n_bytes`, and report the result; `coarser`: what
        their first parts show."""
        last = self.held_out.measure("files", asset.grid, Head.of(asset), self.n_fetches)
        parts = [
            {"bytes": part.bytes, "loss_db": round(self.held_out.lost(last.shown, shown).db, 2)}
            for part, shown in zip(asset.manifest.parts, coarser, strict=False)  # without the last part
        ]
        preset = self.choice.preset
        gpu_bytes, missed = page_memory(asset, preset)
        if last.loss.spread is None:
            if self.config.max_loss_db is not None:
                missed.append(
                    f"loss: expected at most {self.config.max_loss_db:g} dB, which could not be measured, "
                    "because the model has no witnesses"
                )
        elif last.loss.least > self.choice.target_loss_db:
            missed.append(
                f"preset {preset}: expected a loss of at most {self.choice.target_loss_db:g} dB, "
                f"got {last.loss}"
            )
        pictures = list(side_by_side(self.model, asset))
        seconds = self.seconds | {LAST_PART: time.monotonic() - self._begun - sum(self.seconds.values())}
        return BakeReport(
            f"{name}: baked with preset {preset}", self._asked(), self.held_out.table(),
            self.held_out.measured_on(), n_bytes, seconds, self.left_out, self.lookups, parts, missed,
            gpu_bytes, pictures,
        )  # fmt: skip

    @contextmanager
    def _part(self, name: str) -> Iterator[None]:
        """Time the body as part `name`, and return freed memory to the system at its end. The time of parts
        nested in this one is not counted twice."""
        begin, others = time.monotonic(), sum(self.seconds.values())
        try:
            yield
        finally:
            give_back()
            inside = sum(self.seconds.values()) - others
            self.seconds[name] = self.seconds.get(name, 0.0) + time.monotonic() - begin - inside
