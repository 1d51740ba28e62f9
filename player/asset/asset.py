"""An asset on disk: opened and checked, or written as a whole. The format is specified in
`player.asset.manifest`."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from player.asset.grid import SparseGrid, build_grid, most_samples
from player.asset.manifest import MAX_BYTES, NAME, FileEntry, Manifest, manifest_bytes, parse_manifest
from player.asset.packing import pack_codes, pack_masks
from player.asset.pyramid import MAX_LEVELS, PyramidValues
from player.asset.single_level import VertexBricks, from_vertices, to_vertices
from player.asset.unpacking import (
    DENSITIES,
    DTYPES,
    FEATURES,
    PLACES,
    Names,
    check_bricks,
    check_files,
    check_size,
    n_set,
    read_arrays,
)
from player.errors import FormatError, IntegrityError
from player.files.files import new_folder, open_file, read_bytes
from player.files.memory import allowed_bytes
from player.files.replace import clear_up

MAX_VERTICES = 2**31 - 1
"""Stored vertices of a grid, whose rows are numbered in 32 bits (`player.asset.grid.VertexRows`)."""


@dataclass(frozen=True, eq=False)
class GridArrays:
    """What is stored of the field: the same in memory whatever version of the format it was read from."""

    densities: PyramidValues
    """Codes uint8 [n_vertices, 1] of each level."""
    features: PyramidValues
    """Codes int8 [n_vertices, n_channels] of each level."""

    def check(self, manifest: Manifest, where: str) -> None:
        """Raise FormatError unless types, shapes and bricks agree with each other and with the manifest."""
        _check_grid(self.densities, DENSITIES, manifest.resolution, 1, where)
        _check_grid(self.features, FEATURES, manifest.feature_resolution, manifest.n_channels, where)


def _check_grid(grid: PyramidValues, names: Names, resolution: int, n_channels: int, where: str) -> None:
    pyramid = grid.pyramid
    coords_name, masks_name, codes_name = (where + PLACES[name] for name in names)
    if pyramid.resolution != resolution:
        raise FormatError(f"{coords_name}: expected {resolution} cells an axis, got {pyramid.resolution}")
    if not len(pyramid.levels) == len(grid.values) <= MAX_LEVELS:
        raise FormatError(
            f"{codes_name}: expected codes for each of at most {MAX_LEVELS} levels, got {len(grid.values)} "
            f"for {len(pyramid.levels)} levels"
        )
    n_cells = sum(n_set(bricks.masks) for bricks in pyramid.levels)
    if n_cells > MAX_VERTICES:  # there are more vertices than cells
        raise FormatError(f"{masks_name}: expected at most {MAX_VERTICES} vertices, got {n_cells}")
    if names is FEATURES and not n_cells:  # every sample that counts is given a feature
        raise FormatError(f"{masks_name}: expected at least one live cell, got none")
    for level, bricks in enumerate(pyramid.levels):
        _check_array(coords_name, bricks.coords, "<u2", (len(bricks), 3))
        _check_array(masks_name, bricks.masks, "<u8", (len(bricks), 8))
        check_bricks(bricks.coords, bricks.masks, names, pyramid.cells_per_axis(level) - 1, where, "cells")
    n_rows = sum(vertices.n for vertices in pyramid.vertices)
    if n_rows > MAX_VERTICES:
        raise FormatError(f"{masks_name}: expected at most {MAX_VERTICES} vertices, got {n_rows}")
    for vertices, values in zip(pyramid.vertices, grid.values, strict=True):
        _check_array(codes_name, values, DTYPES[names[2]], (vertices.n, n_channels))


def _check_array(where: str, array: np.ndarray, kind: str, shape: tuple[int, ...]) -> None:
    dtype = np.dtype(kind)
    if array.dtype != dtype or array.shape != shape:
        raise FormatError(
            f"{where}: expected {dtype.name} {list(shape)}, got {array.dtype.name} {list(array.shape)}"
        )


@dataclass(frozen=True, eq=False)
class Asset:
    """An opened asset, its arrays unpacked. `asset.grid` arranges them for the march."""

    folder: Path
    manifest: Manifest
    arrays: GridArrays

    @classmethod
    def open(cls, folder: str | Path, verify: bool = False, max_memory: float | None = None) -> Asset:
        """Open the asset in `folder`.

        Args:
            folder: the asset's folder; its files are regular ones inside it.
            verify: compare every checksum first, which reads every byte.
            max_memory: gigabytes that the asset may take, unpacked and arranged for marching; half of what
                the machine has if None.

        Raises:
            FormatError: not an asset, or one that breaks the format; VersionError if it is a newer one.
            IntegrityError: a file is cut short or changed.
            ConfigError: it takes more memory than it may.
        """
        folder, allowed = Path(folder), allowed_bytes(max_memory)
        manifest = read_manifest(folder)
        check_files(folder, manifest, allowed)
        if verify:
            for name, entry in manifest.files.items():
                _check_sum(folder, name, entry)
        densities, features = read_arrays(folder, manifest, allowed)
        arrays = GridArrays(
            from_vertices(densities, manifest.resolution),
            from_vertices(features, manifest.feature_resolution),
        )
        return cls(folder, manifest, arrays)

    def path(self, name: str) -> Path:
        """Path of one of the asset's files, for example `asset.path("mesh.ply")`."""
        if name not in self.manifest.files:
            raise FormatError(f"{self.folder}: expected one of {sorted(self.manifest.files)}, got {name}")
        return self.folder / name

    def read(self, name: str) -> bytes:
        """The content of one of the asset's files. Raises FormatError."""
        return read_bytes(self.path(name), "a file of an asset", self.manifest.files[name].bytes, self.folder)

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
            a.densities,
            a.features,
            np.array(m.aabb),
            m.step,
            (1,) * len(a.densities.pyramid.levels),
            (low, high),
            m.contracted,
            m.near,
        )

    @property
    def most_samples(self) -> int:
        """Samples that a ray can have; more feature fetches than that are as good as one at every sample."""
        low, high = self.manifest.aabb
        return most_samples(math.dist(low, high), self.manifest.step)

    @cached_property
    def world_from_model(self) -> np.ndarray:
        """The similarity [4, 4] float64 from the model frame to the world."""
        return np.array(self.manifest.world_from_model)

    @property
    def scale(self) -> float:
        """World units in a model unit."""
        return math.sqrt(sum(row[0] ** 2 for row in self.manifest.world_from_model[:3]))


