"""The trade as a page: one file, plots and pictures inside it, nothing loaded from elsewhere."""

from __future__ import annotations

import base64
from html import escape

import numpy as np

from player.files.images import png_bytes
from vfr_bake.baking.report import STYLE
from vfr_bake.bench.plot import Mark, plot
from vfr_bake.bench.result import Setting, Trade
from vfr_bake.bench.timing import Times
from vfr_bake.bench.worst import WorstPixel
from vfr_bake.training.comparison import BRIGHTEST_ERROR, comparison


def trade_page(trade: Trade) -> bytes:
    """The trade as HTML."""
    width, height = trade.sizes[0]
    wanted = "full model" if trade.conditions["model"] else "photograph"
    parts = [
        f"<p>{escape(trade.recommendation)}</p>",
        f"<p>{len(trade.conditions['views'])} test views of {escape(str(trade.conditions['data']))}, "
        f"{width}x{height}; {trade.conditions['frames_a_setting_and_size']} frames a setting and size, in "
        f"turns; {trade.conditions['threads']} threads, {escape(trade.conditions['march'])}. Filled marks "
        "and bold rows are on the front: no other setting is better, faster and smaller.</p>",
        "<h2>Quality against time</h2><p>Size of a mark: megabytes.</p>",
        plot(_marks(trade, "time"), f"ms a frame at {width}x{height}", "PSNR, dB"),
        "<h2>Quality against size</h2><p>Size of a mark: ms a frame.</p>",
        plot(_marks(trade, "size"), "MB", "PSNR, dB"),
        "<h2>Loss against k</h2><p>Every sample is at the right; size of a mark: ms a frame.</p>",
        plot(_marks(trade, "k"), "lookups a ray, k", "loss, dB", joined=True),
        "<h2>All settings</h2>",
        _table(trade),
        *(_times_table(trade, size) for size in trade.sizes),
        "<h2>Commands of the front</h2>",
        "".join(
            f"<p>{escape(s.name)}</p><pre>{escape(chr(10).join(filter(None, s.commands)))}</pre>"
            for s in trade.settings
            if s.on_front
        ),
        f"<h2>Where the loss sits</h2><p>Each asset's worst view with its own k: {wanted}, played, "
        f"difference (white: {BRIGHTEST_ERROR:g} of the range or more). Below, the pixels that are farthest "
        "off in all views, and their rays.</p>",
        *(_where(name, *trade.pictures[name], trade.worst[name]) for name in trade.pictures),
    ]
    page = (
        '<!doctype html><html lang="en"><head><meta charset="utf-8"><title>Speed and accuracy</title>'
        f"<style>{STYLE}</style></head><body><h1>Speed and accuracy</h1>{''.join(parts)}</body></html>\n"
    )
    return page.encode()


def table_lines(trade: Trade) -> list[str]:
    """The front as lines of plain text, best first."""
    titles = ["setting", "PSNR", "loss", "SSIM", "ms", "p95", "MB"]
    front = [setting for setting in trade.settings if setting.on_front]
    front.sort(key=lambda setting: -setting.point.psnr)
    rows = [titles, *(_front_cells(setting, setting.times[trade.sizes[0]]) for setting in front)]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    commands: list[tuple[str, ...]] = [(), *(setting.commands for setting in front)]
    lines = []
    for row, some in zip(rows, commands, strict=True):
        cells = [row[0].ljust(widths[0]), *(c.rjust(w) for c, w in zip(row[1:], widths[1:], strict=True))]
        lines.append("  ".join(cells))
        lines += [f"    {command}" for command in some if command]
    return lines


def _front_cells(setting: Setting, times: Times) -> list[str]:
    scores = setting.scores
    time = f"{times.median:.0f} ±{times.uncertainty:.0f}"
    quality = [_number(scores["psnr"], 2), _number(scores["loss_db"], 2), _number(scores["ssim"], 4)]
    return [setting.name, *quality, time, f"{times.p95:.0f}", f"{setting.n_bytes / 1e6:.1f}"]


