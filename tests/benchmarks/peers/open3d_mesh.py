"""Frame times of Open3D, which draws an asset's exported mesh, and of `vfr-play`, taken in turns.

    vfr-export out/ mesh.ply
    python -m tests.benchmarks.peers.open3d_mesh out/ mesh.ply --data lego_400 --json found.json

Open3D draws the coloured mesh without lights and off screen, through Vulkan: on the processor alone, by
SwiftShader, which comes with Chromium. Open3D has no window then, and copies each picture to memory, as a
player does. The views are those of `bench_qualities.py`; times are medians, with the uncertainty of
`vfr_bake.bench.timing`. PSNR is that of test views of DATA, over the asset's background. Linux alone.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from exporters.shapes.colour import linear_from_srgb
from player.app.option_types import positive, size
from player.asset.asset import Asset
from player.cameras.camera import Camera
from player.cameras.rotations import OPENGL_FROM_OPENCV
from player.threads import default_threads
from tests.benchmarks.against import QUALITIES, Player, views
from tests.benchmarks.bench_specks import test_views
from vfr_bake.bench.timing import notch
from vfr_bake.training.scores.metrics import psnr

HERE = Path(__file__).parents[3]


def draw_on_the_processor() -> None:
    """Let Vulkan find SwiftShader alone. Raises FileNotFoundError if there is no Chromium that has it."""
    driver = Path("/usr/lib/chromium/vk_swiftshader_icd.json")
    if not driver.is_file():
        raise FileNotFoundError(f"{driver}: expected SwiftShader of Debian's Chromium, found none")
    os.environ["VK_DRIVER_FILES"] = os.environ["VK_ICD_FILENAMES"] = str(driver)


class MeshDrawer:
    """A mesh in Open3D that is drawn with the colours of its vertices.

    Args:
        background: [3] colour behind the mesh, in [0, 1].
    """

    def __init__(self, mesh: Path, background: np.ndarray) -> None:
        import open3d  # only now: it looks for Vulkan's drivers

        self._rendering = open3d.visualization.rendering
        self._geometry = open3d.io.read_triangle_mesh(str(mesh))
        # Open3D darkens a background as if it were to become linear light.
        levels = np.linspace(0, 1, 4096)
        self._background = [*np.interp(background, linear_from_srgb(levels), levels).tolist(), 1.0]
        self._size, self._renderer = (0, 0), None
        self.n_faces = len(self._geometry.triangles)

    def _resize(self, width: int, height: int) -> Any:
        """Return the renderer of pictures of this size. Open3D ends the process if there are two."""
        if self._size != (width, height):
            self.close()
            renderer = self._rendering.OffscreenRenderer(width, height)
            material = self._rendering.MaterialRecord()
            material.shader = "defaultUnlit"
            renderer.scene.set_background(self._background)
            renderer.scene.view.set_post_processing(False)
            renderer.scene.view.set_shadowing(False, self._rendering.View.ShadowType.PCF)
            renderer.scene.scene.enable_sun_light(False)
            renderer.scene.scene.enable_indirect_light(False)
            renderer.scene.add_geometry("mesh", self._geometry, material)
            self._size, self._renderer = (width, height), renderer
        return self._renderer

    def close(self) -> None:
        if self._renderer is not None:
            self._renderer.scene.clear_geometry()
            self._renderer = None

    def frame(self, camera: Camera) -> tuple[list[float], np.ndarray]:
        """Return (seconds, seconds of processor time), and the picture [h, w, 3] in [0, 1]."""
        renderer = self._resize(camera.width, camera.height)
        wall, used = time.perf_counter(), time.process_time()
        lens = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
        extrinsic = np.linalg.inv(camera.c2w @ OPENGL_FROM_OPENCV)
        renderer.setup_camera(lens, extrinsic, camera.width, camera.height)
        picture = np.asarray(renderer.render_to_image())
        return [time.perf_counter() - wall, time.process_time() - used], picture / 255


def measure(
    folder: Path, mesh: Path, data: Path, frame_size: tuple[int, int], n_frames: int, n_views: int
) -> dict[str, Any]:
    """Return a row for Open3D, and one for each quality of `vfr-play`."""
    asset = Asset.open(folder)
    drawer = MeshDrawer(mesh, np.array(asset.manifest.background))
    cameras, photographs = test_views(asset, data)
    chosen = np.linspace(0, len(cameras) - 1, min(n_views, len(cameras))).round().astype(int)
    with ExitStack() as stack:
        scratch = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="vfr-bench-")))
        stack.callback(drawer.close)
        drawers: dict[str, MeshDrawer | Player] = {"Open3D, mesh": drawer}
        for quality in QUALITIES:
            picture = scratch / f"{quality}.npy"
            player = Player(HERE, folder, default_threads(), "numba", quality, picture)
            stack.callback(player.close)
            drawers[f"vfr-play, {quality}"] = player
        path = views(asset, frame_size, n_frames)
        for some in drawers.values():
            some.frame(path[0])
        taken = np.array([[some.frame(camera)[0][:2] for some in drawers.values()] for camera in path])
        scores = {
            name: [psnr(some.frame(cameras[i])[1], photographs[i]) for i in chosen]
            for name, some in drawers.items()
        }
    shared = taken[..., 0].mean(axis=1)
    n_bytes = sum(entry.bytes for entry in asset.manifest.files.values())
    rows = [
        {
            "what": name,
            "ms": 1000 * float(np.median(times[:, 0])),
            "uncertainty": notch(1000 * times[:, 0], list(1000 * shared)),
            "processor_ms": 1000 * float(np.median(times[:, 1])),
            "psnr": float(np.mean(scores[name])),
            "n_bytes": mesh.stat().st_size if some is drawer else n_bytes,
        }
        for (name, some), times in zip(drawers.items(), taken.swapaxes(0, 1), strict=True)
    ]
    return {"size": list(frame_size), "n_views": len(chosen), "n_faces": drawer.n_faces, "rows": rows}


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("asset", type=Path)
    parser.add_argument("mesh", type=Path, help="the asset's mesh, as vfr-export writes it")
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--views", type=positive, default=8, help="test views for the PSNR")
    parser.add_argument("--size", type=size, default=(800, 800))
    parser.add_argument("--frames", type=positive, default=20)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    draw_on_the_processor()
    found = measure(options.asset, options.mesh, options.data, options.size, options.frames, options.views)
    for row in found["rows"]:
        print(
            f"{row['what']:16} {row['ms']:7.1f} ± {row['uncertainty']:.1f} ms a frame, "
            f"{row['processor_ms']:.1f} ms of processor time, {row['psnr']:.2f} dB, {row['n_bytes']:,} bytes"
        )
    if options.json is not None:
        options.json.write_text(json.dumps(found), encoding="utf-8")


if __name__ == "__main__":
    main()
