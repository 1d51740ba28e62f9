"""Count specks in an asset's pictures that the model's do not have, and find their cause.

    python tests/benchmarks/bench_specks.py ASSET --model model.pt --data DATA

Specks are single pixels that stand out in one picture where another picture of the same view is calm
(`speck_mask`). They are counted in a million pixels, on test views of DATA: as played, with all fetches
(k = 0), with the head's activations in float32, and with the model's own opacity or its own colours in place
of the asset's; specks that remain are then caused by the other of the two.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime

from player.asset.asset import Asset
from player.cameras.camera import Camera
from player.errors import ShapeError
from player.render import Renderer
from vfr_bake.data import load_scene, reader_as
from vfr_bake.data.scene import evenly
from vfr_bake.rendering.render import head_colours
from vfr_bake.training.model_file import Model, load_model
from vfr_bake.training.scores.metrics import over_background, to_8_bit

THRESHOLDS = (0.05, 0.1, 0.2)
"""Least differences of a speck from the pixels around it, in one of three channels of 0 to 1."""
CALM = 0.5
"""Largest difference of the other picture there, as a share of the threshold."""


def speck_mask(picture: np.ndarray, reference: np.ndarray, threshold: float) -> np.ndarray:
    """Return the specks, [h, w] bool: pixels that differ from the median of the 3 x 3 pixels around them,
    themselves included, by more than `threshold` in a channel in which `reference` differs from its own
    median by at most CALM times `threshold`.

    A detail that is one pixel wide in both pictures, such as a wire or a highlight, does not count. Neither
    does an edge, which the median follows. At the border the nearest pixels are repeated.

    Args:
        picture: [h, w, 3] float, 0..1.
        reference: [h, w, 3] float, 0..1: the model's picture.
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
    renderer: Renderer, camera: Camera, rgb: np.ndarray, opacity: np.ndarray
) -> dict[str, np.ndarray]:
    """Return the asset's picture, and those with one thing switched off. `rgb`, `opacity`: the model's."""
    background = np.array(renderer.asset.manifest.background, np.float32)
    pictures = {"as played": renderer.render(camera).rgb, "k = 0": renderer.render(camera, 0).rgb}
    head = renderer._head
    renderer._head = float_head(renderer.asset)  # type: ignore[assignment]
    pictures["k = 0, activations in float32"] = renderer.render(camera, 0).rgb
    renderer._head = head
    straight = renderer.render(camera, background="transparent")
    pictures["the model's opacity"] = straight.rgb * opacity + (1 - opacity) * background
    alpha = straight.opacity[..., None]
    pictures["the model's colours"] = rgb * alpha + (1 - alpha) * background
    return pictures


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("asset", type=Path)
    parser.add_argument("--model", type=Path, required=True)
    parser.add_argument("--data", type=Path, required=True, help="its test views are looked at")
    parser.add_argument("--views", type=int, default=10, help="views, spread over all")
    parser.add_argument("--json", type=Path, help="file for the figures")
    arguments = parser.parse_args()
    asset, model = Asset.open(arguments.asset), load_model(arguments.model)
    cameras, _ = test_views(asset, arguments.data)
    chosen = evenly(len(cameras), arguments.views)
    background = np.array(asset.manifest.background, np.float32)
    counts: dict[str, np.ndarray] = {}
    n_pixels = 0
    with Renderer(asset) as renderer:
        for camera in (cameras[index] for index in chosen):
            rgb, opacity = models_own(model, camera)
            wanted = rgb * opacity + (1 - opacity) * background
            n_pixels += camera.width * camera.height
            for name, picture in variants(renderer, camera, rgb, opacity).items():
                new = np.array([speck_mask(picture, wanted, threshold).sum() for threshold in THRESHOLDS])
                counts[name] = counts.get(name, 0) + new
    print(f"{asset.folder}: {len(chosen)} views, {n_pixels:,} pixels; specks in a million")
    print(f"{'':32}" + "".join(f"{f't = {threshold:g}':>10}" for threshold in THRESHOLDS))
    rates = {name: (count * 1e6 / n_pixels).tolist() for name, count in counts.items()}
    for name, row in rates.items():
        print(f"{name:32}" + "".join(f"{value:10.0f}" for value in row))
    if arguments.json is not None:
        against = "the model's pictures"
        found = {"thresholds": THRESHOLDS, "in_a_million": rates, "n_views": len(chosen), "against": against}
        arguments.json.write_text(json.dumps(found), encoding="utf-8")


if __name__ == "__main__":
    main()