def _marks(trade: Trade, x: str) -> dict[str, list[Mark]]:
    played = [setting for setting in trade.settings if setting.asset is not None]
    shown = played if x == "k" else trade.settings
    most_ms = max(setting.point.ms for setting in shown)
    most_mb = max(setting.point.megabytes for setting in shown)
    most_k = max([setting.samples or 0 for setting in played] + [1])
    series: dict[str, list[Mark]] = {}
    for setting in shown:
        point = setting.point
        across = {"time": point.ms, "size": point.megabytes, "k": float(setting.samples or 2 * most_k)}[x]
        up = float(setting.scores["loss_db"] or 0.0) if x == "k" else point.psnr
        area = point.megabytes / most_mb if x == "time" else point.ms / most_ms
        label = f"{setting.name}: {point.psnr:.2f} dB, {point.ms:.0f} ms, {point.megabytes:.1f} MB"
        series.setdefault(setting.asset or setting.name, []).append(
            Mark(across, up, area, label, setting.on_front)
        )
    return series


def _number(value: float | None, digits: int) -> str:
    return "" if value is None else f"{value:.{digits}f}"


def _row(cells: list[str], bold: bool) -> str:
    tag = "th" if bold else "td"
    first, *rest = cells
    return f"<tr><{tag}>{escape(first)}</{tag}>" + "".join(
        f'<td class="number">{"<b>" if bold else ""}{escape(cell)}{"</b>" if bold else ""}</td>'
        for cell in rest
    ) + "</tr>"  # fmt: skip


def _head(cells: list[str]) -> str:
    return "<tr>" + "".join(f"<th>{escape(cell)}</th>" for cell in cells) + "</tr>"


def _table(trade: Trade) -> str:
    titles = ["setting", "preset", "head", "cells", "channels", "PSNR", "loss", "SSIM", "LPIPS",
              "PSNR to model", "SSIM to model", "MB", "peak MB", "first picture, ms"]  # fmt: skip
    rows = [_head(titles)]
    for setting in trade.settings:
        what, scores = setting.what, setting.scores
        made = [str(what.get(key) or "") for key in ("preset", "head", "resolution", "n_channels")]
        quality = [
            _number(scores[key], digits)
            for key, digits in (("psnr", 2), ("loss_db", 2), ("ssim", 4), ("lpips", 4),
                                ("psnr_to_model", 2), ("ssim_to_model", 4))
        ]  # fmt: skip
        cost = [_number(setting.n_bytes / 1e6, 1), _number(setting.peak_mb, 0)]
        cells = [setting.name, *made, *quality, *cost, _number(setting.first_picture_ms, 0)]
        rows.append(_row(cells, setting.on_front))
    return f"<table>{''.join(rows)}</table>"


def _times_table(trade: Trade, size: tuple[int, int]) -> str:
    rows = [_head(["setting", "median", "p95", "quartiles", "march", "lookups", "head", "rest"])]
    for setting in trade.settings:
        rows.append(_row([setting.name, *_parts(setting, setting.times[size])], setting.on_front))
    return f"<h2>ms a frame at {size[0]}x{size[1]}</h2><table>{''.join(rows)}</table>"


def _parts(setting: Setting, times: Times) -> list[str]:
    low, high = times.quartiles
    whole = [f"{times.median:.0f}", f"{times.p95:.0f}", f"{low:.0f} to {high:.0f}"]
    if setting.asset is None:
        return [*whole, "", "", "", ""]
    return [*whole, *(_number(part, 0) for part in (times.march, times.lookups, times.head, times.rest))]


def _where(name: str, wanted: np.ndarray, played: np.ndarray, worst: list[WorstPixel]) -> str:
    data = base64.b64encode(png_bytes(comparison(wanted, played))).decode()
    titles = ["view", "column, row", "error", "wanted", "played", "samples", "opacity", "t: weight"]
    rows = [_head(titles)]
    for pixel in worst:
        weights = ", ".join(f"{t:.3f}: {weight:.3f}" for t, weight in pixel.weights)
        wanted_rgb, played_rgb = (
            " ".join(f"{c:.2f}" for c in colour) for colour in (pixel.wanted, pixel.played)
        )
        cells = [pixel.view, f"{pixel.column}, {pixel.row}", f"{pixel.error:.2f}", wanted_rgb, played_rgb]
        rows.append(_row([*cells, str(pixel.n_density_samples), f"{pixel.opacity:.3f}", weights], False))
    return (
        f'<p>{escape(name)}<br><img alt="{escape(name)}" src="data:image/png;base64,{data}"></p>'
        f"<table>{''.join(rows)}</table>"
    )
