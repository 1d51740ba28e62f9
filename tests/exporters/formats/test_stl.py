"""Tests of STL: golden bytes, another reader, and the comparison with the source (parity)."""

from __future__ import annotations

import io
import struct
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from exporters.formats.parity import check_mesh_bytes
from exporters.formats.stl import parse_stl, stl_bytes
from player.errors import ConfigError, FormatError, ParityError
from tests.exporters.meshes import random_mesh, tetrahedron


def test_golden() -> None:
    mesh = tetrahedron()
    data = stl_bytes(replace(mesh, faces=mesh.faces[:1]))
    triangle = struct.pack("<12fH", 0, 0, -1, 0, 0, 0, 0, 2, 0, 1, 0, 0, 0)
    assert data[80:] == struct.pack("<I", 1) + triangle
    assert data[:8] == b"vfr-bake" and data == stl_bytes(replace(mesh, faces=mesh.faces[:1]))


def test_trimesh_reads() -> None:
    read = trimesh.load_mesh(io.BytesIO(stl_bytes(tetrahedron())), file_type="stl")
    assert read.is_watertight and len(read.faces) == 4
    np.testing.assert_allclose(read.volume, 1.0, rtol=1e-6)
    assert read.bounds.tolist() == [[0, 0, 0], [1, 2, 3]]


def test_a_face_without_area_has_no_normal() -> None:
    mesh = tetrahedron()
    triangles = parse_stl(stl_bytes(replace(mesh, faces=np.array([[1, 1, 2]], np.int32))), "flat.stl")
    assert triangles["normal"].tolist() == [[0, 0, 0]]


def test_damaged_and_empty() -> None:
    data = stl_bytes(tetrahedron())
    for damaged in (data[:-1], data[:40], b"solid" + data[5:]):
        with pytest.raises(FormatError, match="expected a binary STL"):
            parse_stl(damaged, "a.stl")
    with pytest.raises(ConfigError, match="STL: mesh: expected 1 to"):
        stl_bytes(replace(tetrahedron(), faces=np.zeros((0, 3), np.int32)))


def test_parity_names_the_worst_place() -> None:
    mesh = random_mesh(60, 90)
    data = stl_bytes(mesh)
    check_mesh_bytes(".stl", data, mesh, "a.stl")
    moved = mesh.vertices.copy()
    moved[mesh.faces[7, 2]] += 1e-3
    with pytest.raises(ParityError, match=r"a\.stl: corners: number \d+: expected"):
        check_mesh_bytes(".stl", data, replace(mesh, vertices=moved), "a.stl")
    with pytest.raises(ParityError, match="corners: expected 267, got 270"):
        check_mesh_bytes(".stl", data, replace(mesh, faces=mesh.faces[1:]), "a.stl")
