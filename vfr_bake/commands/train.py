"""`vfr-train`: the cameras, the pictures, the training with its checkpoints, and what is said about them."""

from __future__ import annotations

import math
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import fields, is_dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from player.app.commands import write_result
from player.errors import MissingExtraError, OutputError, VfrError
from player.files.files import write_bytes
from player.progress import Bar, Bars
from player.terminal import printable
from vfr_bake.commands.ctrl_c import CtrlC
from vfr_bake.commands.evaluate import finite
from vfr_bake.commands.targets import (
    check_json_target,
    check_model_target,
    check_page_target,
    check_preview_target,
)
from vfr_bake.config import TrainConfig

if TYPE_CHECKING:
    from vfr_bake.data.scene import Scene
    from vfr_bake.training.model_file import Model
    from vfr_bake.training.preview import Preview
    from vfr_bake.training.processes import Processes
    from vfr_bake.training.trainer import Trainer

EVAL_VIEWS = {False: 10, True: 3}
"""Number of test views rendered at the end if none is asked for, by whether the scene is unbounded."""
EVAL_SHARE, LEAST_EVAL_SECONDS = 0.2, 60.0
"""If none is asked for, test views take at most this share of the training's time, or these seconds if that
is more: then fewer are rendered, but at least one."""
N_LEARNED = 10_000
"""Pixels that training has learned from, at which it is measured: a second or two for a scene."""

GLANCED_AT = 24
"""Most pictures that a run looks at before it begins; `--check` looks at as many as ten seconds allow."""

USED_BY_CHECK = ("data", "model", "check", "html", "force", "json", "max_side", "downscale")
"""What may be given with `--check`: the options that have an effect, and the model that training would write,
so that `--check` can be put behind the command first."""


def train_command(options: Any) -> int:
    """Train, or look at the pictures alone, as `options` says (`vfr_bake.options.Train`); return the exit
    code."""
    from vfr_bake.data import load_scene, training_reader
    from vfr_bake.training.checkpoint import checkpoint_path, load_checkpoint
    from vfr_bake.training.preview import preview_path
    from vfr_bake.training.processes import Processes
    from vfr_bake.training.trainer import Trainer, choose_device

    if wrong := _misused(options):
        _say(wrong)
        return 2
    if options.check:
        return _check(options)
    checkpoint = checkpoint_path(options.model)
    goes_on = options.resume and checkpoint.exists()
    check_model_target(options.model, options.force or goes_on)
    check_json_target(options.json, [], options.model)
    if options.preview:
        check_preview_target(preview_path(options.model), options.force or options.resume)
    config = options.config
    choose_device(config.device)  # reports at once that there is no GPU, not after the cameras
    processes = Processes.from_environment()
    if options.resume and not goes_on and processes.first:
        _say(f"{checkpoint}: no such checkpoint: training begins anew")
    # Masks of no picture are found when cameras are estimated, and again when the pictures are read. What has
    # been said is kept, and is not said again.
    say = cache(partial(_tell, options.data))
    data = processes.in_turn(lambda: _as_folder(options.data, say))
    glance = _glance(data, config) if processes.first else None
    processes.in_turn(lambda: _find_cameras(data, say, config.scale))
    if glance is not None:
        glance()  # the pictures are bad, but their cameras were found nevertheless
    told = say if processes.first else None
    reader = training_reader(config, options.model, kept=not options.no_cache, say=told)
    with Bar("reading pictures", processes.first) as bar:
        scene = processes.in_turn(
            lambda: load_scene(data, bar.count, kind=config.kind, scale=config.scale, reader=reader)
        )
    config = replace(config, max_side=reader.size.max_side)
    scene, blurred = _without_blurred(scene, processes)
    if processes.first:
        _warn_of_folds(scene)
    trainer = Trainer(scene, config, processes)
    if goes_on:
        load_checkpoint(checkpoint, trainer)
        if processes.first:
            _say(f"going on after step {trainer.next_step}")
    preview = _preview(options, scene) if options.preview and processes.first else None
    with CtrlC() as ctrl_c:
        figures = _train_steps(trainer, checkpoint, preview, ctrl_c)
        figures["blurred"] = blurred
        stopped = figures.pop("interrupted")
        if processes.first:
            stopped = _finish(options, trainer, scene, figures, stopped, ctrl_c)
    processes.leave()
    return 130 if stopped else 0


