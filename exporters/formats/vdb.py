"""OpenVDB, the volume format of film software and Blender, written without the library.

OpenVDB has no wheel on PyPI, and the asset's bricks already have the layout of its leaf nodes: 8 x 8 x 8
values, x slowest, and a mask of 512 bits. So this module writes the format itself, version 224 (read by
OpenVDB 6.1 and later); the tests read the files with the library.

A file has a magic number, versions, a UUID, metadata, and then the grids. Each grid has a descriptor with
three offsets, its compression, metadata, the affine map, TOPOLOGY (root, one node of 32^3, nodes of 16^3,
leaves: masks of their children) and BUFFERS (the leaves' values). Only active values are stored
(COMPRESS_ACTIVE_MASK); all others are the background, 0.

Grids: `density` float, 1/unit of the frame, class "fog volume"; `color` vec3s, LINEAR light, as renderers
take it. Renderers interpolate both between voxels, so that the density falls to 0 over the voxel next to the
outermost one. `color` has values one voxel further than `density`, or else the colour would darken there.
"""

from __future__ import annotations

import hashlib
import struct
import uuid
from typing import NamedTuple

import numpy as np

from exporters.shapes.colour import linear_from_srgb
from exporters.shapes.volume import Volume
from player.asset.bricks import pack_vertices, unpack_vertices
from player.errors import ConfigError, FormatError

_MAGIC, _VERSION, _LIBRARY = 0x56444220, 224, (6, 2)
_ACTIVE_MASK = 2  # COMPRESS_ACTIVE_MASK
_REST_IS_BACKGROUND = b"\0"  # NO_MASK_OR_INACTIVE_VALS
_TYPES = {1: "Tree_float_5_4_3", 3: "Tree_vec3s_5_4_3"}
_ROOT_CHILD = 4096  # voxels along an edge of the one node below the root


class VdbGrid(NamedTuple):
    """A grid as a file stores it."""

    index: np.ndarray
    """[n, 3] int64, in the order of the file."""
    values: np.ndarray
    """[n, 1 or 3] float32."""
    matrix: np.ndarray
    """[4, 4] float64, world from index, for column vectors."""


def vdb_bytes(volume: Volume) -> bytes:
    """Return the file's content; the same volume gives the same bytes (the UUID is a checksum).

    Raises ConfigError for an empty volume, or one with a vertex index of 4096 or more.

    >>> volume = Volume(np.array([[1, 0, 2]], np.int32), np.ones(1, np.float32), None, np.eye(4))
    >>> list(parse_vdb(vdb_bytes(volume), "a.vdb"))
    ['density']
    """
    if not len(volume.index) or volume.index.max() >= _ROOT_CHILD:
        raise ConfigError(
            f"VDB: volume: expected 1 or more vertices with indices below {_ROOT_CHILD}, got "
            f"{len(volume.index)} up to {volume.index.max(initial=0)}"
        )
    grids = {"density": (volume.index, volume.density[:, None])}
    if volume.colours is not None:
        grids["color"] = colour_voxels(volume.index, volume.colours)
    metadata = _metadata({"generator": "vfr-bake"}) + struct.pack("<i", len(grids))
    body, at = [], 8 + 4 + 8 + 1 + 36 + len(metadata)
    for name, (index, values) in grids.items():
        coords, masks, order = pack_vertices(index)
        leaves = _depth_first(coords)
        rows = _in_order(values[order], masks, leaves)
        body.append(_grid(name, coords[leaves], masks[leaves], rows, volume, at))
        at += len(body[-1])
    content = metadata + b"".join(body)
    name = str(uuid.UUID(bytes=hashlib.sha256(content).digest()[:16], version=4)).encode()
    return struct.pack("<qIII?", _MAGIC, _VERSION, *_LIBRARY, True) + name + content


