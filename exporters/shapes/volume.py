"""The density of an asset as a volume for other programs: values at the vertices of a sparse grid.

Letters: vertex i (three integers, 0..R) of the asset's grid is at `matrix @ (i, 1)` in the frame of the
export. sigma is the density there, in 1/unit of that frame: a world in millimetres has densities a thousand
times smaller than one in metres. Vertices that are not listed are empty. The player interpolates log sigma,
other programs sigma itself. Between two vertices the interpolated sigma is denser, so that surfaces in other
programs are thicker by a fraction of a voxel.
"""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np

from exporters.shapes.crop import CropBox, nothing_inside
from exporters.shapes.mesh import unit
from player.asset.asset import Asset
from player.asset.density import decode_density
from player.asset.grid import SparseGrid
from player.asset.pyramid import Vertices
from player.errors import ShapeError
from player.files.images import to_8_bit
from player.head.head import Head
from player.march.fetches import MIN_TOTAL, stored_features
from player.threads import default_threads

_ROWS = 1 << 16  # vertices processed at a time, with some megabytes of scratch memory per thread


@dataclass(frozen=True, eq=False)
class Volume:
    """Densities, and colours if asked for, at vertices of a sparse grid.

    >>> matrix = np.diag([2.0, 2, 2, 1])
    >>> volume = Volume(np.array([[1, 0, 2]], np.int32), np.ones(1, np.float32), None, matrix)
    >>> volume.points().tolist(), round(volume.level, 3)
    ([[2.0, 0.0, 4.0]], 0.347)
    """

    index: np.ndarray
    """Vertices [n, 3] int32, 0 or more, each once."""
    density: np.ndarray
    """[n] float32, 1/unit of the frame, > 0."""
    colours: np.ndarray | None
    """[n, 3] uint8 sRGB: the head's colour for the features of this vertex alone, seen along the density
    gradient. None if not asked for."""
    matrix: np.ndarray
    """[4, 4] float64, frame from index; an index is the place of its value, not the corner of a voxel."""

    def __post_init__(self) -> None:
        n = len(self.index)
        shapes = {"index": (n, 3), "density": (n,), "matrix": (4, 4)}
        if self.colours is not None:
            shapes["colours"] = (n, 3)
        for name, shape in shapes.items():
            if getattr(self, name).shape != shape:
                raise ShapeError(
                    f"volume: {name}: expected {list(shape)}, got {list(getattr(self, name).shape)}"
                )

    @property
    def voxel(self) -> float:
        """Distance between neighbouring vertices, units of the frame: the geometric mean over the axes, whose
        distances may differ slightly."""
        return float(np.cbrt(np.linalg.det(self.matrix[:3, :3])))

    @property
    def level(self) -> float:
        """Density at which one voxel is half opaque, 1/unit of the frame: a level for a surface."""
        return math.log(2) / self.voxel

    def for_blender(self) -> Volume:
        """Return the volume shifted down by half a voxel along each axis of the grid. Blender's renderer
        (Cycles, 3.4 and 4.5 alike) draws the value of vertex i at i + 1/2, where OpenVDB has it at i."""
        shift = np.eye(4)
        shift[:3, 3] = -0.5
        return replace(self, matrix=self.matrix @ shift)

    def with_margin(self) -> Volume:
        """Return the same volume with indices of 1 or more, so that there is a voxel before the first. They
        are higher by 8 if one was 0, so that the bricks of 8 x 8 x 8 stay as they are."""
        if self.index.min(initial=1):
            return self
        shift = np.eye(4)
        shift[:3, 3] = -8
        return replace(self, index=self.index + np.int32(8), matrix=self.matrix @ shift)

    def points(self) -> np.ndarray:
        """Return the places of the vertices in the frame, [n, 3] float64."""
        return self.index @ self.matrix[:3, :3].T + self.matrix[:3, 3]


def asset_volume(
    asset: Asset, frame_from_world: np.ndarray, box: CropBox | None = None, colour: bool = False
) -> tuple[Volume, float]:
    """Return the volume of an asset in a frame, and the share of its vertices that the crop removed.

    Args:
        asset: an open asset.
        frame_from_world: [4, 4] similarity, as `exporters.formats.axes.coordinates_from_world` makes it.
        box: keep only the vertices in this box (world units); None keeps all.
        colour: compute colours with the head, too.

    Raises ConfigError: no vertex is in the box.
    """
    manifest, densities = asset.manifest, asset.arrays.densities
    low, high = np.array(manifest.aabb)
    model_from_index = np.eye(4)
    model_from_index[:3, :3] = np.diag((high - low) / manifest.resolution)
    model_from_index[:3, 3] = low
    world_from_index = asset.world_from_model @ model_from_index
    matrix = frame_from_world @ world_from_index
    index = densities.pyramid.vertices[0].index
    keep = np.arange(len(index))
    if box is not None:
        points = index @ world_from_index[:3, :3].T + world_from_index[:3, 3]
        keep = np.flatnonzero(box.holds(points))
        if not len(keep):
            bounds = np.stack([points.min(axis=0), points.max(axis=0)])
            raise nothing_inside("volume", f"{len(index)} vertices; they are", bounds)
    scale = np.cbrt(np.linalg.det((frame_from_world @ asset.world_from_model)[:3, :3]))
    densities = decode_density(
        densities.values[0][keep, 0], (manifest.density_range[0], manifest.density_range[1])
    )
    volume = Volume(
        index[keep],
        (densities / np.float32(scale)).astype(np.float32),
        _colours(asset, index[keep]) if colour else None,
        matrix,
    )
    return volume, 1 - len(keep) / max(len(index), 1)


def _colours(asset: Asset, index: np.ndarray) -> np.ndarray:
    """Return the colours [n, 3] uint8 that the head gives the features at each vertex, as if the vertex alone
    made the whole pixel."""
    head = Head.of(asset)
    grid, densities = asset.grid, asset.arrays.densities
    codes, vertices = densities.values[0][:, 0], densities.pyramid.vertices[0]

    def part(start: int) -> np.ndarray:
        some = slice(start, start + _ROWS)
        dirs = _slope(grid, vertices, codes, index[some])
        values, total = stored_features(grid, index[some].T.astype(np.float32))
        rgb = head(values / np.maximum(total, MIN_TOTAL)[:, None], dirs)
        return to_8_bit(np.nan_to_num(rgb))

    with ThreadPoolExecutor(default_threads()) as pool:
        parts = list(pool.map(part, range(0, len(index), _ROWS)))
    return np.concatenate([np.zeros((0, 3), np.uint8), *parts])


def _slope(grid: SparseGrid, vertices: Vertices, codes: np.ndarray, index: np.ndarray) -> np.ndarray:
    """Return the unit directions [n, 3] float32 of the density gradient, along which a surface is looked at;
    (0, 0, -1) where the density is flat, as inside a solid, which nobody sees."""
    slope = np.empty((len(index), 3))
    for axis, step in enumerate(np.eye(3, dtype=np.int64)):
        rise = _codes_at(vertices, codes, index + step) - _codes_at(vertices, codes, index - step)
        slope[:, axis] = rise * grid.cells_per_unit[axis]
    return unit(slope, [0.0, 0.0, -1.0]).astype(np.float32)


def _codes_at(vertices: Vertices, codes: np.ndarray, index: np.ndarray) -> np.ndarray:
    """Return the codes [n] float64 at vertices that may lie outside the grid; 0 where none is stored."""
    found = vertices.rows(index)
    return np.where(found >= 0, codes[np.maximum(found, 0)], 0).astype(np.float64)
