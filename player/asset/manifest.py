"""Parse and write the manifest of the format `vfr-asset`, version 4.0.

docs/format.md specifies the format, with the type, the bounds and the meaning of every key. A manifest of
version 3.x calls `n_fetches` `n_samples`, and has no levels and no parts.
"""

from __future__ import annotations

import hashlib
import json
import math
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, fields
from functools import partial
from typing import Any

from player.asset.pyramid import MAX_LEVELS
from player.asset.sections import (
    MAX_CHANNELS,
    Grid,
    Part,
    in_order,
    parse_parts,
    part_name,
    parts_as_json,
    shown,
)
from player.errors import FormatError, VersionError

FORMAT = "vfr-asset"
VERSION = (4, 0)
NAME = "manifest.json"
MESH = "mesh.ply"
"""The mesh, which no player reads."""
FILES = ("head.onnx", MESH, "cameras.json", part_name(0))
"""The files that every asset of version 4 has."""
FILES_OF_3 = (
    "brick_coords.npy",
    "brick_masks.bits",
    "density.codes",
    "feature_coords.npy",
    "feature_masks.bits",
    "features.codes",
    "head.onnx",
    MESH,
    "cameras.json",
)
"""The files that every asset of version 3 has."""
MAX_BYTES = 16 << 20
MAX_VALUES = 1 << 20
MAX_DEPTH = 64
"""The most lists and objects inside one another: what walks through them by recursion has room for these."""
MAX_RESOLUTION = 2048
MAX_STEPS = 65536
MAX_EDGES = 1000
"""The largest coordinate of a box along an axis, in edges along this axis: farther away, float32 is too
coarse for its cells."""
MAX_LEVEL_STEP = 128
AGREEMENT = {False: (20.0, 40.0), True: (14.0, 28.0)}
"""Default of `agreement` where the key is absent, by `contracted`."""
OPTIONAL = frozenset({"quality_fetches"})
"""Keys that may be absent; their fields are None then."""
CONTRACTED_AABB = ((-2.0, -2.0, -2.0), (2.0, 2.0, 2.0))

Vector = tuple[float, ...]
Parser = Callable[[str, Any], Any]
"""A function from the name of a key, for messages, and the JSON there to the value; raises FormatError."""


@dataclass(frozen=True)
class FileEntry:
    """Size and checksum of one file."""

    bytes: int
    sha256: str


def file_entry(data: bytes) -> FileEntry:
    """Return the entry of a file that holds `data`.

    >>> file_entry(b"four").bytes
    4
    """
    return FileEntry(len(data), hashlib.sha256(data).hexdigest())


@dataclass(frozen=True, kw_only=True)
class Manifest:
    """A manifest, whose fields are its keys. The bake and `parse_manifest` build it; its values are
    checked in either case.

    >>> manifest = Manifest(generator="doctest", resolution=8, feature_resolution=4, step=0.2,
    ...     density_range=(-5, 5), n_channels=4, view_size=(4, 3))
    >>> json.loads(manifest_bytes(manifest))["density_range"]
    [-5.0, 5.0]
    """

    generator: str
    resolution: int
    feature_resolution: int
    step: float
    density_range: Vector
    n_channels: int
    view_size: tuple[int, ...]
    aabb: tuple[Vector, ...] = ((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))
    world_from_model: tuple[Vector, ...] = tuple(tuple(float(i == j) for j in range(4)) for i in range(4))
    contracted: bool = False
    near: float = 0.0
    level_steps: tuple[int, ...] = (1,)
    n_fetches: int = 5
    agreement: Vector = AGREEMENT[False]
    quality_fetches: tuple[int, ...] | None = None
    density_steps: tuple[int, ...] = (1,)
    feature_steps: tuple[int, ...] = (1,)
    background: Vector = (1.0, 1.0, 1.0)
    colour_space: str = "srgb"
    parts: tuple[Part, ...] = ()
    files: dict[str, FileEntry] = field(default_factory=dict)
    provenance: dict[str, Any] = field(default_factory=dict)
    version: tuple[int, ...] = VERSION

    def __post_init__(self) -> None:
        for key, parse in _PARSERS.items():
            value = getattr(self, key)
            if value is not None or key not in OPTIONAL:
                object.__setattr__(self, key, parse(f"manifest: {key}", value))
        _check_together(self)

    @property
    def n_levels(self) -> dict[Grid, int]:
        """Number of levels of each of the two pyramids."""
        return {"densities": len(self.density_steps), "features": len(self.feature_steps)}

    @property
    def resolutions(self) -> dict[Grid, int]:
        """Cells along each axis of the finest level of each of the two pyramids."""
        return {"densities": self.resolution, "features": self.feature_resolution}

    def parts_in_order(self, where: str = "manifest") -> Iterator[Part]:
        """Yield the parts that can be decoded one after another. Raises FormatError in place of the first
        that cannot, or whose sections are not as long as its file."""
        for part in in_order(where, self.parts, self.resolutions, self.n_levels, self.n_channels):
            size = self.files.get(part.file, part).bytes
            if size != part.bytes:
                place = f"{where}: files: {part.file}: bytes"
                raise FormatError(f"{place}: expected {part.bytes}, the sum of its sections, got {size}")
            yield part