def _misused(options: Any) -> str:
    """Return what is wrong with the options together; nothing if they fit."""
    if not options.check:
        if options.model is None:
            return "expected a model file to write, or --check; see vfr-train --help"
        return "" if options.html is None else "--html: does nothing without --check"
    lost = [name for name in _given(options) if name not in USED_BY_CHECK]
    return f"--{lost[0].replace('_', '-')}: does nothing with --check, which trains nothing" if lost else ""


def _given(settings: Any) -> Iterator[str]:
    """Yield the names of the settings, and of those within them, that are not what they are by default."""
    for field in fields(settings):
        value = getattr(settings, field.name)
        if is_dataclass(value):
            yield from _given(value)
        elif value != field.default:
            yield field.name


def _finish(
    options: Any,
    trainer: Trainer,
    scene: Scene,
    figures: dict[str, Any],
    interrupted: bool,
    ctrl_c: CtrlC,
) -> bool:
    """Write the model, measure it, and report; return whether Ctrl-C was pressed, in training or here.

    The first Ctrl-C waits until the model is written, and then test views are not rendered; while they are,
    it ends them. The model is complete, and is reported without them. An `interrupted` training is measured
    only on what it has learned from, and leaves a checkpoint.
    """
    from vfr_bake.evaluation import training_psnr
    from vfr_bake.training.checkpoint import checkpoint_path
    from vfr_bake.training.model_file import save_model, trained_model

    checkpoint, config = checkpoint_path(options.model), trainer.config
    stopped, witnesses = interrupted, None
    model = trained_model(trainer, scene, figures)
    try:
        figures["training_psnr"] = training_psnr(model, trainer.training_pixels(N_LEARNED, everywhere=True))
        witnesses = None if interrupted else trainer.witness_psnr()
    except KeyboardInterrupt:
        stopped = True
    if witnesses is not None:
        figures["witness_psnr"] = {"patches": witnesses.patches, "whole": witnesses.whole}
    save_model(options.model, replace(model, figures=figures))
    ctrl_c.waits = False
    stopped = stopped or ctrl_c.pressed
    n_views, most_seconds = config.eval_views, math.inf
    if n_views is None:
        n_views = EVAL_VIEWS[scene.unbounded]
        most_seconds = max(EVAL_SHARE * figures["seconds"], LEAST_EVAL_SECONDS)
    if not stopped and n_views and scene.test.cameras:
        try:
            figures |= _test_figures(model, scene, n_views, most_seconds)
        except KeyboardInterrupt:
            stopped = True
        else:
            save_model(options.model, replace(model, figures=figures))
    if interrupted:
        try:
            why = _unsaved(checkpoint, trainer)
        except KeyboardInterrupt:
            why = f"interrupted twice: {checkpoint} is not written anew"
        why = why or f"interrupted: the same command with --resume goes on; {checkpoint} is kept for it"
        _say(printable(why))
    else:
        checkpoint.unlink(missing_ok=True)
        if stopped:
            _say("interrupted: the model is complete, but not measured")
    for line in [*trainer.effects.described(), *(witnesses.lines() if witnesses else ())]:
        _say(line)
    _report_training(options, figures, interrupted)
    return stopped


def _check(options: Any) -> int:
    from vfr_bake.data import working_size
    from vfr_bake.data.check.check import check_data
    from vfr_bake.data.check.page import MARK, check_page

    data = Path(options.data).resolve()
    page = options.html or Path(f"{data.name if data.is_dir() else data.stem}_check.html")
    check_page_target(page, options.force, MARK)
    check_json_target(options.json, [], page)
    with Bar("looking") as bar:
        check = check_data(options.data, working_size(options.config), progress=bar.count)
    write_bytes(page, check_page(check))
    lines = [f"{options.data}: {printable(line)}" for line in check.lines()]
    write_result(options.json, check.document() | {"page": str(page)}, "\n".join([*lines, f"see {page}"]))
    return 0


def _glance(data: str, config: TrainConfig) -> Callable[[], None] | None:
    """Look at some of the pictures, and print what that shows as the first lines of a run.

    If the verdict is bad, print nothing, but return a function that prints these lines later: the estimation
    of cameras looks at all pictures, and refuses them in one line if they are bad.
    """
    from vfr_bake.data import working_size
    from vfr_bake.data.check.check import check_data
    from vfr_bake.data.check.verdict import BAD

    if data == "demo":
        return None
    try:
        check = check_data(data, working_size(config), seconds=3, most=GLANCED_AT)
    except VfrError:  # whatever reads the pictures will report it
        return None

    def say() -> None:
        for line in check.lines():
            _tell(data, line)

    if check.verdict == BAD:
        return say
    say()
    return None


