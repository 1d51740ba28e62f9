"""Binary STL: triangles without colours, shared corners or unit, for printers and CAD.

A triangle is stored as its normal, computed from the corners' winding, and its three corners, all float32;
the two bytes after them are 0. The header must not begin with "solid", or readers take the file for text.
"""

from __future__ import annotations

import struct

import numpy as np

from exporters.shapes.mesh import TriangleMesh, crossed_edges, unit
from player.errors import ConfigError, FormatError

TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
HEADER = b"vfr-bake: binary STL".ljust(80, b" ")


def stl_bytes(mesh: TriangleMesh) -> bytes:
    """Return the file's content, 50 bytes per face; the same mesh gives the same bytes.

    Raises ConfigError for a mesh without faces, or with more than the format's 2^32 - 1.

    >>> corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    >>> up, white = np.tile([0.0, 0.0, 1.0], (3, 1)), np.full((3, 4), 255, np.uint8)
    >>> data = stl_bytes(TriangleMesh(corners, np.array([[0, 1, 2]], np.int32), up, white))
    >>> len(data), parse_stl(data, "one.stl")["normal"].tolist()
    (134, [[0.0, 0.0, 1.0]])
    """
    if not 0 < len(mesh.faces) < 1 << 32:
        raise ConfigError(f"STL: mesh: expected 1 to 2^32 - 1 faces, got {len(mesh.faces)}")
    triangles = np.zeros(len(mesh.faces), TRIANGLE)
    triangles["corners"] = mesh.vertices[mesh.faces]
    triangles["normal"] = unit(crossed_edges(mesh.vertices, mesh.faces), 0.0)
    return HEADER + struct.pack("<I", len(triangles)) + triangles.tobytes()


def parse_stl(data: bytes, where: str) -> np.ndarray:
    """Return the triangles in `data`, [n_faces] of TRIANGLE; FormatError if their
    number does not fill the file."""
    n_faces = struct.unpack_from("<I", data, 80)[0] if len(data) >= 84 else 0
    if len(data) != 84 + n_faces * TRIANGLE.itemsize or data.startswith(b"solid"):
        raise FormatError(f"{where}: expected a binary STL of {n_faces} faces, got {len(data)} bytes")
    return np.frombuffer(data, TRIANGLE, n_faces, 84)