def checksums(folder: Path, manifest: Manifest) -> Iterator[tuple[str, FormatError | None]]:
    """Every file's name with what is wrong with it, or None; reads each byte once."""
    for name, entry in sorted(manifest.files.items()):
        try:
            check_size(folder, name, entry)
            _check_sum(folder, name, entry)
        except FormatError as error:
            yield name, error
        else:
            yield name, None


def read_manifest(folder: str | Path) -> Manifest:
    """The manifest alone, for looking at an asset whose other files may be broken.

    Raises FormatError: not an asset, or a manifest that breaks the format.
    """
    folder = Path(folder)
    if not folder.is_dir():
        clear_up(folder.parent)  # it may be there, if whoever replaced it was killed
    if not folder.is_dir():
        raise FormatError(
            f"{folder}: expected the folder of an asset, got {'a file' if folder.exists() else 'nothing'}"
        )
    path = folder / NAME
    if not path.exists() and not path.is_symlink():
        raise FormatError(f"{folder}: not an asset: expected {NAME} in it, got none")
    return parse_manifest(read_bytes(path, "a manifest", MAX_BYTES, folder), str(path))


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
        for names, grid in ((DENSITIES, arrays.densities), (FEATURES, arrays.features)):
            _write_grid(new, names, to_vertices(grid))
        for name, data in (("head.onnx", head), ("mesh.ply", mesh), ("cameras.json", cameras)):
            (new / name).write_bytes(data)
        _write_manifest(new, manifest)
        if finish is not None:
            for name, data in finish(new).items():
                (new / name).write_bytes(data)
            _write_manifest(new, manifest)


def _write_grid(folder: Path, names: Names, stored: VertexBricks) -> None:
    """The three files of a grid in version 3.1."""
    coords_name, masks_name, codes_name = (folder / PLACES[name] for name in names)
    with coords_name.open("wb") as file:
        coords = np.ascontiguousarray(stored.coords, "<u2")
        np.lib.format.write_array(file, coords, version=(1, 0), allow_pickle=False)
    masks_name.write_bytes(pack_masks(stored.masks))
    codes_name.write_bytes(pack_codes(stored.values))


def _write_manifest(folder: Path, manifest: Manifest) -> None:
    """The manifest of what is in the folder."""
    paths = sorted(path for path in folder.iterdir() if path.name != NAME)
    files = {path.name: _entry(path) for path in paths}
    data = manifest_bytes(replace(manifest, files=files))
    parse_manifest(data, NAME)
    (folder / NAME).write_bytes(data)


def _entry(path: Path) -> FileEntry:
    size = path.stat().st_size
    return FileEntry(size, _digest(path, size, path.parent))


def _check_sum(folder: Path, name: str, entry: FileEntry) -> None:
    path = folder / name
    digest = _digest(path, entry.bytes, folder)
    if digest != entry.sha256:
        raise IntegrityError(f"{path}: sha256: expected {entry.sha256[:16]}..., got {digest[:16]}...")


def _digest(path: Path, most: int, inside: Path) -> str:
    digest = hashlib.sha256()
    with open_file(path, "a file of an asset", most, inside) as file:
        while block := file.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()