def needed_files(version: tuple[int, ...]) -> tuple[str, ...]:
    """Return the names of the files that every asset of a version has."""
    return FILES if version >= (4, 0) else FILES_OF_3


def parse_manifest(data: bytes, where: str) -> Manifest:
    """Parse the bytes of `manifest.json`.

    Args:
        data: the file's bytes.
        where: the file's name in error messages.

    Raises:
        VersionError: written for another major version.
        FormatError: anything else that the specification does not allow.
    """
    if len(data) > MAX_BYTES:
        raise FormatError(f"{where}: size: expected at most {MAX_BYTES} bytes, got {len(data)}")
    n_values = 1 + sum(map(data.count, (b",", b"[", b"{")))
    if n_values > MAX_VALUES:
        raise FormatError(f"{where}: expected at most {MAX_VALUES} values, got about {n_values}")
    try:
        document = json.loads(
            data.decode(), parse_constant=_refuse, parse_float=_finite, object_pairs_hook=_each_once
        )
    except (ValueError, RecursionError) as error:
        raise FormatError(f"{where}: expected JSON, got something else: {error}") from error
    if _is_deeper(document, MAX_DEPTH):
        raise FormatError(
            f"{where}: expected at most {MAX_DEPTH} lists and objects inside one another, got more"
        )
    if not isinstance(document, dict) or document.get("format") != FORMAT:
        raise FormatError(f'{where}: format: expected "{FORMAT}", got {shown(document)}')
    version = _parse_version(f"{where}: version", document.get("version"))
    if version < (4, 0):
        document = _of_version_4(document, version)
    document.setdefault("agreement", AGREEMENT[document.get("contracted") is True])
    known = {f.name for f in fields(Manifest)}
    missing = sorted(known - set(document) - OPTIONAL)
    if missing:
        raise FormatError(f"{where}: {missing[0]}: expected this key, got none (file not fully written?)")
    unknown = sorted(set(document) - known - {"format"})
    if unknown and version <= (VERSION if version >= (4, 0) else (3, 1)):
        raise FormatError(
            f"{where}: {ascii(unknown[0])[1:-1][:80]}: expected no such key in version {list(version)}"
        )
    parsers: dict[str, Parser] = _PARSERS | {"parts": partial(parse_parts, newer=version > VERSION)}
    values = {key: parsers[key](f"{where}: {key}", document[key]) for key in known & set(document)}
    _check_files(f"{where}: files", version, values["files"], values["parts"])
    return Manifest(**values)


def _of_version_4(document: dict[str, Any], version: tuple[int, ...]) -> dict[str, Any]:
    """Return a manifest of version 3.x with the keys of version 4: one level, and no parts.

    Keys that version 3 does not have are kept, those of version 4 under another name, so that they are
    reported as unknown.
    """
    levels = {"level_steps": [1], "density_steps": [1], "feature_steps": [1], "parts": []}
    found = {f"{key} in version 3" if key in {*levels, "n_fetches"} else key: value
             for key, value in document.items()}  # fmt: skip
    if "n_samples" in found:
        found["n_fetches"] = found.pop("n_samples")
    if version < (3, 1):
        found.setdefault("near", 0.0)
    return found | levels


def _check_files(
    where: str, version: tuple[int, ...], files: dict[str, FileEntry], parts: tuple[Part, ...]
) -> None:
    """Raise FormatError unless every file that the version must have is listed."""
    if version >= (4, 0) and not parts:
        raise FormatError(f"{where.removesuffix(': files')}: parts: expected at least one, got none")
    for name in (*needed_files(version), *(part.file for part in parts)):
        if name not in files:
            raise FormatError(f"{where}: expected {name}, got {sorted(files)}")


