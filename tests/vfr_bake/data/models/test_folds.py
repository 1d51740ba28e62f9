"""Estimated cameras that are folded, because the subject looks the same from two sides."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.vfr_bake.data.test_poses import centres, real_pictures
from vfr_bake.data import load_scene, poses
from vfr_bake.data.models import folds
from vfr_bake.data.poses import estimate_cameras


def save_halved(n: int, folder: Path) -> None:
    """Save the first `n` pictures of the can at half their size."""
    for path in sorted((real_pictures("can") / "images").iterdir())[:n]:
        with Image.open(path) as file:
            file.reduce(2).save(folder / path.name, quality=95)


def test_a_label_on_both_sides_does_not_fold_the_walk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """The walk around the can, one and a half times in 71 pictures, is not folded. Matches alone take its two
    sides for one, as in the cameras that come with the pictures."""
    save_halved(71, tmp_path)
    torn: list[int] = []

    def counted(*arguments):
        torn.append(len(found := folds.torn_neighbours(*arguments)))
        return found

    monkeypatch.setattr(poses, "torn_neighbours", counted)
    stages: list[str] = []
    report = estimate_cameras(tmp_path, lambda stage, done, of: stages.append(stage))
    first = ["features", "pairs", "matches", "cameras"]
    assert list(dict.fromkeys(stages)) == [*first, "walk", "turns", "cameras again"]
    assert torn[0] > 0 == torn[-1]
    assert report.n_registered == report.n_pictures == 71 and report.mean_error < 1
    places, rotations = centres(tmp_path / "sparse" / "0")
    steps = np.linalg.norm(np.diff([places[name] for name in sorted(places)], axis=0), axis=1)
    assert steps.max() < 3 * np.median(steps)  # 8 to 16 times if folded
    up = -np.mean([rotation[1] for rotation in rotations.values()], axis=0)
    ahead = np.array([rotations[name][2] for name in sorted(rotations)])
    ahead -= np.outer(ahead @ up, up) / (up @ up)
    turned = np.einsum("ij,ij->i", np.cross(ahead[:-1], ahead[1:]), np.tile(up, (70, 1))) / np.linalg.norm(up)
    angles = np.degrees(np.arctan2(turned, np.einsum("ij,ij->i", ahead[:-1], ahead[1:])))
    assert 520 < abs(angles.sum()) < 570


def test_given_cameras_that_are_folded_are_told_from_those_that_are_not():
    """Folds are found in can's given cameras, but not in fox's, where the camera once leaps ten steps."""
    scene = load_scene(real_pictures("can"), downscale=2)
    torn = [("0013.jpg", "0014.jpg"), ("0034.jpg", "0035.jpg"), ("0052.jpg", "0053.jpg")]
    assert folds.torn_views(scene.train) == torn
    assert folds.torn_views(load_scene(real_pictures("fox"), downscale=4).train) == []


def test_what_is_torn_in_the_walk_as_well_is_left_as_it_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    save_halved(5, tmp_path)
    monkeypatch.setattr(poses, "torn_neighbours", lambda *_: [(0, 1)])
    stages: list[str] = []
    report = estimate_cameras(tmp_path, lambda stage, done, of: stages.append(stage))
    assert stages[-1] == "walk" and report.n_registered == 5
