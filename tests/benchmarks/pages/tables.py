"""The tables of docs/benchmarks.md and of the README."""

from __future__ import annotations

from typing import Any

import numpy as np

from tests.benchmarks.against import QUALITIES
from tests.benchmarks.pages.cells import (
    Block,
    command,
    duration,
    gigabytes,
    give_or_take,
    machines,
    measured_on,
    megabytes,
    missing,
    number,
    present,
    rate,
    titled,
    where,
)
from tests.benchmarks.suite.parts import LIMITS_MB, MINUTES, PAGES, PRESETS, REFINED_AT, SEEDS, plays
from tests.benchmarks.suite.played import LOOKUPS
from tests.benchmarks.suite.results import Results
from tests.benchmarks.suite.scenes import SCENES, uncertainty_of_mean

BAKES = [f"bake_{scene}_{preset}" for scene, presets in PRESETS.items() for preset in presets]
VERSIONS = ("python", "numpy", "numba", "onnxruntime", "torch")
"""Libraries of the results whose versions are shown."""


def asset_name(part: str) -> str:
    """Return the name of a part's asset in tables.

    >>> asset_name("bake_lego_balanced"), asset_name("dial_lego_head32")
    ('lego, balanced', 'lego, head32')
    """
    _, scene, what = part.split("_", 2)
    return f"{scene}, {what}"


def own_setting(results: Results, part: str) -> dict[str, Any] | None:
    """Return the row of the trade in which a baked asset is played exactly with its own lookups."""
    rows = [
        row
        for name, result in results.items() if name.startswith("trade_")
        for row in result["figures"]["settings"] if row["asset"] == part and row["quality"] == "exact"
    ]  # fmt: skip
    return max(rows, key=lambda row: row["what"].get("n_fetches") == row["n_fetches"], default=None)


def machine_table(results: Results) -> list[str]:
    rows = []
    for letter, machine in machines(results).items():
        parts = [part for part in results.values() if part["machine"] == machine]
        versions = [(name, {part["libraries"][name] for part in parts}) for name in VERSIONS]
        told = ", ".join(f"{name} {' and '.join(sorted(some))}" for name, some in versions)
        dates = sorted({part["date"] for part in parts})
        days = dates[0] if len(dates) == 1 else f"{dates[0]} to {dates[-1]}"
        row = [letter, machine["processor"], f"{machine['cores']}, {machine['memory_gb']} GB"]
        rows.append([*row, " ".join(machine["features"]), told, days])
    titles = ["name", "processor", "cores, memory", "features", "versions", "measured on"]
    return titled(titles, rows, []) if rows else missing(["train_lego"])[1:]


def training(results: Results) -> list[str]:
    there, lacking = present(results, [f"train_{name}" for name in SCENES])
    rows = []
    for name in there:
        figures, scored = results[name]["figures"], f"eval_{name[6:]}"
        score = ""
        if scored in results:
            found = results[scored]["figures"]
            mean = give_or_take(found["psnr"], found["psnr_uncertainty"], 2)
            score = f"**{mean} dB** ({found['n_views']} views), SSIM {found['ssim']:.3f}"
        else:
            lacking.append(scored)
        took = f"{duration(figures['training_seconds'])} training, {duration(figures['seconds'])} in all; "
        row = [name[6:], command(results, name, "vfr-train"), where(results, name), f"{figures['steps']:,}"]
        rows.append([*row, took + gigabytes(figures["peak_mb"]), score])
    titles = ["data", "command", "machine, commit", "steps", "time, memory", "PSNR of the held-out views"]
    return titled(titles, rows, lacking)


def minutes(results: Results) -> list[str]:
    names = {f"{m:g}": f"lego_{m:g}" for m in MINUTES}
    there, lacking = present(
        results, [f"{kind}_{name}" for name in names.values() for kind in ("train", "eval")]
    )
    if lacking:
        return missing(lacking)[1:]
    steps = [f"{results[f'train_{name}']['figures']['steps']:,}" for name in names.values()]
    scores = [f"{results[f'eval_{name}']['figures']['psnr']:.2f}" for name in names.values()]
    lines = titled(["minutes", *names], [["steps", *steps], ["PSNR, dB", *scores]], [])
    return [*lines, *measured_on(results, there)]


