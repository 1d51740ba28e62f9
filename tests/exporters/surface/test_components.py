"""Tests of connected parts of meshes: which are removed, and which stay."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from exporters.shapes.mesh import TriangleMesh
from exporters.surface.components import remove_small_components
from tests.exporters.meshes import tetrahedron


def two_parts() -> TriangleMesh:
    one = tetrahedron()
    return TriangleMesh(
        np.concatenate([one.vertices, one.vertices[:3] + 9, one.vertices[:1]]),  # the last belongs to no face
        np.concatenate([one.faces, [[4, 5, 6]]]).astype(np.int32),
        np.concatenate([one.normals, one.normals[:3], one.normals[:1]]),
        np.concatenate([one.colours, one.colours[:3], one.colours[:1]]),
    )


def test_floaters_are_removed() -> None:
    mesh, n_removed = remove_small_components(two_parts(), 0.25)
    assert n_removed == 1
    assert mesh.vertices.tolist() == tetrahedron().vertices.tolist()
    assert mesh.faces.tolist() == tetrahedron().faces.tolist()
    assert remove_small_components(two_parts(), 0.2)[1] == 0  # a part of exactly this share stays
    assert remove_small_components(two_parts(), 1.0)[1] == 1  # the largest part always stays
    empty = replace(mesh, faces=mesh.faces[:0])
    assert remove_small_components(empty, 0.5) == (empty, 0)
