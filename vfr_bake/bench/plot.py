"""Plots as SVG text, which needs no library, fits into one file and can be searched."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape

WIDTH, HEIGHT = 640, 380
LEFT, RIGHT, TOP, BOTTOM = 70, 20, 16, 48
COLOURS = ("#4a7fb5", "#c9722c", "#4f9a5b", "#9467b0", "#a8504f", "#6d6d6d")


@dataclass(frozen=True)
class Mark:
    """One point of a plot."""

    x: float
    """Value along the logarithmic axis, more than 0."""
    y: float
    size: float
    """Area as a share 0 to 1 of the largest mark's."""
    label: str
    """Text that is shown while the mouse rests on the mark."""
    filled: bool
    """True for a setting on the front; only such marks are filled."""


def plot(series: Mapping[str, Sequence[Mark]], x_title: str, y_title: str, joined: bool = False) -> str:
    """Return an SVG plot of marks over a logarithmic x axis, in one colour per series. With `joined`, lines
    connect the marks of a series.

    >>> picture = plot({"out": [Mark(10, 30, 0.5, "k 5", True)]}, "ms", "dB")
    >>> picture.count("<circle"), "k 5" in picture
    (2, True)
    """
    marks = [mark for some in series.values() for mark in some]
    x_low, x_high = _bounds([math.log10(mark.x) for mark in marks], 0.05)
    y_low, y_high = _bounds([mark.y for mark in marks], 0.1)

    def place(mark: Mark) -> tuple[float, float]:
        return _x(math.log10(mark.x), x_low, x_high), _y(mark.y, y_low, y_high)

    parts = [_axes(x_low, x_high, y_low, y_high, x_title, y_title)]
    for index, (name, some) in enumerate(series.items()):
        colour = COLOURS[index % len(COLOURS)]
        if joined:
            path = " ".join("{:.1f},{:.1f}".format(*place(mark)) for mark in sorted(some, key=lambda m: m.x))
            parts.append(f'<polyline points="{path}" fill="none" stroke="{colour}"/>')
        for mark in some:
            x, y = place(mark)
            radius = 3 + 9 * math.sqrt(max(mark.size, 0))
            parts.append(
                f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{radius:.1f}" stroke="{colour}" stroke-width="1.5" '
                f'fill="{colour if mark.filled else "none"}" fill-opacity="0.6">'
                f"<title>{escape(mark.label)}</title></circle>"
            )
        y = TOP + 16 * index + 8
        parts.append(
            f'<circle cx="{WIDTH + 10}" cy="{y}" r="5" fill="{colour}"/>'
            f'<text x="{WIDTH + 20}" y="{y + 4}">{escape(name)}</text>'
        )
    return f'<svg width="{WIDTH + 300}" height="{HEIGHT}" role="img">{"".join(parts)}</svg>'


def _bounds(values: Sequence[float], margin: float) -> tuple[float, float]:
    low, high = min(values), max(values)
    room = max((high - low) * margin, 0.02)
    return low - room, high + room


def _x(value: float, low: float, high: float) -> float:
    return LEFT + (WIDTH - LEFT - RIGHT) * (value - low) / (high - low)


def _y(value: float, low: float, high: float) -> float:
    return HEIGHT - BOTTOM - (HEIGHT - TOP - BOTTOM) * (value - low) / (high - low)


def _axes(x_low: float, x_high: float, y_low: float, y_high: float, x_title: str, y_title: str) -> str:
    bottom = HEIGHT - BOTTOM
    parts = [
        f'<rect x="{LEFT}" y="{TOP}" width="{WIDTH - LEFT - RIGHT}" height="{bottom - TOP}" fill="none" '
        'stroke="#999"/>',
        f'<text x="{(LEFT + WIDTH) / 2:.0f}" y="{HEIGHT - 8}" text-anchor="middle">{escape(x_title)}</text>',
        f'<text x="16" y="{HEIGHT / 2:.0f}" text-anchor="middle" '
        f'transform="rotate(-90 16 {HEIGHT / 2:.0f})">{escape(y_title)}</text>',
    ]
    for value in x_ticks(x_low, x_high):
        x = _x(math.log10(value), x_low, x_high)
        parts.append(f'<line x1="{x:.1f}" x2="{x:.1f}" y1="{TOP}" y2="{bottom}" stroke="#eee"/>')
        parts.append(f'<text x="{x:.1f}" y="{bottom + 16}" text-anchor="middle">{value:g}</text>')
    step = 10 ** math.floor(math.log10((y_high - y_low) / 2))
    step *= next(factor for factor in (1, 2, 5, 10) if (y_high - y_low) / (step * factor) <= 8)
    for count in range(math.ceil(y_low / step), math.floor(y_high / step) + 1):
        y = _y(count * step, y_low, y_high)
        parts.append(f'<line x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{y:.1f}" y2="{y:.1f}" stroke="#eee"/>')
        parts.append(f'<text x="{LEFT - 6}" y="{y + 4:.1f}" text-anchor="end">{count * step:.4g}</text>')
    return "".join(parts)


def x_ticks(low: float, high: float) -> list[float]:
    """Return 1, 2 and 5 times the powers of ten between 10^low and 10^high.

    >>> x_ticks(0.9, 2.1)
    [10.0, 20.0, 50.0, 100.0]
    """
    decades = range(math.floor(low), math.ceil(high) + 1)
    values = [round(factor * 10.0**decade, 9) for decade in decades for factor in (1, 2, 5)]
    return [value for value in values if low <= math.log10(value) <= high]
