"""Write `report.json`, for programs, and `report.html`, for people: what the bake chose, left out and lost.

The page is a single file: it contains plots as SVG and pictures as PNG, and loads nothing from elsewhere.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from html import escape
from typing import Any, NamedTuple

import numpy as np

from player.asset.asset import Asset
from player.asset.manifest import Manifest, file_entry, manifest_bytes
from player.files.images import png_bytes
from player.render import Renderer
from vfr_bake.baking.held_out import views_between
from vfr_bake.rendering.render import render_image
from vfr_bake.training.length.witness_loss import Loss
from vfr_bake.training.model_file import Model
from vfr_bake.training.scores.metrics import BRIGHTEST_ERROR, comparison

N_PICTURES = 2
"""Number of views in the report that show the full model and the asset side by side."""
PICTURE_PIXELS = 160_000
"""Most pixels of such a view: the full model takes a second for 10,000 pixels of an unbounded scene."""
BAR_WIDTH = 420
"""Length in pixels of the longest bar of a plot."""
STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; max-width: 1240px; margin: 2em auto; padding: 0 1em; color: #222
} table { border-collapse: collapse; margin: 1em 0 }
td, th { padding: .2em .8em .2em 0; text-align: left; vertical-align: top }
td.number { text-align: right; font-variant-numeric: tabular-nums }
svg text { font: 13px system-ui, sans-serif }
img { max-width: 100%; image-rendering: pixelated }
.missed { color: #b00 }
"""


class Pictures(NamedTuple):
    """Two pictures of one view, [height, width, 3] in [0, 1]."""

    name: str
    wanted: np.ndarray
    """The reference picture: the full model's, or a photograph."""
    played: np.ndarray
    """The asset's picture."""

    def html(self) -> str:
        """Return a paragraph of HTML with both pictures and their difference."""
        data = base64.b64encode(png_bytes(comparison(self.wanted, self.played))).decode()
        name = escape(self.name)
        return f'<p>{name}<br><img alt="{name}" src="data:image/png;base64,{data}"></p>'


@dataclass(frozen=True)
class BakeResult:
    """Size, time and loss of a finished bake."""

    n_vertices: int
    n_bytes: int
    """Bytes of all files but the report."""
    seconds: float
    loss: Loss
    """Loss against photographs, compared with the trained model."""
    figures: dict[str, Any]
    missed: list[str]
    """The targets that were missed, in words."""


@dataclass(frozen=True, eq=False)
class BakeReport:
    """The content of a bake's report."""

    title: str
    asked: dict[str, Any]
    """Preset and settings as resolved, and the limits that were asked for."""
    stages: list[dict[str, Any]]
    """Figures of each step of the bake, in order, as `vfr_bake.baking.held_out.HeldOut.table` gives them."""
    measured_on: str
    """Description of what the losses are measured on, or estimated from."""
    n_bytes: dict[str, int]
    """Bytes of each of the asset's files but the report."""
    seconds: dict[str, float]
    """Wall-clock seconds of each part of the bake."""
    left_out: dict[str, str]
    """Descriptions, by topic, of what was left out of the asset and what that changed."""
    lookups: dict[str, float]
    """Loss in dB of each number of feature lookups a ray, compared with a lookup at every sample; empty if
    the number was given."""
    parts: list[dict[str, Any]]
    """For each part of the asset but the last, `bytes` of its file, and `loss_db` of the picture of the parts
    up to it, compared with the whole asset's."""
    missed: list[str]
    """The targets that were missed, in words; empty if all were met."""
    gpu_bytes: int | None
    """Bytes of graphics memory that a page of the asset takes; None if there can be no page of it."""
    pictures: list[Pictures] = field(default_factory=list)
    """Pictures of the full model and of the asset."""

    def with_files(self, manifest: Manifest, mesh: bytes) -> dict[str, bytes]:
        """Return the files that complete an asset, by name: its mesh and this report.

        `manifest` is that of the asset without them. Its size in `n_bytes` becomes that of the file that also
        lists them.
        """
        files = {"mesh.ply": mesh}
        for _ in range(2):  # the manifest lists the report, which states the size of the manifest
            files |= {"report.json": self.json(), "report.html": self.html()}
            listed = manifest.files | {name: file_entry(data) for name, data in files.items()}
            self.n_bytes["manifest.json"] = len(manifest_bytes(replace(manifest, files=listed)))
        return files

    def json(self) -> bytes:
        """Return the content of report.json."""
        names = (
            "asked", "stages", "measured_on", "seconds", "left_out", "lookups", "parts", "missed",
            "gpu_bytes",
        )  # fmt: skip
        document = {name: getattr(self, name) for name in names} | {"bytes": self.n_bytes}
        document |= {name: self.stages[-1][name] for name in ("loss_db", "loss_db_spread")}
        return (json.dumps(document, indent=1, sort_keys=True, allow_nan=False) + "\n").encode()

    def html(self) -> bytes:
        """Return the content of report.html."""
        last = self.stages[-1]
        megabytes = sum(self.n_bytes.values()) / 1e6
        of_page = ""
        if self.gpu_bytes is not None:
            of_page = f" A page of it takes {self.gpu_bytes / 1e6:.0f} MB of graphics memory."
        shown = {f"part {i}": part["loss_db"] for i, part in enumerate(self.parts)}
        lookups = f"<h2>Lookups a ray: loss against all</h2>{bars(self.lookups, 'dB', 3)}"
        measured = last["loss_db_spread"] is not None
        loss = "loss" if measured else "expected loss"
        columns = {"psnr": 2, "loss_db": 3, "loss_db_spread": 3, "samples_median": 0, "samples_p95": 0}
        titles = ["after", "dB to the model's pictures", f"{loss}, dB", "give or take, dB"]
        titles += ["samples a ray, median", "95th percentile"]
        stages = [
            row(stage["name"], *(number(stage[key], digits) for key, digits in columns.items()))
            for stage in self.stages
        ]
        spread = f" (give or take {last['loss_db_spread']:.2f} dB)" if measured else ""
        return page(
            self.title,
            f"<p>{megabytes:.1f} MB, baked in {sum(self.seconds.values()):.0f} s; the written files play "
            f"{last['psnr']:.1f} dB from the model's own pictures, {'a' if measured else 'an'} {loss} of "
            f"{last['loss_db']:.2f} dB{spread} against photographs. {escape(self.measured_on)}{of_page}</p>",
            *(f'<p class="missed">Missed: {escape(text)}</p>' for text in self.missed),
            "<h2>Loss, stage by stage</h2>",
            bars({stage["name"]: stage["loss_db"] for stage in self.stages}, "dB", 3),
            table([title_row(*titles), *stages]),
            lookups if self.lookups else "",
            f"<h2>Bytes</h2>{bars({name: size / 1e6 for name, size in self.n_bytes.items()}, 'MB', 2)}",
            f"<h2>Picture of the first parts: loss against all</h2>{bars(shown, 'dB', 2)}" if shown else "",
            f"<h2>Time</h2>{bars(self.seconds, 's', 0)}",
            f"<h2>What was left out</h2>{_pairs(self.left_out)}",
            f"<h2>Pictures</h2><p>Full model, played from the files, difference (white: {BRIGHTEST_ERROR:g} "
            "of the range or more). These views were not learned from.</p>",
            *(pictures.html() for pictures in self.pictures),
            "<h2>What was asked</h2>",
            _pairs({key: json.dumps(value) for key, value in sorted(self.asked.items())}),
        )


