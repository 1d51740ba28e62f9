"""Wavefront OBJ: text, `v x y z r g b` (sRGB in [0, 1], the widely read extension for vertex colours), `vn`,
`f v//vn`.

Numbers are written in fixed point by numpy, digit by digit for a whole array, because Python's formatting
takes seconds for a million faces. OBJ has no alpha per vertex: it is left out.
"""

from __future__ import annotations

import math

import numpy as np

from exporters.mesh import TriangleMesh
from player.errors import ConfigError

_CHUNK = 1 << 17  # rows turned into text at once: tens of megabytes of scratch memory


def obj_bytes(mesh: TriangleMesh) -> bytes:
    """The file's content; positions to nine digits of the largest one, colours to 1e-4 (8 bits survive).

    Raises ConfigError for a coordinate of 1e15 or more.

    >>> corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    >>> up, white = np.tile([0.0, 0.0, 1.0], (3, 1)), np.full((3, 4), 255, np.uint8)
    >>> mesh = TriangleMesh(corners, np.array([[0, 1, 2]], np.int32), up, white)
    >>> print(obj_bytes(mesh).decode().splitlines()[-1])
    f 1//1 2//2 3//3
    """
    largest = float(np.abs(mesh.vertices).max(initial=0.0))
    if largest >= 1e15:
        raise ConfigError(f"OBJ: vertices: expected coordinates below 1e15, got {largest:g}")
    decimals = min(max(8 - math.floor(math.log10(largest)), 0), 15) if largest else 1
    parts = [b"# vfr-bake: v x y z r g b (sRGB), vn, f\n"]
    for start in range(0, len(mesh.vertices), _CHUNK):
        rows = slice(start, start + _CHUNK)
        position = _fixed(mesh.vertices[rows], decimals)
        colour = _fixed(mesh.colours[rows, :3] / 255, 4)
        parts.append(_lines(["v ", *_joined([*position, *colour], " "), "\n"]))
    for start in range(0, len(mesh.normals), _CHUNK):
        normal = _fixed(mesh.normals[start : start + _CHUNK], 6)
        parts.append(_lines(["vn ", *_joined(normal, " "), "\n"]))
    for start in range(0, len(mesh.faces), _CHUNK):
        corners = _fixed(mesh.faces[start : start + _CHUNK] + 1, 0)
        parts.append(
            _lines(["f ", *_joined([part for c in corners for part in (c, "//", c)], " ", every=3), "\n"])
        )
    return b"".join(parts)


def _fixed(values: np.ndarray, decimals: int) -> list[np.ndarray]:
    """The columns of `values` [n, m] as fixed-point text: m arrays [n, width] of ASCII codes, 0 where nothing
    is.
    """
    scaled = np.rint(np.asarray(values, np.float64) * 10.0**decimals).astype(np.int64)
    magnitude = np.abs(scaled)
    n_digits = max(len(str(int(magnitude.max(initial=0)))), decimals + 1)
    columns = []
    for column in range(scaled.shape[1]):
        rest = magnitude[:, column].copy()
        text = np.zeros((len(rest), n_digits), np.uint8)
        for place in range(n_digits - 1, -1, -1):
            before = n_digits - 1 - place  # digits already written
            shown = (rest > 0) | (before <= decimals)
            rest, digit = np.divmod(rest, 10)
            text[:, place] = np.where(shown, digit + ord("0"), 0)
        whole = n_digits - decimals
        sign = np.where(scaled[:, column] < 0, ord("-"), 0).astype(np.uint8)[:, None]
        pieces = [sign, text[:, :whole]]
        if decimals:
            pieces += [np.full((len(text), 1), ord("."), np.uint8), text[:, whole:]]
        columns.append(np.concatenate(pieces, axis=1))
    return columns


def _joined(parts: list, separator: str, every: int = 1) -> list:
    """`parts` with `separator` between each group of `every`."""
    joined: list = []
    for index, part in enumerate(parts):
        if index and index % every == 0:
            joined.append(separator)
        joined.append(part)
    return joined


def _lines(parts: list) -> bytes:
    """One line per row: arrays [n, width] of ASCII codes (0 is nothing) and constant strings side by side."""
    n_rows = next(len(part) for part in parts if isinstance(part, np.ndarray))
    columns = [
        part
        if isinstance(part, np.ndarray)
        else np.broadcast_to(np.frombuffer(part.encode(), np.uint8), (n_rows, len(part)))
        for part in parts
    ]
    text = np.concatenate(columns, axis=1)
    return text[text != 0].tobytes()
