"""Checks that a written file holds what it was written from. Every number is read back from the bytes and
compared before the file gets its name. Another check refuses meshes that float32 cannot hold."""

from __future__ import annotations

import io
from typing import Any

import numpy as np

from exporters.formats.glb import glb_content, y_up
from exporters.formats.npz import parse_npz
from exporters.formats.obj import n_decimals, parse_obj
from exporters.formats.ply import parse_ply
from exporters.formats.points import parse_points
from exporters.formats.stl import parse_stl
from exporters.formats.usd import parse_usd
from exporters.formats.vdb import VdbGrid, colour_voxels, parse_vdb
from exporters.shapes.colour import linear_from_srgb
from exporters.shapes.mesh import TriangleMesh
from exporters.shapes.texture import Texture
from exporters.shapes.volume import Volume
from player.asset.bricks import keys_of
from player.errors import ConfigError, ParityError

COLOUR_TOLERANCE = {".ply": 0.0, ".obj": 6e-5, ".glb": 8e-6, ".usdc": 6e-8, ".usda": 6e-8}
"""Largest difference of a colour, by suffix: half a quantization step of four decimals, 16 bits or float32;
none for the bytes of a PLY."""
UV_TOLERANCE = {".obj": 1e-7, ".glb": 0.0}
"""Largest difference of a place in a picture, by suffix: one step of seven decimals for
OBJ; none for GLB's float32."""
LINEAR_TOLERANCE = 6e-8
"""Largest difference of linear light: half a quantization step in float32."""
COARSEST = 0.1
"""Largest step of float32 between two coordinates that is allowed, in median edges of the mesh, or in voxels
for pictures."""


def check_steps(mesh: TriangleMesh, where: str, hint: str) -> None:
    """Raise ConfigError if the mesh is so far from the origin that float32 would deform it: if the step from
    its largest coordinate to the next number is over COARSEST of its median edge.

    Args:
        mesh: in the coordinates of the file.
        where: the file's name in the error message.
        hint: what to do about it, the end of the message.
    """
    if not len(mesh.faces):
        return
    largest = float(np.abs(mesh.vertices).max())
    step = float(np.spacing(np.float32(largest)))
    edges = mesh.vertices[mesh.faces[:, 1]] - mesh.vertices[mesh.faces[:, 0]]  # one of each face
    edge = float(np.median(np.linalg.norm(edges, axis=1)))
    if step > COARSEST * edge:
        raise ConfigError(
            f"{where}: vertices: expected steps of float32 of at most {COARSEST:g} times the median edge, "
            f"{edge:.3g}, got {step:.3g} at {largest:.8g}, which is too far from the origin: {hint}"
        )


def check_mesh_bytes(
    suffix: str, data: bytes, mesh: TriangleMesh, where: str, texture: Texture | None = None
) -> None:
    """Raise ParityError if `data`, the content of a `suffix` (.ply, .obj, .glb, .stl, .usdc, .usda) file,
    does not hold `mesh`.

    Compared are counts, places, normals and faces, and the colours or else the places in the picture; for a
    GLB also every texel. An STL has no vertices, so only the corners of its faces are compared. Places may
    differ by what the format rounds: float32 for PLY, GLB, STL and USD, the last decimal for OBJ. The message
    names the largest difference.
    """
    if suffix == ".stl":
        corners = parse_stl(data, where)["corners"].reshape(-1, 3)
        _check_rows(where, "corners", mesh.vertices[mesh.faces].reshape(-1, 3), corners, _rounding(mesh))
        return
    found = _content(suffix, data, where)
    is_glb = suffix == ".glb"
    vertices, normals = (y_up(a) if is_glb else a for a in (mesh.vertices, mesh.normals))
    tolerance = _last_decimal(mesh) if suffix == ".obj" else _rounding(mesh)
    _check_rows(where, "vertices", vertices, found["vertices"], tolerance)
    _check_rows(where, "normals", normals, found["normals"], 1e-6)
    _check_rows(where, "faces", mesh.faces, found["faces"], 0.0)
    if texture is None:
        colours = mesh.colours[:, : found["colours"].shape[1]] / 255
        if suffix in (".glb", ".usdc", ".usda"):
            colours[:, :3] = linear_from_srgb(colours[:, :3])
        _check_rows(where, "colours", colours, found["colours"], COLOUR_TOLERANCE[suffix])
        return
    if "colours" in found:
        raise ParityError(f"{where}: colours: expected none beside a texture, got some")
    uvs = texture.uvs.astype(np.float64)
    _check_rows(where, "places in the picture", uvs, found["uvs"], UV_TOLERANCE[suffix])
    if is_glb:
        _check_picture(where, texture, found["picture"])


