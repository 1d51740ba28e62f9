"""The measured trade as a single-file HTML page with plots and pictures inside, which
loads nothing from elsewhere."""

from __future__ import annotations

from html import escape

from vfr_bake.baking.report import number, page, row, table, title_row
from vfr_bake.bench.plot import Mark, plot
from vfr_bake.bench.result import Setting, Trade
from vfr_bake.bench.timing import Size, Times
from vfr_bake.bench.worst import WorstPixel
from vfr_bake.training.scores.metrics import BRIGHTEST_ERROR

SCORES = {"psnr": 2, "loss_db": 2, "ssim": 4, "lpips": 4, "psnr_to_model": 2, "ssim_to_model": 4}
"""Scores that the table of all settings shows, with their decimal places."""


def trade_page(trade: Trade) -> bytes:
    """Return the trade as an HTML page."""
    width, height = trade.sizes[0]
    wanted = "full model" if trade.conditions["model"] else "photograph"
    front = [setting for setting in trade.settings if setting.on_front]
    fitted = ""
    if trade.conditions["exposure_fitted"]:
        fitted = "Exposure is fitted on the left half of each view, and the right half is scored. "
    return page(
        "Speed and accuracy",
        f"<p>{escape(trade.recommendation)}</p>",
        *map(_commands, trade.recommended),
        f"<p>{len(trade.conditions['views'])} test views of {escape(str(trade.conditions['data']))}, "
        f"{width}x{height}; {trade.conditions['frames_a_setting_and_size']} frames a setting and size, in "
        f"turns; {trade.conditions['threads']} threads, {escape(trade.conditions['march'])}. {fitted}"
        "Filled marks and bold rows are on the front: no other setting is better, faster and smaller.</p>",
        *(f"<p>{escape(note)}</p>" for note in trade.conditions["notes"]),
        "<h2>Quality against time</h2><p>Size of a mark: megabytes.</p>",
        plot(_marks(trade, "time"), f"ms a frame at {width}x{height}", "PSNR, dB"),
        "<h2>Quality against size</h2><p>Size of a mark: ms a frame.</p>",
        plot(_marks(trade, "size"), "MB", "PSNR, dB"),
        "<h2>Loss against k</h2><p>Every sample is at the right; size of a mark: ms a frame.</p>",
        plot(_marks(trade, "k"), "lookups a ray, k", "loss, dB", joined=True),
        "<h2>All settings</h2>",
        _settings_table(trade),
        *(_times_table(trade, size) for size in trade.sizes),
        "<h2>Commands of the front</h2>",
        *map(_commands, front),
        f"<h2>Where the loss sits</h2><p>Each asset's worst view with its own k: {wanted}, played, "
        f"difference (white: {BRIGHTEST_ERROR:g} of the range or more). Below, the pixels that are farthest "
        "off in all views, and their rays.</p>",
        *(pictures.html() + _worst_table(trade.worst[pictures.name]) for pictures in trade.pictures),
    )


def _commands(setting: Setting) -> str:
    return f"<p>{escape(setting.name)}</p><pre>{escape(chr(10).join(filter(None, setting.commands)))}</pre>"


def trade_lines(trade: Trade) -> list[str]:
    """Return the settings on the front as lines of plain text, best first, then the recommendation and the
    commands of the settings that it names."""
    titles = ["setting", "PSNR", "loss", "SSIM", "ms", "p95", "MB"]
    front = [setting for setting in trade.settings if setting.on_front]
    front.sort(key=lambda setting: -setting.point.psnr)
    rows = [titles, *(_front_cells(setting, setting.times[trade.sizes[0]]) for setting in front)]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    commands: list[tuple[str, ...]] = [(), *(setting.commands for setting in front)]
    lines = []
    for cells, some in zip(rows, commands, strict=True):
        numbers = (cell.rjust(width) for cell, width in zip(cells[1:], widths[1:], strict=True))
        lines.append("  ".join([cells[0].ljust(widths[0]), *numbers]))
        lines += [f"    {command}" for command in some if command]
    lines.append(trade.recommendation)
    for setting in trade.recommended:
        lines += [setting.name, *(f"    {command}" for command in setting.commands if command)]
    return lines