def _say(text: str) -> None:
    print(f"vfr-train: {text}", file=sys.stderr)


def _tell(data: str, text: str) -> None:
    _say(printable(f"{data}: {text}"))


def _as_folder(data: str, say: Callable[[str], object]) -> str:
    """Return the folder of the pictures of a ZIP or a video, which is unpacked first. What stays as it is
    keeps its name: `./demo` is a folder, and `demo` the built-in scene. `say`: called with a sentence on what
    cannot be read of a video."""
    from vfr_bake.data import unpacked
    from vfr_bake.data.files.video import extract_frames
    from vfr_bake.data.poses import is_video

    with Bars() as bars:
        folder = unpacked(data, lambda done, of: bars.count("unpacking", done, of))
        if is_video(folder):
            folder = extract_frames(folder, lambda done, of: bars.count("frames", done, of), say)
    return data if folder == Path(data) else str(folder)


def _find_cameras(data: str, say: Callable[[str], object], scale: tuple[str, str, float] | None) -> None:
    """Estimate the cameras of photographs that have none, after looking for the pictures that `scale` names.
    `say`: called with a sentence on what the estimation found."""
    from vfr_bake.data import check_scale, needs_cameras
    from vfr_bake.data.poses import added_since, estimate_cameras

    if data == "demo":
        return
    folder = Path(data)
    if not needs_cameras(data):
        if added := added_since(folder):
            named = ", ".join(added[:3]) + (", ..." if len(added) > 3 else "")
            _tell(
                data,
                f"pictures that were added after the cameras were estimated are not used: {len(added)} "
                f"({named}): remove {folder / 'sparse'} to use them",
            )
        return
    if scale is not None:
        check_scale(folder, scale)
    with Bars() as bars:
        report = estimate_cameras(folder, bars.count, say)
    _say(printable(report.summary()))
    for name, reason in report.record.unplaced.items():
        _say(f"  no place for {printable(name)}: {printable(reason)}")


def _without_blurred(scene: Scene, processes: Processes) -> tuple[Scene, list[str]]:
    """Return the scene without blurred training pictures, and the names of these; print which they are."""
    from vfr_bake.data.quality.sharpness import without_blurred

    with Bar("looking for blur", processes.first) as bar:
        train, names = without_blurred(scene.train, bar.count)
    if names and processes.first:
        _say(
            f"{len(names)} of {len(scene.train.cameras)} training pictures are blurred, compared "
            f"with the others, and left out: {printable(', '.join(names))}"
        )
    return replace(scene, train=train), names


def _warn_of_folds(scene: Scene) -> None:
    from vfr_bake.data.models.folds import torn_views

    try:
        torn = torn_views(scene.train)
    except MissingExtraError:
        return
    if torn:
        named = printable(", ".join(f"{first} and {second}" for first, second in torn))
        _say(
            f"{printable(str(scene.name))}: {named} match, but their cameras are far apart: the "
            "subject seems to look the same from several sides, and its cameras are folded. Train on a "
            "folder of the pictures alone to have the cameras estimated anew"
        )


def _preview(options: Any, scene: Scene) -> Preview:
    from vfr_bake.training.preview import Preview, preview_path

    path = preview_path(options.model)
    _say(f"look at {printable(str(path))}, new every minute")
    return Preview(scene, path)


