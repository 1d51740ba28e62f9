"""`report.json` and `report.html`: what the bake chose, left out and lost, for programs and for people.

The page is one file: plots are SVG inside it, pictures are PNG inside it, nothing is loaded from elsewhere.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Iterator
from dataclasses import dataclass, field
from html import escape
from typing import Any

import numpy as np

from player.asset.asset import Asset
from player.files.images import png_bytes
from player.render import Renderer
from vfr_bake.baking.held_out import views_between
from vfr_bake.rendering.render import render_image
from vfr_bake.training.comparison import BRIGHTEST_ERROR, comparison
from vfr_bake.training.model_file import Model

N_PICTURES = 2
"""Views shown side by side in the report."""
PICTURE_PIXELS = 160_000
"""Of each of them at most: the full model takes a second for 10,000 pixels of an unbounded scene."""
BAR_WIDTH = 420
"""Pixels of the longest bar of a plot."""
STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; max-width: 1240px; margin: 2em auto; padding: 0 1em; color: #222
} table { border-collapse: collapse; margin: 1em 0 }
td, th { padding: .2em .8em .2em 0; text-align: left; vertical-align: top }
td.number { text-align: right; font-variant-numeric: tabular-nums }
svg text { font: 13px system-ui, sans-serif }
img { max-width: 100%; image-rendering: pixelated }
.missed { color: #b00 }
"""


@dataclass(frozen=True, eq=False)
class BakeReport:
    """All that a bake has to say about itself."""

    title: str
    asked: dict[str, Any]
    """Preset and settings as resolved, and the limits that were asked for."""
    stages: list[dict[str, Any]]
    """`vfr_bake.baking.held_out.Stage` after each step, in order."""
    n_bytes: dict[str, int]
    """Bytes of each file."""
    seconds: dict[str, float]
    """Time of each part."""
    left_out: dict[str, str]
    """What is not in the asset, and what that changed."""
    lookups: dict[str, float]
    """dB that each number of lookups a ray loses against all; none where the number was given."""
    missed: list[str]
    """Limits that were not met, in words; none if all were."""
    pictures: list[tuple[str, np.ndarray, np.ndarray]] = field(default_factory=list)
    """Name, the model's picture and the played one, [height, width, 3] in [0, 1]."""

    def json(self) -> bytes:
        """The content of report.json."""
        document = {
            "asked": self.asked,
            "stages": self.stages,
            "bytes": self.n_bytes,
            "seconds": self.seconds,
            "left_out": self.left_out,
            "lookups": self.lookups,
            "missed": self.missed,
        }
        return (json.dumps(document, indent=1, sort_keys=True, allow_nan=False) + "\n").encode()

    def html(self) -> bytes:
        """The content of report.html."""
        last = self.stages[-1]
        megabytes = sum(self.n_bytes.values()) / 1e6
        parts = [
            f"<p>{megabytes:.1f} MB, baked in {sum(self.seconds.values()):.0f} s; the written files play "
            f"{last['psnr']:.1f} dB from the model's own pictures, an expected loss of "
            f"{last['loss_db']:.2f} dB against photographs.</p>",
            *(f'<p class="missed">Missed: {escape(text)}</p>' for text in self.missed),
            "<h2>Loss, stage by stage</h2>",
            bars({stage["name"]: stage["loss_db"] for stage in self.stages}, "dB", 3),
            _stage_table(self.stages),
            *(
                ["<h2>Lookups a ray: loss against all</h2>", bars(self.lookups, "dB", 3)]
                if self.lookups
                else []
            ),
            "<h2>Bytes</h2>",
            bars({name: size / 1e6 for name, size in self.n_bytes.items()}, "MB", 2),
            "<h2>Time</h2>",
            bars(self.seconds, "s", 0),
            "<h2>What was left out</h2>",
            _table(self.left_out),
            "<h2>Pictures</h2>",
            f"<p>Full model, played from the files, difference (white: {BRIGHTEST_ERROR:g} of the range or "
            "more). These views were not learned from.</p>",
            *(_picture(*picture) for picture in self.pictures),
            "<h2>What was asked</h2>",
            _table({key: json.dumps(value) for key, value in sorted(self.asked.items())}),
        ]
        title = escape(self.title)
        page = (
            f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{title}</title>'
            f"<style>{STYLE}</style></head><body><h1>{title}</h1>{''.join(parts)}</body></html>\n"
        )
        return page.encode()


def bars(values: dict[str, float], unit: str, digits: int) -> str:
    """A bar for each value >= 0, longest for the largest, as SVG.

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


def _stage_table(stages: list[dict[str, Any]]) -> str:
    rows = "".join(
        f"<tr><td>{escape(stage['name'])}</td>"
        + "".join(
            f'<td class="number">{stage[key]:.{digits}f}</td>'
            for key, digits in (("psnr", 2), ("loss_db", 3), ("samples_median", 0), ("samples_p95", 0))
        )
        + "</tr>"
        for stage in stages
    )
    return (
        "<table><tr><th>after</th><th>dB to the model's pictures</th><th>expected loss, dB</th>"
        f"<th>samples a ray, median</th><th>95th percentile</th></tr>{rows}</table>"
    )


def _table(values: dict[str, str]) -> str:
    rows = "".join(f"<tr><th>{escape(k)}</th><td>{escape(v)}</td></tr>" for k, v in values.items())
    return f"<table>{rows}</table>"


def _picture(name: str, full: np.ndarray, played: np.ndarray) -> str:
    data = base64.b64encode(png_bytes(comparison(full, played))).decode()
    return f'<p>{escape(name)}<br><img alt="{escape(name)}" src="data:image/png;base64,{data}"></p>'


def side_by_side(model: Model, asset: Asset) -> Iterator[tuple[str, np.ndarray, np.ndarray]]:
    """Name, the model's picture and the asset's [height, width, 3] of some views between the cameras."""
    with Renderer(asset) as renderer:
        for view in views_between(model, N_PICTURES, seed=3):
            share = min(1.0, float(np.sqrt(PICTURE_PIXELS / (view.width * view.height))))
            camera = view.resized(max(round(share * view.width), 1), max(round(share * view.height), 1))
            full = render_image(model.field, model.sampler, camera, model.background)
            yield camera.name, full, renderer.render(camera.transformed(model.world_from_model)).rgb
