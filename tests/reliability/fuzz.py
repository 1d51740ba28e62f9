"""Broken inputs to every reader: nothing but a VfrError, in bounded time and memory, inside the folder.

    python -m tests.reliability.fuzz --inputs 100000 --seed 0

Input i of a seed is always the same one. Each is given LIMIT_SECONDS, and all of them together ROOM bytes
more than the process had before; files opened outside the work folder, and programs started, are failures.
"""

from __future__ import annotations

import argparse
import hashlib
import io
import json
import os
import resource
import shutil
import signal
import struct
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

# Before player is imported: compiled code that writes beside its arrays is found out (`player.scratch`).
os.environ["VFR_CANARIES"] = "1"

from exporters.onnx_head import head_onnx
from player.asset import Asset
from player.errors import VfrError
from player.head import Head
from player.manifest import parse_manifest
from player.transforms import read_cameras
from player.views import read_views
from tests.exporters.test_onnx_head import random_head
from tests.player.conftest import cameras_bytes, head_bytes, look_at, write_shells
from tests.reliability.mutations import broken_bytes, broken_json, broken_value

LIMIT_SECONDS = 20.0
ROOM = 3 << 30
N_FIRST = 12
"""Inputs that each reader is given before anybody watches."""

Break = Callable[[np.random.Generator], object]
"""Writes one broken input."""


class SlowError(BaseException):
    """An input took longer than LIMIT_SECONDS; not an Exception, so that no reader swallows it."""


@dataclass(frozen=True)
class Target:
    """A reader, and what makes broken inputs for it."""

    name: str
    prepare: Break
    read: Callable[[], object]


class Watch:
    """What is opened and started while a reader works."""

    def __init__(self, inside: Path) -> None:
        self.wrong: list[str] = []
        self.on = False
        self._inside = str(inside)
        self._installed = tuple({sys.prefix, sys.base_prefix, str(Path(np.__file__).parent.parent)})
        sys.addaudithook(self._hear)

    def _hear(self, event: str, arguments: tuple) -> None:
        if not self.on:
            return
        if event == "open" and isinstance(arguments[0], str | bytes):
            name = arguments[0] if isinstance(arguments[0], str) else arguments[0].decode(errors="replace")
            source = Path(__file__).parent.parent.parent
            if not name.startswith((self._inside, *self._installed, str(source), "/proc", "/sys")):
                self.wrong.append(f"opened {name!r}")
        elif event in ("os.system", "subprocess.Popen", "os.exec", "os.posix_spawn", "pickle.find_class"):
            self.wrong.append(f"{event} {arguments[:1]!r}")


def targets(work: Path) -> list[Target]:
    """All of them, with their files in `work`."""
    found = [*_asset_targets(work), *_camera_targets(work), *_colmap_targets(work)]
    head = work / "head.onnx"

    def read_head(compiled: bool) -> None:
        Head(head, 4, compiled)(np.zeros((2, 4), np.float32), np.zeros((2, 3), np.float32))

    weights = random_head(n_channels=4, width=8, sh_degree=2, n_sh_features=2, n_more=1)
    for name, whole, compiled in (
        ("head", head_bytes(), False),
        ("compiled head", head_onnx(weights), True),
        ("compiled head in 8 bits", head_onnx(weights, [(-0.2, 1.0)] * 2), True),
    ):

        def spoil(random: np.random.Generator, whole: bytes = whole) -> None:
            head.write_bytes(broken_bytes(whole, random))

        head.write_bytes(whole)
        read_head(compiled)  # numba loads what it has compiled, once
        found.append(Target(name, spoil, partial(read_head, compiled)))
    return [*found, _model_target(work)]