def _train_steps(
    trainer: Trainer, checkpoint: Path, preview: Preview | None, ctrl_c: CtrlC
) -> dict[str, Any]:
    """Train to the end, or to the end of the step in which Ctrl-C is pressed, with a checkpoint now and then;
    return the figures to report. In the first step, and pressed twice, it raises KeyboardInterrupt."""
    from vfr_bake.training.length.expectation import EXPECTED_AT, SAID_AT, TIMED, typical_step
    from vfr_bake.training.scores.metrics import decibels

    interrupted = told = False
    ends: deque[float] = deque(maxlen=TIMED)
    saved = time.monotonic()
    with Bar("training", trainer.processes.first) as bar:
        error, n_steps, rays = 0.0, 0, 0.0
        for last in trainer.run():
            ctrl_c.waits = True  # before the first step is done, there is nothing to keep
            weight = max(0.02, 1 / (n_steps + 1))
            n_steps += 1
            if n_steps == 1:
                bar.began(last.progress)
            if last.loss == last.loss:  # a skipped step reports NaN
                error += weight * (last.loss - error)
                rays += weight * (last.n_rays - rays)
            rate = rays * (last.step + 1) / max(last.seconds, 1e-9)
            skipped = f"  {trainer.n_bad_steps} skipped" if trainer.n_bad_steps else ""
            bar.share(
                last.progress,
                f"loss {error:.5f}  PSNR {decibels(error):.2f} dB  {rate:,.0f} rays/s{skipped}",
            )
            if trainer.processes.total(float(ctrl_c.pressed))[0]:  # all processes end after the same step
                interrupted = True
                break
            ends.append(last.seconds)
            if (n_steps == SAID_AT or trainer.next_step == EXPECTED_AT) and len(ends) > 1:
                _expect(trainer, typical_step(list(ends)), bar, n_steps == SAID_AT)
            if preview is not None:
                preview.update(trainer)
            due = time.monotonic() - saved > 60 * trainer.config.checkpoint_minutes
            if due and trainer.processes.first:
                why = _unsaved(checkpoint, trainer)
                if why and not told:
                    bar.close()
                    _say(f"{printable(why)}: training goes on without it")
                    told = True
                saved = time.monotonic()
    interrupted = interrupted or ctrl_c.pressed  # after the last step
    if n_steps and not trainer.head_learns and trainer.processes.first:
        _say(
            "the training has ended in its first steps, which teach the pilot network alone: the "
            "model shows random colours: train longer"
        )
    if preview is not None:
        preview.write(trainer)
    return {
        "effects": trainer.effects.figures(),
        "steps": trainer.next_step,
        "seconds": round(trainer.seconds, 1),
        "ended_early": trainer.duration.ended_early,
        "skipped_steps": trainer.n_bad_steps,
        "interrupted": interrupted,
    }


def _unsaved(checkpoint: Path, trainer: Trainer) -> str:
    """Write a checkpoint; return why it cannot be written, or nothing. The training in memory is worth more
    than its checkpoint, so a full disk does not end it."""
    from vfr_bake.training.checkpoint import save_checkpoint

    try:
        save_checkpoint(checkpoint, trainer)
    except OutputError as error:
        return str(error)
    return ""


def _expect(trainer: Trainer, seconds_a_step: float, bar: Bar, always: bool) -> None:
    """Print, on a line of its own, how many steps the training will take, and what it is likely to reach if
    that is known now. If it is not, print the line only if `always`."""
    from vfr_bake.training.length.expectation import EXPECTED_AT, expectation

    if not trainer.processes.first:
        return
    step, on_cpu = trainer.next_step, trainer.device.type == "cpu"
    known = on_cpu and step == EXPECTED_AT and trainer.head_learns
    witnesses = trainer.witness_psnr() if known else None
    if witnesses is None and not always:
        return
    psnr = None if witnesses is None else witnesses.every
    length = trainer.pace.steps, trainer.minutes, trainer.field.config.unbounded
    bar.close()
    _say(expectation(psnr, step, trainer.seconds, seconds_a_step, *length, on_cpu))


def _report_training(options: Any, figures: dict[str, Any], interrupted: bool) -> None:
    tested = ""
    if figures.get("test_psnr") is not None:
        tested = f", {figures['test_psnr']:.2f} dB on {figures['test_views']} test views"
    skipped = f", {figures['skipped_steps']} skipped (not finite)" if figures["skipped_steps"] else ""
    flat = ", which is all that pays" if figures["ended_early"] else ""
    write_result(
        options.json,
        figures | {"model": str(options.model)},
        f"{options.model}: {figures['steps']} steps in {figures['seconds']:.0f} s{flat}{skipped}{tested}"
        + (" (stopped early)" if interrupted else ""),
    )


def _test_figures(model: Model, scene: Scene, n_views: int, most_seconds: float) -> dict[str, Any]:
    from vfr_bake.evaluation import quick_psnr

    with Bar("test views") as bar:
        scores, lines = quick_psnr(model, scene, n_views, most_seconds, bar.count)
    for line in lines:
        _say(line)
    return {
        **finite({"test_psnr": sum(scores) / len(scores) if scores else None}),
        "test_views": len(scores),
        "background": model.background.tolist(),
    }
