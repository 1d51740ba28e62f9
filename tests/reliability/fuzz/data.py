"""Broken files of cameras, pictures and models."""

from __future__ import annotations

import io
import json
import struct
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from exporters.shapes.crop import parse_crop
from player.cameras.colmap import read_points
from player.cameras.transforms import read_cameras
from player.cameras.views import read_views
from player.errors import FormatError
from player.files.images import png_bytes, read_key, webp_bytes
from tests.player.conftest import cameras_bytes, look_at
from tests.reliability.fuzz.broken import broken_bytes, broken_json, broken_value
from tests.reliability.fuzz.targets import Break, Target, written


def _json(path: Path, data: bytes) -> Break:
    return lambda random: path.write_bytes(broken_json(data, random))


def camera_targets(work: Path) -> list[Target]:
    """Return targets that break a transforms.json, a camera_path.json, and a box to crop to."""
    views, path, box = work / "transforms.json", work / "camera_path.json", work / "box.json"
    frames = [
        {"camera_to_world": look_at((7, 2 + i, 5), (1, 2, 3)).reshape(-1).tolist(), "fov": 50}
        for i in range(3)
    ]
    camera_path = {"render_width": 40, "render_height": 30, "fps": 24, "seconds": 2, "camera_path": frames}
    turn = json.dumps(camera_path).encode()
    crop = {"centre": [0, 0, 0], "size": [1, 2, 3], "yaw": 30}
    return [
        Target("transforms", _json(views, cameras_bytes()), lambda: read_cameras(views, (48, 40))),
        Target("camera path", _json(path, turn), lambda: read_views(path, (48, 40))),
        Target("box", _json(box, json.dumps(crop).encode()), lambda: parse_crop(str(box))),
    ]


def _count(data: bytes, at: int, random: np.random.Generator) -> bytes:
    """Replace a count by another number, which may or may not fit the length of the data."""
    (n,) = struct.unpack_from("<Q", data, at)
    n = int(
        random.choice([0, 1, 2, max(n - 1, 0), n + 1, 2**32, 2**60, 2**64 - 1], p=[0.1, 0.1] + [0.8 / 6] * 6)
    )
    return data[:at] + struct.pack("<Q", n % 2**64) + data[at + 8 :]


def colmap_targets(work: Path) -> list[Target]:
    """Return targets that break COLMAP models, binary and text."""
    binary, text = work / "binary", work / "text"
    binary.mkdir()
    text.mkdir()
    lens = struct.pack("<IiQQ4d", 1, 1, 40, 30, 50, 50, 20, 15)
    pose = struct.pack("<I7dI", 1, 1, 0, 0, 0, 0.1, 0.2, 3, 1)
    seen = struct.pack("<Qddq", 1, 3, 4, -1)
    point = struct.pack("<Q3d3BdQ2I", 7, 0, 1, 2, 9, 9, 9, 0.5, 1, 1, 0)
    files = {
        binary / "cameras.bin": struct.pack("<Q", 1) + lens,
        binary / "images.bin": struct.pack("<Q", 1) + pose + b"a.png\0" + seen,
        text / "cameras.txt": b"# a comment\n1 PINHOLE 40 30 50 50 20 15\n",
        text / "images.txt": b"1 1 0 0 0 0.1 0.2 3 1 a.png\n3 4 -1\n2 0.7 0 0.7 0 1 2 3 1 b.png\n\n",
    }
    points = work / "points3D.bin"

    def prepare(folder: Path, random: np.random.Generator) -> None:
        mine = [path for path in files if path.parent == folder]
        chosen = mine[random.integers(0, len(mine))]
        for path in mine:
            path.write_bytes(files[path])
        data = files[chosen]
        if folder is binary and random.random() < 0.4:  # repeated, with counts that agree
            n = int(random.integers(0, 4))
            data = struct.pack("<Q", n) + data[8:] * n
            chosen.write_bytes(_count(data, 0, random) if random.random() < 0.5 else data)
        else:
            chosen.write_bytes(broken_bytes(data, random))

    def prepare_points(random: np.random.Generator) -> None:
        data = struct.pack("<Q", 3) + point * 3
        points.write_bytes(_count(data, 0, random) if random.random() < 0.3 else broken_bytes(data, random))

    return [
        Target("COLMAP binary", partial(prepare, binary), lambda: read_views(binary)),
        Target("COLMAP text", partial(prepare, text), lambda: read_views(text)),
        Target("COLMAP points", prepare_points, lambda: read_points(points)),
    ]