def _asset_targets(work: Path) -> list[Target]:
    """The manifest alone; and each array with a manifest that vouches for it, so that the reader gets past
    the checksums."""
    whole = write_shells(work / "whole")
    broken = Path(shutil.copytree(whole, work / "asset"))
    manifest = json.loads((whole / "manifest.json").read_bytes())

    def write_manifest(random: np.random.Generator) -> None:
        (broken / "manifest.json").write_bytes(broken_json((whole / "manifest.json").read_bytes(), random))

    def write_array(name: str) -> Break:
        def write(random: np.random.Generator) -> None:
            for file in whole.iterdir():
                shutil.copy(file, broken)
            data = broken_bytes((whole / name).read_bytes(), random)
            (broken / name).write_bytes(data)
            entry = {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}
            document = manifest | {"files": manifest["files"] | {name: entry}}
            (broken / "manifest.json").write_text(json.dumps(document))

        return write

    def read_asset() -> None:
        Asset.open(broken, verify=True).grid  # noqa: B018

    def read_manifest() -> None:
        parse_manifest((broken / "manifest.json").read_bytes(), "manifest.json")

    arrays = (
        *("brick_coords.npy", "brick_masks.bits", "density.codes"),
        *("feature_coords.npy", "feature_masks.bits", "features.codes"),
    )
    return [
        Target("manifest", write_manifest, read_manifest),
        *(Target(name, write_array(name), read_asset) for name in arrays),
    ]


def _camera_targets(work: Path) -> list[Target]:
    views, path = work / "transforms.json", work / "camera_path.json"
    frames = [
        {"camera_to_world": look_at((7, 2 + i, 5), (1, 2, 3)).reshape(-1).tolist(), "fov": 50}
        for i in range(3)
    ]
    camera_path = json.dumps(
        {"render_width": 40, "render_height": 30, "fps": 24, "seconds": 2, "camera_path": frames}
    ).encode()

    def write(target: Path, data: bytes) -> Break:
        return lambda random: target.write_bytes(broken_json(data, random))

    return [
        Target("transforms", write(views, cameras_bytes()), lambda: read_cameras(views, (48, 40))),
        Target("camera path", write(path, camera_path), lambda: read_views(path, (48, 40))),
    ]


def _colmap_targets(work: Path) -> list[Target]:
    binary, text = work / "binary", work / "text"
    binary.mkdir()
    text.mkdir()
    pose = struct.pack("<I7dI", 1, 1, 0, 0, 0, 0.1, 0.2, 3, 1)
    files = {
        binary / "cameras.bin": struct.pack("<QIiQQ4d", 1, 1, 1, 40, 30, 50, 50, 20, 15),
        binary / "images.bin": struct.pack("<Q", 1) + pose + b"a.png\0" + struct.pack("<Qddq", 1, 3, 4, -1),
        text / "cameras.txt": b"# a comment\n1 PINHOLE 40 30 50 50 20 15\n",
        text / "images.txt": b"1 1 0 0 0 0.1 0.2 3 1 a.png\n3 4 -1\n2 0.7 0 0.7 0 1 2 3 1 b.png\n\n",
    }

    def write(folder: Path) -> Break:
        def broken(random: np.random.Generator) -> None:
            mine = [path for path in files if path.parent == folder]
            chosen = mine[random.integers(0, len(mine))]
            for path in mine:
                path.write_bytes(broken_bytes(files[path], random) if path == chosen else files[path])

        return broken

    return [
        Target("COLMAP binary", write(binary), lambda: read_views(binary)),
        Target("COLMAP text", write(text), lambda: read_views(text)),
    ]


