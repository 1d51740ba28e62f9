"""The plots of docs/trade.md, as SVG."""

from __future__ import annotations

from typing import Any

from tests.benchmarks.suite.results import Results
from tests.benchmarks.suite.scenes import SCENES
from vfr_bake.bench.front import Point, pareto_front
from vfr_bake.bench.plot import Mark, plot

FILE = 'xmlns="http://www.w3.org/2000/svg" font-family="sans-serif" font-size="13" style="background:#fff"'
"""Attributes that an SVG file has, and an SVG inside a page has not."""


def plot_name(scene: str) -> str:
    """Return the name of the plot's file in docs/."""
    return f"trade_{scene}.svg"


def played_rows(results: Results, name: str) -> list[dict[str, Any]]:
    """Return the settings of a trade that play an asset, not the full model, with `on_front`: whether they
    are on the front for frames of the size by which settings are compared."""
    figures = results[name]["figures"]
    rows = [row for row in figures["settings"] if row["asset"] is not None]
    points = []
    for row in rows:
        times = row["times"][figures["size"]]
        megabytes = row["n_bytes"] / 1e6
        points.append(Point("", row["scores"]["psnr"], times["median"], times["uncertainty"], megabytes))
    return [row | {"on_front": on} for row, on in zip(rows, pareto_front(points), strict=True)]


def plots(results: Results) -> dict[str, str]:
    """Return the plots of the scenes that have results, by the names of their files."""
    names = {scene: f"trade_{scene}" for scene in (*SCENES, "dials")}
    return {plot_name(scene): _plot(results, scene) for scene, name in names.items() if name in results}


def _plot(results: Results, scene: str) -> str:
    """Plot PSNR against frames a second; a mark's area is the asset's share of the largest one's bytes."""
    size = results[f"trade_{scene}"]["figures"]["size"]
    rows = played_rows(results, f"trade_{scene}")
    most = max(row["n_bytes"] for row in rows)
    series: dict[str, list[Mark]] = {}
    for row in rows:
        times = row["times"][size]
        k, megabytes = row["n_fetches"] or "all", row["n_bytes"] / 1e6
        rate = 1000 / times["median"]
        label = (
            f"k = {k}, {row['quality']}: {row['scores']['psnr']:.2f} dB, {rate:.3g} frames a second, "
            f"{megabytes:.1f} MB"
        )
        mark = Mark(rate, row["scores"]["psnr"], row["n_bytes"] / most, label, row["on_front"])
        series.setdefault(f"{row['asset'].rpartition('_')[2]}, {megabytes:.1f} MB", []).append(mark)
    picture = plot(series, f"frames a second, {size}", "PSNR, dB")
    return picture.replace("<svg ", f"<svg {FILE} ", 1) + "\n"
