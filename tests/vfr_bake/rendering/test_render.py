"""Pictures of a field: large ones are rendered in parts."""

from __future__ import annotations

import numpy as np
import pytest

from player.cameras.camera import Camera
from vfr_bake.config import FieldConfig
from vfr_bake.field.field import VfrField
from vfr_bake.rendering import render
from vfr_bake.rendering.occupancy import OccupancyGrid


def test_large_pictures_are_rendered_in_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Rays and features are held for a part of the pixels only, and the picture is the same."""
    field = VfrField(FieldConfig(n_levels=2, max_resolution=16, log2_table_size=10, head_width=8))
    grid = OccupancyGrid(8, step=0.2, seed=0)
    c2w = np.eye(4)
    c2w[2, 3] = 3.0
    camera = Camera("a", c2w, 23, 17, 20.0, 20.0, 11.5, 8.5)
    whole = render.render_camera(field, grid, camera)
    assert whole[1].max() > 0.1
    n_rays, render_rays = [], render.render_rays

    def counted(field: VfrField, sampler: render.Sampler, rays_o: np.ndarray, rays_d: np.ndarray):
        n_rays.append(len(rays_o))
        return render_rays(field, sampler, rays_o, rays_d)

    monkeypatch.setattr(render, "render_rays", counted)
    monkeypatch.setattr(render, "PIXELS_AT_ONCE", 100)
    parts = render.render_camera(field, grid, camera)
    assert n_rays == [100, 100, 100, 91]
    for array, part in zip(whole, parts, strict=True):
        np.testing.assert_allclose(part, array, atol=1e-6)
