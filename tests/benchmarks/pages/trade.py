"""Tables of docs/trade.md: what speed and bytes cost, and which settings to choose for a purpose."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

from tests.benchmarks.pages.cells import (
    Block,
    give_or_take,
    megabytes,
    missing,
    number,
    present,
    rate,
    titled,
    where,
)
from tests.benchmarks.pages.plots import played_rows, plot_name
from tests.benchmarks.pages.tables import asset_name
from tests.benchmarks.suite.results import Results
from tests.benchmarks.suite.scenes import SCENES

Row = dict[str, Any]


class Wish(NamedTuple):
    """Purpose of a user, and the rule by which it chooses among settings."""

    wanted: str
    fits: Callable[[Row, float], bool]
    """Returns whether a row, whose frame takes so many milliseconds, meets the purpose."""
    cost: Callable[[Row, float], tuple[float, ...]]
    """Returns the cost of a row; the row with the least cost is chosen."""


def _loss(row: Row) -> float:
    return row["scores"]["loss_db"]


WISHES = (
    Wish(
        "final pictures, and pictures that are compared with others",
        lambda row, ms: row["quality"] == "exact",
        lambda row, ms: (_loss(row), ms),
    ),
    Wish(
        "most things: at most half a decibel lost, as fast as that goes",
        lambda row, ms: _loss(row) <= 0.5,
        lambda row, ms: (ms, row["n_bytes"]),
    ),
    Wish(
        "moving around: 5 frames a second",
        lambda row, ms: ms <= 200,
        lambda row, ms: (_loss(row), ms),
    ),
    Wish("moving smoothly: 10 frames a second", lambda row, ms: ms <= 100, lambda row, ms: (_loss(row), ms)),
    Wish(
        "a small download: at most 3 MB",
        lambda row, ms: row["n_bytes"] <= 3e6,
        lambda row, ms: (_loss(row), ms),
    ),
    Wish(
        "the fewest bytes that lose at most 1 dB",
        lambda row, ms: _loss(row) <= 1,
        lambda row, ms: (row["n_bytes"], _loss(row), ms),
    ),
)


def setting_name(row: Row) -> str:
    """Return the name of a setting in tables.

    >>> setting_name({"asset": "bake_lego_fast", "n_fetches": 0, "quality": "high"})
    'lego, fast; k = all, `high`'
    """
    quality = "" if row["quality"] == "exact" else f", `{row['quality']}`"
    return f"{asset_name(row['asset'])}; k = {row['n_fetches'] or 'all'}{quality}"


def choose(results: Results) -> list[str]:
    """Return the table of settings to choose for each purpose, for an object and for a capture, and what was
    compared."""
    there, lacking = present(results, ["trade_lego", "trade_fox"])
    rows = []
    for wish in WISHES:
        for name in there:
            size = results[name]["figures"]["size"]
            some = [(row, row["times"][size]["median"]) for row in played_rows(results, name)]
            fitting = [(row, ms) for row, ms in some if wish.fits(row, ms)]
            if not fitting:
                rows.append([wish.wanted, f"{name[6:]}: none of these", "", "", "", ""])
                continue
            row, _ = min(fitting, key=lambda pair: wish.cost(*pair))
            times = row["times"][size]
            preset = row["asset"].rpartition("_")[2]
            quality = "" if row["quality"] == "exact" else f" --quality {row['quality']}"
            cells = [wish.wanted, setting_name(row), number(_loss(row), 2)]
            cells += [rate(times["median"], times["uncertainty"]), megabytes(row["n_bytes"])]
            bake = f"`vfr-bake model.pt out/ --preset {preset}`"
            rows.append([*cells, f"{bake}, `vfr-play out/ --samples {row['n_fetches']}{quality}`"])
    compared = []
    for name in there:
        presets = dict.fromkeys(row["asset"].rpartition("_")[2] for row in played_rows(results, name))
        names = ", ".join(f"`{preset}`" for preset in presets)
        compared.append(f"{name[6:]} {names} at {results[name]['figures']['size']}")
    titles = ["for", "choose", "lost, dB", "frames a second", "MB", "commands"]
    told = ["", f"Compared presets, and sizes of frames: {'; '.join(compared)}."] if compared else []
    return [*titled(titles, rows, lacking), *told]


def scene_section(results: Results, scene: str) -> list[str]:
    """Return a scene's plot and its settings that nothing else beats; for dials, those with their own k."""
    name = f"trade_{scene}"
    if name not in results:
        return missing([name])[1:]
    figures = results[name]["figures"]
    conditions, size = figures["conditions"], figures["size"]
    sizes = sorted(figures["settings"][0]["times"], key=lambda some: int(some.partition("x")[0]))
    rows = []
    for row in sorted(played_rows(results, name), key=_loss):
        own = row["quality"] != "exact" or row["what"]["n_fetches"] == row["n_fetches"]
        if row["on_front"] if scene != "dials" else own:
            scores = row["scores"]
            cells = [
                setting_name(row),
                f"{scores['psnr']:.2f}",
                number(_loss(row), 2),
                f"{scores['ssim']:.4f}",
            ]
            times = [row["times"][some] for some in sizes]
            cells += [rate(some["median"], some["uncertainty"]) for some in times]
            rows.append([*cells, megabytes(row["n_bytes"])])
    told = (
        f"Settings are compared at {size}. Test views: {conditions['n_views']}; "
        f"threads: {conditions['threads']}; timed frames of a setting "
        f"and size: {conditions['frames_a_setting_and_size']}; machine and commit: {where(results, name)}."
    )
    titles = [
        "setting",
        "PSNR, dB",
        "lost, dB",
        "SSIM",
        *(f"frames a second, {some}" for some in sizes),
        "MB",
    ]
    alt = f"{scene}: PSNR in dB against frames a second at {size}; size of a mark: bytes"
    return [f"![{alt}]({plot_name(scene)})", "", told, "", *titled(titles, rows, [])]


def full_model(results: Results) -> list[str]:
    """Return the table of the full models' cost, which baking saves."""
    there, lacking = present(results, [f"trade_{scene}" for scene in SCENES])
    rows = []
    for name in there:
        for row in results[name]["figures"]["settings"]:
            if row["asset"] is None:
                times = next(iter(row["times"].values()))
                seconds = give_or_take(times["median"] / 1000, times["uncertainty"] / 1000, 1)
                rows.append([name[6:], f"{row['scores']['psnr']:.2f}", seconds, megabytes(row["n_bytes"])])
    return titled(
        ["full model", "PSNR, dB", "seconds a picture of the photographs' size", "MB"], rows, lacking
    )


BLOCKS: dict[str, Block] = {
    "choose": choose,
    "full-model": full_model,
    **{f"trade-{scene}": partial(scene_section, scene=scene) for scene in (*SCENES, "dials")},
}