def check_textured_obj(files: dict[str, bytes], mesh: TriangleMesh, texture: Texture, where: str) -> None:
    """Raise ParityError if the `.obj`, `.mtl` and `.png` in `files` do not hold `mesh` and `texture`."""
    data = files[".obj"]
    named = [line[7:] for line in files[".mtl"].decode().splitlines() if line.startswith("map_Kd ")]
    start = data.index(b"mtllib ") + 7
    stem = data[start : data.index(b"\n", start)].decode().removesuffix(".mtl")
    if named != [f"{stem}.png"]:
        raise ParityError(f"{where}: map_Kd: expected {stem}.png, got {named}")
    check_mesh_bytes(".obj", data, mesh, where, texture)
    _check_picture(where, texture, files[".png"])


def check_points_bytes(data: bytes, cloud: TriangleMesh, where: str) -> None:
    """Raise ParityError if `data`, the content of a point cloud's PLY, holds other points than `cloud`."""
    points = parse_points(data, where)
    _check_rows(where, "points", cloud.vertices, points["position"], _rounding(cloud))
    _check_rows(where, "normals", cloud.normals, points["normal"], 1e-6)
    _check_rows(where, "colours", cloud.colours, points["colour"], 0.0)


def check_volume_bytes(suffix: str, data: bytes, volume: Volume, where: str) -> None:
    """Raise ParityError if `data`, the content of a `suffix` (.vdb, .npz) file, holds another volume. Every
    vertex, density, colour and the matrix are compared, exactly but for linear colours in float32."""
    is_vdb = suffix == ".vdb"
    expected = _grids(volume, is_vdb)
    got = parse_vdb(data, where) if is_vdb else _grids(parse_npz(data, where), is_vdb)
    if set(expected) != set(got):
        raise ParityError(f"{where}: grids: expected {sorted(expected)}, got {sorted(got)}")
    for name, grid in expected.items():
        tolerance = LINEAR_TOLERANCE if is_vdb and name == "color" else 0.0
        _check_grid(where, name, grid, got[name], tolerance)


def _grids(volume: Volume, is_vdb: bool) -> dict[str, VdbGrid]:
    """Return the grids of a volume, by the names that a VDB gives them; in one, colours are linear light."""
    grids = {"density": VdbGrid(volume.index, volume.density[:, None], volume.matrix)}
    if volume.colours is not None:
        voxels = colour_voxels(volume.index, volume.colours) if is_vdb else (volume.index, volume.colours)
        grids["color"] = VdbGrid(*voxels, volume.matrix)
    return grids


def _check_grid(where: str, what: str, expected: VdbGrid, got: VdbGrid, tolerance: float) -> None:
    """Raise ParityError unless two grids agree, in whichever order their vertices are."""
    order, rows = (np.argsort(keys_of(grid.index), kind="stable") for grid in (expected, got))
    _check_rows(where, "matrix", expected.matrix, got.matrix, 0.0)
    _check_rows(where, "vertices", expected.index[order], got.index[rows], 0.0)
    _check_rows(where, what, expected.values[order], got.values[rows], tolerance)


def _rounding(mesh: TriangleMesh) -> float:
    """Return how far rounding to float32 may move the largest coordinate."""
    return 2e-7 * max(float(np.abs(mesh.vertices).max(initial=0)), 1e-30)


def _last_decimal(mesh: TriangleMesh) -> float:
    """Return how far an OBJ may move a coordinate: by half its last decimal, and by what float64 rounds."""
    return 0.5 * 10.0 ** -n_decimals(mesh) + 2 * float(np.spacing(np.abs(mesh.vertices).max(initial=0.0)))


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


def _check_picture(where: str, texture: Texture, png: bytes) -> None:
    from PIL import Image

    image = np.asarray(Image.open(io.BytesIO(png)))
    if image.shape != texture.image.shape:
        raise ParityError(f"{where}: picture: expected {texture.image.shape}, got {image.shape}")
    if not np.array_equal(image, texture.image):  # as bytes, because differences in float64 take much memory
        _check_rows(where, "texels", texture.image.reshape(-1, 3), image.reshape(-1, 3), 0.0)


def _content(suffix: str, data: bytes, where: str) -> dict[str, Any]:
    """Return the arrays in a file, in its own axes: `vertices`, `normals` [n, 3], `faces` [m, 3],
    and either `colours` [n, 3 or 4] in 0..1, linear in GLB and USD and else sRGB, or `uvs` [n, 2],
    origin at the upper left."""
    if suffix == ".obj":
        return parse_obj(data, where)
    if suffix == ".glb":
        return glb_content(data, where)
    if suffix == ".ply":
        mesh = parse_ply(data, where)
        return {**vars(mesh), "colours": mesh.colours / 255}
    return parse_usd(data, suffix, where)
