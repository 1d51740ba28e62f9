"""Does a written mesh hold what it was written from? Every number is read from the bytes and compared, before
any rename.
"""

from __future__ import annotations

import io
from typing import NamedTuple

import numpy as np

from exporters.formats.glb import parse_glb, y_up
from exporters.formats.npz import parse_npz
from exporters.formats.ply import parse_ply
from exporters.formats.points import parse_points
from exporters.formats.stl import parse_stl
from exporters.formats.usd import parse_usd
from exporters.formats.vdb import VdbGrid, colour_voxels, parse_vdb
from exporters.mesh.paint import Texture
from exporters.shapes.colour import linear_from_srgb
from exporters.shapes.mesh import TriangleMesh
from exporters.shapes.volume import Volume
from player.errors import ParityError


class _Arrays(NamedTuple):
    """What a file holds, in the file's own axes."""

    vertices: np.ndarray
    normals: np.ndarray
    colours: np.ndarray
    """[n, 3 or 4], 0..1: sRGB, in GLB and USD linear."""
    faces: np.ndarray


COLOUR_TOLERANCE = {".ply": 0.0, ".obj": 6e-5, ".glb": 8e-6, ".usdc": 6e-8, ".usda": 6e-8}
"""Half a step of what the format writes: bytes, four decimals, 16 bits, float32."""


def check_mesh_bytes(suffix: str, data: bytes, mesh: TriangleMesh, where: str) -> None:
    """Raises ParityError if `data`, the content of a `suffix` (.ply, .obj, .glb, .stl, .usdc, .usda) file,
    does not hold `mesh`: counts, places, normals, colours, faces; of an STL, which has no vertices, the
    corners.

    Places may differ by what the format rounds: float32 for PLY, GLB, STL and USD, nine digits for OBJ. The
    message names the worst.
    """
    if suffix == ".stl":
        corners = parse_stl(data, where)["corners"].reshape(-1, 3)
        _check_rows(where, "corners", mesh.vertices[mesh.faces].reshape(-1, 3), corners, _rounding(mesh))
        return
    readers = {".ply": _ply, ".obj": _obj, ".glb": _glb, ".usdc": _usdc, ".usda": _usda}
    got = readers[suffix](data, where)
    n_colours = got.colours.shape[1]
    colours = mesh.colours[:, :n_colours] / 255
    vertices, normals = mesh.vertices, mesh.normals
    if suffix == ".glb":
        vertices, normals = y_up(vertices), y_up(normals)
    if suffix in (".glb", ".usdc", ".usda"):
        colours[:, :3] = linear_from_srgb(colours[:, :3])
    if len(mesh.faces) != len(got.faces):
        raise ParityError(f"{where}: faces: expected {len(mesh.faces)}, got {len(got.faces)}")
    _check_rows(where, "vertices", vertices, got.vertices, _rounding(mesh))
    _check_rows(where, "normals", normals, got.normals, 1e-6)
    _check_rows(where, "colours", colours, got.colours, COLOUR_TOLERANCE[suffix])
    _check_rows(where, "faces", mesh.faces, got.faces, 0.0)