def page(title: str, *parts: str) -> bytes:
    """Return a page of HTML."""
    title = escape(title)
    text = (
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{title}</title>'
        f"<style>{STYLE}</style></head><body><h1>{title}</h1>{''.join(parts)}</body></html>\n"
    )
    return text.encode(errors="replace")  # names of files on Linux may have no UTF-8


def table(rows: Iterable[str]) -> str:
    """Return an HTML table of rows that are HTML already."""
    return f"<table>{''.join(rows)}</table>"


def title_row(*titles: str) -> str:
    """Return the HTML of a table's first row."""
    return f"<tr>{''.join(f'<th>{escape(title, quote=False)}</th>' for title in titles)}</tr>"


def row(first: str, *numbers: str, bold: bool = False) -> str:
    """Return the HTML of a table's row: a name and numbers.

    >>> row("grid", "1.5")
    '<tr><td>grid</td><td class="number">1.5</td></tr>'
    """
    tag, begin, end = ("th", "<b>", "</b>") if bold else ("td", "", "")
    cells = "".join(f'<td class="number">{begin}{escape(number)}{end}</td>' for number in numbers)
    return f"<tr><{tag}>{escape(first)}</{tag}>{cells}</tr>"


def bars(values: dict[str, float], unit: str, digits: int) -> str:
    """Return a bar plot as SVG, with a bar for each value; negative values have bars of length 0.

    >>> bars({"grid": 0.5, "k": 1.0}, "dB", 1).count("<rect")
    2
    """
    largest = max([*values.values(), 1e-12])
    rows = []
    for index, (name, value) in enumerate(values.items()):
        y = 24 * index
        width = BAR_WIDTH * max(value, 0) / largest
        rows.append(
            f'<text x="190" y="{y + 16}" text-anchor="end">{escape(name)}</text>'
            f'<rect x="200" y="{y + 4}" width="{width:.1f}" height="16" fill="#4a7fb5"/>'
            f'<text x="{206 + width:.1f}" y="{y + 16}">{value:.{digits}f} {unit}</text>'
        )
    height = 24 * len(values)
    return f'<svg width="{BAR_WIDTH + 320}" height="{height}" role="img">{"".join(rows)}</svg>'


def number(value: float | None, digits: int) -> str:
    """Format a number with so many decimal `digits`; None becomes an empty string."""
    return "" if value is None else f"{value:.{digits}f}"


def _pairs(values: dict[str, str]) -> str:
    return table(f"<tr><th>{escape(k)}</th><td>{escape(v)}</td></tr>" for k, v in values.items())


def side_by_side(model: Model, asset: Asset) -> Iterator[Pictures]:
    """Render some views between the training cameras with the full model and with the asset."""
    with Renderer(asset) as renderer:
        for view in views_between(model, N_PICTURES, seed=3):
            share = min(1.0, float(np.sqrt(PICTURE_PIXELS / (view.width * view.height))))
            camera = view.scaled(share)
            full = render_image(model.field, model.sampler, camera, model.background)
            played = renderer.render(camera.transformed(model.world_from_model)).rgb
            yield Pictures(camera.name, full, played)
