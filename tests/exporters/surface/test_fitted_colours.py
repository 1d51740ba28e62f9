"""Tests of colours of a ball's vertices, fitted to pictures of a ball whose colours are known."""

from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np
import pytest

from exporters.shapes.mesh import take_faces
from exporters.surface.depth_views import DepthView
from exporters.surface.fitted_colours import fit_colours
from player.errors import MissingExtraError
from tests.exporters.meshes import sphere
from tests.exporters.surface.test_depth_views import all_around, joined


def colour_of(places: np.ndarray) -> np.ndarray:
    """Return colours linear in the place, so that only flat faces and rounded pixels cause errors."""
    return 0.5 + 0.4 * places / np.linalg.norm(places, axis=-1, keepdims=True)


def pictures(bias: float = 0.0) -> list[DepthView]:
    """Return views of the ball from all around; in every second one everything is brighter by `bias`."""
    views = []
    for number, view in enumerate(all_around(1.0)):
        rays_o, rays_d = view.camera.rays()
        t = view.distance.reshape(-1)
        hit = np.isfinite(t)
        rgb = np.zeros((len(t), 3))
        rgb[hit] = colour_of(rays_o[hit] + rays_d[hit] * t[hit][:, None]) + bias * (number % 2)
        picture = np.rint(rgb.clip(0, 1) * 255).astype(np.uint8).reshape(64, 64, 3)
        views.append(replace(view, rgb=picture))
    return views


@pytest.mark.needs("open3d")
def test_the_colours_of_a_ball() -> None:
    mesh = sphere(24)
    shares: list[tuple[int, int]] = []
    rgb, known = fit_colours(mesh, pictures(), 0.05, lambda done, of: shares.append((done, of)))
    assert known.all() and shares[-1] == (6, 6)
    assert np.abs(rgb - colour_of(mesh.vertices)).max() < 0.03
    again, _ = fit_colours(mesh, pictures(), 0.05)
    assert again.tobytes() == rgb.tobytes()


@pytest.mark.needs("open3d")
def test_far_from_the_origin() -> None:
    """In the coordinates of a map, which float32 rounds to half a radius, a ball has the same colours."""
    mesh = sphere(24)
    shift = np.eye(4)
    shift[:3, 3] = 4.5e6, -5e5, 300
    views = [replace(view, camera=view.camera.transformed(shift)) for view in pictures()]
    near, _ = fit_colours(mesh, pictures(), 0.05)
    far, known = fit_colours(mesh.transformed(shift), views, 0.05)
    assert known.all() and np.abs(far - near).max() < 0.01


@pytest.mark.needs("open3d")
def test_no_other_colours_are_nearer_to_the_pictures() -> None:
    """Where pictures contradict each other, colours are their mean; a side that only one sees has its own."""
    mesh = sphere(24)
    rgb, _ = fit_colours(mesh, pictures(0.1), 0.05)
    above = rgb - colour_of(mesh.vertices)
    assert above.min() > -0.04 and above.max() < 0.14 and 0.03 < above.mean() < 0.07


@pytest.mark.needs("open3d")
def test_what_does_not_count() -> None:
    """No colours are fitted to a mesh beside the surface that the pictures show, nor to an unseen part."""
    mesh = sphere(24)
    rgb, known = fit_colours(replace(mesh, vertices=mesh.vertices * 1.2), pictures(), 0.05)
    assert not known.any() and rgb.shape == (len(mesh.vertices), 3)
    far = replace(mesh, vertices=mesh.vertices + 100)
    _, known = fit_colours(joined(mesh, far), pictures(), 0.05)
    assert known[: len(mesh.vertices)].all() and not known[len(mesh.vertices) :].any()


@pytest.mark.needs("open3d")
def test_unseen_corners_have_their_neighbours_colours() -> None:
    """Vertices just behind the rim of the half that one picture shows get the colours at the rim, up to 0.35
    off their own."""
    mesh = sphere(24)
    upper = take_faces(mesh, mesh.vertices[mesh.faces, 2].min(axis=1) > -0.3)
    rgb, known = fit_colours(upper, pictures()[4:5], 0.05)
    assert known.all()
    hidden = upper.vertices[:, 2] < 0
    assert np.abs(rgb - colour_of(upper.vertices))[hidden].max() < 0.35


def test_missing_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "open3d", None)
    with pytest.raises(MissingExtraError, match=r"needs open3d: pip install 'vfr-bake\[export\]'"):
        fit_colours(sphere(8), pictures(), 0.05)