def _model_target(work: Path) -> Target:
    import torch

    from vfr_bake.config import FieldConfig
    from vfr_bake.field.field import VfrField
    from vfr_bake.rendering.occupancy import OccupancyGrid
    from vfr_bake.training.model_file import Model, load_model, save_model

    path = work / "model.pt"
    cameras = read_cameras(_written(work / "cameras.json", cameras_bytes()))
    field = VfrField(FieldConfig(n_levels=2, max_resolution=16, log2_table_size=10, head_width=8))
    save_model(path, Model(field, OccupancyGrid(8, 0.2, seed=0), np.eye(4), cameras, False, {}, {}))
    load_model(path)  # compiles, or reads what was compiled before
    whole = path.read_bytes()
    content = torch.load(path, weights_only=True)
    tensors = (torch.zeros(0), torch.full((3, 3), torch.nan), torch.zeros(1, dtype=torch.uint8),
               torch.zeros(2, 2, dtype=torch.complex64), torch.zeros(5).to_sparse())  # fmt: skip

    def broken_content(random: np.random.Generator) -> Any:
        key = list(content)[random.integers(0, len(content))]
        value = content[key]
        if isinstance(value, dict) and value and random.random() < 0.7:
            inner = list(value)[random.integers(0, len(value))]
            new = tensors[random.integers(0, len(tensors))] if random.random() < 0.4 else None
            return content | {key: value | {inner: broken_value([], random) if new is None else new}}
        return content | {
            key: tensors[random.integers(0, 5)] if random.random() < 0.3 else broken_value([], random)
        }

    def write(random: np.random.Generator) -> None:
        if random.random() < 0.5:
            path.write_bytes(broken_bytes(whole, random))
            return
        buffer = io.BytesIO()
        torch.save(broken_content(random), buffer)
        path.write_bytes(buffer.getvalue())

    return Target("model", write, lambda: load_model(path))


def _written(path: Path, data: bytes) -> Path:
    path.write_bytes(data)
    return path


def fuzz(n_inputs: int, seed: int, names: list[str] | None = None) -> dict[str, Any]:
    """Give `n_inputs` to the readers in turn; what became of them."""
    begin = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="vfr-fuzz-") as folder:
        chosen = [target for target in targets(Path(folder)) if names is None or target.name in names]
        watch = Watch(Path(folder))
        counts = {target.name: {"inputs": 0, "refused": 0, "read": 0} for target in chosen}
        failures: list[dict[str, Any]] = []
        slowest = 0.0
        signal.signal(signal.SIGALRM, _too_slow)
        for target in chosen:  # what is imported or compiled when first used is so now
            for index in range(N_FIRST):
                target.prepare(np.random.default_rng([index]))
                _outcome(target)
        size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (size + ROOM, resource.RLIM_INFINITY))
        for index in range(n_inputs):
            target = chosen[index % len(chosen)]
            target.prepare(np.random.default_rng([seed, index]))
            start = time.process_time()
            watch.on = True
            outcome = _outcome(target)
            watch.on = False
            slowest = max(slowest, time.process_time() - start)
            counts[target.name]["inputs"] += 1
            if watch.wrong:
                outcome, watch.wrong = "; ".join(watch.wrong[:3]), []
            if outcome in ("refused", "read"):
                counts[target.name][outcome] += 1
            else:
                failures.append({"index": index, "target": target.name, "what": outcome})
    return {
        "seed": seed,
        "inputs": n_inputs,
        "targets": counts,
        "failures": failures,
        "slowest_s": round(slowest, 2),
        "seconds": round(time.monotonic() - begin, 1),
        "peak_mb": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1000),
    }


def _too_slow(*_: object) -> None:
    raise SlowError


def _outcome(target: Target) -> str:
    """ "refused" by a VfrError of one line, "read", or what went wrong."""
    signal.setitimer(signal.ITIMER_REAL, LIMIT_SECONDS)
    try:
        target.read()
    except VfrError as error:
        text = str(error)
        return "refused" if "\n" not in text and len(text) < 3000 else f"not one short line: {text[:200]!r}"
    except SlowError:
        return f"over {LIMIT_SECONDS:g} s"
    except BaseException as error:
        return f"{type(error).__name__}: {str(error)[:200]}"
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
    return "read"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--inputs", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--targets", nargs="*")
    options = parser.parse_args()
    result = fuzz(options.inputs, options.seed, options.targets)
    sys.stdout.write(json.dumps(result, indent=1) + "\n")
    return 1 if result["failures"] else 0


if __name__ == "__main__":
    sys.exit(main())
