"""Features of pictures, the matches between them, and the cameras that the files describe."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.vfr_bake.data.test_poses import textured
from vfr_bake.data import mapping
from vfr_bake.data.features import _n_matches, find_features, match, pairs_to_match
from vfr_bake.data.looks import sensor_of


def test_features_follow_the_picture_to_its_own_pixels(monkeypatch: pytest.MonkeyPatch):
    """Features that are found in a reduced picture lie where they are found in the whole one."""
    rgba = np.dstack([textured(3, 640, 480), np.full((480, 640), 255, np.uint8)])
    whole = find_features(rgba)
    monkeypatch.setattr("vfr_bake.data.features.MAX_SIDE", 320)
    reduced = find_features(rgba)
    pairs = match(whole.descriptors, reduced.descriptors)
    off = whole.points[pairs[:, 0]] - reduced.points[pairs[:, 1]]
    assert (
        len(pairs) > 50 and np.abs(np.median(off, axis=0)).max() < 0.15
    )  # an error of half a pixel would be 0.5


def test_nothing_is_found_where_a_picture_is_transparent():
    rgba = np.dstack([textured(4), np.full((120, 160), 255, np.uint8)])
    rgba[:, :80, 3] = 0
    points = find_features(rgba).points
    assert len(points) and points[:, 0].min() > 79


def test_match_is_what_loops_say():
    rng = np.random.default_rng(0)
    a = np.abs(rng.normal(size=(300, 128))).astype(np.float32)
    b = np.concatenate([a[50:250] + 0.3 * rng.normal(size=(200, 128)), np.abs(rng.normal(size=(40, 128)))])
    a, b = (x / np.linalg.norm(x, axis=1, keepdims=True) for x in (a, b.astype(np.float32)))
    expected = []
    for i in range(len(a)):
        distances = np.linalg.norm(a[i] - b, axis=1)
        j, second = np.argsort(distances)[:2]
        if distances[j] < 0.8 * distances[second] and np.linalg.norm(a - b[j], axis=1).argmin() == i:
            expected.append([i, j])
    assert 20 < len(expected) and match(a, b).tolist() == expected
    stacked = np.stack([b[:120], b[120:]])
    assert _n_matches(a, stacked).tolist() == [len(match(a, half)) for half in stacked]
    assert match(a[:0], b).shape == match(a, b[:1]).shape == (0, 2)


def test_a_walk_is_closed_without_all_pairs():
    """The last of sixty pictures around a closed strip is matched with the first, without all pairs."""
    strip = textured(5, 1600, 120)
    strip = np.concatenate([strip, strip[:, :200]], axis=1)
    views = [strip[:, start : start + 160] for start in np.linspace(0, 1600, 60, endpoint=False).astype(int)]
    opaque = np.full((120, 160), 255, np.uint8)
    calls: list[tuple[int, int]] = []
    features = [find_features(np.dstack([view, opaque])) for view in views]
    pairs = pairs_to_match(features, lambda *call: calls.append(call))
    assert (0, 59) in pairs and (0, 1) in pairs and len(pairs) < 60 * 59 / 4
    assert len(set(pairs)) == len(pairs) and all(i < j for i, j in pairs)
    assert calls[:2] == [(59, 1770), (59 + 58, 1770)] and calls[-1] == (1770, 1770)


def test_one_camera_for_one_device_and_its_focal_length(tmp_path: Path):
    exif = Image.Exif()
    exif[271], exif[272] = "Maker", "Model"
    exif[0x8769] = {0xA405: 26}  # Pillow before 11.3 does not write what get_ifd was given
    for name, tags in (("a", exif), ("b", exif), ("c", Image.Exif())):
        Image.fromarray(textured(0, 400, 300)).save(tmp_path / f"{name}.jpg", exif=tags)
    a, b, c = (sensor_of(tmp_path / f"{name}.jpg", 400, 300) for name in "abc")
    assert a == b != c and c.focal is None
    assert a.focal == pytest.approx(26 / 43.27 * 500)
    assert mapping.colmap_camera(a).has_prior_focal_length
    assert mapping.colmap_camera(c).focal_length == 480
