"""Tests of the crop: the forms of a box, which faces stay, and what is reported about the removed ones."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

from exporters.shapes.crop import corners_text, crop_mesh, parse_crop
from player.errors import ConfigError, FormatError
from tests.exporters.meshes import box, sphere


def test_a_turned_box_holds_its_corners_and_no_more() -> None:
    crop = parse_crop("1,2,3,4,2,6,30")
    c, s = math.cos(math.radians(30)), math.sin(math.radians(30))
    corner = np.array([1 + 2 * c - 1 * s, 2 + 2 * s + 1 * c, 6])  # half edges 2, 1, 3, turned about Z
    assert crop.holds(corner[None]).all()
    assert not crop.holds(corner[None] + [0, 0, 1e-4]).any()
    assert not crop.holds(np.array([[3.0, 3.0, 3.0]])).any()  # inside if it were not turned


def test_the_three_forms_agree(tmp_path: Path) -> None:
    typed = parse_crop("1,2,3,4,2,6,30")
    named, matrix = tmp_path / "named.json", tmp_path / "matrix.JSON"
    named.write_text(json.dumps({"centre": [1, 2, 3], "size": [4, 2, 6], "yaw": 30}))
    matrix.write_text(json.dumps({"matrix": typed.matrix.tolist(), "size": [4, 2, 6]}))
    for other in (parse_crop(str(named)), parse_crop(str(matrix))):
        assert np.array_equal(typed.matrix, other.matrix) and np.array_equal(typed.size, other.size)


def test_a_mesh_of_the_size_of_the_box_stays_whole() -> None:
    mesh = box((0.1, 0.2, 0.3), (1.1, 1.2, 1.3))
    assert crop_mesh(mesh, parse_crop("0.6,0.7,0.8,1,1,1")) == (mesh, 0.0)


def test_half_a_sphere() -> None:
    mesh = sphere(40)
    half, removed = crop_mesh(mesh, parse_crop("0,0,5,10,10,10"))
    assert half.bounds[0, 2] >= -1e-4 and abs(removed - 0.5) < 0.03
    assert len(half.faces) == round(len(mesh.faces) * (1 - removed))
    np.testing.assert_allclose(np.linalg.norm(half.vertices, axis=-1), 1)


def test_nothing_left() -> None:
    with pytest.raises(
        ConfigError, match=r"got none of its 12 faces; the mesh is from \(0, 0, 0\) to \(1, 1"
    ):
        crop_mesh(box((0, 0, 0), (1, 1, 1)), parse_crop("5,5,5,1,1,1"))


def test_the_bounds_of_a_mesh_far_from_the_origin_can_be_told_apart() -> None:
    with pytest.raises(ConfigError, match=r"from \(4500000, 0\.125, 0\) to \(4500000\.5, 1\.251, 1"):
        crop_mesh(box((4.5e6, 0.125, -1e-9), (4500000.5, 1.25099, 1)), parse_crop("5,5,5,1,1,1"))
    assert corners_text([[-1e-9, 0, 0], [1e-9, 0, 5e-10]]) == "(-1e-09, 0, 0) to (1e-09, 0, 5e-10)"
    assert corners_text([[0, 0, 0], [123456.7, 9, 51]]) == "(0, 0, 0) to (123457, 9, 51)"
    assert corners_text([[1, 2, 3], [1, 2, 3]]) == "(1, 2, 3) to (1, 2, 3)"


@pytest.mark.parametrize(
    "text", ["", "1,2,3", "1,2,3,4,5,6,7,8", "a,b,c,d,e,f", "1,2,3,nan,1,1", "1,2,3,1,1,inf"]
)
def test_not_a_box(text: str) -> None:
    with pytest.raises(ConfigError, match="--crop: expected X,Y,Z,W,D,H"):
        parse_crop(text)


def test_no_size() -> None:
    with pytest.raises(ConfigError, match="size: expected three lengths > 0"):
        parse_crop("0,0,0,1,0,1")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "expected JSON"),
        ("[1]", "expected matrix and size, or centre, size and yaw"),
        ('{"size": [1, 1, 1]}', "expected matrix and size"),
        ('{"centre": [0, 0], "size": [1, 1, 1]}', r"centre: expected \[3\] finite numbers"),
        ('{"centre": [0, 0, 0], "size": [1, 1, -1]}', "size: expected three lengths > 0"),
        (
            '{"matrix": [[2,0,0,0],[0,2,0,0],[0,0,2,0],[0,0,0,1]], "size": [1, 1, 1]}',
            r"box\.json: matrix of the box: expected a rotation",
        ),
    ],
)
def test_bad_files(text: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "box.json"
    path.write_text(text)
    with pytest.raises((FormatError, ConfigError), match=message) as caught:
        parse_crop(str(path))
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)
    with pytest.raises(FormatError, match="no such file"):
        parse_crop(str(tmp_path / "none.json"))