def check_textured_glb(data: bytes, mesh: TriangleMesh, texture: Texture, where: str) -> None:
    """Raises ParityError if `data` does not hold `mesh` and `texture`: places, normals, faces, places in the
    picture, every texel."""
    document, buffer = parse_glb(data, where)
    names = document["meshes"][0]["primitives"][0]["attributes"]
    if "COLOR_0" in names:
        raise ParityError(f"{where}: COLOR_0: expected none beside a texture, got one")
    uvs = _accessor(document, buffer, names["TEXCOORD_0"], "<f4", 2)
    view = document["bufferViews"][document["images"][0]["bufferView"]]
    picture = buffer[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
    _check_textured(
        where,
        (y_up(mesh.vertices), y_up(mesh.normals), mesh.faces, texture),
        (*_glb_places(document, buffer, where), uvs, picture),
        _rounding(mesh),
        0.0,
    )


def check_textured_obj(files: dict[str, bytes], mesh: TriangleMesh, texture: Texture, where: str) -> None:
    """Raises ParityError if the `.obj`, `.mtl` and `.png` in `files` do not hold `mesh` and `texture`."""
    data = files[".obj"]
    vertices, normals, faces, uvs = _textured_obj(data, where)
    named = [line[7:] for line in files[".mtl"].decode().splitlines() if line.startswith("map_Kd ")]
    stem = data[data.index(b"mtllib ") + 7 : data.index(b".mtl")].decode()
    if named != [f"{stem}.png"]:
        raise ParityError(f"{where}: map_Kd: expected {stem}.png, got {named}")
    uvs[:, 1] = 1 - uvs[:, 1]
    _check_textured(
        where,
        (mesh.vertices, mesh.normals, mesh.faces, texture),
        (vertices, normals, faces, uvs, files[".png"]),
        _rounding(mesh),
        1e-7,
    )


def check_points_bytes(data: bytes, cloud: TriangleMesh, where: str) -> None:
    """Raises ParityError if `data`, the content of a point cloud's PLY, holds other points than `cloud`."""
    points = parse_points(data, where)
    _check_rows(where, "points", cloud.vertices, points["position"], _rounding(cloud))
    _check_rows(where, "normals", cloud.normals, points["normal"], 1e-6)
    _check_rows(where, "colours", cloud.colours, points["colour"], 0.0)


def check_volume_bytes(suffix: str, data: bytes, volume: Volume, where: str) -> None:
    """Raises ParityError if `data`, the content of a `suffix` (.vdb, .npz) file, holds another volume: every
    vertex, density, colour and the matrix are compared, exactly but for linear colours in float32."""
    colours, light = volume.colours, None
    if suffix == ".npz":
        got = parse_npz(data, where)
        index, density, matrix, found = got.index, got.density[:, None], got.matrix, got.colours
    else:
        grids = parse_vdb(data, where)
        index, density, matrix = grids["density"]
        light = grids.get("color")
        found = None if light is None else light.values
    order, rows = _sorted(volume.index), _sorted(index)
    _check_rows(where, "matrix", volume.matrix, matrix, 0.0)
    _check_rows(where, "vertices", volume.index[order], index[rows], 0.0)
    _check_rows(where, "density", volume.density[order, None], density[rows], 0.0)
    if (colours is None) != (found is None):
        raise ParityError(f"{where}: colours: expected {'some' if found is None else 'none'}, got the other")
    if colours is not None and found is not None:
        if light is not None:
            _check_colour_grid(where, volume, colours, light)
        else:
            _check_rows(where, "colours", colours[order], found[rows], 0.0)


def _check_colour_grid(where: str, volume: Volume, colours: np.ndarray, got: VdbGrid) -> None:
    index, linear = colour_voxels(volume.index, colours)
    rows = _sorted(got.index)
    _check_rows(where, "color: matrix", volume.matrix, got.matrix, 0.0)
    _check_rows(where, "color: vertices", index, got.index[rows], 0.0)
    _check_rows(where, "colours", linear, got.values[rows], 6e-8)


def _sorted(index: np.ndarray) -> np.ndarray:
    x, y, z = index.T.astype(np.int64)
    return np.argsort((x << 40) | (y << 20) | z, kind="stable")


def _rounding(mesh: TriangleMesh) -> float:
    """What float32, and nine digits, may move the largest coordinate."""
    return 2e-7 * max(float(np.abs(mesh.vertices).max(initial=0)), 1e-30)


def _check_rows(where: str, what: str, expected: np.ndarray, got: np.ndarray, tolerance: float) -> None:
    if expected.shape != got.shape:
        raise ParityError(f"{where}: {what}: expected {len(expected)}, got {len(got)}")
    apart = np.abs(expected - got.astype(np.float64)).max(axis=-1, initial=0)
    if not (apart <= tolerance).all():
        row = int(np.argmax(np.where(np.isnan(apart), np.inf, apart)))
        raise ParityError(
            f"{where}: {what}: number {row}: expected {expected[row].tolist()}, got {got[row].tolist()}: "
            f"{apart[row]:g} apart, tolerance {tolerance:g}"
        )


def _ply(data: bytes, where: str) -> _Arrays:
    mesh = parse_ply(data, where)
    return _Arrays(mesh.vertices, mesh.normals, mesh.colours / 255, mesh.faces)


def _obj(data: bytes, where: str) -> _Arrays:
    first, normals, faces = (data.find(start) for start in (b"\nv ", b"\nvn ", b"\nf "))
    end = len(data)
    faces = faces if faces >= 0 else end
    normals = normals if normals >= 0 else faces
    first = first if first >= 0 else normals

    def numbers(part: bytes, letters: list[bytes], width: int) -> np.ndarray:
        for letter in letters:
            part = part.replace(letter, b" ")
        return np.fromstring(part.decode(), sep=" ").reshape(-1, width)

    rows = numbers(data[first:normals], [b"v"], 6)
    corners = numbers(data[faces:], [b"f", b"//"], 6)
    if not np.array_equal(corners[:, ::2], corners[:, 1::2]):
        raise ParityError(f"{where}: faces: expected the normals of their vertices, got others")
    turned = numbers(data[normals:faces], [b"vn"], 3)
    return _Arrays(rows[:, :3], turned, rows[:, 3:], corners[:, ::2].astype(np.int64) - 1)


def _glb(data: bytes, where: str) -> _Arrays:
    document, buffer = parse_glb(data, where)
    vertices, normals, faces = _glb_places(document, buffer, where)
    names = document["meshes"][0]["primitives"][0]["attributes"]
    return _Arrays(vertices, normals, _accessor(document, buffer, names["COLOR_0"], "<u2", 4) / 65535, faces)


def _glb_places(document: dict, buffer: bytes, where: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    primitive = document["meshes"][0]["primitives"][0]
    names = primitive["attributes"]
    vertices = _accessor(document, buffer, names["POSITION"], "<f4", 3)
    position = document["accessors"][names["POSITION"]]
    if [vertices.min(0).tolist(), vertices.max(0).tolist()] != [position["min"], position["max"]]:
        raise ParityError(f"{where}: POSITION: min and max: expected those of its numbers, got {position}")
    faces = _accessor(document, buffer, primitive["indices"], "<u4", 3)
    return vertices, _accessor(document, buffer, names["NORMAL"], "<f4", 3), faces


def _accessor(document: dict, buffer: bytes, index: int, kind: str, width: int) -> np.ndarray:
    accessor = document["accessors"][index]
    start = document["bufferViews"][accessor["bufferView"]]["byteOffset"]
    count = accessor["count"] * (1 if accessor["type"] == "SCALAR" else width)
    return np.frombuffer(buffer, kind, count, start).reshape(-1, width)


def _textured_obj(data: bytes, where: str) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Vertices, normals, faces and places in the picture of what `textured_obj_files` writes."""
    starts = [data.find(word) for word in (b"\nv ", b"\nvt ", b"\nvn ", b"\nf ")]
    if min(starts) < 0 or starts != sorted(starts):
        raise ParityError(f"{where}: expected v, vt, vn and f in this order, got {starts}")

    def numbers(part: bytes, letter: bytes, width: int) -> np.ndarray:
        return np.fromstring(part.replace(letter, b" ").replace(b"/", b" ").decode(), sep=" ").reshape(
            -1, width
        )

    first, places, turned, faces = starts
    corners = numbers(data[faces:], b"f", 9)
    if not (
        np.array_equal(corners[:, ::3], corners[:, 1::3])
        and np.array_equal(corners[:, ::3], corners[:, 2::3])
    ):
        raise ParityError(f"{where}: faces: expected the normals and places of their vertices, got others")
    return (
        numbers(data[first:places], b"v", 3),
        numbers(data[turned:faces], b"vn", 3),
        corners[:, ::3].astype(np.int64) - 1,
        numbers(data[places:turned], b"vt", 2),
    )


def _check_textured(
    where: str,
    expected: tuple[np.ndarray, np.ndarray, np.ndarray, Texture],
    got: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, bytes],
    rounding: float,
    uv_tolerance: float,
) -> None:
    vertices, normals, faces, texture = expected
    _check_rows(where, "vertices", vertices, got[0], rounding)
    _check_rows(where, "normals", normals, got[1], 1e-6)
    _check_rows(where, "faces", faces, got[2], 0.0)
    _check_rows(where, "places in the picture", texture.uvs.astype(np.float64), got[3], uv_tolerance)
    from PIL import Image

    image = np.asarray(Image.open(io.BytesIO(got[4])))
    if image.shape != texture.image.shape:
        raise ParityError(f"{where}: picture: expected {texture.image.shape}, got {image.shape}")
    _check_rows(where, "texels", texture.image.reshape(-1, 3), image.reshape(-1, 3), 0.0)


def _usdc(data: bytes, where: str) -> _Arrays:
    return _usd(data, ".usdc", where)


def _usda(data: bytes, where: str) -> _Arrays:
    return _usd(data, ".usda", where)


def _usd(data: bytes, suffix: str, where: str) -> _Arrays:
    found = parse_usd(data, suffix, where)
    return _Arrays(*(found[name] for name in _Arrays._fields))
