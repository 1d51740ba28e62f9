"""What a frame holds: colour, opacity, depth and normals of one view, side by side in one picture.

python examples/layers.py out/ layers.png
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from player import Asset, Frame
from player.cameras.camera import orbit
from player.cameras.views import asset_cameras
from player.files.images import write_png
from player.render import render


def side_by_side(frame: Frame) -> np.ndarray:
    """[h, 4 w, 3] uint8: colour, opacity, depth (near is bright), normals (x, y, z as red, green, blue)."""
    met = frame.opacity > 0.5
    near, far = np.percentile(frame.depth[met], [1, 99]) if met.any() else (0.0, 1.0)
    depth = np.clip((far - frame.depth) / max(far - near, 1e-9), 0, 1)
    layers = [
        frame.rgb,
        np.repeat(frame.opacity[..., None], 3, axis=-1),
        np.repeat(np.where(met, depth, 0)[..., None], 3, axis=-1),
        np.where(met[..., None], frame.normals / 2 + 0.5, 0),
    ]
    return (np.clip(np.concatenate(layers, axis=1), 0, 1) * 255 + 0.5).astype(np.uint8)


def main(folder: str, target: str) -> None:
    asset = Asset.open(folder)
    trained = asset_cameras(asset)
    camera = orbit(trained, n_frames=8, size=(400, 400))[3]  # a view that nobody has photographed
    frame = render(asset, camera)
    write_png(Path(target), side_by_side(frame))
    print(f"{target}: {np.mean(frame.opacity > 0.5):.0%} of the pixels show the scene, "
          f"{frame.depth[frame.opacity > 0.5].min():.3g} or more units away")  # fmt: skip


if __name__ == "__main__":
    main(*sys.argv[1:])
