"""Broken assets. Their arrays are unpacked, changed, packed again and given their checksums in the manifest,
so that the code behind zlib and the checksums is reached. There are also assets with things that are no
files.

What can be read is played: with both marches, the head and the pixels.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import os
import shutil
import socket
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from exporters.formats.ply import parse_ply
from player.app.info import facts, page
from player.asset.asset import Asset, read_manifest
from player.asset.bricks import bricks_per_axis, pack_vertices
from player.asset.manifest import parse_manifest
from player.asset.single_level import VertexBricks
from player.asset.version_3.unpacking import DENSITIES, FEATURES, read_arrays
from player.compiling import available
from player.errors import FormatError
from player.render import March, Renderer
from tests.reliability.fuzz.broken import broken_bytes, broken_json, broken_value
from tests.reliability.fuzz.targets import Target, small_view
from tests.version_3 import pack_codes, pack_masks, write_version_3

PLACES = {name.partition(".")[0]: name for name in (*DENSITIES, *FEATURES)}
"""The files of the arrays of an asset of version 3, by the names that its targets have."""
Arrays = dict[str, np.ndarray]
RESOLUTION = 19
"""Cells per axis of the asset that is broken: three bricks, of which the last is not full."""
MARCHES: tuple[March, ...] = ("numpy", "numba") if available() else ("numpy",)


def whole_asset(folder: Path, head: bytes, mesh: bytes, cameras: bytes) -> Path:
    """Write a ball and a wall, as small as they can be, in version 3.1."""
    from player.asset.manifest import Manifest

    axis = np.arange(RESOLUTION + 1)
    vertices = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    radius = np.linalg.norm(vertices / RESOLUTION * 2 - 1, axis=-1)
    dense, coarse = vertices[(radius < 0.6) | (vertices[:, 2] > 16)], vertices[radius < 0.9]
    coords, masks, _ = pack_vertices(dense)
    coarse_coords, coarse_masks, _ = pack_vertices(coarse)
    random = np.random.default_rng(0)
    density = random.integers(0, 256, len(dense)).astype(np.uint8)
    features = random.integers(-128, 128, (len(coarse), 4)).astype(np.int8)
    manifest = Manifest(
        generator="fuzz", resolution=RESOLUTION, feature_resolution=RESOLUTION, step=0.1,
        density_range=(-2, 4), n_channels=4, view_size=(8, 8), provenance={"bake": {"preset": "fast"}},
    )  # fmt: skip
    stored = VertexBricks(coords, masks, density), VertexBricks(coarse_coords, coarse_masks, features)
    files = {"head.onnx": head, "mesh.ply": mesh, "cameras.json": cameras}
    return write_version_3(folder, manifest, *stored, files)


class BrokenAsset:
    """A copy of an asset in which some files are broken until the next input."""

    def __init__(self, whole: Path, folder: Path) -> None:
        self.folder = Path(shutil.copytree(whole, folder))
        self._whole = {path.name: path.read_bytes() for path in whole.iterdir()}
        self.manifest: dict[str, Any] = json.loads(self._whole["manifest.json"])
        self.arrays: Arrays = {}
        if self.manifest["version"][0] == 3:
            stored = read_arrays(whole, read_manifest(whole), 1 << 40)
            self.arrays = dict(zip(PLACES, (*stored[0], *stored[1]), strict=True))
        self._changed: set[str] = set()

    @property
    def version(self) -> str:
        """Return the suffix that tells this version's targets from those of the other version."""
        return "" if self.manifest["version"][0] == 3 else " of version 4"

    def bytes_of(self, name: str) -> bytes:
        return self._whole[name]

    def restore(self) -> None:
        """Restore every changed file."""
        for name in self._changed:
            path = self.folder / name
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path)
            path.unlink(missing_ok=True)
            if name in self._whole:
                path.write_bytes(self._whole[name])
        self._changed.clear()

    def place(self, name: str) -> Path:
        """Return the path of a file that is going to be changed."""
        self._changed.add(name)
        return self.folder / name

    def write(self, files: dict[str, bytes], manifest: dict[str, Any] | None = None) -> None:
        """Write files, and a manifest with their sizes and checksums."""
        document = dict(self.manifest if manifest is None else manifest)
        entries = dict(document["files"]) if isinstance(document.get("files"), dict) else {}
        for name, data in files.items():
            self.place(name).write_bytes(data)
            entries[name] = {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}
        self.place("manifest.json").write_text(json.dumps(document | {"files": entries}))

    def read(self) -> None:
        """Open, describe and play the asset."""
        asset = Asset.open(self.folder, verify=True)
        assert all(line.isprintable() for line in page(self.folder, asset.manifest, facts(asset)))
        play(asset)


