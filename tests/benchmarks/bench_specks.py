"""Count specks in an asset's pictures that the model's or the photographs do not have, and find their cause.

    python tests/benchmarks/bench_specks.py ASSET --model model.pt [--data DIR] [--views 10] [--pictures DIR]
    python tests/benchmarks/bench_specks.py ASSET --data DIR          # against the photographs

Specks are single pixels that stand out in one picture where another picture of the same view is calm
(`speck_mask`). They are counted in a million pixels, on test views of DIR or from training cameras of the
asset. With a model, they are also counted with all fetches (k = 0), with the head's activations in float32,
and with the model's own opacity or its own colours in place of the asset's; specks that remain are then
caused by the other of the two. `--pictures` writes the worst places eight times as large: played, model,
specks.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
from PIL import Image
from scipy.ndimage import label

from player.asset.asset import Asset
from player.cameras.camera import Camera
from player.cameras.views import asset_cameras
from player.errors import ShapeError
from player.render import Renderer
from vfr_bake.data import load_scene, reader_as
from vfr_bake.rendering.render import head_colours
from vfr_bake.training.model_file import Model, load_model
from vfr_bake.training.scores.metrics import over_background, to_8_bit

THRESHOLDS = (0.05, 0.1, 0.2)
"""Least differences of a speck from the pixels around it, in one of three channels of 0 to 1."""
CALM = 0.5
"""Largest difference of the other picture there, as a share of the threshold."""
AROUND, TIMES = 12, 8
"""Number of pixels written around a worst place on each side, and the factor of their enlargement."""


def speck_mask(picture: np.ndarray, reference: np.ndarray, threshold: float) -> np.ndarray:
    """Return the specks, [h, w] bool: pixels that differ from the median of the 3 x 3 pixels around them,
    themselves included, by more than `threshold` in a channel in which `reference` differs from its own
    median by at most CALM times `threshold`.

    A detail that is one pixel wide in both pictures, such as a wire or a highlight, does not count. Neither
    does an edge, which the median follows. At the border the nearest pixels are repeated.

    Args:
        picture: [h, w, 3] float, 0..1.
        reference: [h, w, 3] float, 0..1: the model's picture, or the photograph.
        threshold: 0..1.

    Raises ShapeError: the pictures have different sizes.
    """
    if picture.shape != reference.shape or picture.ndim != 3:
        raise ShapeError(f"specks: expected two pictures [h, w, 3], got {picture.shape} {reference.shape}")
    stands_out = _from_around(picture) > threshold
    calm = _from_around(reference) <= CALM * threshold
    return np.asarray((stands_out & calm).any(axis=-1))


def _from_around(picture: np.ndarray) -> np.ndarray:
    """Return how far each pixel is from the median of the nine around it, [h, w, 3]."""
    height, width = picture.shape[:2]
    padded = np.pad(picture, ((1, 1), (1, 1), (0, 0)), mode="edge")
    nine = [padded[y : y + height, x : x + width] for y in range(3) for x in range(3)]
    return np.abs(picture - np.median(nine, axis=0))


def test_views(asset: Asset, data: Path) -> tuple[list[Camera], list[np.ndarray]]:
    """Return the test cameras of a data set, in the world's frame, and their photographs in 8 bits over the
    asset's background."""
    reader = reader_as(asset.manifest.provenance.get("train", {}))
    scene = load_scene(str(data), reader=reader)
    cameras = [camera.transformed(scene.world_from_model) for camera in scene.test.cameras]
    background = np.array(asset.manifest.background, np.float32)
    return cameras, [to_8_bit(over_background(image, background)) / 255 for image in scene.test.images]


