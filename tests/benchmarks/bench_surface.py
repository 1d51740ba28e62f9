"""Quality of exported surfaces: compared with known geometry, with the volume and with photographs.

    python -m tests.benchmarks.bench_surface demo ASSET                     # an asset of the built-in scene
    python -m tests.benchmarks.bench_surface views ASSET transforms_test.json [--pictures DIR] [--views 10]

`demo`: mean and 95th percentile of the distance to the true surface, both ways, in the asset's voxels, and
the mean angle between normals. The true surface is sampled where rays of training cameras end. Before that:
where the asset's density reaches some levels along the true normals, which no mesh of it can improve on.
`views`: silhouette IoU with the volume, and PSNR against the photographs, of the mesh's picture (2 x 2 rays a
pixel) and of the volume's. `colours`: the direction, or the mean of directions, that gives a place the
nearest colour.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import open3d
from PIL import Image

from exporters.shapes.mesh import TriangleMesh
from exporters.surface import shaded_colours as surface_colour
from exporters.surface.asset_surface import AssetSurface, Removed
from exporters.surface.marching_cubes import code_and_slope, voxel_size
from player.asset.asset import Asset
from player.cameras.camera import Camera
from player.cameras.transforms import read_cameras
from player.progress import silent
from player.render import Renderer
from tests.exporters.meshes import read_ply

SHARP = 2
"""Rays of a pixel along each side in pictures of a mesh, because photographs have no jagged edges either."""
LEVELS = (10.0, 20.0, 30.0, 40.0, 60.0, 100.0)


def meshes(asset: Asset, methods: list[str]) -> Iterator[tuple[str, TriangleMesh, float]]:
    """Yield the name and the mesh of each method, and its seconds of processor time."""
    surface = AssetSurface(asset, silent)
    for method in methods:
        start = time.process_time()
        if method == "baked":
            mesh = read_ply(asset.path("mesh.ply"))
        else:
            mesh, removed = made_again(surface, method)
            mesh = surface.painted(mesh)
            print(f"{method}: {removed}")
        yield method, mesh, time.process_time() - start


def made_again(surface: AssetSurface, method: str) -> tuple[TriangleMesh, Removed]:
    """Return the surface by the method that `vfr-export --method` calls so."""
    return surface.from_depth() if method == "tsdf" else surface.from_density()


def cameras_of(asset: Asset, path: Path | None) -> list[Camera]:
    """Return the cameras of a file, or the training cameras."""
    width, height = asset.manifest.view_size
    return read_cameras(path or asset.path("cameras.json"), (width, height))


def cast(mesh: TriangleMesh, camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return which pixels are hit, [n] bool, and their place, normal and sRGB colour (0..1) on the mesh."""
    rays_o, rays_d = camera.rays()
    rays = np.concatenate([rays_o, rays_d], axis=1).astype(np.float32)
    answer = caster(mesh).cast_rays(TENSOR(rays))
    t = answer["t_hit"].numpy()
    hit = np.isfinite(t)
    u, v = answer["primitive_uvs"].numpy()[hit].T
    shares = np.stack([1 - u - v, u, v], axis=-1)
    corners = mesh.faces[answer["primitive_ids"].numpy()[hit]]
    normals = np.einsum("ij,ijk->ik", shares, mesh.normals[corners])
    colours = np.einsum("ij,ijk->ik", shares, mesh.colours[corners, :3] / 255)
    places = rays_o[hit].astype(np.float64) + rays_d[hit] * t[hit][:, None].astype(np.float64)
    return hit, places, normals / np.linalg.norm(normals, axis=-1, keepdims=True), colours


TENSOR: Any = open3d.core.Tensor  # Open3D's stubs lack some of its code
_CASTERS: dict[int, Any] = {}


def caster(mesh: TriangleMesh) -> Any:
    if id(mesh) not in _CASTERS:
        _CASTERS.clear()
        scene: Any = open3d.t.geometry.RaycastingScene()
        scene.add_triangles(mesh.vertices.astype(np.float32), mesh.faces.astype(np.uint32))
        _CASTERS[id(mesh)] = scene
    return _CASTERS[id(mesh)]


