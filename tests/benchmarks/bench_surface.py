"""Quality of exported surfaces: compared with known geometry, or with the volume and with photographs.

    python -m tests.benchmarks.bench_surface ASSET                        # an asset of the built-in scene
    python -m tests.benchmarks.bench_surface ASSET --data DATA --views 10

Without DATA: mean and 95th percentile of the distance to the true surface, both ways, in the asset's voxels,
and the mean angle between normals. The true surface is sampled where rays of training cameras end. With DATA:
silhouette IoU with the volume, and PSNR against the photographs of test views, of the mesh's picture (2 x 2
rays a pixel) and of the volume's.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import open3d

from exporters.shapes.mesh import TriangleMesh
from exporters.surface.asset_surface import AssetSurface
from exporters.surface.inner_region import inner_region
from exporters.surface.marching_cubes import voxel_size
from player.asset.asset import Asset
from player.cameras.camera import Camera
from player.cameras.views import asset_cameras
from player.progress import silent
from player.render import Renderer
from tests.benchmarks.bench_specks import test_views
from tests.exporters.meshes import read_ply
from tests.vfr_bake.data.solids import signed_distance
from vfr_bake.data.demo import trace
from vfr_bake.data.scene import evenly
from vfr_bake.training.scores.metrics import psnr

SHARP = 2
"""Rays of a pixel along each side in pictures of a mesh, because photographs have no jagged edges either."""
TENSOR: Any = open3d.core.Tensor  # Open3D's stubs lack some of its code


def meshes(asset: Asset, methods: list[str]) -> Iterator[tuple[str, TriangleMesh]]:
    """Yield a description and the mesh of each method: the baked one, or those of `vfr-export --method`."""
    surface = AssetSurface(inner_region(asset), silent)
    for method in methods:
        start = time.process_time()
        if method == "baked":
            mesh = read_ply(asset.path("mesh.ply"))
        else:
            mesh, removed = surface.from_depth() if method == "tsdf" else surface.from_density()
            mesh = surface.painted(mesh)
            print(f"{method}: {removed}")
        yield f"{method:8} {len(mesh.faces):9,} faces, {time.process_time() - start:5.1f} CPU s", mesh


class Caster:
    """Rays that are cast at a mesh."""

    def __init__(self, mesh: TriangleMesh) -> None:
        self._mesh = mesh
        self._scene: Any = open3d.t.geometry.RaycastingScene()
        self._scene.add_triangles(mesh.vertices.astype(np.float32), mesh.faces.astype(np.uint32))

    def distances(self, points: np.ndarray) -> np.ndarray:
        """Return the distances [n] of points [n, 3] from the mesh."""
        return self._scene.compute_distance(TENSOR(points.astype(np.float32))).numpy()

    def cast(self, camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return which pixels are hit, [n] bool, and their places, normals and sRGB colours (0..1) on the
        mesh."""
        rays_o, rays_d = camera.rays()
        rays = np.concatenate([rays_o, rays_d], axis=1).astype(np.float32)
        answer = self._scene.cast_rays(TENSOR(rays))
        t = answer["t_hit"].numpy()
        hit = np.isfinite(t)
        u, v = answer["primitive_uvs"].numpy()[hit].T
        shares = np.stack([1 - u - v, u, v], axis=-1)
        corners = self._mesh.faces[answer["primitive_ids"].numpy()[hit]]
        normals = np.einsum("ij,ijk->ik", shares, self._mesh.normals[corners])
        colours = np.einsum("ij,ijk->ik", shares, self._mesh.colours[corners, :3] / 255)
        places = rays_o[hit].astype(np.float64) + rays_d[hit] * t[hit][:, None].astype(np.float64)
        return hit, places, normals / np.linalg.norm(normals, axis=-1, keepdims=True), colours

    def picture(self, camera: Camera, background: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return which pixels the mesh covers by half or more, [h, w] bool, and the picture [h, w, 3] in
        0..1."""
        hit, _, _, colours = self.cast(camera.resized(camera.width * SHARP, camera.height * SHARP))
        picture = np.tile(background, (len(hit), 1))
        picture[hit] = colours
        blocks = (camera.height, SHARP, camera.width, SHARP)
        covered = hit.reshape(blocks).mean(axis=(1, 3)) >= 0.5
        return covered, picture.reshape(*blocks, 3).mean(axis=(1, 3))


def true_normals(points: np.ndarray) -> np.ndarray:
    steps = 1e-4 * np.eye(3)
    slopes = np.stack([signed_distance(points + e) - signed_distance(points - e) for e in steps], axis=-1)
    return slopes / np.maximum(np.linalg.norm(slopes, axis=-1, keepdims=True), 1e-12)


def true_surface(camera: Camera) -> np.ndarray:
    """Return the points [n, 3] where a camera's rays end, in the world's frame."""
    distance = trace(camera)[1].reshape(-1)
    rays_o, rays_d = camera.rays()
    seen = np.isfinite(distance)
    return rays_o[seen] + rays_d[seen] * distance[seen][:, None].astype(np.float64)


def compare_geometry(asset: Asset, methods: list[str]) -> None:
    voxel = voxel_size(asset.grid) * asset.scale
    cameras = asset_cameras(asset)[::8]
    truths = [true_surface(camera) for camera in cameras]
    for told, mesh in meshes(asset, methods):
        caster = Caster(mesh)
        sample = mesh.vertices[:: max(1, len(mesh.vertices) // 100_000)].astype(np.float64)
        to_truth = np.abs(signed_distance(sample)) / voxel
        from_truth = np.concatenate([caster.distances(truth) for truth in truths]) / voxel
        angles = []
        for camera in cameras:
            _, places, normals, _ = caster.cast(camera)
            near = np.abs(signed_distance(places)) < 2 * voxel
            cosines = (true_normals(places) * normals).sum(-1)[near]
            angles.append(np.degrees(np.arccos(np.clip(cosines, -1, 1))))
        angle = np.concatenate(angles)
        print(
            f"{told}: to truth {to_truth.mean():.2f} voxel (95 %: {np.percentile(to_truth, 95):.2f}), truth "
            f"to mesh {from_truth.mean():.2f} (95 %: {np.percentile(from_truth, 95):.2f}), normals "
            f"{angle.mean():.1f} degrees (median {np.median(angle):.1f})",
            flush=True,
        )


def compare_pictures(asset: Asset, methods: list[str], data: Path, n_views: int) -> None:
    cameras, photographs = test_views(asset, data)
    chosen = evenly(len(cameras), n_views)
    with Renderer(asset) as renderer:
        frames = [renderer.render(cameras[i]) for i in chosen]
    for told, mesh in meshes(asset, methods):
        caster = Caster(mesh)
        both = either = 0
        scores: dict[str, list[float]] = {"mesh": [], "volume": [], "mesh against volume": []}
        for i, frame in zip(chosen, frames, strict=True):
            hit, picture = caster.picture(cameras[i], np.array(asset.manifest.background))
            solid = frame.opacity > 0.5
            both, either = both + (hit & solid).sum(), either + (hit | solid).sum()
            scores["mesh against volume"].append(psnr(picture, frame.rgb))
            scores["mesh"].append(psnr(picture, photographs[i]))
            scores["volume"].append(psnr(frame.rgb, photographs[i]))
        figures = ", ".join(f"{key} {np.mean(value):.2f} dB" for key, value in scores.items())
        print(f"{told}: IoU {both / either:.4f}, {figures}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("asset", type=Path)
    parser.add_argument("--data", type=Path, help="the data set, whose test views are compared")
    parser.add_argument("--views", type=int, default=10, help="test views, spread over all")
    parser.add_argument("--methods", nargs="+", default=["baked", "density", "tsdf"])
    arguments = parser.parse_args()
    asset = Asset.open(arguments.asset)
    if arguments.data is None:
        compare_geometry(asset, arguments.methods)
    else:
        compare_pictures(asset, arguments.methods, arguments.data, arguments.views)


if __name__ == "__main__":
    main()
