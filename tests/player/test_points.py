"""Tests of points of a COLMAP model, in its binary form."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

from player.cameras.colmap import read_points
from player.errors import FormatError


def points_file(points: list[tuple[float, float, float]]) -> bytes:
    """Return a file of points, each with a colour, an error and a track of as many pictures as its number."""
    data = struct.pack("<Q", len(points))
    for number, point in enumerate(points):
        track = struct.pack("<Q", number) + struct.pack("<ii", 7, 8) * number
        data += struct.pack("<Q3d3Bd", number + 100, *point, 1, 2, 3, 0.5) + track
    return data


def test_points_are_where_the_file_has_them(tmp_path: Path) -> None:
    path = tmp_path / "points3D.bin"
    path.write_bytes(
        points_file([(1.0, 2.0, 3.0), (-4.0, 5.5, 1e-3), (np.nan, 0.0, 0.0), (7.0, 8.0, np.inf)])
    )
    assert read_points(path).tolist() == [[1, 2, 3], [-4, 5.5, 1e-3]], "one that is nowhere is left out"
    path.write_bytes(points_file([]))
    assert read_points(path).shape == (0, 3)


def test_points_that_are_cut_short(tmp_path: Path) -> None:
    path, data = tmp_path / "points3D.bin", points_file([(1.0, 2.0, 3.0)] * 3)
    for end in range(len(data)):
        path.write_bytes(data[:end])
        with pytest.raises(FormatError, match="cut short"):
            read_points(path)
    path.write_bytes(data + b"\0")
    with pytest.raises(FormatError, match="expected the end"):
        read_points(path)