def true_normals(points: np.ndarray) -> np.ndarray:
    from tests.vfr_bake.data.solids import signed_distance

    steps = 1e-4 * np.eye(3)
    slopes = np.stack([signed_distance(points + e) - signed_distance(points - e) for e in steps], axis=-1)
    return slopes / np.maximum(np.linalg.norm(slopes, axis=-1, keepdims=True), 1e-12)


def true_surface(camera: Camera) -> np.ndarray:
    """Return the points [n, 3] where a camera's rays end, in the world's frame."""
    from vfr_bake.data.demo import trace

    _, distance = trace(camera)
    rays_o, rays_d = camera.rays()
    seen = np.isfinite(distance.reshape(-1))
    return rays_o[seen] + rays_d[seen] * distance.reshape(-1)[seen][:, None].astype(np.float64)


def bench_levels(asset: Asset, points: np.ndarray) -> None:
    """Print how far in front of the true surface the density reaches each level, coming from outside."""
    grid, voxel = asset.grid, voxel_size(asset.grid) * asset.scale
    normals, inverse = true_normals(points), np.linalg.inv(asset.world_from_model)
    along = np.arange(8, -8.01, -0.1)
    sigmas = np.zeros((len(points), len(along)))
    for column, ahead in enumerate(along):
        there = (points + normals * ahead * voxel) @ inverse[:3, :3].T + inverse[:3, 3]
        codes, _, known = code_and_slope(grid, (there - grid.aabb_min) * grid.cells_per_unit)
        sigmas[:, column] = np.where(known, np.exp(grid.density_low + grid.density_slope * codes), 0)
    for level in LEVELS:
        found = (sigmas > level).any(axis=1)
        apart = along[(sigmas > level).argmax(axis=1)][found]
        print(
            f"level {level:5g}: found at {found.mean():.1%}, mean distance {np.abs(apart).mean():.2f} voxel, "
            f"median before the surface {np.median(apart):+.2f}"
        )


