"""Wavefront OBJ, a text format: `v x y z r g b` (sRGB in [0, 1], the widely read extension for vertex
colours), `vn`, `f v//vn`.

Numbers are written in fixed point by numpy, digit by digit for a whole array, because Python's formatting
takes seconds for a million faces. OBJ has no alpha per vertex, so alpha is left out.

A mesh with a texture is three files: `v x y z`, `vt u v` (origin at the LOWER left, unlike glTF's), `vn` and
`f v/vt/vn` in the OBJ, a material without light in the MTL, and the picture as a PNG.
"""

from __future__ import annotations

import math

import numpy as np

from exporters.shapes.mesh import TriangleMesh
from exporters.shapes.texture import Texture
from player.errors import ConfigError, ParityError

_PLAIN = b"# vfr-bake: v x y z r g b (sRGB), vn, f\n"
_TEXTURED = b"# vfr-bake: v, vt, vn, f\n"
_CHUNK = 1 << 17  # rows turned into text at once, with tens of megabytes of scratch memory


def obj_bytes(mesh: TriangleMesh) -> bytes:
    """Return the file's content: positions to nine digits of the mesh's extent (`n_decimals`), colours to
    1e-4 (8 bits survive).

    Raises ConfigError for a coordinate of 1e15 or more.

    >>> corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    >>> up, white = np.tile([0.0, 0.0, 1.0], (3, 1)), np.full((3, 4), 255, np.uint8)
    >>> mesh = TriangleMesh(corners, np.array([[0, 1, 2]], np.int32), up, white)
    >>> print(obj_bytes(mesh).decode().splitlines()[-1])
    f 1//1 2//2 3//3
    """
    vertices = _rows("v", (mesh.vertices, n_decimals(mesh)), (mesh.colours[:, :3] / 255, 4))
    return b"".join([_PLAIN, *vertices, *_rows("vn", (mesh.normals, 6)), *_faces(mesh.faces, "//", 2)])


def textured_obj_files(mesh: TriangleMesh, texture: Texture, stem: str) -> dict[str, bytes]:
    """Return the files of a mesh with a texture by suffix, `.png`, `.mtl` and `.obj`; they refer to each
    other as `stem` plus suffix.

    Raises ConfigError for a coordinate of 1e15 or more. `check_stem` tells which stems are allowed.

    >>> corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    >>> up, white = np.tile([0.0, 0.0, 1.0], (3, 1)), np.full((3, 4), 255, np.uint8)
    >>> mesh = TriangleMesh(corners, np.array([[0, 1, 2]], np.int32), up, white)
    >>> files = textured_obj_files(mesh, Texture(np.float32([[0, 0], [1, 0], [0, 1]]),
    ...     np.zeros((2, 2, 3), np.uint8)), "one")
    >>> files[".obj"].decode().splitlines()[-1], "map_Kd one.png" in files[".mtl"].decode()
    ('f 1/1/1 2/2/2 3/3/3', True)
    """
    flipped = np.stack([texture.uvs[:, 0], 1 - texture.uvs[:, 1].astype(np.float64)], axis=-1)
    obj = b"".join(
        [
            _TEXTURED,
            f"mtllib {stem}.mtl\nusemtl surface\n".encode(),
            *_rows("v", (mesh.vertices, n_decimals(mesh))),
            *_rows("vt", (flipped, 7)),
            *_rows("vn", (mesh.normals, 6)),
            *_faces(mesh.faces, "/", 3),
        ]
    )
    mtl = f"newmtl surface\nillum 0\nKa 1 1 1\nKd 1 1 1\nKs 0 0 0\nmap_Kd {stem}.png\n".encode()
    return {".png": texture.png(), ".mtl": mtl, ".obj": obj}


def check_stem(stem: str) -> None:
    """Raise ConfigError if the files of a mesh with a texture cannot have this stem: if it is empty or has
    spaces, which an MTL file cannot quote."""
    if not stem or any(character.isspace() for character in stem):
        raise ConfigError(
            f"OBJ: name: expected one without spaces, which MTL files cannot name, got {stem!r}"
        )


