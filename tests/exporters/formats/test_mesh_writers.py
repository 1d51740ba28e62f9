"""Tests of the PLY, OBJ and GLB writers: golden bytes, and what two other programs read in them."""

from __future__ import annotations

import io
import json
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from exporters.formats.glb import glb_bytes, parse_glb, y_up
from exporters.formats.obj import obj_bytes, parse_obj, textured_obj_files
from exporters.formats.parity import check_mesh_bytes, check_steps
from exporters.formats.ply import parse_ply, ply_bytes, small_ply_bytes, small_ply_size
from exporters.shapes.colour import linear_from_srgb
from exporters.shapes.mesh import TriangleMesh
from exporters.shapes.texture import Texture
from player.errors import ConfigError, FormatError, IntegrityError, ParityError
from tests.exporters.meshes import random_mesh, read_ply, sphere, tetrahedron

WRITERS = {".ply": ply_bytes, ".obj": obj_bytes, ".glb": glb_bytes}


def triangle() -> TriangleMesh:
    return TriangleMesh(
        np.array([[0.0, 0, 0], [1.5, 0, 0], [0, -2, 0.25]]),
        np.array([[0, 1, 2]], np.int32),
        np.tile([0.0, 0.6, 0.8], (3, 1)),
        np.array([[0, 128, 255, 255], [255, 0, 0, 255], [10, 20, 30, 0]], np.uint8),
    )


