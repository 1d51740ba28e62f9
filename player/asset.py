"""An asset on disk: opened and checked, or written as a whole. The format is specified in
`player.manifest`."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from tokenize import TokenError

import numpy as np

from player.bricks import bricks_per_axis, unpack_vertices
from player.errors import FormatError, IntegrityError, OutputError
from player.files import new_folder
from player.manifest import NAME, FileEntry, Manifest, manifest_bytes, parse_manifest
from player.packing import pack_codes, pack_masks, unpack_codes, unpack_masks
from player.replace import clear_up
from player.sparse_grid import SparseGrid, build_grid

_DTYPES = {
    "brick_coords": "<u2",
    "brick_masks": "<u8",
    "density": "|u1",
    "feature_coords": "<u2",
    "feature_masks": "<u8",
    "features": "|i1",
}
_FILES = {
    "brick_coords": "brick_coords.npy",
    "brick_masks": "brick_masks.bits",
    "density": "density.codes",
    "feature_coords": "feature_coords.npy",
    "feature_masks": "feature_masks.bits",
    "features": "features.codes",
}


_HEADER_ERRORS = (
    ValueError,
    EOFError,
    OSError,
    SyntaxError,
    TypeError,
    OverflowError,
    RecursionError,
    TokenError,
)
"""What numpy raises for broken .npy files; the last one where it tries the header again as Python 2 wrote
it."""

Names = tuple[str, str, str]
_DENSITIES: Names = ("brick_coords", "brick_masks", "density")
_FEATURES: Names = ("feature_coords", "feature_masks", "features")

MAX_VERTICES = 2**31 - 1
"""Stored vertices of a grid, whose rows are numbered in 32 bits (`player.vertex_rows`)."""


@dataclass(frozen=True, eq=False)
class GridArrays:
    """The arrays of an asset, as `player.manifest` describes them."""

    brick_coords: np.ndarray
    brick_masks: np.ndarray
    density: np.ndarray
    feature_coords: np.ndarray
    feature_masks: np.ndarray
    features: np.ndarray

    def check(self, manifest: Manifest, where: str) -> None:
        """Raise FormatError unless types, shapes and bricks agree with each other and with the manifest."""
        self._check_grid(_DENSITIES, (), manifest.resolution, where)
        self._check_grid(_FEATURES, (manifest.n_channels,), manifest.feature_resolution, where)

    def _check_grid(self, names: Names, of_a_vertex: tuple[int, ...], resolution: int, where: str) -> None:
        coords_name, masks_name, codes_name = names
        coords, masks = getattr(self, coords_name), getattr(self, masks_name)
        n_bricks = len(coords) if coords.ndim else 0
        n_vertices = int(np.bitwise_count(masks).sum()) if masks.dtype.kind == "u" else 0
        if n_vertices > MAX_VERTICES:
            raise FormatError(
                f"{where}{_FILES[masks_name]}: expected at most {MAX_VERTICES} vertices, got {n_vertices}"
            )
        shapes = {
            coords_name: (n_bricks, 3),
            masks_name: (n_bricks, 8),
            codes_name: (n_vertices, *of_a_vertex),
        }
        for name, shape in shapes.items():
            array = getattr(self, name)
            dtype = np.dtype(_DTYPES[name])
            if array.dtype != dtype or array.shape != shape:
                raise FormatError(
                    f"{where}{_FILES[name]}: expected {dtype.name} {list(shape)}, "
                    f"got {array.dtype.name} {list(array.shape)}"
                )
        coords = np.asarray(coords, np.int64)
        keys = (coords[:, 0] << 32) | (coords[:, 1] << 16) | coords[:, 2]
        if (np.diff(keys) <= 0).any():
            raise FormatError(f"{where}{_FILES[coords_name]}: expected bricks sorted by x, y, z, each once")
        n = bricks_per_axis(resolution)
        if (coords >= n).any():
            raise FormatError(
                f"{where}{_FILES[coords_name]}: expected coordinates below {n}, got {coords.max()}"
            )
        edge = (coords == n - 1).any(axis=1)
        beyond = unpack_vertices(coords[edge], masks[edge]).max(initial=0)
        if beyond > resolution:
            raise FormatError(
                f"{where}{_FILES[masks_name]}: expected vertices up to {resolution}, got one at {beyond}"
            )


@dataclass(frozen=True, eq=False)
class Asset:
    """An opened asset, its arrays unpacked. `asset.grid` arranges them for the march."""

    folder: Path
    manifest: Manifest
    arrays: GridArrays

    @classmethod
    def open(cls, folder: str | Path, verify: bool = False) -> Asset:
        """Open the asset in `folder`.

        Args:
            folder: the asset's folder.
            verify: compare every checksum first, which reads every byte.

        Raises:
            FormatError: not an asset, or one that breaks the format; VersionError if it is a newer one.
            IntegrityError: a file is cut short or changed.
        """
        folder = Path(folder)
        manifest = _read_manifest(folder)
        for name, entry in manifest.files.items():
            _check_size(folder / name, entry)
            if verify:
                _check_sum(folder / name, entry)
        arrays = _read_arrays(folder, manifest)
        arrays.check(manifest, f"{folder}/")
        return cls(folder, manifest, arrays)

    def path(self, name: str) -> Path:
        """Path of one of the asset's files, for example `asset.path("mesh.ply")`."""
        if name not in self.manifest.files:
            raise FormatError(f"{self.folder}: expected one of {sorted(self.manifest.files)}, got {name}")
        return self.folder / name

    def verify(self) -> None:
        """Compare every file with its checksum; raises IntegrityError that names the first that differs."""
        for _, error in checksums(self.folder, self.manifest):
            if error is not None:
                raise error

    @cached_property
    def grid(self) -> SparseGrid:
        """The arrays arranged for marching; built when first asked for."""
        m, a = self.manifest, self.arrays
        low, high = m.density_range
        return build_grid(
            (a.brick_coords, a.brick_masks, a.density),
            (a.feature_coords, a.feature_masks, a.features),
            (m.resolution, m.feature_resolution),
            np.array(m.aabb),
            m.step,
            (low, high),
            m.contracted,
            m.near,
        )

    @cached_property
    def world_from_model(self) -> np.ndarray:
        """[4, 4] float64."""
        return np.array(self.manifest.world_from_model)

    @property
    def scale(self) -> float:
        """World units in a model unit."""
        return math.sqrt(sum(row[0] ** 2 for row in self.manifest.world_from_model[:3]))


