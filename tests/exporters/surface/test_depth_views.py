"""Tests of what training cameras see: known depth pictures, and points before, behind and beside them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from exporters.shapes.mesh import TriangleMesh, take_faces
from exporters.surface.asset_surface import AssetSurface, Removed, cleaned
from exporters.surface.depth_views import DepthView, cosines_in_view, depth_views, sightings
from player.asset.asset import Asset
from player.cameras.camera import Camera
from player.errors import DataError
from tests.exporters.conftest import BALL_CENTRE, BALL_RADIUS
from tests.exporters.meshes import sphere
from tests.exporters.solids import WORLD_FROM_MODEL
from tests.player.conftest import look_at

UP = np.array([[0.0, 0.0, 1.0]])
BLACK = np.zeros((64, 64, 3), np.uint8)


def camera(eye: tuple[float, float, float], size: int = 64) -> Camera:
    return Camera("a", look_at(eye, (0.0, 0.0, 0.0)), size, size, size * 1.5, size * 1.5, size / 2, size / 2)


def sphere_view(eye: tuple[float, float, float], radius: float) -> DepthView:
    """Return the view of a ball around the origin by a camera, in closed form."""
    seen_by = camera(eye)
    rays_o, rays_d = (a.astype(np.float64) for a in seen_by.rays())
    along = -(rays_o * rays_d).sum(-1)
    square = radius**2 - (rays_o**2).sum(-1) + along**2
    distance = np.where(square > 0, along - np.sqrt(np.maximum(square, 0)), np.inf)
    return DepthView(seen_by, distance.reshape(64, 64).astype(np.float32), BLACK)


def all_around(radius: float) -> list[DepthView]:
    eyes = [(4, 0.1, 0.1), (-4, 0.1, 0.1), (0.1, 4, 0.1), (0.1, -4, 0.1), (0.1, 0.1, 4), (0.1, 0.1, -4)]
    return [sphere_view(eye, radius) for eye in eyes]


def test_before_behind_beside_and_turned_away() -> None:
    view = DepthView(camera((0.0, 0.001, 5.0)), np.full((64, 64), 5.0, np.float32), BLACK)
    points = np.array([[0, 0, 0], [0, 0, 1], [0, 0, -0.05], [0, 0, -0.2], [9, 0, 0], [0, 0, 9.0]])
    cosines = cosines_in_view(view, points, np.tile(UP, (6, 1)), 0.1)
    np.testing.assert_allclose(cosines, [1, 1, 1, 0, 0, 0], rtol=0, atol=1e-5)
    assert not cosines_in_view(view, points, np.tile(-UP, (6, 1)), 0.1)[:5].any()
    slanted = np.tile(np.array([[0.6, 0.0, 0.8]]), (1, 1))
    np.testing.assert_allclose(cosines_in_view(view, points[:1], slanted, 0.1), [0.8], atol=1e-3)
    nothing = DepthView(view.camera, np.full((64, 64), np.inf, np.float32), BLACK)
    assert cosines_in_view(nothing, points[3:4], UP, 0.0)[0] == pytest.approx(1)
    assert len(cosines_in_view(view, points[:0], UP[:0], 0.1)) == 0


def test_half_of_a_ball_is_seen_from_one_side() -> None:
    mesh = sphere(40)
    seen = sightings([sphere_view((0.0, 0.001, 5.0), 1.0)], mesh.vertices, mesh.normals, 0.02).seen > 0
    height = mesh.vertices[:, 2]  # tangents from (0, 0, 5) touch at z = 1/5
    assert not seen[height < 1 / 5 - 0.05].any()
    # One pixel (0.05 wide here) inside the outline, the ball is sqrt(2 * 0.05) higher.
    assert seen[height > 1 / 5 + 0.35].all()
    assert sightings(all_around(1.0), mesh.vertices, mesh.normals, 0.02).seen.all()


def joined(*meshes: TriangleMesh) -> TriangleMesh:
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    faces = [mesh.faces + start for mesh, start in zip(meshes, starts[:-1], strict=True)]
    return TriangleMesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate(faces).astype(np.int32),
        np.concatenate([mesh.normals for mesh in meshes]),
        np.concatenate([mesh.colours for mesh in meshes]),
    )


def test_what_is_hidden_and_what_floats_goes() -> None:
    outer = sphere(120)
    inner = replace(sphere(30), vertices=sphere(30).vertices * 0.8)
    # as near as the outer sphere, but with normals inwards
    wall = replace(sphere(30), vertices=sphere(30).vertices * 0.99, normals=-sphere(30).normals)
    tiny = np.array([[1.5, 0, 0], [1.5, 0.01, 0], [1.5, 0, 0.01]])
    out = np.tile([1.0, 0, 0], (3, 1))
    floater = TriangleMesh(tiny, np.array([[0, 1, 2]], np.int32), out, np.full((3, 4), 255, np.uint8))
    mesh = joined(outer, inner, wall, floater)
    kept, removed = cleaned(mesh, all_around(1.0), 0.02)
    assert removed == Removed(len(inner.faces) + len(wall.faces), 1, 0, 0)
    assert len(kept.faces) == len(outer.faces) and np.array_equal(kept.vertices, outer.vertices)
    with pytest.raises(DataError, match=r"expected some of \d+ faces in a training camera's view, got none"):
        cleaned(replace(inner, vertices=inner.vertices + 100), all_around(1.0), 0.02)


@pytest.mark.needs("open3d")
def test_what_fills_a_hole_stays() -> None:
    whole, inner = sphere(60), replace(sphere(60), vertices=sphere(60).vertices * 0.9)
    outer = take_faces(whole, whole.vertices[whole.faces, 0].max(axis=1) < 0.97)
    kept, removed = cleaned(joined(outer, inner), all_around(1.0), 0.02)
    assert np.array_equal(kept.vertices[: len(outer.vertices)], outer.vertices)
    filling = kept.vertices[len(outer.vertices) :]
    assert 20 < len(filling) < 200 and filling[:, 0].min() > 0.7
    assert removed.unseen_faces > 0.9 * len(inner.faces)


def test_views_that_show_something_at_a_point_and_views_that_see_through_it() -> None:
    """`seen` counts the views that see a point, `solid` those that show a surface there; by hand, for points
    on a ball of radius 1, before it, inside it, and where the pictures show nothing."""
    points = np.array([[0.0, 0, 1], [0, 0, 1.5], [0, 0, 0.99], [0, 0, 0.5], [1.25, 0, 0]])
    out = np.array([[0.0, 0, 1], [0, 0, 1], [0, 0, 1], [0, 0, 1], [0, 0, 1]])
    found = sightings([sphere_view((0.0, 0.001, 4.0), 1.0)] * 3, points, out, 0.05)
    assert found.seen.tolist() == [3, 3, 3, 0, 3]
    assert found.solid.tolist() == [3, 0, 3, 0, 0]


def test_haze_goes() -> None:
    """A closed shell of haze around the ball in the pictures is removed, though it has more faces than the
    ball. The shell alone is refused: every picture sees through it."""
    ball, haze = sphere(60), sphere(120)
    haze = replace(haze, vertices=haze.vertices * 1.3)
    kept, removed = cleaned(joined(haze, ball), all_around(1.0), 0.02)
    assert removed == Removed(0, len(haze.faces), 0, 0) and np.array_equal(kept.vertices, ball.vertices)
    with pytest.raises(DataError, match="got haze that is seen through"):
        cleaned(haze, all_around(1.0), 0.02)


def test_depth_views_of_a_ball(ball_asset: Asset) -> None:
    shares: list[tuple[int, int]] = []
    views = depth_views(ball_asset, 32 * 32, progress=lambda done, of: shares.append((done, of)))
    assert len(views) == 12 and shares[-1] == (12, 12) and views[0].camera.width == 32
    centre = np.array(WORLD_FROM_MODEL)[:3] @ [*BALL_CENTRE, 1]
    for view in views:
        middle = np.linalg.norm(view.camera.c2w[:3, 3] - centre) - 2 * BALL_RADIUS
        assert np.isfinite(view.distance).any() and np.isinf(view.distance).any()
        assert view.distance.min() == pytest.approx(middle, abs=0.1)  # a voxel is 0.056 here
    assert depth_views(ball_asset)[0].camera.width == 64
    assert len(depth_views(ball_asset, 32 * 32, 5)) == 5


def test_the_surface_of_a_ball_with_what_was_removed(ball_asset: Asset) -> None:
    stages = []
    surface = AssetSurface(ball_asset, lambda stage, done, of: stages.append(stage))
    for method in ("density", "tsdf"):
        mesh, removed = surface.from_depth() if method == "tsdf" else surface.from_density()
        centre = np.array(WORLD_FROM_MODEL)[:3] @ [*BALL_CENTRE, 1]
        outward = mesh.vertices - centre
        radius = np.linalg.norm(outward, axis=-1)
        assert np.abs(radius - 2 * BALL_RADIUS).max() < 2 * 4 / 72
        cosines = (mesh.normals * outward).sum(-1) / radius
        # depth is that of the nearest pixel, as wide as a voxel here: it has steps, and thin faces at them
        assert cosines.min() > 0.99 if method == "density" else cosines.mean() > 0.9
        assert removed.unseen_faces < 0.02 * len(mesh.faces)
        assert (mesh.colours == 255).all()
        assert surface.painted(mesh).colours[:, :3].std(axis=0).min() > 5
    assert set(stages) == {"views", "surface", "colours", "fusion"}
