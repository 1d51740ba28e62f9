"""Tests of files with a texture: what other programs read in them, and the comparison before writing."""

from __future__ import annotations

import io
import tracemalloc
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from exporters.formats.glb import glb_bytes, parse_glb
from exporters.formats.obj import check_stem, textured_obj_files
from exporters.formats.parity import check_mesh_bytes, check_textured_obj
from exporters.shapes.colour import linear_from_srgb
from exporters.shapes.mesh import TriangleMesh
from exporters.shapes.texture import Texture
from player.errors import ConfigError, ParityError, ShapeError
from tests.exporters.meshes import tetrahedron


def cornered() -> tuple[TriangleMesh, Texture]:
    """Return a tetrahedron and a texture of four coloured quarters, with a corner in the middle of each."""
    uvs = np.array([[0.25, 0.25], [0.75, 0.25], [0.25, 0.75], [0.75, 0.75]], np.float32)
    image = np.zeros((16, 16, 3), np.uint8)
    image[:8, :8], image[:8, 8:], image[8:, :8], image[8:, 8:] = COLOURS
    return tetrahedron(), Texture(uvs, image)


COLOURS = np.array([[250, 10, 20], [30, 240, 40], [50, 60, 230], [128, 128, 128]], np.uint8)


def test_trimesh_finds_the_colours(tmp_path: Path) -> None:
    mesh, texture = cornered()
    (tmp_path / "a.glb").write_bytes(glb_bytes(mesh, texture))
    for suffix, data in textured_obj_files(mesh, texture, "a").items():
        (tmp_path / f"a{suffix}").write_bytes(data)
    for name in ("a.glb", "a.obj"):
        read = trimesh.load_mesh(tmp_path / name, process=False, maintain_order=True)
        vertices = read.vertices if name == "a.obj" else read.vertices[:, [0, 2, 1]] * [1, -1, 1]
        np.testing.assert_allclose(vertices, mesh.vertices, rtol=0, atol=1e-6)
        assert np.array_equal(read.faces, mesh.faces)
        colours = np.asarray(read.visual.to_color().vertex_colors)
        assert np.array_equal(colours[:, :3], COLOURS), name


@pytest.mark.needs("open3d")
def test_open3d_finds_the_picture(tmp_path: Path) -> None:
    import open3d

    mesh, texture = cornered()
    (tmp_path / "a.glb").write_bytes(glb_bytes(mesh, texture))
    for suffix, data in textured_obj_files(mesh, texture, "a").items():
        (tmp_path / f"a{suffix}").write_bytes(data)
    for name in ("a.obj", "a.glb"):
        read = open3d.io.read_triangle_mesh(str(tmp_path / name), enable_post_processing=False)
        assert len(read.triangles) == 4 and len(read.triangle_uvs) == 12
        picture = np.asarray(next(image for image in read.textures if not image.is_empty()))[..., :3]
        for corner, (u, v) in zip(
            np.asarray(read.triangles).ravel(), np.asarray(read.triangle_uvs), strict=True
        ):
            place = np.asarray(read.vertices)[corner]
            place = place if name == "a.obj" else place[[0, 2, 1]] * [1, -1, 1]
            number = int(np.argmin(np.abs(mesh.vertices - place).sum(-1)))
            # Open3D turns an OBJ's picture upside down, so that both origins are at its upper left again
            assert picture[int(v * 16), int(u * 16)].tolist() == COLOURS[number].tolist(), name


def test_the_picture_is_srgb_unlit_and_alone() -> None:
    mesh, texture = cornered()
    document, buffer = parse_glb(glb_bytes(mesh, texture), "a.glb")
    attributes = document["meshes"][0]["primitives"][0]["attributes"]
    assert sorted(attributes) == ["NORMAL", "POSITION", "TEXCOORD_0"]
    material = document["materials"][0]
    assert "KHR_materials_unlit" in material["extensions"]
    image = document["images"][
        document["textures"][material["pbrMetallicRoughness"]["baseColorTexture"]["index"]]["source"]
    ]
    view = document["bufferViews"][image["bufferView"]]
    png = buffer[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
    assert np.array_equal(np.asarray(Image.open(io.BytesIO(png))), texture.image)  # unchanged: sRGB
    assert len(buffer) % 4 == 0 and not np.array_equal(
        linear_from_srgb(texture.image / 255), texture.image / 255
    )


def test_parity_of_textured_files() -> None:
    mesh, texture = cornered()
    glb, obj = glb_bytes(mesh, texture), textured_obj_files(mesh, texture, "a")
    check_mesh_bytes(".glb", glb, mesh, "a.glb", texture)
    check_textured_obj(obj, mesh, texture, "a.obj")
    check_textured_obj(textured_obj_files(mesh, texture, "a.mtl"), mesh, texture, "a.mtl.obj")
    moved = Texture(texture.uvs + np.float32(1e-3), texture.image)
    image = texture.image.copy()
    image[3, 4, 1] ^= 1
    for message, other_mesh, other in (
        ("vertices: number", replace(mesh, vertices=mesh.vertices + 1e-3), texture),
        ("normals: number", replace(mesh, normals=-mesh.normals), texture),
        ("faces: number", replace(mesh, faces=mesh.faces[:, ::-1].copy()), texture),
        ("places in the picture: number", mesh, moved),
        ("texels: number 52: expected", mesh, Texture(texture.uvs, image)),
        ("picture: expected", mesh, Texture(texture.uvs, image[:8, :8])),
    ):
        with pytest.raises(ParityError, match=message):
            check_mesh_bytes(".glb", glb, other_mesh, "a.glb", other)
        with pytest.raises(ParityError, match=message):
            check_textured_obj(obj, other_mesh, other, "a.obj")
    with pytest.raises(ParityError, match=r"map_Kd: expected a.png, got \['b.png'\]"):
        check_textured_obj(obj | {".mtl": b"map_Kd b.png\n"}, mesh, texture, "a.obj")


def test_equal_pictures_are_compared_in_little_memory() -> None:
    """Comparing a picture takes a few times its bytes; differences in float64 would take over 24 times."""
    mesh, texture = cornered()
    large = Texture(texture.uvs, np.zeros((1024, 1024, 3), np.uint8))
    data = glb_bytes(mesh, large)
    check_mesh_bytes(".glb", data, mesh, "a.glb", large)  # loads Pillow
    tracemalloc.start()
    try:
        check_mesh_bytes(".glb", data, mesh, "a.glb", large)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 8 * large.image.nbytes


def test_refusals() -> None:
    _, texture = cornered()
    with pytest.raises(ConfigError, match="expected one without spaces"):
        check_stem("my scene")
    with pytest.raises(ShapeError, match="texture: uvs"):
        Texture(np.zeros((3, 3), np.float32), texture.image)
    with pytest.raises(ShapeError, match="texture: image"):
        Texture(texture.uvs, texture.image[:5])