def play(asset: Asset) -> None:
    """Render a small picture with every march. Raises AssertionError if it is no picture."""
    for march in MARCHES:
        with Renderer(asset, 1, march) as renderer:
            for n_fetches in (None, 0):
                frame = renderer.render(small_view().transformed(asset.world_from_model), n_fetches)
                assert np.isfinite(frame.rgb).all() and np.isfinite(frame.depth).all(), "not finite"
                assert ((frame.opacity >= 0) & (frame.opacity <= 1)).all(), "opacity beyond 0..1"


# --- arrays ---


def _rows(array: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """Return broken bytes of an array, as whole rows, as many as the bytes hold."""
    data = broken_bytes(array.tobytes(), random)
    row = int(np.prod(array.shape[1:], dtype=int)) * array.itemsize
    return np.frombuffer(data[: len(data) // row * row], array.dtype).reshape(-1, *array.shape[1:])


def _starts(masks: np.ndarray) -> np.ndarray:
    return np.concatenate([[0], np.cumsum(np.bitwise_count(masks).sum(axis=1, dtype=np.int64))])


def _with_bricks(arrays: Arrays, names: tuple[str, str, str], order: np.ndarray) -> Arrays:
    """Return the bricks of `order`, each with its rows, so that all counts agree."""
    coords, masks, codes = (arrays[name] for name in names)
    starts = _starts(masks)
    order = order[(order < len(coords)) & (order < len(masks))]
    rows = [np.arange(starts[i], starts[i + 1]) for i in order]
    taken = np.concatenate(rows) if rows and len(codes) else np.zeros(0, int)
    return arrays | {
        names[0]: coords[order],
        names[1]: masks[order],
        names[2]: codes[taken % max(len(codes), 1)],
    }


def _moved(arrays: Arrays, names: tuple[str, str, str], random: np.random.Generator) -> Arrays:
    """Move some bricks to other places, beyond the grid, or to the ends of 16 bits; sorted or not."""
    coords = arrays[names[0]].astype(np.int64)
    some = random.random(len(coords)) < random.choice([0.05, 0.5, 1.0])
    places = [0, 1, 2] if random.random() < 0.5 else [0, 1, 2, 3, 4, 255, 256, 32767, 32768, 65535]
    coords[some] = random.choice(places, (int(some.sum()), 3))
    arrays = arrays | {names[0]: coords.astype(np.uint16)}
    _, order = np.unique(coords, axis=0, return_index=True)  # sorted, each place once
    return _with_bricks(arrays, names, order) if random.random() < 0.7 else arrays


def _other_masks(arrays: Arrays, names: tuple[str, str, str], random: np.random.Generator) -> Arrays:
    """Change masks to as many vertices, or more or fewer, with a number of codes that fits or does not."""
    masks, codes = arrays[names[1]].copy(), arrays[names[2]]
    brick = int(random.integers(0, max(len(masks), 1)))
    if not len(masks):
        return arrays
    match int(random.integers(0, 4)):
        case 0:  # the same number of bits, anywhere
            bits = np.unpackbits(masks.view(np.uint8), axis=1)
            masks = np.packbits(random.permuted(bits, axis=1), axis=1).view("<u8")
        case 1:
            masks[brick] = 2**64 - 1
        case 2:
            masks[brick] = 0
        case 3:
            masks = random.integers(0, 2**64, masks.shape, dtype=np.uint64) & random.integers(
                0, 2**64, masks.shape, dtype=np.uint64
            )
    n_rows = int(_starts(masks)[-1]) + (0 if random.random() < 0.8 else int(random.integers(-2, 3)))
    other = np.resize(codes, (max(n_rows, 0), *codes.shape[1:])) if codes.size else codes
    return arrays | {names[1]: masks, names[2]: other}


def _structure(arrays: Arrays, names: tuple[str, str, str], random: np.random.Generator) -> Arrays:
    n = len(arrays[names[0]])
    match int(random.integers(0, 8)):
        case 0:
            return _with_bricks(arrays, names, random.permutation(n))
        case 1:
            return _with_bricks(arrays, names, np.sort(random.integers(0, n, n + 1)) if n else np.arange(0))
        case 2:
            return _with_bricks(arrays, names, np.flatnonzero(random.random(n) < 0.7))
        case 3:
            return _with_bricks(arrays, names, np.arange(0))
        case 4 | 5:
            return _moved(arrays, names, random)
        case 6:
            return _other_masks(arrays, names, random)
        case _:
            return arrays | {names[2]: _rows(arrays[names[2]], random)}


def _packed(name: str, array: np.ndarray, random: np.random.Generator) -> bytes:
    """Return the bytes of an array's file: packed at any level of zlib, or with data added, or unchanged."""
    if name.endswith("coords"):
        file = io.BytesIO()
        np.save(file, np.ascontiguousarray(array))
        return file.getvalue()
    data = pack_masks(array) if name.endswith("masks") else pack_codes(array)
    match int(random.integers(0, 12)):
        case 0:
            return zlib.compress(zlib.decompress(data), int(random.integers(0, 10)))
        case 1:
            return data + data
        case 2:
            return zlib.compress(zlib.decompress(data) + b"\0")
        case 3:
            stream = zlib.compressobj()
            plain = zlib.decompress(data)
            half = len(plain) // 2
            return stream.compress(plain[:half]) + stream.flush(zlib.Z_FULL_FLUSH) + stream.compress(
                plain[half:]) + stream.flush()  # fmt: skip
    return data


def other_settings(document: dict[str, Any], random: np.random.Generator) -> dict[str, Any]:
    """Change settings to values that the specification allows, but that do not fit the arrays."""
    choices: dict[str, tuple[Any, ...]] = {
        "resolution": (1, 7, 8, 15, 16, 18, 20, 23, 24, 100, 400),
        "feature_resolution": (1, 7, 8, 16, 18, 20, 23, 24, 100, 400),
        "n_channels": (1, 2, 3, 5, 8, 16, 1024),
        "step": (1e-3, 0.01, 0.5, 3.0, 1e9),
        ("n_samples" if document["version"][0] == 3 else "n_fetches"): (0, 1, 2, 64, 1024),
        "density_range": ((-80, 80), (79, 80), (-80, -79), (0, 1e-30)),
        "aabb": (((-1e9,) * 3, (1e9,) * 3), ((0, 0, 0), (1e-9, 1, 1)), ((-1, -1, -1), (1, 1, 1e-3))),
        "background": ((0, 0, 0),),
        "view_size": ((1, 1), (1 << 20, 1)),
        "world_from_model": tuple(
            [[s, 0, 0, 1e8], [0, s, 0, 0], [0, 0, s, 0], [0, 0, 0, 1]] for s in (1e-9, 1e-3, 1e3, 1e9)
        ),
    }
    document = dict(document)
    for _ in range(int(random.integers(1, 3))):
        key = list(choices)[random.integers(0, len(choices))]
        document[key] = choices[key][random.integers(0, len(choices[key]))]
    if random.random() < 0.2:
        document |= {
            "contracted": True,
            "aabb": [[-2] * 3, [2] * 3],
            "near": float(random.choice([0, 0.1, 1e6])),
        }
        document["step"] = float(random.choice([1e-3, 0.05, 0.6, 2.0]))
    return document


def _target_of_array(asset: BrokenAsset, name: str) -> Target:
    """Return a target that breaks an array: values, structure or packed bytes, with other settings too."""
    names = ("brick_coords", "brick_masks", "density")
    if name.startswith("feature"):
        names = ("feature_coords", "feature_masks", "features")

    def prepare(random: np.random.Generator) -> None:
        asset.restore()
        arrays = dict(asset.arrays)
        share = random.random()
        if share < 0.2:  # the file's bytes
            asset.write({PLACES[name]: broken_bytes(asset.bytes_of(PLACES[name]), random)})
            return
        document = other_settings(asset.manifest, random) if random.random() < 0.4 else dict(asset.manifest)
        if share < 0.45:
            arrays[name] = _rows(arrays[name], random)
        else:
            for _ in range(int(random.integers(1, 3))):
                arrays = _structure(arrays, names, random)
        n_channels = document["n_channels"]
        if names[2] == "features" and n_channels != 4 and random.random() < 0.8:
            arrays["features"] = np.resize(arrays["features"], (len(arrays["features"]), n_channels))
        changed = {key: array for key, array in arrays.items() if array is not asset.arrays[key]}
        asset.write({PLACES[key]: _packed(key, array, random) for key, array in changed.items()}, document)

    return Target(name, prepare, asset.read)


# --- what is no array ---


def special_files(asset: BrokenAsset) -> Target:
    """Return a target that puts a link, pipe, device, socket, folder or a terabyte in place of a file."""

    def prepare(random: np.random.Generator) -> None:
        asset.restore()
        names = [*sorted(asset.manifest["files"]), "manifest.json"]
        name = names[random.integers(0, len(names))]
        path = asset.place(name)
        other = names[random.integers(0, len(names))]
        data = path.read_bytes()
        if (kind := int(random.integers(0, 12))) < 10:
            path.unlink()
        links = ("/dev/zero", "/dev/tty", "/proc/self/mem", path.name, "..", f"../{path.name}", other,
                 str(asset.folder / other))  # fmt: skip
        match kind:
            case 0 | 1 | 2:
                path.symlink_to(links[random.integers(0, len(links))])
            case 3:
                os.mkfifo(path)
            case 4:
                path.mkdir()
            case 5:
                with socket.socket(socket.AF_UNIX) as listener:
                    listener.bind(str(path))
            case 6:
                away = asset.place("away")
                away.write_bytes(data)
                path.symlink_to(away)
            case 7:
                outside = asset.folder.with_name("outside")
                outside.write_bytes(data)
                path.symlink_to(outside)
            case 8:
                os.link(asset.folder / other, path) if other != name else path.write_bytes(data)
            case 9:
                pass
            case _:
                with path.open("r+b") as file:
                    file.truncate(int(random.choice([0, 1, len(data) - 1, len(data) + 1, 1 << 34, 1 << 40])))
        vouched = random.random() < 0.3 and name in asset.manifest["files"] and path.is_file()
        if vouched and name != "manifest.json":
            entry = asset.manifest["files"][name] | {"bytes": path.stat().st_size}
            files = asset.manifest["files"] | {name: entry}
            asset.place("manifest.json").write_text(json.dumps(asset.manifest | {"files": files}))

    return Target(f"special files{asset.version}", prepare, asset.read)


def broken_manifest(asset: BrokenAsset) -> Target:
    """Return a target that breaks the manifest: values, and keys that are renamed, repeated or reordered."""
    data = asset.bytes_of("manifest.json")

    def prepare(random: np.random.Generator) -> None:
        asset.restore()
        place = asset.place("manifest.json")
        pairs = list(asset.manifest.items())
        match int(random.integers(0, 6)):
            case 0 | 1:
                place.write_bytes(broken_json(data, random))
                return
            case 2:
                asset.write({}, other_settings(asset.manifest, random))
                return
            case 3:  # a key twice, with two values
                key, value = pairs[random.integers(0, len(pairs))]
                pairs.insert(int(random.integers(0, len(pairs))), (key, broken_value(value, random)))
            case 4:
                index = int(random.integers(0, len(pairs)))
                other = ("Format", "files ", "\u0430abb", "near\0", "__proto__", "step.", "constructor")
                pairs[index] = (other[random.integers(0, len(other))], pairs[index][1])
            case 5:
                random.shuffle(pairs)  # pyright: ignore[reportArgumentType]
        place.write_text(
            "{" + ",".join(f"{json.dumps(key)}: {json.dumps(value)}" for key, value in pairs) + "}"
        )

    def read() -> None:
        with contextlib.suppress(OSError):
            parse_manifest((asset.folder / "manifest.json").read_bytes(), "manifest.json")
        asset.read()

    return Target(f"manifest{asset.version}", prepare, read)


def _mesh(asset: BrokenAsset) -> Target:
    def prepare(random: np.random.Generator) -> None:
        asset.restore()
        asset.write({"mesh.ply": broken_bytes(asset.bytes_of("mesh.ply"), random)})

    def read() -> None:
        opened = Asset.open(asset.folder)
        mesh = parse_ply(opened.read("mesh.ply"), "mesh.ply")
        if not (len(mesh.vertices) or not len(mesh.faces)):
            raise FormatError("mesh.ply: faces without vertices")

    return Target("mesh", prepare, read)


def asset_targets(asset: BrokenAsset) -> list[Target]:
    """Return all targets of an asset; they share one folder."""
    assert bricks_per_axis(RESOLUTION) == 3
    makers: list[Callable[[BrokenAsset], Target]] = [broken_manifest, special_files, _mesh]
    return [*(make(asset) for make in makers), *(_target_of_array(asset, name) for name in PLACES)]
