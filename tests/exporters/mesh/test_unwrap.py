"""Tests of layouts by xatlas: faces stay the same, no two share a texel, and a time limit ends xatlas."""

from __future__ import annotations

import importlib.util
import sys

import numpy as np
import pytest

from exporters.mesh import unwrap as module
from exporters.mesh.paint import covered_texels
from exporters.mesh.unwrap import parts_of, unwrap
from exporters.shapes.mesh import TriangleMesh
from player.errors import ConfigError, DataError, MissingExtraError
from tests.exporters.meshes import sphere
from tests.exporters.surface.test_depth_views import joined

MESH = sphere(30)


def test_the_faces_stay_and_share_no_texel() -> None:
    cut, uvs = unwrap(MESH, 256, 60.0)
    assert np.array_equal(
        cut.vertices[cut.faces], MESH.vertices[MESH.faces]
    )  # the same faces in the same order
    assert np.array_equal(cut.normals[cut.faces], MESH.normals[MESH.faces])
    assert np.array_equal(cut.colours[cut.faces], MESH.colours[MESH.faces])
    assert uvs.shape == (len(cut.vertices), 2) and uvs.dtype == np.float32
    assert uvs.min() >= 0 and uvs.max() <= 1
    size = 512
    texels, _, _ = covered_texels(uvs, cut.faces, size)
    alone = sum(len(covered_texels(uvs, cut.faces[n : n + 1], size)[0]) for n in range(len(cut.faces)))
    assert alone <= 1.02 * len(texels)  # a centre on the edge between two faces may be in both
    assert len(texels) > 0.5 * size * size
    again = unwrap(MESH, 256, 60.0)
    assert again[1].tobytes() == uvs.tobytes() and again[0].faces.tobytes() == cut.faces.tobytes()


def test_small_faces_have_a_place() -> None:
    """A face with edges of 1/2500 of the mesh is laid out, too. All corners of a face that xatlas leaves out
    are at (0, 0)."""
    corners = np.array([[1.5, 0, 0], [1.5, 1e-3, 0], [1.5, 0, 1e-3]])
    normals, white = np.tile([1.0, 0, 0], (3, 1)), np.full((3, 4), 255, np.uint8)
    small = TriangleMesh(corners, np.array([[0, 1, 2]], np.int32), normals, white)
    cut, uvs = unwrap(joined(MESH, small), 256, 60.0)
    assert (uvs[cut.faces] != 0).any(axis=(1, 2)).all()


def test_parts_hold_every_face_once() -> None:
    parts = parts_of(MESH.vertices, MESH.faces, 100)
    assert max(map(len, parts)) <= 100 and len(parts) < 2 * 2 * len(MESH.faces) / 100
    assert np.array_equal(np.sort(np.concatenate(parts)), np.arange(len(MESH.faces)))


def test_time_is_over(monkeypatch: pytest.MonkeyPatch) -> None:
    """A layout that exceeds its time limit raises an error, and its process has ended by then."""
    started = []
    original = module.subprocess.Popen

    def popen(*arguments, **settings):
        started.append(original(*arguments, **settings))
        return started[-1]

    monkeypatch.setattr(module.subprocess, "Popen", popen)
    with pytest.raises(
        ConfigError, match=r"expected an end within 0.01 seconds, got none: ask for fewer with"
    ):
        unwrap(MESH, 256, 0.01)
    assert started[0].poll() is not None


def test_what_xatlas_says_is_passed_on(monkeypatch: pytest.MonkeyPatch) -> None:
    broken = [sys.executable, "-c", "raise RuntimeError('no memory')"]
    monkeypatch.setattr(module, "python_command", lambda *_: broken)
    with pytest.raises(
        DataError, match="xatlas: expected a layout, got exit code 1: RuntimeError: no memory"
    ):
        unwrap(MESH, 256, 60.0)


def test_without_xatlas(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(MissingExtraError, match=r"--texture: needs xatlas: pip install 'vfr-bake\[export\]'"):
        unwrap(MESH, 256, 60.0)


def test_seconds_are_shown(monkeypatch: pytest.MonkeyPatch) -> None:
    """The seconds that passed are reported. The layout sleeps first, to take seconds on any machine."""

    def slow(name: str, folder: str) -> list[str]:
        program = f"import time, runpy; time.sleep(2.5); runpy.run_module({name!r}, None, '__main__', True)"
        return [sys.executable, "-c", program, folder]

    monkeypatch.setattr(module, "python_command", slow)
    seen = []
    unwrap(MESH, 256, 300.0, lambda done, of: seen.append((done, of)))
    assert seen[:2] == [(1, 300), (2, 300)] and seen == sorted(seen)