def compositing(results: Results) -> list[str]:
    there, lacking = present(results, ["compositing_lego"])
    rows = []
    for name in there:
        features, colours = (results[name]["figures"][kind] for kind in ("features", "colour"))
        row = [f"lego, {features['minutes']:g} minutes", where(results, name)]
        row += [f"{some['psnr']:.2f} dB ({some['n_views']} views)" for some in (features, colours)]
        rows.append([*row, f"{features['steps'] / colours['steps']:.1f} times as many"])
    titles = ["data", "machine, commit", "features", "colours", "steps of features in equal time"]
    return titled(titles, rows, lacking)


def step(results: Results) -> list[str]:
    there, lacking = present(results, ["steps_lego"])
    rows = [
        [part, f"{value:,.0f}" if value >= 100 else f"{value:.3g}"]
        for name in there
        for part, value in results[name]["figures"]["this version"].items()
        if "times this version's" not in part
    ]
    titles = ["a step of lego on two threads", "milliseconds, or number"]
    return [*titled(titles, rows, lacking), *measured_on(results, there)]


def cameras(results: Results) -> list[str]:
    told = {
        "cameras_lego": "lego_800_train, a rendered object on nothing",
        "cameras_fox": "fox",
        "cameras_ring": "a rendered ring of 300 views of 12 megapixels",
    }
    there, lacking = present(results, told)
    rows = []
    for name in there:
        found = results[name]["figures"]
        stages = ", ".join(f"{stage} {duration(some[0])}" for stage, some in found["stages"].items())
        off = [
            f"{found[what]['root_mean_square']:.3f}{unit} (at most {found[what]['greatest']:.3f})"
            for what, unit in (("places", " %"), ("turns", ""))
        ]
        took = f"{duration(found['seconds'])} ({stages}); {gigabytes(found['peak_mb'])}"
        placed = f"{found['n_placed']} of {found['n_pictures']}"
        rows.append([told[name], where(results, name), took, placed, *off])
    titles = [
        "data",
        "machine, commit",
        "time, memory",
        "placed",
        "places, of their spread",
        "turns, degrees",
    ]
    return titled(titles, rows, lacking)


def baking(results: Results) -> list[str]:
    there, lacking = present(results, BAKES)
    rows = []
    for name in there:
        found, played = results[name]["figures"], own_setting(results, name)
        if played is not None and played["n_bytes"] != found["n_bytes"]:
            played = None  # another asset's
        row = [
            asset_name(name),
            where(results, name),
            f"{found['resolution']}, {found['feature_resolution']}",
        ]
        row += [f"{found['n_channels']}, {found['n_fetches']}", f"{found['n_vertices'] / 1e6:.1f} M"]
        row += [f"**{megabytes(found['n_bytes'])}**", duration(found["seconds"]), gigabytes(found["peak_mb"])]
        row += [f"{found['samples_median']:.0f}, {found['samples_p95']:.0f}"]
        row += [give_or_take(found["loss_db"], found["loss_db_spread"], 2)]
        rows.append([*row, number(played and played["scores"]["loss_db"], 2)])
    titles = ["data, preset", "machine, commit", "cells an axis: densities, features", "channels, lookups"]
    titles += ["vertices", "MB", "time", "memory", "samples a ray", "lost on witnesses, dB"]
    return titled([*titles, "lost on test views, dB"], rows, lacking)


def presets(results: Results) -> list[str]:
    """Return the table of the presets for those who choose one: bytes, time, loss and frames a second."""
    names = [
        (f"bake_{scene}_{preset}", scene, preset) for scene in ("lego", "fox") for preset in PRESETS[scene]
    ]
    _, lacking = present(results, [name for name, *_ in names])
    rows = []
    for name, scene, preset in names:
        if name not in results:
            continue
        found, rates = results[name]["figures"], ["", ""]
        if played := results.get(f"play_{scene}_{preset}"):
            ms = {row["quality"]: row["ms"] for row in played["figures"]["rows"] if row["march"] == "numba"}
            rates = [number(1000 / ms[quality], 1) for quality in ("exact", "fast")]
        lost = give_or_take(found["loss_db"], found["loss_db_spread"], 2)
        rows.append(
            [f"{scene}, `{preset}`", megabytes(found["n_bytes"]), duration(found["seconds"]), lost, *rates]
        )
    sizes = " and ".join(f"{SCENES[scene].size} ({scene})" for scene in ("lego", "fox"))
    titles = ["scene, preset", "MB", "time", "lost, dB", "frames a second, `exact`", "`fast`"]
    lines = titled(titles, rows, lacking)
    return [*lines, "", f"Frames of {sizes}."] if rows else lines


