"""The surface of a field as a mesh with vertex colours: what the training views see of it, and nothing
else."""

from __future__ import annotations

import numpy as np

from exporters.mesh import TriangleMesh, take_faces
from exporters.surface import extract_surface, remove_small_components
from player.contraction import contract
from player.errors import ConfigError, DataError
from vfr_bake.baking.visibility import Progress
from vfr_bake.rendering.render import head_colours
from vfr_bake.training.metrics import to_8_bit
from vfr_bake.training.model_file import Model

FLOATER_FRACTION = 1e-3
"""Connected parts with a smaller share of the faces are floaters and go."""
N_PROBED = 100_000
"""Visible cells that are looked at for the largest density."""
STAND_OFF = 3.0
"""Colours are seen from this many voxels above the surface, along its normal."""


def bake_mesh(
    model: Model, visible: np.ndarray, resolution: int, progress: Progress
) -> tuple[TriangleMesh, int]:
    """The mesh in the WORLD frame, and how many floating parts were removed.

    `visible` [n, n, n] bool are the cells that some training view sees; faces away from all of them (the
    inside of a solid) are dropped. Of an unbounded scene it is the surface inside the unit ball. A field
    without a surface there, an even fog, has an empty mesh.
    """
    aabb = np.array([[-1.0] * 3, [1.0] * 3])
    unbounded = model.field.config.unbounded

    def density(points: np.ndarray) -> np.ndarray:
        return np.exp(model.field.log_densities(_unit(points, unbounded)))

    level = _level(model, visible, 2 / resolution)
    try:
        vertices, faces, normals = extract_surface(
            density, aabb, resolution, level, lambda share: progress(round(share * 100), 100)
        )
    except (ConfigError, DataError):  # every density is over the level, or under it
        none = np.zeros((0, 3))
        return TriangleMesh(none, none.astype(np.int32), none, np.zeros((0, 4), np.uint8)), 0
    mesh = TriangleMesh(vertices, faces, normals, np.zeros((len(vertices), 4), np.uint8))
    mesh = take_faces(mesh, np.any(_seen(vertices, visible, unbounded)[faces], axis=1))
    if unbounded:
        mesh = take_faces(mesh, np.all(np.linalg.norm(mesh.vertices, axis=-1)[mesh.faces] <= 1, axis=1))
    mesh, n_removed = remove_small_components(mesh, FLOATER_FRACTION)
    colours = _colours(model, mesh, 2 / resolution)
    coloured = TriangleMesh(mesh.vertices, mesh.faces, mesh.normals, colours)
    return coloured.transformed(model.world_from_model), n_removed


def _level(model: Model, visible: np.ndarray, voxel: float) -> float:
    """The density that is half opaque over a voxel; in a field nowhere so dense, half of its largest."""
    cells = np.argwhere(visible)
    some = cells[np.random.default_rng(0).integers(0, len(cells), N_PROBED)]
    points = ((some + 0.5) / len(visible)).astype(np.float32)
    largest = float(np.exp(model.field.log_densities(points).max()))
    return min(float(np.log(2)) / voxel, largest / 2)


def _unit(points: np.ndarray, unbounded: bool) -> np.ndarray:
    """Points [n, 3] of the model frame in the unit cube of the field."""
    return np.ascontiguousarray((contract(points) + 2) / 4 if unbounded else (points + 1) / 2)


def _seen(vertices: np.ndarray, visible: np.ndarray, unbounded: bool) -> np.ndarray:
    """Whether a visible cell lies within one cell of each vertex."""
    n = len(visible)
    cells = np.clip((_unit(vertices, unbounded) * n).astype(int), 0, n - 1)
    seen = np.zeros(len(vertices), bool)
    for offset in np.ndindex(3, 3, 3):
        near = np.clip(cells + np.array(offset) - 1, 0, n - 1)
        seen |= visible[tuple(near.T)]
    return seen


def _colours(model: Model, mesh: TriangleMesh, voxel: float) -> np.ndarray:
    """[n_vertices, 4] uint8 sRGB: the head's colour of a short ray down the normal onto each vertex; in an
    unbounded scene, whose proposals are made for whole rays, of the features at the vertex."""
    rays_d = -mesh.normals.astype(np.float32)
    if model.field.config.unbounded:
        features = model.field.features(_unit(mesh.vertices.astype(np.float32), True))
        return _opaque(head_colours(model.field, features, rays_d))
    rays_o = mesh.vertices.astype(np.float32) - rays_d * np.float32(STAND_OFF * voxel)
    features, opacity, _ = model.occupancy.composited_features(model.field, rays_o, rays_d)
    rgb = head_colours(model.field, features / np.maximum(opacity, 1e-3)[:, None], rays_d)
    return _opaque(rgb)


def _opaque(rgb: np.ndarray) -> np.ndarray:
    return np.concatenate([to_8_bit(rgb), np.full((len(rgb), 1), 255, np.uint8)], axis=1)
