"""Open and check an asset on disk, or write one as a whole. docs/format.md specifies the format."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from player.asset.arranging import write_parts
from player.asset.check_bricks import check_level
from player.asset.folder import check_files, check_size, check_sum, file_digest, read_checked
from player.asset.grid import SparseGrid, build_grid, most_samples
from player.asset.manifest import (
    MAX_BYTES,
    MESH,
    NAME,
    VERSION,
    FileEntry,
    Manifest,
    manifest_bytes,
    needed_files,
    parse_manifest,
)
from player.asset.parts import DTYPES, PartsReader
from player.asset.pyramid import PyramidValues
from player.asset.sections import MAX_ROWS, Grid
from player.asset.single_level import from_vertices
from player.asset.target import check_asset_target
from player.asset.version_3.unpacking import read_arrays
from player.errors import ConfigError, FormatError
from player.files.files import new_folder, read_bytes
from player.files.memory import allowed_bytes
from player.files.replace import clear_up


@dataclass(frozen=True, eq=False)
class GridArrays:
    """The stored codes of a field, laid out the same whatever version of the format they were read from."""

    densities: PyramidValues
    """Codes uint8 [n_vertices, 1] of each level."""
    features: PyramidValues
    """Codes int8 [n_vertices, n_channels] of each level."""

    def check(self, manifest: Manifest) -> None:
        """Raise FormatError unless dtypes, shapes and bricks agree with each other and with the manifest."""
        _check_grid("densities", self.densities, manifest)
        _check_grid("features", self.features, manifest)


def _check_grid(grid: Grid, stored: PyramidValues, manifest: Manifest) -> None:
    pyramid, levels = stored.pyramid, stored.pyramid.levels
    resolution, n_levels = manifest.resolutions[grid], manifest.n_levels[grid]
    if pyramid.resolution != resolution:
        raise FormatError(f"{grid}: expected {resolution} cells an axis, got {pyramid.resolution}")
    if not len(levels) == len(stored.values) == n_levels:
        raise FormatError(
            f"{grid}: expected bricks and values of {n_levels} levels, got {len(levels)} and "
            f"{len(stored.values)}"
        )
    if grid == "features" and not len(levels[-1]):  # every sample with weight needs a feature
        raise FormatError(f"{grid}: expected at least one live cell, got none")
    for level, bricks in reversed(list(enumerate(levels))):
        where = f"{grid}, level {level}"
        _check_array(f"{where}: coords", bricks.coords, np.uint16, (len(bricks), 3))
        _check_array(f"{where}: masks", bricks.masks, np.uint64, (len(bricks), 8))
        above = levels[level + 1] if level + 1 < n_levels else None
        check_level(bricks, above, pyramid.cells_per_axis(level), where)
    n_rows = sum(vertices.n for vertices in pyramid.vertices)
    if n_rows > MAX_ROWS:
        raise FormatError(f"{grid}: expected at most {MAX_ROWS} vertices, got {n_rows}")
    n_channels = manifest.n_channels if grid == "features" else 1
    for level, (vertices, values) in enumerate(zip(pyramid.vertices, stored.values, strict=True)):
        _check_array(f"{grid}, level {level}: values", values, DTYPES[grid], (vertices.n, n_channels))


def _check_array(where: str, array: np.ndarray, kind: type[np.generic], shape: tuple[int, ...]) -> None:
    dtype = np.dtype(kind)
    if array.dtype != dtype or array.shape != shape:
        raise FormatError(
            f"{where}: expected {dtype.name} {list(shape)}, got {array.dtype.name} {list(array.shape)}"
        )


@dataclass(frozen=True, eq=False)
class Asset:
    """An opened asset with its values decoded; `asset.grid` has them arranged for the march."""

    folder: Path
    """Absolute, so that the asset can still be read when the process has changed its folder."""
    manifest: Manifest
    arrays: GridArrays
    n_parts: int = 0
    """Number of parts that have been read; 0 for version 3, which has none."""
    missing: str | None = None
    """One line that says why fewer parts were read than asked for: a later one is missing, cut short,
    changed, broken or not in its place. None if all were read. The asset can be played either way."""

    @classmethod
    def open(
        cls,
        folder: str | Path,
        verify: bool = False,
        max_memory: float | None = None,
        parts: int | None = None,
    ) -> Asset:
        """Open the asset in `folder`.

        Args:
            folder: the asset's folder; its files must be regular files inside it.
            verify: first compare the checksum of every file that the manifest lists, which reads every byte,
                and raise if any part cannot be decoded. If False, a file is compared when it is read: now the
                parts, later the head and the cameras. A part after the first that is missing, cut short,
                changed, broken or not in its place is then no error: `asset.missing` says so. The mesh is
                not looked at.
            max_memory: gigabytes that the asset may take, unpacked and arranged for marching. If None, half
                of what the machine has.
            parts: number of parts to read, 1 or more: the fewer, the coarser the picture and the sooner it
                is there. All if None.

        Raises:
            FormatError: not an asset, or one that breaks the format; VersionError: another major version.
            IntegrityError: a file is cut short or changed.
            ConfigError: the asset takes more memory than allowed, or `parts` is less than 1.

        >>> asset = Asset.open("out/", parts=1)
        >>> asset.n_parts, asset.missing
        (1, None)
        """
        if parts is not None and parts < 1:
            raise ConfigError(f"parts: expected at least 1, got {parts}")
        opening = _Opening(Path(folder), verify, max_memory)
        return opening.asset(len(opening.manifest.parts) if parts is None else parts)

    @classmethod
    def growing(cls, folder: str | Path, max_memory: float | None = None) -> Iterator[Asset]:
        """Yield the asset in `folder` after each further part is read: first a whole, coarser picture, then
        sharper ones. Each part is read and decoded once.

        Arguments and errors are those of `open` without `verify`, except that `max_memory` bounds an asset
        together with the one yielded before it, because the earlier one may still be shown.

        >>> for asset in Asset.growing("out/"):
        ...     print(asset.n_parts, asset.missing)
        1 None
        """
        opening = _Opening(Path(folder), False, max_memory)
        n_all = max(len(opening.manifest.parts), 1)
        for n_parts in range(1, n_all):
            asset = opening.asset(n_parts)
            yield asset
            if asset.missing is not None:
                return
        asset = opening.asset(n_all)
        del opening  # frees the decoded symbols, which take more memory than the values
        yield asset

    def path(self, name: str) -> Path:
        """Return the path of one of the asset's files, for example `asset.path("mesh.ply")`.

        Raises FormatError: the manifest lists no such file.
        """
        if name not in self.manifest.files:
            raise FormatError(f"{self.folder}: expected one of {sorted(self.manifest.files)}, got {name}")
        return self.folder / name

    def read(self, name: str) -> bytes:
        """Return the content of one of the asset's files, for example `asset.read("head.onnx")`.

        Raises FormatError: the manifest lists no such file, or it is none; IntegrityError: it is cut short,
        or not the one that the manifest lists, for example because another asset has taken its place.
        """
        path = self.path(name)
        return read_checked(self.folder, path.name, self.manifest.files[name])

    def verify(self) -> None:
        """Compare every file with its checksum. Raises IntegrityError that names the first that differs."""
        for _, error in checksums(self.folder, self.manifest):
            if error is not None:
                raise error

    @cached_property
    def grid(self) -> SparseGrid:
        """The arrays arranged for marching; built at the first access."""
        m, a = self.manifest, self.arrays
        low, high = m.density_range
        return build_grid(
            a.densities,
            a.features,
            np.array(m.aabb),
            m.step,
            m.level_steps,
            (low, high),
            m.contracted,
            m.near,
            skip_dead=True,
        )

    @cached_property
    def digest(self) -> str:
        """A digest of the manifest as it was opened, and with it of all files, whose checksums it lists."""
        return hashlib.sha256(manifest_bytes(self.manifest)).hexdigest()

    @property
    def most_samples(self) -> int:
        """The most samples that a ray can have; a ray never needs more feature lookups than that."""
        low, high = self.manifest.aabb
        return most_samples(math.dist(low, high), self.manifest.step)

    @cached_property
    def world_from_model(self) -> np.ndarray:
        """The similarity [4, 4] float64 from the model frame to the world."""
        return np.array(self.manifest.world_from_model)

    @property
    def scale(self) -> float:
        """World units per model unit."""
        return math.sqrt(sum(row[0] ** 2 for row in self.manifest.world_from_model[:3]))


class _Opening:
    """An asset that is being opened, part by part."""

    def __init__(self, folder: Path, verify: bool, max_memory: float | None) -> None:
        self._verify, self._allowed = verify, allowed_bytes(max_memory)
        self.manifest = read_manifest(folder)
        self._folder = folder = folder.absolute()
        files = self.manifest.files
        played = (name for name in needed_files(self.manifest.version) if name != MESH)
        needed = files if verify else {name: files[name] for name in played}
        check_files(folder, needed, self._allowed)
        if verify:
            for name, entry in needed.items():
                check_sum(folder, name, entry)
        self._parts = PartsReader(folder, self.manifest, self._allowed)

    def asset(self, n_parts: int) -> Asset:
        """Return the asset made of its first `n_parts` parts, or of fewer if a later one cannot be read."""
        folder, manifest, parts = self._folder, self.manifest, self._parts
        if manifest.version < (4, 0):
            densities, features = read_arrays(folder, manifest, self._allowed)
            arrays = GridArrays(
                from_vertices(densities, manifest.resolution),
                from_vertices(features, manifest.feature_resolution),
            )
            return Asset(folder, manifest, arrays)
        missing = None
        try:
            parts.read(n_parts)
        except FormatError as error:
            if self._verify or not parts.n_read:
                raise
            missing = f"{error}: shown as the first {parts.n_read} of {len(manifest.parts)} parts have it"
        arrays = GridArrays(*parts.values())
        return Asset(folder, manifest, arrays, parts.n_read, missing)


def checksums(folder: Path, manifest: Manifest) -> Iterator[tuple[str, FormatError | None]]:
    """Yield the name of every file and the error found in it, or None; reads each byte once."""
    for name, entry in sorted(manifest.files.items()):
        try:
            check_size(folder, name, entry)
            check_sum(folder, name, entry)
        except FormatError as error:
            yield name, error
        else:
            yield name, None


def read_manifest(folder: str | Path) -> Manifest:
    """Read the manifest alone, for looking at an asset whose other files may be broken.

    Raises FormatError: not an asset, or a manifest that breaks the format.
    """
    folder = Path(folder)
    if not folder.is_dir():
        clear_up(folder.parent)  # brings the folder back if a process was killed while replacing it
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
    mesh: bytes | None,
    cameras: bytes,
    force: bool = False,
    finish: Callable[[Path], dict[str, bytes]] | None = None,
) -> None:
    """Write an asset, which appears under `folder` complete or not at all.

    Args:
        folder: the new folder.
        manifest: everything but `parts` and `files`, which are filled in here.
        arrays: checked before anything is written.
        head: bytes of `head.onnx`.
        mesh: bytes of `mesh.ply`, world frame; None if `finish` returns it. Parts are then cut as if it took
            the tenth of the asset's bytes that it may take at most.
        cameras: bytes of `cameras.json`, world frame.
        force: replace a folder that exists, if it holds an asset and nothing else.
        finish: called with the temporary folder of the complete asset, which can already be played. It
            returns further files to add, content by name. If it raises, nothing is left on disk.

    Raises:
        FormatError: the arrays contradict the manifest, or hold values that its quantization steps cannot
            reach.
        OutputError: the folder exists, or holds something else than an asset; or the disk is full.
    """
    force = check_asset_target(folder, force)
    arrays.check(manifest)
    n_before = len(head) + len(cameras)
    n_behind = None if mesh is None else len(mesh)
    parts = write_parts(arrays.densities, arrays.features, manifest, n_before, n_behind)
    manifest = replace(manifest, version=VERSION, parts=tuple(part.part for part in parts), files={})
    with new_folder(folder, force) as new:
        for part in parts:
            (new / part.part.file).write_bytes(part.data)
        for name, data in (("head.onnx", head), ("mesh.ply", mesh or b""), ("cameras.json", cameras)):
            (new / name).write_bytes(data)
        _write_manifest(new, manifest)
        if finish is not None:
            for name, data in finish(new).items():
                (new / name).write_bytes(data)
            _write_manifest(new, manifest)


def _write_manifest(folder: Path, manifest: Manifest) -> None:
    """Write the manifest, which lists all files in the folder."""
    paths = sorted(path for path in folder.iterdir() if path.name != NAME)
    files = {path.name: _entry(path) for path in paths}
    data = manifest_bytes(replace(manifest, files=files))
    tuple(parse_manifest(data, NAME).parts_in_order())  # raises if any part is wrong
    (folder / NAME).write_bytes(data)


def _entry(path: Path) -> FileEntry:
    size = path.stat().st_size
    return FileEntry(size, file_digest(path, size, path.parent))