def curve(results: Results) -> list[str]:
    """Return the table of loss by bytes: of the presets, and of limits on the size."""
    names = [
        *(f"bytes_lego_{mb}" for mb in LIMITS_MB),
        *(f"bake_lego_{preset}" for preset in PRESETS["lego"]),
    ]
    there, lacking = present(results, names)
    rows = []
    for name in sorted(there, key=lambda name: results[name]["figures"]["n_bytes"]):
        found = results[name]["figures"]
        asked = f"`{'--max-mb' if name.startswith('bytes') else '--preset'} {name.rpartition('_')[2]}`"
        row = [asked, where(results, name), megabytes(found["n_bytes"])]
        row += [f"{found['resolution']}, {found['feature_resolution']}", f"{found['n_channels']}"]
        lost = give_or_take(found["loss_db"], found["loss_db_spread"], 2)
        rows.append([*row, lost, number(found["psnr_to_model"], 1)])
    titles = ["asked", "machine, commit", "MB", "cells an axis", "channels", "lost, dB", "dB to the model"]
    return titled(titles, rows, lacking)


def ours(results: Results) -> list[str]:
    there, lacking = present(results, ["bake_lego_balanced", "bake_fox_balanced"])
    rows = []
    for name in there:
        found = results[name]["figures"]
        lost = f"loses {give_or_take(found['loss_db'], found['loss_db_spread'], 2)} dB"
        rows.append([asset_name(name), lost, f"{megabytes(found['n_bytes'])} MB", "any CPU; browser"])
    return titled(["ours", "PSNR", "bytes", "plays on"], rows, lacking)


def expected_lookups(results: Results) -> list[str]:
    there, lacking = present(results, [name for name in BAKES if name.endswith("balanced")])
    ks = [k for k in LOOKUPS if any(k in results[name]["figures"]["lookups"] for name in there)]
    rows = []
    for name in there:
        found = results[name]["figures"]
        losses = [number(found["lookups"].get(k), 2) for k in ks]
        samples = f"{found['samples_median']:.0f}, {found['samples_p95']:.0f}"
        rows.append([asset_name(name), where(results, name), samples, *losses])
    return titled(["asset", "machine, commit", "samples a ray", *ks], rows, lacking)


def lookups(results: Results) -> list[str]:
    there, lacking = present(results, ["lookups_lego", "lookups_fox"])
    ks = [k for k in LOOKUPS if k != "0"]
    rows = [row for name in there for row in _lookup_rows(results, name, ks)]
    titles = ["scene, refined for", "test views", "MB", *ks]
    return [*titled(titles, rows, lacking), *measured_on(results, there)]


def _lookup_rows(results: Results, name: str, ks: list[str]) -> list[list[str]]:
    """Return rows with the bytes of the assets and with mean losses over views and seeds, with the views'
    uncertainty and the seeds' range."""
    scene, found = name.partition("_")[2], results[name]["figures"]
    rows = []
    every = {seed: np.array(found[f"every, seed {seed}"]["0"]) for seed in SEEDS}
    for refined, asked in REFINED_AT.items():
        assets = [f"bake_{scene}_seed{seed}_{refined}" for seed in SEEDS]
        sizes = [results[asset]["figures"]["n_bytes"] for asset in assets if asset in results]
        told = f"{megabytes(min(sizes))} to {megabytes(max(sizes))}" if sizes else ""
        cells = [f"{len(every[SEEDS[0]])}", told]
        for k in ks:
            if asked not in ("0", k):
                cells.append("")
                continue
            lost = np.array([every[s] - np.array(found[f"{refined}, seed {s}"][k]) for s in SEEDS])
            views, seeds = lost.mean(axis=0), lost.mean(axis=1)
            spread = uncertainty_of_mean(views.tolist())
            seen = f"({number(seeds.min(), 2)} to {number(seeds.max(), 2)})"
            cells.append(f"{give_or_take(lost.mean(), spread, 2)} {seen}")
        told = "every sample" if asked == "0" else f"{asked} lookups"
        rows.append([f"{scene}, {told}", *cells])
    return rows