def bench_demo(asset: Asset, methods: list[str]) -> None:
    from tests.vfr_bake.data.solids import signed_distance

    voxel = voxel_size(asset.grid) * asset.scale
    cameras = cameras_of(asset, None)[::8]
    truths = [true_surface(camera) for camera in cameras]
    bench_levels(asset, np.concatenate([truth[::20] for truth in truths]))
    for name, mesh, seconds in meshes(asset, methods):
        sample = mesh.vertices[:: max(1, len(mesh.vertices) // 100_000)].astype(np.float64)
        to_truth = np.abs(signed_distance(sample)) / voxel
        back, angles = [], []
        for camera, truth in zip(cameras, truths, strict=True):
            points = TENSOR(truth.astype(np.float32))
            back.append(caster(mesh).compute_distance(points).numpy() / voxel)
            _, places, normals, _ = cast(mesh, camera)
            near = np.abs(signed_distance(places)) < 2 * voxel
            cosines = (true_normals(places) * normals).sum(-1)[near]
            angles.append(np.degrees(np.arccos(np.clip(cosines, -1, 1))))
        from_truth, angle = np.concatenate(back), np.concatenate(angles)
        print(
            f"{name:8} {len(mesh.faces):9,} faces, {seconds:.1f} CPU s: to truth {to_truth.mean():.2f} voxel "
            f"(95 %: {np.percentile(to_truth, 95):.2f}), truth to mesh {from_truth.mean():.2f} "
            f"(95 %: {np.percentile(from_truth, 95):.2f}), normals {angle.mean():.1f} degrees "
            f"(median {np.median(angle):.1f})",
            flush=True,
        )


def bench_views(asset: Asset, methods: list[str], cameras: list[Camera], photographs: Path | None) -> None:
    with Renderer(asset) as renderer:
        frames = [renderer.render(camera) for camera in cameras]
    photos = [photograph(photographs, camera) if photographs else None for camera in cameras]
    for name, mesh, seconds in meshes(asset, methods):
        both = either = 0
        scores: dict[str, list[float]] = {"mesh": [], "volume": [], "mesh against volume": []}
        for camera, frame, photo in zip(cameras, frames, photos, strict=True):
            hit, picture = pictured(mesh, camera, np.array(asset.manifest.background))
            solid = frame.opacity.reshape(-1) > 0.5
            both, either = both + (hit & solid).sum(), either + (hit | solid).sum()
            played = frame.rgb.reshape(-1, 3)
            scores["mesh against volume"].append(psnr(picture, played))
            if photo is not None:
                scores["mesh"].append(psnr(picture, photo))
                scores["volume"].append(psnr(played, photo))
        figures = ", ".join(f"{key} {np.mean(value):.2f} dB" for key, value in scores.items() if value)
        print(
            f"{name:8} {len(mesh.faces):9,} faces, {seconds:5.1f} CPU s: IoU {both / either:.4f}, {figures}",
            flush=True,
        )


def pictured(mesh: TriangleMesh, camera: Camera, background: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return which pixels the mesh covers by half or more, [n] bool, and the picture [n, 3] in 0..1."""
    hit, _, _, colours = cast(mesh, camera.resized(camera.width * SHARP, camera.height * SHARP))
    picture = np.tile(background, (len(hit), 1))
    picture[hit] = colours
    blocks = (camera.height, SHARP, camera.width, SHARP)
    covered = hit.reshape(blocks).mean(axis=(1, 3)).reshape(-1) >= 0.5
    return covered, picture.reshape(*blocks, 3).mean(axis=(1, 3)).reshape(-1, 3)


def bench_colours(asset: Asset, method: str, cameras: list[Camera]) -> None:
    """Print how near colours are to the volume's pictures, by the number of directions averaged."""
    surface = AssetSurface(asset, silent)
    mesh, _ = made_again(surface, method)
    places, normals, truth = [], [], []
    with Renderer(asset) as renderer:
        for camera in cameras:
            hit, at, normal, _ = cast(mesh, camera)
            frame = renderer.render(camera)
            solid = frame.opacity.reshape(-1)[hit] > 0.99
            near = np.abs(np.linalg.norm(at - camera.c2w[:3, 3], axis=-1) - frame.depth.reshape(-1)[hit])
            kept = np.flatnonzero(solid & (near < 4 * voxel_size(asset.grid) * asset.scale))[::5]
            places.append(at[kept])
            normals.append(normal[kept])
            truth.append(frame.rgb.reshape(-1, 3)[hit][kept])
    at, normal, expected = map(np.concatenate, (places, normals, truth))
    for count in (0, 1, 2, 4, 8, 16):
        surface_colour.MAX_DIRECTIONS = count
        rgb, _ = surface_colour.surface_colours(asset, at, normal, surface.views if count else [])
        name = f"mean of {count} directions" if count else "along the normal"
        print(f"{name}: {psnr(rgb, expected):.2f} dB at {len(at):,} places", flush=True)


def photograph(folder: Path, camera: Camera) -> np.ndarray:
    path = folder / f"{camera.name.removeprefix('./')}"
    rgba = np.asarray(Image.open(path if path.suffix else path.with_suffix(".png")).convert("RGBA")) / 255
    return (rgba[..., :3] * rgba[..., 3:] + 1 - rgba[..., 3:]).reshape(-1, 3)


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    return float(-10 * np.log10(np.mean((a - b) ** 2)))


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("what", choices=("demo", "views", "colours"))
    parser.add_argument("asset", type=Path)
    parser.add_argument(
        "cameras", type=Path, nargs="?", help="views, colours: transforms.json of test cameras"
    )
    parser.add_argument(
        "--pictures", type=Path, help="views: the folder that the photographs' names start from"
    )
    parser.add_argument("--views", type=int, default=10, help="test cameras, spread over all")
    parser.add_argument("--methods", default="baked,density,tsdf")
    arguments = parser.parse_args()
    asset = Asset.open(arguments.asset)
    methods = arguments.methods.split(",")
    if arguments.what == "demo":
        bench_demo(asset, methods)
        return 0
    every = cameras_of(asset, arguments.cameras)
    chosen = [every[i] for i in np.linspace(0, len(every) - 1, arguments.views).round().astype(int)]
    if arguments.what == "colours":
        bench_colours(asset, methods[0], chosen)
    else:
        bench_views(asset, methods, chosen, arguments.pictures)
    return 0


if __name__ == "__main__":
    sys.exit(main())