def colour_voxels(index: np.ndarray, colours: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the voxels of the grid `color`, those of a volume and all that touch
    one, and their linear light.

    A voxel that only touches one takes the mean of its neighbours along x; voxels that still have no colour
    then take it along y, and last along z.

    Args:
        index: [n, 3] integers, 0 to 4095, each once.
        colours: [n, 3] uint8 sRGB.

    Returns:
        index [m, 3] int32, sorted; colours [m, 3] float64, 0..1.

    >>> index, light = colour_voxels(np.array([[1, 0, 2]]), np.array([[255, 0, 0]], np.uint8))
    >>> len(index), index.min(axis=0).tolist(), index.max(axis=0).tolist(), light[0].tolist()
    (18, [0, 0, 1], [2, 1, 3], [1.0, 0.0, 0.0])
    """
    x, y, z = np.asarray(index).T.astype(np.int64)
    number = (x << 24) | (y << 12) | z
    order = np.argsort(number)
    number, light = number[order], linear_from_srgb(colours[order] / 255)
    for shift in (24, 12, 0):
        along = (number >> shift) & (_ROOT_CHILD - 1)
        lower, upper = along > 0, along < _ROOT_CHILD - 1
        beside = np.concatenate([number[lower] - (1 << shift), number[upper] + (1 << shift)])
        source = np.concatenate([np.flatnonzero(lower), np.flatnonzero(upper)])
        place = np.minimum(np.searchsorted(number, beside), len(number) - 1)
        fresh = number[place] != beside
        added, which, count = np.unique(beside[fresh], return_inverse=True, return_counts=True)
        total = np.stack([np.bincount(which, light[source[fresh], k], len(added)) for k in range(3)], axis=-1)
        number = np.concatenate([number, added])
        order = np.argsort(number)
        number, light = number[order], np.concatenate([light, total / count[:, None]])[order]
    axes = [(number >> shift) & (_ROOT_CHILD - 1) for shift in (24, 12, 0)]
    return np.stack(axes, axis=-1).astype(np.int32), light


def parse_vdb(data: bytes, where: str) -> dict[str, VdbGrid]:
    """Return the grids in a file that `vdb_bytes` made, by name.

    Raises FormatError for a file with another layout: this does not read VDB files in general.
    """
    try:
        return _parse(data)
    except (struct.error, ValueError, IndexError) as error:
        raise FormatError(f"{where}: expected a VDB as `vfr-export` writes it, got: {error}") from error


def _text(text: str) -> bytes:
    return struct.pack("<I", len(text.encode())) + text.encode()


def _metadata(entries: dict[str, str | float]) -> bytes:
    parts = [struct.pack("<I", len(entries))]
    for name, value in entries.items():
        if isinstance(value, str):
            parts += [_text(name), _text("string"), _text(value)]
        else:
            parts += [_text(name), _text("float"), struct.pack("<If", 4, value)]
    return b"".join(parts)


def _depth_first(coords: np.ndarray) -> np.ndarray:
    """Return the order of the leaves: by the node of 16^3 leaves that holds them, then within the node."""
    x, y, z = coords.T.astype(np.int64)
    within = ((x & 15) << 8) | ((y & 15) << 4) | (z & 15)
    return np.lexsort((within, _node(coords)))


def _node(coords: np.ndarray) -> np.ndarray:
    x, y, z = coords.T.astype(np.int64) >> 4
    return (x << 10) | (y << 5) | z


def _in_order(values: np.ndarray, masks: np.ndarray, leaves: np.ndarray) -> list[bytes]:
    """Return the bytes of each leaf's values, in the order of `leaves`."""
    counts = np.bitwise_count(masks).sum(axis=1, dtype=np.int64)
    stops = np.cumsum(counts)
    rows = np.ascontiguousarray(values, "<f4")
    return [rows[stops[k] - counts[k] : stops[k]].tobytes() for k in leaves.tolist()]


def _grid(
    name: str, coords: np.ndarray, masks: np.ndarray, values: list[bytes], volume: Volume, at: int
) -> bytes:
    """Return the descriptor and content of a grid that begins at byte `at` of the file."""
    width = 1 if name == "density" else 3
    header = _text(name) + _text(_TYPES[width]) + _text("")
    kind = {"class": "fog volume", "vfr.level": volume.level} if width == 1 else {"class": "unknown"}
    start = struct.pack("<I", _ACTIVE_MASK) + _metadata({"name": name, **kind})
    start += _text("AffineMap") + volume.matrix.T.astype("<f8").tobytes()  # OpenVDB has row vectors
    masks_le = np.ascontiguousarray(masks, "<u8")
    topology = start + _topology(coords, masks_le, width)
    buffers = b"".join(
        part
        for mask, leaf in zip(masks_le, values, strict=True)
        for part in (mask.tobytes(), _REST_IS_BACKGROUND, leaf)
    )
    first = at + len(header) + 24
    offsets = struct.pack("<qqq", first, first + len(topology), first + len(topology) + len(buffers))
    return header + offsets + topology + buffers


def _topology(coords: np.ndarray, masks: np.ndarray, width: int) -> bytes:
    nodes, first = np.unique(_node(coords), return_index=True)
    parts = [struct.pack("<I", 1), b"\0" * (4 * width), struct.pack("<II3i", 0, 1, 0, 0, 0)]
    parts.append(_inner(nodes, 32))
    x, y, z = (coords & 15).T.astype(np.int64)
    within = (x << 8) | (y << 4) | z
    for start, stop in zip(first, [*first[1:], len(coords)], strict=True):
        parts += [_inner(within[start:stop], 16), masks[start:stop].tobytes()]
    return b"".join(parts)


def _inner(children: np.ndarray, edge: int) -> bytes:
    """Return a node of `edge`^3 entries: the mask of its children, no active tile, no value."""
    has = np.zeros(edge**3, bool)
    has[children] = True
    return np.packbits(has, bitorder="little").tobytes() + b"\0" * (edge**3 // 8) + _REST_IS_BACKGROUND


def _parse(data: bytes) -> dict[str, VdbGrid]:
    magic, version, *_ = struct.unpack_from("<qIII?", data)
    if (magic, version) != (_MAGIC, _VERSION):
        raise ValueError(f"magic {magic:#x}, version {version}")
    file = _Reader(data, 57)
    file.skip_metadata()
    (n_grids,) = file.take("<i")
    widths = {kind: width for width, kind in _TYPES.items()}
    grids = {}
    for _ in range(n_grids):
        name, kind, _ = file.text(), file.text(), file.text()
        start, _, end = file.take("<qqq")
        if start != file.at:
            raise ValueError(f"grid {name} at byte {start}")
        grids[name] = _read_grid(file, widths.get(kind, 0))
        if file.at != end:
            raise ValueError(f"a grid that ends at byte {file.at}, not {end}")
    if file.at != len(data):
        raise ValueError(f"{len(data) - file.at} bytes after the last grid")
    return grids


def _read_grid(file: _Reader, width: int) -> VdbGrid:
    file.take("<I")
    file.skip_metadata()
    kind = file.text()
    if kind != "AffineMap" or not width:
        raise ValueError(f"map {kind}")
    matrix = file.array("<f8", 16).reshape(4, 4).T.copy()
    file.at += 4 + 4 * width + 8 + 12
    origins, masks = [], []
    for node in file.children(32):
        within = file.children(16)
        place = np.stack([within >> 8, (within >> 4) & 15, within & 15], axis=-1)
        origins.append(place + np.array([node >> 10, (node >> 5) & 31, node & 31]) * 16)
        masks.append(file.array("<u8", 8 * len(within)).reshape(-1, 8))
    stored = np.concatenate(masks)
    values = []
    for mask in stored:
        head = mask.tobytes() + _REST_IS_BACKGROUND
        if file.data[file.at : file.at + len(head)] != head:
            raise ValueError(f"a leaf at byte {file.at} with another mask")
        file.at += len(head)
        values.append(file.array("<f4", int(np.bitwise_count(mask).sum()) * width))
    index = unpack_vertices(np.concatenate(origins), stored)
    return VdbGrid(index, np.concatenate(values).reshape(-1, width), matrix)


class _Reader:
    """Reader of a file's bytes, one item after another."""

    def __init__(self, data: bytes, at: int) -> None:
        self.data = data
        self.at = at

    def take(self, form: str) -> tuple:
        values = struct.unpack_from(form, self.data, self.at)
        self.at += struct.calcsize(form)
        return values

    def array(self, kind: str, count: int) -> np.ndarray:
        values = np.frombuffer(self.data, kind, count, self.at)
        self.at += values.nbytes
        return values

    def text(self) -> str:
        (size,) = self.take("<I")
        self.at += size
        return self.data[self.at - size : self.at].decode()

    def skip_metadata(self) -> None:
        (count,) = self.take("<I")
        for _ in range(3 * count):  # name, type and value, each with its size in front
            (size,) = self.take("<I")
            self.at += size

    def children(self, edge: int) -> np.ndarray:
        """Read a node of `edge`^3 entries, as `_inner` writes it; return the numbers of its children."""
        has = np.unpackbits(self.array("u1", edge**3 // 8), bitorder="little")
        self.at += edge**3 // 8 + len(_REST_IS_BACKGROUND)
        return np.flatnonzero(has)