def n_decimals(mesh: TriangleMesh) -> int:
    """Return the number of decimals of positions: nine digits of the mesh's extent, or of its largest
    coordinate if that is smaller, so that a small mesh far from the origin keeps its shape. Digits that
    float64 does not have are left out.

    Raises ConfigError for a coordinate of 1e15 or more.

    >>> corners = np.array([[0.0, 0, 0], [0.25, 0, 0], [0, 0.5, 0]]) + 4.5e6
    >>> up, white = np.tile([0.0, 0.0, 1.0], (3, 1)), np.full((3, 4), 255, np.uint8)
    >>> n_decimals(TriangleMesh(corners, np.array([[0, 1, 2]], np.int32), up, white))
    9
    """
    largest = float(np.abs(mesh.vertices).max(initial=0.0))
    if largest >= 1e15:
        raise ConfigError(f"OBJ: vertices: expected coordinates below 1e15, got {largest:g}")
    if not largest:
        return 1
    extent = float(np.ptp(mesh.vertices, axis=0).max()) or largest
    wanted, there = 8 - _exponent(min(extent, largest)), 15 - _exponent(largest)
    return min(max(min(wanted, there), 0), 15)


def _exponent(value: float) -> int:
    return math.floor(math.log10(value))


def parse_obj(data: bytes, where: str) -> dict[str, np.ndarray]:
    """Return the arrays in a file that `obj_bytes` or `textured_obj_files` wrote.

    Returns:
        `vertices`, `normals` [n, 3], `faces` [m, 3], and `colours` [n, 3] sRGB, 0..1, or, for a mesh with a
        texture, `uvs` [n, 2], origin at the upper left.

    Raises ParityError: a corner of a face has the normal or the place in the picture of another vertex.
    """
    textured = data.startswith(_TEXTURED)
    widths = {"v": 3, "vt": 2, "vn": 3, "f": 9} if textured else {"v": 6, "vn": 3, "f": 6}
    rows, stop = {}, len(data)
    for word in reversed(widths):
        start = data.find(f"\n{word} ".encode())
        start = start if start >= 0 else stop
        text = data[start:stop].replace(word.encode(), b" ").replace(b"/", b" ")
        rows[word] = np.fromstring(text.decode(), sep=" ").reshape(-1, widths[word])
        stop = start
    corners = rows["f"].reshape(-1, 3, widths["f"] // 3)
    if (corners != corners[:, :, :1]).any():
        raise ParityError(f"{where}: faces: expected the normals and places of their vertices, got others")
    faces = corners[:, :, 0].astype(np.int64) - 1
    found = {"vertices": rows["v"][:, :3], "normals": rows["vn"], "faces": faces}
    if textured:
        return {**found, "uvs": rows["vt"] * [1, -1] + [0, 1]}
    return {**found, "colours": rows["v"][:, 3:]}


def _rows(word: str, *columns: tuple[np.ndarray, int]) -> list[bytes]:
    """Return lines that begin with `word`. Each has one row of every array [n, m] side by side; an array
    comes with its number of decimals."""
    lines = []
    for start in range(0, len(columns[0][0]), _CHUNK):
        rows = [_fixed(values[start : start + _CHUNK], decimals) for values, decimals in columns]
        lines.append(_lines([word, *(part for row in rows for number in row for part in (" ", number))]))
    return lines


def _faces(faces: np.ndarray, separator: str, n_times: int) -> list[bytes]:
    """Return the lines of faces whose corners repeat the vertex's number `n_times`."""
    lines = []
    for start in range(0, len(faces), _CHUNK):
        corners = _fixed(faces[start : start + _CHUNK] + 1, 0)
        words = [[" ", *([corner, separator] * (n_times - 1)), corner] for corner in corners]
        lines.append(_lines(["f", *(part for word in words for part in word)]))
    return lines


def _fixed(values: np.ndarray, decimals: int) -> list[np.ndarray]:
    """Return the columns of `values` [n, m] as fixed-point text: m arrays [n, width] of ASCII codes, 0
    where there is no character."""
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


def _lines(parts: list[np.ndarray | str]) -> bytes:
    """Return one line of text per row, from arrays [n, width] of ASCII codes (0 is no character) and constant
    strings, side by side."""
    n_rows = next(len(part) for part in parts if isinstance(part, np.ndarray))
    columns = [
        part
        if isinstance(part, np.ndarray)
        else np.broadcast_to(np.frombuffer(part.encode(), np.uint8), (n_rows, len(part)))
        for part in [*parts, "\n"]
    ]
    text = np.concatenate(columns, axis=1)
    return text[text != 0].tobytes()