def test_ply_golden() -> None:
    header = (
        b"ply\nformat binary_little_endian 1.0\nelement vertex 3\n"
        b"property float x\nproperty float y\nproperty float z\n"
        b"property float nx\nproperty float ny\nproperty float nz\nproperty uchar red\nproperty uchar green\n"
        b"property uchar blue\nproperty uchar alpha\n"
        b"element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    )
    body = (
        struct.pack("<6f4B", 0, 0, 0, 0, 0.6, 0.8, 0, 128, 255, 255)
        + struct.pack("<6f4B", 1.5, 0, 0, 0, 0.6, 0.8, 255, 0, 0, 255)
        + struct.pack("<6f4B", 0, -2, 0.25, 0, 0.6, 0.8, 10, 20, 30, 0)
        + struct.pack("<B3i", 3, 0, 1, 2)
    )
    assert ply_bytes(triangle()) == header + body


def test_obj_golden() -> None:
    assert obj_bytes(triangle()).decode() == (
        "# vfr-bake: v x y z r g b (sRGB), vn, f\n"
        "v 0.00000000 0.00000000 0.00000000 0.0000 0.5020 1.0000\n"
        "v 1.50000000 0.00000000 0.00000000 1.0000 0.0000 0.0000\n"
        "v 0.00000000 -2.00000000 0.25000000 0.0392 0.0784 0.1176\n"
        + "vn 0.000000 0.600000 0.800000\n" * 3
        + "f 1//1 2//2 3//3\n"
    )


def test_glb_golden() -> None:
    document = (
        b'{"asset":{"generator":"vfr-bake","version":"2.0"},"extensionsUsed":["KHR_materials_unlit"],"scene":0,'
        b'"scenes":[{"nodes":[0]}],"nodes":[{"mesh":0,"name":"mesh"}],'
        b'"meshes":[{"primitives":[{"attributes":{"POSITION":0,"NORMAL":1,"COLOR_0":2},"indices":3,"material":0,"mode":4}]}],'
        b'"materials":[{"doubleSided":true,"extensions":{"KHR_materials_unlit":{}},'
        b'"pbrMetallicRoughness":{"metallicFactor":0,"roughnessFactor":1}}],'
        b'"accessors":[{"bufferView":0,"componentType":5126,"count":3,"type":"VEC3","min":[0.0,0.0,-0.0],"max":[1.5,0.25,2.0]},'
        b'{"bufferView":1,"componentType":5126,"count":3,"type":"VEC3"},'
        b'{"bufferView":2,"componentType":5123,"count":3,"type":"VEC4","normalized":true},'
        b'{"bufferView":3,"componentType":5125,"count":3,"type":"SCALAR"}],'
        b'"bufferViews":[{"buffer":0,"byteOffset":0,"byteLength":36,"target":34962},'
        b'{"buffer":0,"byteOffset":36,"byteLength":36,"target":34962},'
        b'{"buffer":0,"byteOffset":72,"byteLength":24,"target":34962},'
        b'{"buffer":0,"byteOffset":96,"byteLength":12,"target":34963}],"buffers":[{"byteLength":108}]}'
    )
    document += b" " * (-len(document) % 4)
    buffer = (
        struct.pack("<9f", 0, 0, 0, 1.5, 0, 0, 0, 0.25, 2)
        + struct.pack("<9f", *[0, 0.8, -0.6] * 3)
        # 128 -> 0.2158605 * 65535 = 14146.4; 10, 20, 30 -> 0.0030353, 0.0069954, 0.0129830 (1 / 329.5, ...)
        + struct.pack("<12H", 0, 14146, 65535, 65535, 65535, 0, 0, 65535, 199, 458, 851, 0)
        + struct.pack("<3I", 0, 1, 2)
    )
    data = glb_bytes(triangle())
    # The sign of a zero coordinate does not matter: compare coordinates as numbers, all else as bytes.
    got_document, got_buffer = parse_glb(data, "triangle.glb")
    assert got_document == json.loads(document)
    assert data[:20] == struct.pack("<4sIII4s", b"glTF", 2, len(data), len(data) - 28 - len(buffer), b"JSON")
    assert np.array_equal(np.frombuffer(got_buffer, "<f4", 18), np.frombuffer(buffer, "<f4", 18))
    assert got_buffer[72:] == buffer[72:]
    assert data == glb_bytes(triangle())


@pytest.mark.parametrize("suffix", WRITERS)
@pytest.mark.parametrize("mesh", [tetrahedron(), random_mesh(600, 1500)], ids=["tetrahedron", "random"])
def test_trimesh_reads(suffix: str, mesh: TriangleMesh) -> None:
    data = WRITERS[suffix](mesh)
    read = trimesh.load_mesh(io.BytesIO(data), file_type=suffix[1:], process=False, maintain_order=True)
    assert isinstance(read, trimesh.Trimesh)
    expected = mesh.vertices
    if suffix == ".glb":
        expected = expected[:, [0, 2, 1]] * [1, 1, -1]
    np.testing.assert_allclose(read.vertices, expected, rtol=0, atol=2e-6)  # float32 at up to 16 units
    assert np.array_equal(read.faces, mesh.faces)
    if mesh.vertices.shape == (4, 3):
        assert read.is_watertight and read.is_winding_consistent
        np.testing.assert_allclose(
            read.volume, 1.0, rtol=1e-6
        )  # 1 * 2 * 3 / 6: positive, so faces look outwards
    if suffix != ".glb":  # trimesh drops a GLB's COLOR_0 if there is a material; Open3D reads it below
        n_colours = 3 if suffix == ".obj" else 4
        colours = np.asarray(read.visual.vertex_colors)  # type: ignore[union-attr]
        assert np.array_equal(colours[:, :n_colours], mesh.colours[:, :n_colours])


def test_glb_colours_are_linear() -> None:
    mesh = replace(tetrahedron(), colours=np.full((4, 4), 128, np.uint8))
    document, buffer = parse_glb(glb_bytes(mesh), "grey.glb")
    accessor = document["accessors"][document["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"]]
    view = document["bufferViews"][accessor["bufferView"]]
    colours = np.frombuffer(buffer, "<u2", 16, view["byteOffset"]).reshape(4, 4)
    assert accessor["normalized"] and accessor["componentType"] == 5123
    assert (colours[:, :3] == round(0.2158605 * 65535)).all()
    assert (colours[:, 3] == 128 * 257).all()  # alpha is linear


@pytest.mark.needs("open3d")
def test_open3d_reads(tmp_path: Path) -> None:
    """Open3D reads what was written. Where pyproject.toml asks for Open3D, a missing one is a failure."""
    import open3d

    mesh = random_mesh(300, 500)
    for suffix, writer in WRITERS.items():
        path = tmp_path / f"mesh{suffix}"
        path.write_bytes(writer(mesh))
        read = open3d.io.read_triangle_mesh(str(path))
        vertices, normals = (y_up(a) if suffix == ".glb" else a for a in (mesh.vertices, mesh.normals))
        corners = np.asarray(read.triangles)  # Open3D renumbers the vertices of an OBJ: compare by corner
        np.testing.assert_allclose(
            np.asarray(read.vertices)[corners], vertices[mesh.faces], rtol=0, atol=2e-6
        )
        np.testing.assert_allclose(
            np.asarray(read.vertex_normals)[corners], normals[mesh.faces], rtol=0, atol=1e-6
        )
        colours = mesh.colours[mesh.faces, :3] / 255
        if suffix == ".glb":
            colours = linear_from_srgb(colours)
        np.testing.assert_allclose(np.asarray(read.vertex_colors)[corners], colours, rtol=0, atol=1e-4)


def test_read_ply_gives_back_what_was_written(tmp_path: Path) -> None:
    mesh = random_mesh(50, 80)
    path = tmp_path / "mesh.ply"
    path.write_bytes(ply_bytes(mesh))
    read = read_ply(path)
    assert np.array_equal(read.vertices, mesh.vertices.astype(np.float32))
    assert np.array_equal(read.faces, mesh.faces) and np.array_equal(read.colours, mesh.colours)
    assert ply_bytes(read) == path.read_bytes()


def test_the_mesh_of_an_asset_is_small_and_gets_the_normals_of_its_faces() -> None:
    """A small PLY gives back positions, faces and colours; normals come from faces. trimesh reads it too."""
    mesh = sphere(20)
    data = small_ply_bytes(mesh)
    assert len(data) == small_ply_size(len(mesh.vertices), len(mesh.faces)) < 0.8 * len(ply_bytes(mesh))
    read = parse_ply(data, "mesh.ply")
    assert np.array_equal(read.vertices, mesh.vertices.astype(np.float32))
    assert np.array_equal(read.faces, mesh.faces) and np.array_equal(read.colours, mesh.colours)
    assert (read.normals * mesh.normals).sum(axis=-1).min() > 0.98
    other = trimesh.load_mesh(io.BytesIO(data), file_type="ply", process=False)
    assert np.array_equal(other.faces, mesh.faces)
    assert np.array_equal(other.visual.vertex_colors[:, :3], mesh.colours[:, :3])
    with pytest.raises(IntegrityError, match="size"):
        parse_ply(data[:-1], "a.ply")
    with pytest.raises(FormatError, match=r"a\.ply: mesh: faces: expected vertex numbers"):
        parse_ply(data[:-4] + b"\xff\xff\xff\x7f", "a.ply")


def test_damaged_ply() -> None:
    data = ply_bytes(tetrahedron())
    with pytest.raises(
        IntegrityError, match=rf"a.ply: size: expected {len(data)} bytes, got {len(data) - 1}"
    ):
        parse_ply(data[:-1], "a.ply")
    with pytest.raises(IntegrityError, match="size"):
        parse_ply(data + b"\0", "a.ply")
    with pytest.raises(FormatError, match=r"a\.ply: header"):
        parse_ply(data.replace(b"float nx", b"float xn"), "a.ply")
    with pytest.raises(FormatError, match=r"a\.ply: header"):
        parse_ply(b"", "a.ply")
    with pytest.raises(FormatError, match=r"a\.ply: faces: expected triangles, got a face of 4"):
        parse_ply(data[:-13] + b"\x04" + data[-12:], "a.ply")
    with pytest.raises(FormatError, match=r"a\.ply: mesh: faces: expected vertex numbers"):
        parse_ply(data[:-4] + struct.pack("<i", 4), "a.ply")


@pytest.mark.parametrize("scale", [1e-6, 1e-3, 1.0, 1e4, 1e12])
def test_obj_keeps_nine_digits(scale: float) -> None:
    mesh = random_mesh(40, 10)
    mesh = replace(mesh, vertices=mesh.vertices * scale)
    rows = [line.split()[1:4] for line in obj_bytes(mesh).decode().splitlines() if line.startswith("v ")]
    largest = np.abs(mesh.vertices).max()
    np.testing.assert_allclose(np.array(rows, float), mesh.vertices, rtol=0, atol=1e-8 * largest)
    check_mesh_bytes(".obj", obj_bytes(mesh), mesh, "mesh.obj")


def test_limits() -> None:
    mesh = tetrahedron()
    with pytest.raises(ConfigError, match="below 1e15"):
        obj_bytes(replace(mesh, vertices=mesh.vertices * 1e15))
    with pytest.raises(ConfigError, match="at least one face"):
        glb_bytes(replace(mesh, faces=mesh.faces[:0]))
    empty = TriangleMesh(mesh.vertices[:0], mesh.faces[:0], mesh.normals[:0], mesh.colours[:0])
    assert len(parse_ply(ply_bytes(empty), "empty.ply").vertices) == 0
    assert obj_bytes(empty).decode().count("\n") == 1
    check_mesh_bytes(".obj", obj_bytes(empty), empty, "empty.obj")
    check_mesh_bytes(
        ".obj", obj_bytes(replace(mesh, faces=mesh.faces[:0])), replace(mesh, faces=mesh.faces[:0]), "a.obj"
    )


def test_too_far_from_the_origin_for_float32() -> None:
    """Float32 has steps of 1/64 from 2^17 on and of 1/32 from 2^18 on; the sphere's median edge is 0.157."""
    mesh = sphere(20)
    check_steps(mesh, "a.ply", "come nearer")
    near = replace(mesh, vertices=mesh.vertices + np.array([2.0**17, 0, 0]))
    check_steps(near, "a.ply", "come nearer")
    far = replace(mesh, vertices=mesh.vertices - np.array([0, 2.0**18, 0]))
    message = (
        r"^a\.ply: vertices: expected steps of float32 of at most 0\.1 times the median edge, 0\.157, "
        r"got 0\.0312 at 262145, which is too far from the origin: come nearer$"
    )
    with pytest.raises(ConfigError, match=message):
        check_steps(far, "a.ply", "come nearer")
    check_steps(replace(far, faces=far.faces[:0]), "a.ply", "come nearer")


@pytest.mark.parametrize("textured", [False, True])
def test_an_obj_far_from_the_origin_keeps_its_shape(textured: bool) -> None:
    """In the coordinates of a map, places of a small thing are as exact as float64 has them there: its steps
    at 4.5e6 are 2^-30."""
    near = sphere(20, 0.15)
    mesh = replace(near, vertices=near.vertices + np.array([4.5e6, -5e5, 300.0]))
    if textured:
        texture = Texture(np.zeros((len(mesh.vertices), 2), np.float32), np.zeros((2, 2, 3), np.uint8))
        data = textured_obj_files(mesh, texture, "far")[".obj"]
    else:
        data = obj_bytes(mesh)
        check_mesh_bytes(".obj", data, mesh, "far.obj")
        moved = replace(mesh, vertices=mesh.vertices + 1e-8)
        with pytest.raises(ParityError, match="vertices: number"):
            check_mesh_bytes(".obj", data, moved, "far.obj")
    read = parse_obj(data, "far.obj")["vertices"]
    assert np.abs(read - mesh.vertices).max() <= 0.5e-9 + 2 * 2.0**-30


@pytest.mark.parametrize("suffix", WRITERS)
def test_parity(suffix: str) -> None:
    mesh = random_mesh(60, 90)
    data = WRITERS[suffix](mesh)
    check_mesh_bytes(suffix, data, mesh, "mesh")
    with pytest.raises(ParityError, match="faces: expected 89, got 90"):
        check_mesh_bytes(suffix, data, replace(mesh, faces=mesh.faces[:-1]), "mesh")
    with pytest.raises(ParityError, match="vertices: number"):
        check_mesh_bytes(suffix, data, replace(mesh, vertices=mesh.vertices + 1e-4), "mesh")
    inner = mesh.vertices.copy()  # move an inner vertex: the bounds stay
    place = int(np.argmin(np.abs(inner).max(axis=-1)))
    inner[place] += 1e-3
    with pytest.raises(ParityError, match=f"vertices: number {place}: expected"):
        check_mesh_bytes(suffix, data, replace(mesh, vertices=inner), "mesh")
    colours = mesh.colours.copy()
    colours[7, 1] ^= 255
    with pytest.raises(ParityError, match="colours: number 7: expected"):
        check_mesh_bytes(suffix, data, replace(mesh, colours=colours), "mesh")
    with pytest.raises(ParityError, match="normals: number"):
        check_mesh_bytes(suffix, data, replace(mesh, normals=-mesh.normals), "mesh")
    with pytest.raises(ParityError, match="faces: number"):
        check_mesh_bytes(suffix, data, replace(mesh, faces=mesh.faces[:, ::-1].copy()), "mesh")