def manifest_bytes(manifest: Manifest) -> bytes:
    """Return the bytes of a manifest's file. Keys are sorted, so that equal manifests are equal files.

    Raises FormatError: `provenance` holds something that is no finite JSON value.
    """
    document: dict[str, Any] = {f.name: getattr(manifest, f.name) for f in fields(manifest)}
    document = {key: value for key, value in document.items() if value is not None}
    document["format"] = FORMAT
    document["parts"] = parts_as_json(manifest.parts)
    document["files"] = {
        name: {"bytes": entry.bytes, "sha256": entry.sha256} for name, entry in manifest.files.items()
    }
    try:
        return (json.dumps(document, sort_keys=True, indent=1, allow_nan=False) + "\n").encode()
    except (ValueError, TypeError) as error:
        raise FormatError(f"manifest: provenance: expected finite JSON values: {error}") from error


def _is_deeper(value: object, most: int) -> bool:
    """Return whether more than `most` lists and objects are inside one another."""
    if not isinstance(value, dict | list):
        return False
    inside = value.values() if isinstance(value, dict) else value
    return most == 0 or any(_is_deeper(item, most - 1) for item in inside)


def _refuse(text: str) -> float:
    raise ValueError(f"{text[:80]} is not a number of JSON")


def _each_once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        raise ValueError("a key that is there twice")
    return found


def _finite(text: str) -> float:
    value = float(text)
    return value if math.isfinite(value) else _refuse(text)


def _parse_version(where: str, value: object) -> tuple[int, ...]:
    version = _integers(2, 0, 1 << 20)(where, value)
    if version[0] not in (3, VERSION[0]):
        raise VersionError(
            f"{where}: expected 3.x or {VERSION[0]}.x, got {version[0]}.{version[1]}: "
            f"{'install a newer vfr-bake' if version > VERSION else 'bake the asset again'}"
        )
    return version


def _of_type(kind: type, expected: str) -> Parser:
    def parse(where: str, value: object) -> Any:
        if not isinstance(value, kind):
            raise FormatError(f"{where}: expected {expected}, got {shown(value)}")
        return value

    return parse


_text, _object = _of_type(str, "text"), _of_type(dict, "an object")


def _one_of(*allowed: str) -> Parser:
    def parse(where: str, value: object) -> str:
        if value not in allowed:
            raise FormatError(f"{where}: expected one of {list(allowed)}, got {shown(value)}")
        return str(value)

    return parse


def _integer(low: int, high: int) -> Parser:
    def parse(where: str, value: object) -> int:
        if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
            raise FormatError(f"{where}: expected an integer in {low}..{high}, got {shown(value)}")
        return int(value)

    return parse


def _number(low: float, high: float) -> Parser:
    def parse(where: str, value: object) -> float:
        if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
            raise FormatError(f"{where}: expected a number in {low:g}..{high:g}, got {shown(value)}")
        return float(value)

    return parse


def _list(of: str, item: Parser, least: int, most: int | None = None) -> Parser:
    """Make the parser of a list of `least` to `most` items, or exactly `least`; messages call it by their
    number and `of`."""
    most = most or least
    expected = f"{least} {of}" if most == least else f"{least} to {most} {of}"

    def parse(where: str, value: object) -> tuple[Any, ...]:
        if not isinstance(value, list | tuple) or not least <= len(value) <= most:
            raise FormatError(f"{where}: expected {expected}, got {shown(value)}")
        return tuple(item(where, each) for each in value)

    return parse


def _integers(count: int, low: int, high: int) -> Parser:
    return _list("integers", _integer(low, high), count)


def _steps_of_levels(most: int) -> Parser:
    return _list("integers", _integer(1, most), 1, MAX_LEVELS)


def _numbers(count: int, low: float = -1e9, high: float = 1e9) -> Parser:
    return _list("numbers", _number(low, high), count)


def _matrix(rows: int, columns: int) -> Parser:
    return _list(f"rows of {columns} numbers", _numbers(columns), rows)


def _similarity(where: str, value: object) -> tuple[Vector, ...]:
    matrix = _matrix(4, 4)(where, value)
    columns = [[matrix[i][j] for i in range(3)] for j in range(3)]
    gram = [[sum(a * b for a, b in zip(u, v, strict=True)) for v in columns] for u in columns]
    (a, d, g), (b, e, h), (c, f, i) = columns
    scale = gram[0][0]
    is_similarity = (
        scale > 0
        and all(
            abs(gram[p][q] - (scale if p == q else 0)) <= 1e-4 * scale for p in range(3) for q in range(3)
        )
        and a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g) > 0
        and matrix[3] == (0, 0, 0, 1)
    )
    if not is_similarity:
        raise FormatError(f"{where}: expected a rotation, one scale and a translation, got {shown(value)}")
    return matrix


