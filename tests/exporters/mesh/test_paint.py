"""Tests of texels: which face contains them, their padding, and the points whose colours are asked for."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from exporters.mesh import paint as module
from exporters.mesh.paint import covered_texels, padded, paint
from exporters.shapes.colour import KnownColours
from exporters.shapes.mesh import TriangleMesh
from player.errors import DataError
from player.progress import Progress


def naive_texels(uvs: np.ndarray, faces: np.ndarray, size: int) -> dict[int, int]:
    """Return the first face that contains the centre of each texel, by edge functions in a plain loop."""
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
    bands = [covered_texels(uvs, faces, 13, rows) for rows in (range(5), range(5, 6), range(6, 13))]
    for whole, parts in zip((texels, face, shares), zip(*bands, strict=True), strict=True):
        assert np.array_equal(np.concatenate(parts), whole)


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
    """Return a square of 2 x 2 at z = 5, laid out over the whole picture with its first row at y = 2."""
    vertices = np.array([[0.0, 0, 5], [2, 0, 5], [0, 2, 5], [2, 2, 5]])
    faces = np.array([[0, 1, 2], [1, 3, 2]], np.int32)
    up, white = np.tile([0.0, 0, 1], (4, 1)), np.full((4, 4), 255, np.uint8)
    uvs = np.array([[0, 1], [1, 1], [0, 0], [1, 0]], np.float32)
    return TriangleMesh(vertices, faces, up, white), uvs


def test_paint_asks_for_the_places_under_the_centres() -> None:
    mesh, uvs = flat()
    asked = []

    def colours(points: np.ndarray, normals: np.ndarray, progress: Progress) -> KnownColours:
        asked.append((points, normals))
        return KnownColours(points / 2 * [1, 1, 0], points[:, 0] > 0.5)

    texture = paint(mesh, uvs, 8, colours)
    points, normals = asked[0]
    centres = (np.arange(8) + 0.5) / 4
    np.testing.assert_allclose(points.reshape(8, 8, 3)[..., 0], np.tile(centres, (8, 1)), atol=1e-6)
    np.testing.assert_allclose(
        points.reshape(8, 8, 3)[..., 1], np.tile(centres[::-1, None], (1, 8)), atol=1e-6
    )
    assert (points[:, 2] == 5).all() and (normals == [0, 0, 1]).all()
    assert texture.image[0, 7].tolist() == [239, 239, 0] and texture.image[7, 7].tolist() == [239, 16, 0]
    assert texture.image[0, 0].tolist() == texture.image[0, 2].tolist()  # unknown there: the nearest colour
    with pytest.raises(DataError, match="expected colours on the surface, got none"):
        paint(mesh, uvs, 8, lambda points, *_: KnownColours(points, np.zeros(len(points), bool)))
    with pytest.raises(DataError, match="expected a texel under some face"):
        paint(mesh, uvs * 0, 8, colours)


def test_bands_of_rows_make_the_picture_that_is_made_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Colours are asked for no more texels at a time than is allowed, and progress is that of all bands."""
    mesh, uvs = flat()
    asked, counts = [], []

    def colours(points: np.ndarray, normals: np.ndarray, progress: Progress) -> KnownColours:
        asked.append(len(points))
        progress(1, 2)
        progress(2, 2)
        return KnownColours(points / 2 * [1, 1, 0], points[:, 0] > 0.5)

    whole = paint(mesh, uvs, 8, colours)
    monkeypatch.setattr(module, "_COLOURED", 24)
    parts = paint(mesh, uvs, 8, colours, lambda done, of: counts.append((done, of)))
    assert asked == [64, 24, 24, 16]
    assert np.array_equal(parts.image, whole.image)
    assert counts == [(done, 6) for done in range(1, 7)]