def checksums(folder: Path, manifest: Manifest) -> Iterator[tuple[str, FormatError | None]]:
    """Every file's name with what is wrong with it, or None; reads each byte once."""
    for name, entry in sorted(manifest.files.items()):
        try:
            _check_size(folder / name, entry)
            _check_sum(folder / name, entry)
        except FormatError as error:
            yield name, error
        else:
            yield name, None


def read_manifest(folder: str | Path) -> Manifest:
    """The manifest alone, for looking at an asset whose other files may be broken."""
    return _read_manifest(Path(folder))


def write_asset(
    folder: Path,
    manifest: Manifest,
    arrays: GridArrays,
    head: bytes,
    mesh: bytes,
    cameras: bytes,
    force: bool = False,
    finish: Callable[[Path], dict[str, bytes]] | None = None,
) -> None:
    """Write an asset; it appears under `folder` complete or not at all.

    Args:
        folder: the new folder.
        manifest: everything but `files`, which is filled in here.
        arrays: checked before anything is written.
        head: bytes of `head.onnx`.
        mesh: bytes of `mesh.ply`, world frame.
        cameras: bytes of `cameras.json`, world frame.
        force: replace a folder that exists.
        finish: called with the complete asset while it still has another name, so that it can be played; the
            files that it returns, content by name, are added. What it raises leaves nothing.

    Raises:
        FormatError: the arrays contradict the manifest.
        OutputError: the folder exists, or the disk is full.
    """
    arrays.check(manifest, "")
    with new_folder(folder, force) as new:
        for name in ("brick_coords", "feature_coords"):
            with (new / _FILES[name]).open("wb") as file:
                array = np.ascontiguousarray(getattr(arrays, name), _DTYPES[name])
                np.lib.format.write_array(file, array, version=(1, 0), allow_pickle=False)
        for name in ("brick_masks", "feature_masks"):
            (new / _FILES[name]).write_bytes(pack_masks(getattr(arrays, name)))
        for name in ("density", "features"):
            (new / _FILES[name]).write_bytes(pack_codes(getattr(arrays, name)))
        for name, data in (("head.onnx", head), ("mesh.ply", mesh), ("cameras.json", cameras)):
            (new / name).write_bytes(data)
        _write_manifest(new, manifest)
        if finish is not None:
            for name, data in finish(new).items():
                (new / name).write_bytes(data)
            _write_manifest(new, manifest)