def _front_cells(setting: Setting, times: Times) -> list[str]:
    time = f"{times.median:.0f} ±{times.uncertainty:.0f}"
    quality = [number(setting.scores[key], SCORES[key]) for key in ("psnr", "loss_db", "ssim")]
    return [setting.name, *quality, time, f"{times.p95:.0f}", f"{setting.n_bytes / 1e6:.1f}"]


def _marks(trade: Trade, x: str) -> dict[str, list[Mark]]:
    """Return a mark for every setting, grouped by asset; `x` names the quantity on the x
    axis: "time", "size" or "k"."""
    played = [setting for setting in trade.settings if setting.asset is not None]
    shown = played if x == "k" else trade.settings
    most_ms = max(setting.point.ms for setting in shown)
    most_mb = max(setting.point.megabytes for setting in shown)
    most_k = max([setting.n_fetches or 0 for setting in played] + [1])
    series: dict[str, list[Mark]] = {}
    for setting in shown:
        point = setting.point
        across = {"time": point.ms, "size": point.megabytes, "k": float(setting.n_fetches or 2 * most_k)}[x]
        up = float(setting.scores["loss_db"] or 0.0) if x == "k" else point.psnr
        area = point.megabytes / most_mb if x == "time" else point.ms / most_ms
        label = f"{setting.name}: {point.psnr:.2f} dB, {point.ms:.0f} ms, {point.megabytes:.1f} MB"
        mark = Mark(across, up, area, label, setting.on_front)
        series.setdefault(setting.asset or setting.name, []).append(mark)
    return series


def _settings_table(trade: Trade) -> str:
    titles = ["setting", "preset", "head", "cells", "channels", "PSNR", "loss", "SSIM", "LPIPS",
              "PSNR to model", "SSIM to model", "MB", "peak MB", "first picture, ms"]  # fmt: skip
    rows = [title_row(*titles)]
    for setting in trade.settings:
        made = [str(setting.what.get(key) or "") for key in ("preset", "head", "resolution", "n_channels")]
        quality = [number(setting.scores[key], digits) for key, digits in SCORES.items()]
        cost = [number(setting.n_bytes / 1e6, 1), number(setting.peak_mb, 0)]
        cells = [setting.name, *made, *quality, *cost, number(setting.first_picture_ms, 0)]
        rows.append(row(*cells, bold=setting.on_front))
    return table(rows)


def _times_table(trade: Trade, size: Size) -> str:
    rows = [title_row("setting", "median", "p95", "quartiles", "march", "lookups", "head", "rest")]
    for setting in trade.settings:
        times = setting.times[size]
        low, high = times.quartiles
        whole = [f"{times.median:.0f}", f"{times.p95:.0f}", f"{low:.0f} to {high:.0f}"]
        parts = [number(part, 0) for part in (times.march, times.lookups, times.head, times.rest)]
        cells = [*whole, *(parts if setting.asset is not None else [""] * len(parts))]
        rows.append(row(setting.name, *cells, bold=setting.on_front))
    return f"<h2>ms a frame at {size[0]}x{size[1]}</h2>{table(rows)}"


def _worst_table(worst: list[WorstPixel]) -> str:
    titles = ["view", "column, row", "error", "wanted", "played", "samples", "opacity", "t: weight"]
    rows = [title_row(*titles)]
    for pixel in worst:
        weights = ", ".join(f"{t:.3f}: {weight:.3f}" for t, weight in pixel.weights)
        colours = (" ".join(f"{c:.2f}" for c in colour) for colour in (pixel.wanted, pixel.played))
        place = [f"{pixel.column}, {pixel.row}", f"{pixel.error:.2f}"]
        ray = [str(pixel.n_density_samples), f"{pixel.opacity:.3f}", weights]
        rows.append(row(pixel.view, *place, *colours, *ray))
    return table(rows)
