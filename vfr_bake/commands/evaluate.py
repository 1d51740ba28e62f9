"""`vfr-eval` and `vfr-bench`: a model, or assets of it, compared with photographs."""

from __future__ import annotations

import math
import sys
from dataclasses import asdict, replace
from typing import Any

from player.app.commands import write_result
from player.files.files import write_bytes
from player.progress import Bar, Bars
from vfr_bake.commands.targets import check_json_target, check_page_target, check_pictures_target


def eval_command(options: Any) -> int:
    """Evaluate a model as `options` says (`vfr_bake.options.Eval`); return the exit code."""
    import numpy as np

    from player.cameras.transforms import frame_names
    from player.files.images import write_png
    from vfr_bake.data import load_scene_as
    from vfr_bake.evaluation import render_views
    from vfr_bake.training.model_file import load_model
    from vfr_bake.training.scores.lpips import Lpips
    from vfr_bake.training.scores.metrics import comparison, mean_scores
    from vfr_bake.training.scores.views import Learned, scored_views

    check_json_target(options.json, [options.model])
    if options.pictures is not None:
        check_pictures_target(options.pictures, options.data)
    lpips = None if options.lpips is None else Lpips(options.lpips)
    model = load_model(options.model, options.max_memory)
    with Bar("reading pictures") as bar:
        scene = load_scene_as(model.train, model.field.config.unbounded, options.data, bar.count)
    learned = Learned(str(options.model), model.cameras, model.world_from_model)
    views, lines = scored_views(scene, options.data, model.exposure is not None, [learned])
    for line in lines:
        print(f"vfr-eval: {line}", file=sys.stderr)
    to_model = np.linalg.inv(model.world_from_model)
    views = replace(views, cameras=[camera.transformed(to_model) for camera in views.cameras])
    names = frame_names(views.cameras)
    scores = []
    with Bar("test views") as bar:
        for view in render_views(model, views, masked=scene.masked):
            if options.pictures is not None:
                picture = comparison(view.photograph, view.rgb)
                write_png(options.pictures / f"{names[len(scores)]}.png", picture)
            scores.append(view.score(lpips))
            bar.count(len(scores), len(names))
    means = mean_scores(scores)
    figures = finite(means) | {
        "per_view": [finite(asdict(score)) for score in scores],
        "n_views": len(scores),
        "background": model.background.tolist(),
        "bits": 8,
        "exposure_fitted": model.exposure is not None,
        "lpips_network": options.lpips,
    }
    similar = "" if means["ssim"] is None else f", SSIM {means['ssim']:.4f}"
    if lpips is not None and means["lpips"] is not None:
        similar += f", LPIPS ({lpips.network}) {means['lpips']:.4f}"
    write_result(
        options.json,
        figures,
        f"{options.model}: {means['psnr']:.2f} dB mean PSNR{similar} "
        f"over {len(scores)} test views"
        + (" (exposure fitted on their left halves, right halves scored)" if model.exposure else ""),
    )
    return 0


def bench_command(options: Any) -> int:
    """Measure assets as `options` says (`vfr_bake.options.Bench`); return the exit code."""
    from vfr_bake.bench.page import trade_lines, trade_page
    from vfr_bake.bench.trade import measure_trade
    from vfr_bake.training.scores.lpips import Lpips

    options.check()
    if options.html is not None:
        check_page_target(options.html, options.force)
    check_json_target(options.json, options.assets, options.html, options.force)
    lpips = None if options.lpips is None else Lpips(options.lpips)
    with Bars() as bars:
        trade = measure_trade(options, lpips, bars.count)
    for note in trade.conditions["notes"]:
        print(f"vfr-bench: {note}", file=sys.stderr)
    if (timed := trade.conditions["frames_a_setting_and_size"]) < options.frames:
        print(
            f"vfr-bench: timed {timed} of {options.frames} frames of each setting and size in "
            f"{options.minutes:g} minutes: for more, raise --minutes or give --samples and --sizes",
            file=sys.stderr,
        )
    if options.html is not None:
        write_bytes(options.html, trade_page(trade))
    write_result(options.json, trade.document(), "\n".join(trade_lines(trade)))
    return 0


def finite(figures: dict[str, Any]) -> dict[str, Any]:
    """Replace infinite figures by None, because JSON has no number for the PSNR of equal pictures."""
    return {key: None if value == math.inf else value for key, value in figures.items()}