def models_own(model: Model, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Return colours [h, w, 3] before they are mixed with the background, and opacity [h, w, 1], of a camera
    in the world's frame."""
    rays_o, rays_d = camera.transformed(np.linalg.inv(model.world_from_model)).rays()
    features, opacity = model.sampler.composited_features(model.field, rays_o, rays_d)
    hit = np.flatnonzero(opacity > 0)
    rgb = np.zeros((len(rays_o), 3), np.float32)
    rgb[hit] = head_colours(model.field.head, features[hit], rays_d[hit])
    return rgb.reshape(camera.height, camera.width, 3), opacity.reshape(camera.height, camera.width, 1)


def float_head(asset: Asset) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """Return the asset's head without the rounding of its activations; its weights stay as stored."""
    graph = onnx.load(str(asset.path("head.onnx")))
    rounded = {node.output[0]: node.input[0] for node in graph.graph.node if node.op_type == "QuantizeLinear"}
    instead = {
        node.output[0]: rounded[node.input[0]]
        for node in graph.graph.node
        if node.op_type == "DequantizeLinear" and node.input[0] in rounded
    }
    for node in graph.graph.node:
        for place, name in enumerate(node.input):
            node.input[place] = instead.get(name, name)
    session: Any = onnxruntime.InferenceSession(graph.SerializeToString(), providers=["CPUExecutionProvider"])
    return lambda features, dirs: session.run(["rgb"], {"features": features, "dirs": dirs})[0]


def variants(
    renderer: Renderer, camera: Camera, model: Model | None, own: tuple[np.ndarray, np.ndarray] | None
) -> dict[str, np.ndarray]:
    """Return the asset's picture, and with a model also those with one thing switched off."""
    pictures = {"as played": renderer.render(camera).rgb}
    if model is None or own is None:
        return pictures
    rgb, opacity = own
    background = np.array(renderer.asset.manifest.background, np.float32)
    every = renderer.render(camera, 0)
    pictures["k = 0"] = every.rgb
    head = renderer._head
    renderer._head = float_head(renderer.asset)  # type: ignore[assignment]
    pictures["k = 0, activations in float32"] = renderer.render(camera, 0).rgb
    renderer._head = head
    straight = renderer.render(camera, background="transparent")
    pictures["the model's opacity"] = straight.rgb * opacity + (1 - opacity) * background
    alpha = straight.opacity[..., None]
    pictures["the model's colours"] = rgb * alpha + (1 - alpha) * background
    return pictures


def write_worst(folder: Path, name: str, played: np.ndarray, wanted: np.ndarray, mask: np.ndarray) -> None:
    """Write the place of a view with the most specks, enlarged: played, wanted, specks."""
    count = np.pad(mask, AROUND).cumsum(0).cumsum(1)
    size = 2 * AROUND
    totals = count[size:, size:] - count[:-size, size:] - count[size:, :-size] + count[:-size, :-size]
    y, x = np.unravel_index(totals.argmax(), totals.shape)
    rows, columns = (slice(max(at - AROUND, 0), at + AROUND) for at in (int(y), int(x)))
    shown = [played[rows, columns], wanted[rows, columns], np.repeat(mask[rows, columns, None], 3, -1)]
    wide = np.concatenate([np.repeat(np.repeat(part, TIMES, 0), TIMES, 1) for part in shown], axis=1)
    Image.fromarray(np.rint(np.clip(wide, 0, 1) * 255).astype(np.uint8)).save(folder / f"{name}.png")


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("asset", type=Path)
    parser.add_argument("--model", type=Path)
    parser.add_argument("--data", type=Path, help="folder of the data set; its test views are looked at")
    parser.add_argument("--views", type=int, default=10, help="views, spread over all")
    parser.add_argument("--pictures", type=Path, help="folder for the worst places")
    parser.add_argument("--json", type=Path, help="file for the figures")
    arguments = parser.parse_args()
    if arguments.model is None and arguments.data is None:
        parser.error("expected --model, --data or both")
    asset = Asset.open(arguments.asset)
    model = None if arguments.model is None else load_model(arguments.model)
    cameras, photographs = (asset_cameras(asset), [])
    if arguments.data is not None:
        cameras, photographs = test_views(asset, arguments.data)
    chosen = np.linspace(0, len(cameras) - 1, min(arguments.views, len(cameras))).round().astype(int)
    counts: dict[str, np.ndarray] = {}
    n_pixels, n_parts, lighter, less_opaque = 0, 0, 0, 0
    with Renderer(asset) as renderer:
        for index in chosen:
            camera = cameras[index]
            own = None if model is None else models_own(model, camera)
            background = np.array(asset.manifest.background, np.float32)
            wanted = photographs[index] if own is None else own[0] * own[1] + (1 - own[1]) * background
            n_pixels += camera.width * camera.height
            found = variants(renderer, camera, model, own)
            for name, picture in found.items():
                new = np.array([speck_mask(picture, wanted, threshold).sum() for threshold in THRESHOLDS])
                counts[name] = counts.get(name, np.zeros(len(THRESHOLDS), int)) + new
            played = found["as played"]
            mask = speck_mask(played, wanted, THRESHOLDS[1])
            n_parts += int(label(mask, np.ones((3, 3)))[1])
            lighter += int((played[mask].mean(axis=-1) > wanted[mask].mean(axis=-1)).sum())
            if own is not None:
                less_opaque += int((renderer.render(camera).opacity[mask] < own[1][mask, 0] - 0.05).sum())
            if arguments.pictures is not None:
                arguments.pictures.mkdir(parents=True, exist_ok=True)
                write_worst(arguments.pictures, f"view_{index}", played, wanted, mask)
    against = "the model's pictures" if model is not None else "the photographs"
    print(f"{asset.folder}: {len(chosen)} views, {n_pixels:,} pixels, against {against}; specks in a million")
    print(f"{'':32}" + "".join(f"{f't = {threshold:g}':>10}" for threshold in THRESHOLDS))
    for name, count in counts.items():
        print(f"{name:32}" + "".join(f"{value * 1e6 / n_pixels:10.0f}" for value in count))
    if arguments.json is not None:
        rates = {name: (count * 1e6 / n_pixels).tolist() for name, count in counts.items()}
        found = {"thresholds": THRESHOLDS, "in_a_million": rates, "n_views": len(chosen), "against": against}
        arguments.json.write_text(json.dumps(found), encoding="utf-8")
    total = max(int(counts["as played"][THRESHOLDS.index(0.1)]), 1)
    print(f"at t = 0.1: {n_parts} parts of {total} pixels, {lighter / total:.0%} lighter than they should be")
    if model is not None:
        print(f"{less_opaque / total:.0%} less opaque than the model by more than 0.05")
    return 0


if __name__ == "__main__":
    sys.exit(main())
