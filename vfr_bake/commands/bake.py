"""`vfr-bake`: a bake, or with --convert the conversion of an asset."""

from __future__ import annotations

import sys
from dataclasses import asdict
from typing import Any

from player.app.commands import write_result
from player.asset.target import check_asset_target
from player.errors import ConfigError
from player.files.memory import available_bytes
from player.progress import Bar, Bars
from vfr_bake.commands.targets import check_json_target
from vfr_bake.config import BakeConfig


def bake_command(options: Any) -> int:
    """Bake as `options` says (`vfr_bake.options.Bake`), or convert an asset; return the exit code."""
    check_asset_target(options.asset, options.force)
    check_json_target(options.json, [options.model], options.asset)
    if (options.config.max_memory or 0) > (there := available_bytes() / 1e9):
        _say(
            f"warning: --max-memory {options.config.max_memory:g} is more than the {there:.1f} GB "
            "that there are: the system may end the bake"
        )
    if options.convert:
        return _convert(options)
    from player.proof import prove
    from vfr_bake.baking.bake import bake
    from vfr_bake.baking.plan import COMPILE_SECONDS, check_bakeable, expected_seconds, is_compiled, make_plan
    from vfr_bake.training.model_file import load_model

    model = load_model(options.model, options.config.memory)
    check_bakeable(model, options.config)
    plan = make_plan(model, options.config)
    minutes = expected_seconds(model, options.config, plan) / 60
    fine, coarse = plan.resolutions
    first = f", {COMPILE_SECONDS:.0f} s of them to compile its code for the first time,"
    compiling = "" if is_compiled() else first
    _say(
        f"about {max(minutes, 0.1):.1f} minutes{compiling} and {plan.n_bytes / 1e9:.1f} GB of "
        f"memory ({options.config.memory:.3g} GB at most), densities on at most {fine} cells per axis and "
        f"features on {coarse}, about {plan.n_rays(plan.n_cells):,} rays to learn from"
    )
    prove(_say)  # the bake will play the asset at its end
    with Bars() as bars:
        result = bake(model, options.asset, options.config, bars.count, options.force)
    megabytes = result.n_bytes / 1e6
    written = {"asset": str(options.asset), "megabytes": megabytes, "seconds": result.seconds}
    write_result(
        options.json,
        written | result.figures,
        f"{options.asset}: {megabytes:.1f} MB, {result.n_vertices:,} vertices, "
        f"{result.figures['mesh_faces']:,} faces, baked in {result.seconds:.0f} s; as played it agrees "
        f"with the full model to {result.figures['psnr_to_full_model']:.1f} dB and loses {result.loss} "
        f"against photographs: see {options.asset / 'report.html'}",
    )
    if result.loss.spread is None:
        _say(
            "the model has no witnesses (docs/train.md), so that the loss is estimated from its "
            "own pictures: train again to have it measured against photographs"
        )
    if "preset" in result.figures["left_out"]:
        _say(f"baked with preset fidelity; {result.figures['left_out']['preset']}")
    for missed in result.missed:
        _say(f"warning: {missed} (see report.html)")
    return 0


def _say(text: str) -> None:
    print(f"vfr-bake: {text}", file=sys.stderr)


def _convert(options: Any) -> int:
    from vfr_bake.baking.convert import convert

    given = [name for name, value in asdict(options.config).items()
             if name != "max_memory" and value != getattr(BakeConfig(), name)]  # fmt: skip
    if given:
        raise ConfigError(f"--convert: expected no other setting than --max-memory, got {sorted(given)}")
    with Bar("converting") as bar:
        done = convert(options.model, options.asset, options.config.memory, options.force, bar.count)
    version = done.asset.manifest.version
    write_result(
        options.json,
        {
            "asset": str(options.asset),
            "megabytes": done.n_bytes / 1e6,
            "megabytes_before": done.n_bytes_before / 1e6,
            "version_before": list(version),
            "seconds": done.seconds,
        },
        f"{options.asset}: {done.n_bytes / 1e6:.1f} MB, rewritten from {options.model} (version "
        f"{version[0]}.{version[1]}, {done.n_bytes_before / 1e6:.1f} MB) in {done.seconds:.0f} s",
    )
    return 0