def page(results: Results) -> list[str]:
    there, lacking = present(results, PAGES)
    rows = []
    for name in there:
        found = results[name]["figures"]
        counts, times = found["counts"], found["times"]["fast"]
        exact = counts["exact"]
        merf, smerf = (
            f"{some['fetches']:.0f}, {some['multiply_adds']:.0f}"
            for some in (counts["MERF"], counts["SMERF"])
        )
        more = times["processor"] / times["player_processor"]
        rows.append(
            [
                asset_name(name),
                where(results, name),
                f"{found['n_bytes'] / 1e6:.1f} MB",
                f"{counts['gpu_bytes'] / 1e6:.0f} MB",
                f"{exact['fetches']:.0f} + {exact['weights']:.0f}, {exact['multiply_adds']:,.0f}",
                f"{merf}; {smerf}",
                f"{found['first_picture_s']:.1f} s",
                f"{times['processor']:.0f} ms",
                f"{times['player_processor']:.0f} ms: {more:.1f} times less",
            ]
        )
    titles = ["asset", "machine, commit", "page", "graphics memory", "fetches, multiply-adds a pixel"]
    titles += ["MERF; SMERF", "first picture", "a picture, `fast`", "`vfr-play`, exact, with numba"]
    return titled(titles, rows, lacking)


def playing(results: Results) -> list[str]:
    """Return the table of frames a second by march and quality."""
    there, lacking = present(results, [*plays(SCENES["lego"]), *plays(SCENES["fox"])])
    rows = []
    for name in there:
        n_views = _compared_views(results, name)
        found = results[name]["figures"]
        size = "x".join(map(str, found["size"]))
        for march in ("numba", "numpy"):
            some = {row["quality"]: row for row in found["rows"] if row["march"] == march}
            rates = [rate(some[q]["ms"], some[q]["uncertainty"]) for q in QUALITIES]
            memory = gigabytes(max(row["peak_mb"] for row in some.values()))
            lost = [
                f"{number(found['losses'][q]['loss_db'], 2)}, {number(found['losses'][q]['worst_db'], 2)}"
                for q in QUALITIES[1:]
            ]
            row = [f"{asset_name(name)}, {size}", march, where(results, name), *rates, memory]
            rows.append([*row, *([n_views, *lost] if march == "numba" else ["", "", ""])])
    titles = ["asset, size", "march", "machine, commit", *QUALITIES, "memory", "test views"]
    return titled([*titles, "`high` loses, dB", "`fast` loses, dB"], rows, lacking)


def _compared_views(results: Results, name: str) -> str:
    """Return how many test views the losses of a part that plays an asset are means of: as many as its
    command asked for, or all if the scene has fewer."""
    words = results[name]["commands"][0].split()
    asked = int(words[words.index("--views") + 1])
    scored = results.get(f"eval_{name.split('_')[1]}")
    return f"{min(asked, scored['figures']['n_views'])}" if scored else ""


def viewers(results: Results) -> list[str]:
    """Return the table of Open3D, which draws the mesh, beside `vfr-play`."""
    there, lacking = present(results, ["viewers_lego"])
    rows = []
    for name in there:
        found = results[name]["figures"]
        for row in found["rows"]:
            cells = [row["what"], where(results, name), rate(row["ms"], row["uncertainty"])]
            cells += [number(row["processor_ms"], 0), number(row["psnr"], 2), megabytes(row["n_bytes"])]
            rows.append(cells)
    titles = ["lego, balanced, drawn by", "machine, commit", "frames a second", "processor time, ms"]
    return titled([*titles, "PSNR, dB", "MB"], rows, lacking)


def frame_parts(results: Results) -> list[str]:
    """Return the table of where the time of an exact frame goes, and of the time to the first picture."""
    needed = [f"trade_{scene}" for scene in SCENES]
    there, lacking = present(results, needed)
    rows = []
    for name in there:
        size = results[name]["figures"]["size"]
        for part in (f"bake_{name[6:]}_{preset}" for preset in PRESETS[name[6:]]):
            row = own_setting(results, part)
            if row is None:
                continue
            times = row["times"][size]
            parts = [number(times[key], 0) for key in ("march", "lookups", "head")]
            cells = [f"{asset_name(part)}, {size}", where(results, name)]
            cells += [give_or_take(times["median"], times["uncertainty"], 0), *parts]
            rows.append([*cells, f"{row['first_picture_ms'] / 1000:.1f} s", gigabytes(row["peak_mb"])])
    titles = ["asset, size", "machine, commit", "ms a frame", "march", "lookups", "head"]
    return titled([*titles, "first picture", "memory"], rows, lacking)


