"""GLB, binary glTF 2.0: the file that engines, Blender and web viewers open with its colours.

glTF is Y up and in metres: a mesh given Z up is turned by (x, y, z) -> (x, z, -y). COLOR_0 is LINEAR light by
the specification (sRGB bytes there look washed out). It is stored as normalised 16-bit numbers, because 8
bits would show bands in the dark. With a texture, the colours are its texels alone, a PNG inside the file,
which the specification takes as sRGB; a COLOR_0 beside it would be multiplied with it, and is left out. The
scene's lighting is already in the colours, so the material is unlit (KHR_materials_unlit), double sided, and,
for viewers without that extension, not metallic and fully rough.
"""

from __future__ import annotations

import json
import struct
from typing import Any

import numpy as np

from exporters.shapes.colour import linear_from_srgb
from exporters.shapes.mesh import TriangleMesh
from exporters.shapes.texture import Texture
from player.errors import ConfigError, FormatError, ParityError

_FLOAT, _USHORT, _UINT = 5126, 5123, 5125
_ARRAY_BUFFER, _ELEMENT_ARRAY_BUFFER = 34962, 34963


def glb_bytes(mesh: TriangleMesh, texture: Texture | None = None) -> bytes:
    """Return the file's content, Y up, for a mesh that is Z up; with a texture in place of vertex colours if
    one is given. The same mesh gives the same bytes.

    Raises ConfigError for a mesh without faces (glTF has no empty accessors) or one of 4 GiB and more.
    """
    if not len(mesh.faces):
        raise ConfigError("GLB: mesh: expected at least one face, got none")
    positions = y_up(mesh.vertices).astype("<f4")
    normals = y_up(mesh.normals).astype("<f4")
    arrays = [(positions, _FLOAT, "VEC3", _ARRAY_BUFFER), (normals, _FLOAT, "VEC3", _ARRAY_BUFFER)]
    if texture is None:
        colours = mesh.colours / 255
        colours[:, :3] = linear_from_srgb(colours[:, :3])
        arrays.append((np.rint(colours * 65535).astype("<u2"), _USHORT, "VEC4", _ARRAY_BUFFER))
    else:
        arrays.append((texture.uvs.astype("<f4"), _FLOAT, "VEC2", _ARRAY_BUFFER))
    arrays.append((mesh.faces.astype("<u4").reshape(-1), _UINT, "SCALAR", _ELEMENT_ARRAY_BUFFER))
    accessors, views, offset = [], [], 0
    for index, (array, component, kind, target) in enumerate(arrays):
        views.append({"buffer": 0, "byteOffset": offset, "byteLength": array.nbytes, "target": target})
        accessors.append({"bufferView": index, "componentType": component, "count": len(array), "type": kind})
        offset += array.nbytes  # every array is a multiple of 4 bytes long
    accessors[0] |= {"min": positions.min(0).tolist(), "max": positions.max(0).tolist()}
    picture = b""
    if texture is None:
        accessors[2] |= {"normalized": True}
    else:
        picture = texture.png()
        views.append({"buffer": 0, "byteOffset": offset, "byteLength": len(picture)})
        picture += b"\0" * (-len(picture) % 4)
        offset += len(picture)
    colour = "COLOR_0" if texture is None else "TEXCOORD_0"
    primitive = {
        "attributes": {"POSITION": 0, "NORMAL": 1, colour: 2},
        "indices": 3,
        "material": 0,
        "mode": 4,
    }
    material: dict[str, Any] = {
        "doubleSided": True,
        "extensions": {"KHR_materials_unlit": {}},
        "pbrMetallicRoughness": {"metallicFactor": 0, "roughnessFactor": 1},
    }
    document: dict[str, Any] = {
        "asset": {"generator": "vfr-bake", "version": "2.0"},
        "extensionsUsed": ["KHR_materials_unlit"],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": "mesh"}],
        "meshes": [{"primitives": [primitive]}],
        "materials": [material],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": offset}],
    }
    if texture is not None:
        material["pbrMetallicRoughness"]["baseColorTexture"] = {"index": 0}
        document["textures"] = [{"source": 0, "sampler": 0}]
        document["images"] = [{"bufferView": len(views) - 1, "mimeType": "image/png"}]
        document["samplers"] = [{"magFilter": 9729, "minFilter": 9987, "wrapS": 33071, "wrapT": 33071}]
    text = json.dumps(document, separators=(",", ":"), allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    total = 12 + 8 + len(text) + 8 + offset
    if total >= 1 << 32:
        raise ConfigError(f"GLB: mesh: expected less than 4 GiB, got {total} bytes")
    return b"".join(
        [
            struct.pack("<4sII", b"glTF", 2, total),
            struct.pack("<I4s", len(text), b"JSON"),
            text,
            struct.pack("<I4s", offset, b"BIN\0"),
            *(array.tobytes() for array, *_ in arrays),
            picture,
        ]
    )


def y_up(vectors: np.ndarray) -> np.ndarray:
    """Return vectors [n, 3] of a Z-up world as those of a Y-up world: a quarter turn about x.

    >>> y_up(np.array([[1.0, 2.0, 3.0]])).tolist()
    [[1.0, 3.0, -2.0]]
    """
    return np.stack([vectors[:, 0], vectors[:, 2], -vectors[:, 1]], axis=-1)


def parse_glb(data: bytes, where: str) -> tuple[dict, bytes]:
    """Return the JSON document and the buffer of a file that `glb_bytes` wrote; raise FormatError if the
    chunks do not fill the file."""
    magic, version, total = struct.unpack_from("<4sII", data)
    if (magic, version, total) != (b"glTF", 2, len(data)):
        raise FormatError(
            f"{where}: header: expected glTF 2 of {len(data)} bytes, got {magic!r} {version} of {total}"
        )
    n_text, kind = struct.unpack_from("<I4s", data, 12)
    n_buffer, buffer_kind = struct.unpack_from("<I4s", data, 20 + n_text)
    if (kind, buffer_kind) != (b"JSON", b"BIN\0") or 28 + n_text + n_buffer != len(data):
        raise FormatError(
            f"{where}: chunks: expected JSON and BIN that fill the file, got {kind!r}, {buffer_kind!r}"
        )
    return json.loads(data[20 : 20 + n_text]), data[28 + n_text :]


def glb_content(data: bytes, where: str) -> dict[str, Any]:
    """Return the arrays in a file that `glb_bytes` wrote, Y up.

    Returns:
        `vertices`, `normals` [n, 3], `faces` [m, 3], and `colours` [n, 4] linear, 0..1, or, for a mesh with a
        texture, `uvs` [n, 2], origin at the upper left, and `picture`, the bytes of a PNG file.

    Raises:
        FormatError: as `parse_glb`.
        ParityError: the smallest and largest coordinates that the file states are not those of its vertices.
    """
    document, buffer = parse_glb(data, where)
    primitive = document["meshes"][0]["primitives"][0]
    names = primitive["attributes"]

    def array(index: int, kind: str, width: int) -> np.ndarray:
        accessor = document["accessors"][index]
        start = document["bufferViews"][accessor["bufferView"]]["byteOffset"]
        count = accessor["count"] * (1 if accessor["type"] == "SCALAR" else width)
        return np.frombuffer(buffer, kind, count, start).reshape(-1, width)

    found: dict[str, Any] = {
        "vertices": array(names["POSITION"], "<f4", 3),
        "normals": array(names["NORMAL"], "<f4", 3),
        "faces": array(primitive["indices"], "<u4", 3),
    }
    if "COLOR_0" in names:
        found["colours"] = array(names["COLOR_0"], "<u2", 4) / 65535
    if "TEXCOORD_0" in names:
        found["uvs"] = array(names["TEXCOORD_0"], "<f4", 2)
        view = document["bufferViews"][document["images"][0]["bufferView"]]
        found["picture"] = buffer[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
    position = document["accessors"][names["POSITION"]]
    bounds = [found["vertices"].min(0).tolist(), found["vertices"].max(0).tolist()]
    if bounds != [position["min"], position["max"]]:
        raise ParityError(f"{where}: POSITION: min and max: expected those of its numbers, got {position}")
    return found