def picture_target(work: Path) -> Target:
    """Return a target that breaks existing frames, which `--resume` looks at."""
    path = work / "frame.png"
    pixels = np.random.default_rng(0).integers(0, 255, (9, 7, 3)).astype(np.uint8)
    wholes = (png_bytes(pixels, "abc"), webp_bytes(pixels, "abc"))

    def prepare(random: np.random.Generator) -> None:
        path.write_bytes(broken_bytes(wholes[random.integers(0, 2)], random))

    def read() -> None:
        if read_key(path, (7, 9)) is None:
            raise FormatError("frame.png: expected a key, got none")

    return Target("picture", prepare, read)


def model_target(work: Path) -> Target:
    """Return a target that breaks a trained model."""
    import torch

    from vfr_bake.config import FieldConfig
    from vfr_bake.data.view_pixels import ViewPixels
    from vfr_bake.data.witnesses import Witnesses
    from vfr_bake.field.field import VfrField
    from vfr_bake.rendering.occupancy import OccupancyGrid
    from vfr_bake.training.model_file import Model, load_model, save_model

    path = work / "model.pt"
    cameras = read_cameras(written(work / "model_cameras.json", cameras_bytes()))
    field = VfrField(FieldConfig(n_levels=2, max_resolution=16, log2_table_size=10, head_width=8))
    counts = np.zeros(len(cameras), np.int32)
    counts[0] = 3
    rgba, whole = np.zeros((3, 4), np.uint8), np.array([len(cameras) - 1], np.int32)
    witnesses = Witnesses(counts, np.arange(3, dtype=np.int32), rgba, whole)
    learned = ViewPixels(counts, np.arange(3, 6, dtype=np.int32), rgba)
    grid = OccupancyGrid(8, 0.2, seed=0)
    model = Model(field, grid, np.eye(4), cameras, False, {}, {}, witnesses, training_pixels=learned)
    save_model(path, model)
    load_model(path)  # compiles, or reads what was compiled before
    whole = path.read_bytes()
    content = torch.load(path, weights_only=True)
    tensors = (torch.zeros(0), torch.full((3, 3), torch.nan), torch.zeros(1, dtype=torch.uint8),
               torch.zeros(2, 2, dtype=torch.complex64), torch.zeros(5).to_sparse(),
               torch.zeros(1).expand(10**9), torch.zeros(4, 4).T, torch.ones(()) > 0)  # fmt: skip

    def another(random: np.random.Generator) -> Any:
        return (
            tensors[random.integers(0, len(tensors))] if random.random() < 0.4 else broken_value([], random)
        )

    def broken_content(random: np.random.Generator) -> Any:
        key = list(content)[random.integers(0, len(content))]
        value = content[key]
        if isinstance(value, dict) and value and random.random() < 0.7:
            inner = list(value)[random.integers(0, len(value))]
            return content | {key: value | {inner: another(random)}}
        return content | {key: another(random)}

    def prepare(random: np.random.Generator) -> None:
        if random.random() < 0.5:
            path.write_bytes(broken_bytes(whole, random))
            return
        buffer = io.BytesIO()
        torch.save(broken_content(random), buffer)
        path.write_bytes(buffer.getvalue())

    return Target("model", prepare, lambda: load_model(path))
