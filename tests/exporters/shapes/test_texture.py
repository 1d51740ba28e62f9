"""Texels: which face holds which, their colours on a ball, the padding; and textured files read by others."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from exporters.formats.glb import glb_bytes, parse_glb
from exporters.formats.obj import textured_obj_files
from exporters.formats.parity import check_textured_glb, check_textured_obj
from exporters.mesh.paint import Texture, covered_texels, padded, paint
from exporters.shapes.colour import linear_from_srgb
from exporters.shapes.mesh import TriangleMesh
from player.errors import ConfigError, DataError, ParityError, ShapeError
from tests.exporters.meshes import tetrahedron


def naive_texels(uvs: np.ndarray, faces: np.ndarray, size: int) -> dict[int, int]:
    """The first face that holds each centre, by edge functions, texel after texel."""
    found = {}
    for row in range(size):
        for column in range(size):
            p = np.array([column + 0.5, row + 0.5]) / size
            for number, (a, b, c) in enumerate(uvs[faces]):
                sides = [
                    (q - o)[0] * (p - o)[1] - (q - o)[1] * (p - o)[0] for o, q in ((a, b), (b, c), (c, a))
                ]
                area = (b - a)[0] * (c - a)[1] - (b - a)[1] * (c - a)[0]
                if abs(area) * size * size > 1e-9 and min(side * np.sign(area) for side in sides) >= 0:
                    found[row * size + column] = number
                    break
    return found


@given(st.integers(0, 10_000))
def test_texels_are_the_naive_loop(seed: int) -> None:
    random = np.random.default_rng(seed)
    uvs = random.random((9, 2)) * 1.2 - 0.1  # some beyond the picture
    faces = random.integers(0, 9, (5, 3))  # some without area
    texels, face, shares = covered_texels(uvs, faces, 13)
    assert dict(zip(texels.tolist(), face.tolist(), strict=True)) == naive_texels(uvs, faces, 13)
    centres = np.stack([texels % 13 + 0.5, texels // 13 + 0.5], axis=-1) / 13
    np.testing.assert_allclose(np.einsum("ij,ijk->ik", shares, uvs[faces[face]]), centres, rtol=0, atol=1e-9)


def test_padding_takes_the_nearest() -> None:
    image = np.zeros((8, 8, 3), np.uint8)
    covered = np.zeros((8, 8), bool)
    image[2, 1], image[5, 6] = (10, 20, 30), (200, 100, 50)
    covered[2, 1] = covered[5, 6] = True
    filled = padded(image, covered)
    rows, columns = np.mgrid[:8, :8]
    first = (rows - 2) ** 2 + (columns - 1) ** 2
    second = (rows - 5) ** 2 + (columns - 6) ** 2
    clear = first != second
    expected = np.where((first < second)[..., None], image[2, 1], image[5, 6])
    assert np.array_equal(filled[clear], expected[clear])


def flat() -> tuple[TriangleMesh, np.ndarray]:
    """A square of 2 x 2 at z = 5, laid out over the whole picture, its first row at y = 2."""
    vertices = np.array([[0.0, 0, 5], [2, 0, 5], [0, 2, 5], [2, 2, 5]])
    faces = np.array([[0, 1, 2], [1, 3, 2]], np.int32)
    up, white = np.tile([0.0, 0, 1], (4, 1)), np.full((4, 4), 255, np.uint8)
    uvs = np.array([[0, 1], [1, 1], [0, 0], [1, 0]], np.float32)
    return TriangleMesh(vertices, faces, up, white), uvs


def test_paint_asks_for_the_places_under_the_centres() -> None:
    mesh, uvs = flat()
    asked = []

    def colours(points: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        asked.append((points, normals))
        return points / 2 * [1, 1, 0], points[:, 0] > 0.5

    texture = paint(mesh, uvs, 8, colours)
    points, normals = asked[0]
    centres = (np.arange(8) + 0.5) / 4
    np.testing.assert_allclose(points.reshape(8, 8, 3)[..., 0], np.tile(centres, (8, 1)), atol=1e-6)
    np.testing.assert_allclose(
        points.reshape(8, 8, 3)[..., 1], np.tile(centres[::-1, None], (1, 8)), atol=1e-6
    )
    assert (points[:, 2] == 5).all() and (normals == [0, 0, 1]).all()
    assert texture.image[0, 7].tolist() == [239, 239, 0] and texture.image[7, 7].tolist() == [239, 16, 0]
    assert texture.image[0, 0].tolist() == texture.image[0, 2].tolist()  # no colour there: the nearest
    with pytest.raises(DataError, match="expected colours on the surface, got none"):
        paint(mesh, uvs, 8, lambda points, normals: (points, np.zeros(len(points), bool)))
    with pytest.raises(DataError, match="expected a texel under some face"):
        paint(mesh, uvs * 0, 8, colours)


def cornered() -> tuple[TriangleMesh, Texture]:
    """A tetrahedron whose corners are in the middle of the quarters of a picture of four colours."""
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
    assert np.array_equal(np.asarray(Image.open(io.BytesIO(png))), texture.image)  # as they are: sRGB
    assert len(buffer) % 4 == 0 and not np.array_equal(
        linear_from_srgb(texture.image / 255), texture.image / 255
    )


def test_parity_of_textured_files() -> None:
    mesh, texture = cornered()
    glb, obj = glb_bytes(mesh, texture), textured_obj_files(mesh, texture, "a")
    check_textured_glb(glb, mesh, texture, "a.glb")
    check_textured_obj(obj, mesh, texture, "a.obj")
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
            check_textured_glb(glb, other_mesh, other, "a.glb")
        with pytest.raises(ParityError, match=message):
            check_textured_obj(obj, other_mesh, other, "a.obj")
    with pytest.raises(ParityError, match=r"map_Kd: expected a.png, got \['b.png'\]"):
        check_textured_obj(obj | {".mtl": b"map_Kd b.png\n"}, mesh, texture, "a.obj")


def test_refusals() -> None:
    mesh, texture = cornered()
    with pytest.raises(ConfigError, match="expected one without spaces"):
        textured_obj_files(mesh, texture, "my scene")
    with pytest.raises(ShapeError, match="texture: uvs"):
        Texture(np.zeros((3, 3), np.float32), texture.image)
    with pytest.raises(ShapeError, match="texture: image"):
        Texture(texture.uvs, texture.image[:5])
