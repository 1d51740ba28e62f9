"""Write a check as one HTML file: thumbnails, what is wrong with which picture, and the cameras in 3D.

Everything is inside the file; nothing is loaded from elsewhere.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Sequence
from html import escape
from string import Template

import numpy as np

from player.cameras.camera import Camera, focus_point, world_up
from vfr_bake.data.check.check import Check, CheckedPicture
from vfr_bake.data.check.verdict import level_axes

MARK = "<!-- vfr-train --check -->"
"""Second line of every page of a check. An existing file that has it may be replaced."""
SIDE, MARGIN = 380, 24
"""Pixels along a side of a drawing of the cameras, and of its margin."""
STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; max-width: 1240px; margin: 2em auto; padding: 0 1em; color: #222
} .good { color: #070 } .doubtful { color: #850 } .bad { color: #b00 }
.pictures { display: flex; flex-wrap: wrap; gap: 10px }
figure { margin: 0; width: 150px; font-size: 12px; line-height: 1.3; overflow-wrap: anywhere }
figure img { display: block; max-width: 144px; border: 3px solid #ddd }
figure.fault img { border-color: #c33 } .why { color: #b00 }
svg, canvas { background: #f6f6f6; margin-right: 16px } canvas { cursor: grab; touch-action: none }
svg text { font: 13px system-ui, sans-serif }
"""


TURNABLE = Template("""<canvas id="turn" width="$side" height="$side"
 aria-label="$n cameras, to be turned"></canvas><script>
"use strict";
const cameras = $cameras;
const canvas = document.getElementById("turn"), draw = canvas.getContext("2d"), half = $side / 2;
let azimuth = 0.6, height = 0.5;
function placed([x, y, z]) {
  const c = Math.cos(azimuth), s = Math.sin(azimuth), near = x * s + y * c;
  return [half + (half - $margin) * (x * c - y * s),
    half - (half - $margin) * (z * Math.cos(height) - near * Math.sin(height))];
}
function line(from, to, colour) {
  draw.strokeStyle = colour; draw.beginPath(); draw.moveTo(...placed(from)); draw.lineTo(...placed(to));
  draw.stroke();
}
function paint() {
  draw.clearRect(0, 0, 2 * half, 2 * half);
  draw.fillStyle = "#222"; draw.font = "13px system-ui, sans-serif";
  draw.fillText("$n cameras: drag to turn", 8, 18);
  line([0, 0, 0], [0, 0, 0.3], "#c33");
  for (const [x, y, z, a, b, c] of cameras) {
    line([x, y, z], [x + a, y + b, z + c], "#58c");
    draw.fillStyle = "#124"; draw.beginPath(); draw.arc(...placed([x, y, z]), 2.5, 0, 7); draw.fill();
  }
}
canvas.addEventListener("pointermove", (event) => {
  if (!event.buttons) return;
  azimuth += 0.01 * event.movementX;
  height = Math.min(1.57, Math.max(-1.57, height + 0.01 * event.movementY));
  paint();
});
paint();
</script>""")


def check_page(check: Check) -> bytes:
    """Return the page of a check, as the bytes of an HTML file."""
    title = escape(f"Check of {check.data}")
    summary = "".join(f"<p>{escape(line)}</p>" for line in check.lines()[:2])
    advice = "".join(f"<li>{escape(line)}</li>" for line in check.advice)
    parts = [
        f"<h1>{title}</h1>",
        f'<p class="{check.verdict}"><b>{check.verdict}</b>: {escape(" ".join(check.likely))}</p>',
        f"<h2>What to photograph</h2><ul>{advice}</ul>" if advice else "",
        f"<h2>What there is</h2>{summary}",
        cameras_drawing(check.cameras) if check.cameras else "",
        "<h2>Pictures</h2><div class='pictures'>",
        *map(_figure, check.pictures),
        "</div>",
    ]
    head = f'<meta charset="utf-8"><meta name="viewport" content="width=device-width"><title>{title}</title>'
    return (
        f"<!doctype html>\n{MARK}\n<html lang=en><head>{head}<style>{STYLE}</style></head><body>"
        f"{''.join(parts)}</body></html>\n"
    ).encode(errors="replace")


def _figure(picture: CheckedPicture) -> str:
    name = escape(picture.name)
    image = "<p>not looked at</p>"
    if picture.look is not None:
        data = base64.b64encode(picture.look.thumbnail).decode()
        image = f'<img alt="{name}" src="data:image/jpeg;base64,{data}">'
    facts = [name]
    if picture.used is not None:
        facts.append(f"{picture.used[0]}x{picture.used[1]}")
    if picture.look is not None:
        facts.append(f"sharpness {picture.look.sharpness:.0f}, blur {picture.look.blur:.2f}")
    if picture.found is not None:
        facts.append("camera known" if picture.found else "no camera")
    why = f'<br><span class="why">{escape(picture.why)}</span>' if picture.why else ""
    return f"<figure{' class=fault' if picture.why else ''}>{image}{'<br>'.join(facts)}{why}</figure>"


def cameras_drawing(cameras: Sequence[Camera]) -> str:
    """Return HTML that draws the cameras in 3D, turned by dragging, and as two SVG drawings, from above and
    from the side. A dot marks where a camera is, and a line where it looks. In 3D a red line points up from
    the point that the cameras look at; in the SVG drawings a red circle marks that point."""
    up = world_up(cameras)
    right, back = level_axes(up)
    focus = focus_point(cameras)
    places = np.stack([camera.c2w[:3, 3] for camera in cameras]) - focus
    looks = -np.stack([camera.c2w[:3, 2] for camera in cameras])
    # The drawing has room for most of them: one that strayed must not shrink the rest.
    reach = 1.1 * float(np.quantile(np.linalg.norm(places, axis=1), 0.95)) or 1.0
    drawings = []
    for title, axes in (("from above", (right, back)), ("from the side", (right, -up))):
        plane = np.stack(axes, axis=-1)
        points, ways = places @ plane / reach, 0.12 * looks @ plane
        marks = "".join(_camera_mark(point, way) for point, way in zip(points, ways, strict=True))
        drawings.append(
            f'<svg width="{SIDE}" height="{SIDE}" role="img" aria-label="cameras {title}">'
            f'<text x="8" y="18">{len(cameras)} cameras {title}</text>'
            f'<circle cx="{SIDE / 2}" cy="{SIDE / 2}" r="5" fill="none" stroke="#c33"/>{marks}</svg>'
        )
    axes = np.stack([right, back, up], axis=-1)
    rows = np.concatenate([places @ axes / reach, 0.12 * looks @ axes], axis=1).round(4)
    turnable = TURNABLE.substitute(
        side=SIDE, margin=MARGIN, n=len(cameras), cameras=json.dumps(rows.tolist(), allow_nan=False)
    )
    return f"<h2>Cameras</h2><p>{turnable}{''.join(drawings)}</p>"


def _camera_mark(point: np.ndarray, way: np.ndarray) -> str:
    (x, y), (to_x, to_y) = (SIDE / 2 + (SIDE / 2 - MARGIN) * end for end in (point, point + way))
    return (
        f'<line x1="{x:.1f}" y1="{y:.1f}" x2="{to_x:.1f}" y2="{to_y:.1f}" stroke="#58c"/>'
        f'<circle cx="{x:.1f}" cy="{y:.1f}" r="2.5" fill="#124"/>'
    )
