"""Turning on the spot: how points move under a rotation alone, and under a step."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.vfr_bake.data.check.test_check import MINUTES, wall
from vfr_bake.data.check.check import check_data
from vfr_bake.data.check.turning import MIN_MATCHES, off, share_turned
from vfr_bake.data.store.working import WorkingSize


def turn(degrees: float) -> np.ndarray:
    """Return a rotation [3, 3] about the vertical, with a little nodding."""
    a, b = np.radians([degrees, degrees / 5])
    level = np.array([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]])
    return np.array([[1, 0, 0], [0, np.cos(b), -np.sin(b)], [0, np.sin(b), np.cos(b)]]) @ level


def seen(
    points: np.ndarray, rotation: np.ndarray, step: np.ndarray, focal: float, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return `points` [n, 3] as seen in two pictures, with noise of half a pixel in 480. The second camera is
    turned by `rotation` and moved by `step`."""
    random = np.random.default_rng(seed)
    pictures = []
    for some in (points, (points - step) @ rotation.T):
        pictures.append(focal * some[:, :2] / some[:, 2:] + random.normal(0, 0.001, (len(points), 2)))
    return pictures[0], pictures[1]


def cloud(seed: int, n: int = 150) -> np.ndarray:
    """Return points of a room, at depths of 2 to 8."""
    random = np.random.default_rng(seed)
    z = random.uniform(2, 8, n)
    return np.stack([*(random.uniform(-0.4, 0.4, (2, n)) * z), z], axis=-1)


@pytest.mark.parametrize("focal", [0.7, 1.0, 1.15])
def test_a_rotation_is_one_whatever_is_seen_and_a_step_is_none(focal: float) -> None:
    still, arm = np.zeros(3), np.array([0.06, 0, 0.01])
    on_the_spot = [seen(cloud(seed), turn(8), still, focal, seed) for seed in range(4)]
    assert share_turned(on_the_spot) == 1
    assert share_turned([seen(cloud(seed), turn(10), arm, focal, seed) for seed in range(4)]) == 1
    steps = [seen(cloud(seed), turn(8), np.array([0.6, 0, 0]), focal, seed) for seed in range(4)]
    assert share_turned(steps) == 0
    assert share_turned([*on_the_spot, *on_the_spot, *steps]) == pytest.approx(2 / 3)


def test_false_matches_do_not_hide_a_rotation() -> None:
    a, b = seen(cloud(0), turn(8), np.zeros(3), 1.0, 0)
    b[::8] = np.random.default_rng(1).uniform(-0.4, 0.4, b[::8].shape)
    assert share_turned([(a, b)]) == 1


def test_what_tells_nothing() -> None:
    a, b = seen(cloud(0), turn(8), np.zeros(3), 1.0, 0)
    few = MIN_MATCHES - 1
    assert share_turned([]) is None and share_turned([(a[:0], b[:0])]) is None
    assert share_turned([(a[:few], b[:few])]) is None
    assert share_turned([(a, a)]) is None  # as from a tripod
    assert np.isfinite(off(a, np.zeros_like(a), 1.0))
    assert off(np.zeros((40, 2)), np.zeros((40, 2)), 1.0) == pytest.approx(0, abs=1e-6)


def test_the_check_warns_of_pictures_from_one_spot(tmp_path: Path) -> None:
    """The check warns of pictures from one spot: a wall seen by a camera that turns 5 degrees each time."""
    picture = np.asarray(wall(3))
    focal, size = 480.0, (480, 400)
    lens = np.array([[focal, 0, 240], [0, focal, 200], [0, 0, 1]])
    ahead = np.array([[focal, 0, 1000], [0, focal, 200], [0, 0, 1]])
    for number, degrees in enumerate(range(-25, 26, 5)):
        through = lens @ turn(degrees) @ np.linalg.inv(ahead)
        shown = cv2.warpPerspective(picture, through, size)
        assert cv2.imwrite(str(tmp_path / f"p{number:02d}.png"), shown)
    check = check_data(str(tmp_path), WorkingSize(), MINUTES)
    assert check.verdict == "bad" and check.figures["share_turned_on_the_spot"] == 1
    assert any("turned on the spot (100% of the steps)" in line for line in check.advice)
    assert any("from one place" in line for line in check.likely)