def exporting(results: Results) -> list[str]:
    there, lacking = present(results, ["export_lego"])
    rows = []
    for name in there:
        for file, found in results[name]["figures"].items():
            times = found["seconds"]
            words = f"vfr-export out/ {file} {found['options']}".strip()
            took = duration(times["median"])
            if times["n"] > 1:
                took += f" ({times['low']:.1f} to {times['high']:.1f})"
            row = [f"`{words}`", where(results, name), took, duration(found["processor_seconds"]["median"])]
            rows.append([*row, gigabytes(found["peak_mb"]), megabytes(found["n_bytes"])])
    titles = ["command", "machine, commit", "time", "processor time", "memory", "MB"]
    return titled(titles, rows, lacking)


def specks(results: Results) -> list[str]:
    there, lacking = present(results, ["specks_lego"])
    rows = []
    for name in there:
        found = results[name]["figures"]
        for variant, counts in found["in_a_million"].items():
            rows.append([variant, *(f"{count:.0f}" for count in counts)])
    titles = ["specks of lego, balanced, in a million pixels", "by 0.05", "by 0.1", "by 0.2"]
    return [*titled(titles, rows, lacking), *measured_on(results, there)]


def expect(results: Results) -> list[str]:
    """Return the README's table: lego's training, and two presets' time, bytes, loss and frame rates, with
    the machine of each row if there are several."""

    def letters(*names: str) -> str:
        return ", ".join(machines({name: results[name] for name in names if name in results}))

    rows, lacking = [], present(results, ["train_lego", "eval_lego"])[1]
    if not lacking:
        trained, score = results["train_lego"]["figures"], results["eval_lego"]["figures"]
        took = f"{trained['seconds'] / 60:.1f} minutes"
        psnr = give_or_take(score["psnr"], score["psnr_uncertainty"], 2)
        found = f"{took}, {psnr} dB mean PSNR on all {score['n_views']} test views"
        rows.append(["`vfr-train --minutes 9.25`", found, letters("train_lego", "eval_lego")])
    for preset in ("balanced", "fast"):
        names = [f"{what}_lego_{preset}" for what in ("bake", "play", "page")]
        there, missed = present(results, names)
        lacking += missed
        figures = {name.partition("_")[0]: results[name]["figures"] for name in there}
        if baked := figures.get("bake"):
            size = f"{baked['seconds'] / 60:.1f} minutes, {megabytes(baked['n_bytes'])} MB"
            if "page" in figures:
                size += f"; as a page {figures['page']['n_bytes'] / 1e6:.1f} MB"
            lost = give_or_take(baked["loss_db"], baked["loss_db_spread"], 2)
            told = f"{size}; loses {lost} dB against photographs"
            rows.append([f"`vfr-bake --preset {preset}`", told, letters(names[0], names[2])])
        if played := figures.get("play"):
            some = {row["quality"]: row for row in played["rows"] if row["march"] == "numba"}
            rates = ", ".join(f"{q} {rate(some[q]['ms'], some[q]['uncertainty'])}" for q in QUALITIES)
            size = "x".join(map(str, played["size"]))
            told = f"`vfr-play` of it at {size}, frames a second by `--quality`"
            told += ", moving between training views and turning around the scene"
            rows.append([told, rates, letters(names[1])])
    if not rows:
        return missing(lacking)[1:]
    shown = {letter for row in rows for letter in row[2].split(", ")}
    on = {
        letter: f"{machine['cores']} cores ({machine['processor']})"
        for letter, machine in machines(results).items()
        if letter in shown
    }
    told = "; ".join(f"{letter}: {place}" for letter, place in on.items())
    titles = ["what", "figure", "machine"]
    if len(on) == 1:
        told, titles, rows = on[rows[0][2]], titles[:2], [row[:2] for row in rows]
    return [f"Lego of NeRF-synthetic at 400x400, no GPU, on {told}:", "", *titled(titles, rows, lacking)]


BLOCKS: dict[str, Block] = {
    "machines": machine_table,
    "training": training,
    "minutes": minutes,
    "compositing": compositing,
    "step": step,
    "cameras": cameras,
    "baking": baking,
    "presets": presets,
    "bytes": curve,
    "ours": ours,
    "expected-lookups": expected_lookups,
    "lookups": lookups,
    "page": page,
    "playing": playing,
    "viewers": viewers,
    "frame-parts": frame_parts,
    "exporting": exporting,
    "specks": specks,
    "expect": expect,
}