def _write_manifest(folder: Path, manifest: Manifest) -> None:
    """The manifest of what is in the folder."""
    paths = sorted(path for path in folder.iterdir() if path.name != NAME)
    files = {path.name: FileEntry(path.stat().st_size, _digest(path)) for path in paths}
    data = manifest_bytes(replace(manifest, files=files))
    parse_manifest(data, NAME)
    (folder / NAME).write_bytes(data)


def _read_arrays(folder: Path, manifest: Manifest) -> GridArrays:
    """Both grids at the same time: what unpacks them leaves the interpreter to others. Headers of .npy files
    are read before, because Python 3.11 parses on one thread at a time."""

    def grid(coords: np.ndarray, names: Names, *of_a_vertex: int) -> list[np.ndarray]:
        _, masks_name, codes_name = names
        path = folder / _FILES[masks_name]
        masks = unpack_masks(path.read_bytes(), len(coords) if coords.ndim else 0, str(path))
        path, shape = folder / _FILES[codes_name], (int(np.bitwise_count(masks).sum()), *of_a_vertex)
        return [coords, masks, unpack_codes(path.read_bytes(), shape, _DTYPES[codes_name], str(path))]

    of_densities, of_features = (_map_array(folder / _FILES[names[0]]) for names in (_DENSITIES, _FEATURES))
    with ThreadPoolExecutor(1) as other:
        features = other.submit(grid, of_features, _FEATURES, manifest.n_channels)
        densities = grid(of_densities, _DENSITIES)
        return GridArrays(*densities, *features.result())


def _read_manifest(folder: Path) -> Manifest:
    path = folder / NAME
    if not folder.is_dir():
        clear_up(folder.parent)  # it may be there, if whoever replaced it was killed
    if not folder.is_dir():
        raise FormatError(
            f"{folder}: expected the folder of an asset, got {'a file' if folder.exists() else 'nothing'}"
        )
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        raise FormatError(f"{folder}: not an asset: expected {NAME} in it, got none") from None
    except OSError as error:
        raise FormatError(f"{path}: cannot read: {error.strerror}") from error
    return parse_manifest(data, str(path))


def _check_size(path: Path, entry: FileEntry) -> None:
    try:
        size = path.stat().st_size
    except OSError:
        raise FormatError(f"{path}: expected a file of {entry.bytes} bytes, got none") from None
    if size != entry.bytes:
        raise IntegrityError(f"{path}: size: expected {entry.bytes} bytes, got {size}")


def _check_sum(path: Path, entry: FileEntry) -> None:
    digest = _digest(path)
    if digest != entry.sha256:
        raise IntegrityError(f"{path}: sha256: expected {entry.sha256[:16]}..., got {digest[:16]}...")


def _digest(path: Path) -> str:
    digest = hashlib.sha256()
    try:
        with path.open("rb") as file:
            while block := file.read(1 << 20):
                digest.update(block)
    except OSError as error:
        raise OutputError(f"{path}: cannot read: {error.strerror}") from error
    return digest.hexdigest()


def _map_array(path: Path) -> np.ndarray:
    try:
        array = np.lib.format.open_memmap(path, mode="r")
    except _HEADER_ERRORS as error:
        raise FormatError(f"{path}: expected a numpy array, got something else: {error}") from error
    if not isinstance(array, np.memmap) or not array.flags.c_contiguous:
        raise FormatError(f"{path}: expected one plain array in C order")
    explained = array.offset + array.nbytes
    if explained != path.stat().st_size:
        raise FormatError(f"{path}: expected {explained} bytes as its header says, got {path.stat().st_size}")
    return array
