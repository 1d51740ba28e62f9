"""Features, size and sharpness of a photograph whose camera is still unknown: they are the same if EXIF turns
the picture, and if a part of its pixels is decoded only."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from player.progress import Progress
from tests.vfr_bake.data.files.test_orientation import save_turned
from vfr_bake.data.features import find_features, match
from vfr_bake.data.files.looks import look_at
from vfr_bake.data.kept_matches import KeptMatches


def blots(width: int, height: int, size: int = 8) -> np.ndarray:
    """Return a picture [height, width, 3] uint8 that is full of features."""
    random = np.random.default_rng(0)
    coarse = random.integers(0, 256, (height // size + 1, width // size + 1, 3), np.uint8)
    return np.asarray(Image.fromarray(coarse).resize((width, height), Image.Resampling.BICUBIC))


@pytest.mark.parametrize("number", [3, 6, 8])
def test_a_picture_that_exif_turns_is_its_upright_twin(number: int, tmp_path: Path) -> None:
    """A picture turned by EXIF gives the same features, to the bit, as one that is stored upright."""
    upright = blots(160, 120)
    save_turned(upright, tmp_path / "turned.png", number)
    Image.fromarray(upright).save(tmp_path / "upright.png")
    paths = [(tmp_path / "turned.png", None), (tmp_path / "upright.png", None)]
    a, b = look_at(paths, KeptMatches(tmp_path / "kept"), None)
    assert a.sensor == b.sensor and (a.sensor.width, a.sensor.height) == (160, 120)
    assert len(a.features.points) > 50 and a.sharpness == b.sharpness
    assert np.array_equal(a.features.points, b.features.points)
    assert np.array_equal(a.features.sift, b.features.sift)


@pytest.mark.parametrize("size", [(3601, 1203), (1501, 3302)])
def test_features_of_a_large_photograph_are_where_all_its_pixels_have_them(
    size: tuple[int, int], tmp_path: Path
) -> None:
    """Features of a JPEG decoded at half its size, rounded up, lie where those of the whole picture do."""
    path = tmp_path / "large.jpg"
    Image.fromarray(blots(*size, size=40)).save(path, quality=95)
    (seen,) = look_at([(path, None)], KeptMatches(tmp_path / "kept"), None)
    assert (seen.sensor.width, seen.sensor.height) == size
    with Image.open(path) as file:
        whole = find_features(np.asarray(file.convert("RGBA")))
    pairs = match(seen.features.descriptors, whole.descriptors)
    assert len(pairs) > 0.5 * len(whole.points) > 100
    off = seen.features.points[pairs[:, 0]] - whole.points[pairs[:, 1]]
    assert np.abs(np.median(off, axis=0)).max() < 0.1 and np.median(np.abs(off)) < 0.5


def test_what_is_kept_is_not_looked_at_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    Image.fromarray(blots(160, 120)).save(tmp_path / "a.png")
    progress: Progress = lambda done, of: None  # noqa: E731
    (first,) = look_at([(tmp_path / "a.png", None)], KeptMatches(tmp_path / "kept"), progress)
    monkeypatch.setattr("vfr_bake.data.files.looks.find_features", None)
    (again,) = look_at([(tmp_path / "a.png", None)], KeptMatches(tmp_path / "kept"), progress)
    assert again.sharpness == first.sharpness and np.array_equal(again.features.sift, first.features.sift)