def _files(where: str, value: object) -> dict[str, FileEntry]:
    entries = {}
    for name, entry in _object(where, value).items():
        if (
            not isinstance(name, str)
            or not re.fullmatch(r"[A-Za-z0-9_-][A-Za-z0-9_.-]{0,199}", name)
            or name == NAME
        ):
            raise FormatError(f"{where}: expected plain file names, got {shown(name)}")
        if isinstance(entry, FileEntry):
            entry = {"bytes": entry.bytes, "sha256": entry.sha256}
        if not isinstance(entry, dict) or not {"bytes", "sha256"} <= set(entry):
            raise FormatError(f"{where}: {name}: expected bytes and sha256, got {shown(entry)}")
        size = _integer(0, 1 << 50)(f"{where}: {name}: bytes", entry["bytes"])
        digest = _text(f"{where}: {name}: sha256", entry["sha256"])
        if not re.fullmatch(r"[0-9a-f]{64}", digest):
            raise FormatError(f"{where}: {name}: sha256: expected 64 hexadecimal digits, got {shown(digest)}")
        entries[name] = FileEntry(size, digest)
    return entries


def _check_together(manifest: Manifest) -> None:
    low, high = manifest.aabb
    if not all(a < b for a, b in zip(low, high, strict=True)):
        raise FormatError(f"manifest: aabb: expected lower corner below upper, got {manifest.aabb}")
    if any(max(-a, b) > MAX_EDGES * (b - a) for a, b in zip(low, high, strict=True)):
        raise FormatError(
            f"manifest: aabb: expected coordinates up to {MAX_EDGES} times the edge along their axis, "
            f"got {manifest.aabb}"
        )
    if not manifest.density_range[0] < manifest.density_range[1]:
        raise FormatError(f"manifest: density_range: expected low < high, got {manifest.density_range}")
    if manifest.contracted and manifest.aabb != CONTRACTED_AABB:
        raise FormatError(f"manifest: aabb: expected {CONTRACTED_AABB} where contracted, got {manifest.aabb}")
    if manifest.near and not manifest.contracted:
        raise FormatError(f"manifest: near: expected 0 unless contracted, got {manifest.near}")
    if math.dist(low, high) > MAX_STEPS * manifest.step:
        raise FormatError(
            f"manifest: step: expected at most {MAX_STEPS} steps along the diagonal, got {manifest.step}"
        )
    steps = manifest.level_steps
    if len(steps) != len(manifest.density_steps):
        raise FormatError(
            f"manifest: level_steps: expected {len(manifest.density_steps)}, as many as density_steps, got "
            f"{len(steps)}"
        )
    if any(n & (n - 1) for n in steps) or sorted(steps) != list(steps):
        raise FormatError(
            f"manifest: level_steps: expected powers of two that do not fall, got {list(steps)}"
        )
    if manifest.contracted and not steps[-1] * manifest.step < math.pi:
        raise FormatError(
            "manifest: level_steps: expected less than pi in all where contracted, "
            f"got {steps[-1]} steps of {manifest.step}"
        )
    next(manifest.parts_in_order(), None)  # without the first part there is no picture


_PARSERS: dict[str, Parser] = {
    "version": _parse_version,
    "generator": _text,
    "resolution": _integer(1, MAX_RESOLUTION),
    "feature_resolution": _integer(1, MAX_RESOLUTION),
    "aabb": _matrix(2, 3),
    "world_from_model": _similarity,
    "step": _number(1e-9, 1e9),
    "contracted": _of_type(bool, "true or false"),
    "near": _number(0, 1e6),
    "level_steps": _steps_of_levels(MAX_LEVEL_STEP),
    "n_fetches": _integer(0, 1024),
    "density_range": _numbers(2, -80, 80),
    "density_steps": _steps_of_levels(255),
    "n_channels": _integer(1, MAX_CHANNELS),
    "feature_steps": _steps_of_levels(255),
    "agreement": _numbers(2, 0, 255),
    "quality_fetches": _integers(2, 0, 1024),
    "background": _numbers(3, 0, 1),
    "colour_space": _one_of("srgb"),
    "view_size": _integers(2, 1, 1 << 20),
    "parts": parse_parts,
    "files": _files,
    "provenance": _object,
}
