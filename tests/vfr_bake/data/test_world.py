"""Estimates of which way is up, and of how long a unit is."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from player.errors import DataError
from vfr_bake.data import check_scale, load_scene
from vfr_bake.data.demo import demo_views
from vfr_bake.data.store.capture import Capture, PosedImages
from vfr_bake.data.store.reading import PictureReader
from vfr_bake.data.world import find_up, scaled, turn_to_z


def degrees(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.degrees(np.arccos(np.clip(a @ b / np.linalg.norm(a) / np.linalg.norm(b), -1, 1))))


def ring(seed: int, roll: float, n_sideways: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return poses [24, 4, 4] on three quarters of a turn in a randomly turned world, and this world's up.
    Cameras roll by `roll` degrees (standard deviation); `n_sideways` of them are turned by 90 degrees."""
    random = np.random.default_rng(seed)
    world = np.linalg.qr(random.normal(size=(3, 3)))[0]
    world *= np.sign(np.linalg.det(world))
    poses = []
    for number, azimuth in enumerate(np.linspace(0, 1.5 * np.pi, 24)):
        back = np.array([np.cos(azimuth), np.sin(azimuth), 0.4])
        back /= np.linalg.norm(back)
        right = np.cross([0, 0, 1], back)
        right /= np.linalg.norm(right)
        turn = np.radians(random.normal() * roll + (90 if number < n_sideways else 0))
        up = np.cross(back, right)
        c2w = np.eye(4)
        x, y = np.cos(turn) * right + np.sin(turn) * up, np.cos(turn) * up - np.sin(turn) * right
        c2w[:3] = world @ np.stack([x, y, back, 3 * back], axis=-1)
        poses.append(c2w)
    return np.stack(poses), world[:, 2]


@pytest.mark.parametrize("seed", range(4))
def test_up_from_cameras_that_are_held_nearly_level(seed: int) -> None:
    poses, up = ring(seed, roll=2)
    assert degrees(find_up(poses, np.zeros((0, 3))), up) < 2
    poses, up = ring(seed, roll=2, n_sideways=5)  # as of a phone that did not notice
    assert degrees(find_up(poses, np.zeros((0, 3))), up) < 4


@pytest.mark.parametrize("seed", range(4))
def test_up_from_the_ground(seed: int) -> None:
    poses, up = ring(seed, roll=3)
    random = np.random.default_rng(seed)
    basis = np.linalg.svd(up[None])[2][1:]
    ground = random.uniform(-1, 1, (600, 2)) @ basis + random.normal(size=(600, 1)) * 0.002 * up
    above = random.uniform(-0.5, 0.5, (400, 3)) + 0.6 * up
    assert degrees(find_up(poses, np.concatenate([ground, above])), up) < 0.5
    below = np.concatenate([ground, above - 1.5 * up])  # a ceiling is no ground
    assert degrees(find_up(poses, below), up) == degrees(find_up(poses, below[:0]), up)


def test_a_slope_is_not_level() -> None:
    poses, up = ring(0, roll=0)
    slope = np.random.default_rng(0).uniform(-1, 1, (500, 2)) @ np.linalg.svd(up[None])[2][1:]
    slope = slope + 0.2 * (slope @ np.linalg.svd(up[None])[2][1])[:, None] * up
    assert degrees(find_up(poses, slope), up) < 0.1


def test_turns_to_z() -> None:
    for up in (*np.random.default_rng(0).normal(size=(20, 3)), [0, 0, 1.0], [0, 0, -1.0], [1e-9, 0, -1.0]):
        up = np.asarray(up) / np.linalg.norm(up)
        turn = turn_to_z(up)
        np.testing.assert_allclose(turn @ up, [0, 0, 1], atol=1e-8)
        np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-8)
        assert np.linalg.det(turn) > 0


def test_a_known_distance() -> None:
    train, test = demo_views(16, 4, 2)
    capture = Capture("toy", train, test, np.ones((2, 3)))
    names = train.cameras[0].name, test.cameras[1].name
    before = np.linalg.norm(train.cameras[0].c2w[:3, 3] - test.cameras[1].c2w[:3, 3])
    larger = scaled(capture, *names, 2.5)
    after = np.linalg.norm(larger.train.cameras[0].c2w[:3, 3] - larger.test.cameras[1].c2w[:3, 3])
    assert after == pytest.approx(2.5)
    np.testing.assert_allclose(larger.points, 2.5 / before)
    np.testing.assert_array_equal(larger.train.cameras[1].c2w[:3, :3], train.cameras[1].c2w[:3, :3])


@pytest.mark.parametrize("name", ["nothing.jpg", ""])
def test_a_picture_that_is_not_there(name: str) -> None:
    train, test = demo_views(16, 4, 2)
    with pytest.raises(
        DataError, match=r"scale: .*expected one picture with a camera, got none of that name"
    ):
        scaled(Capture("toy", train, test), train.cameras[0].name, name, 1.0)
    with pytest.raises(DataError, match="scale: expected two pictures from different places"):
        scaled(Capture("toy", train, PosedImages([], [])), *[train.cameras[0].name] * 2, 1.0)


def test_a_picture_that_has_no_camera() -> None:
    train, test = demo_views(16, 4, 2)
    why = {"left/IMG_3.jpg": "shows what IMG_2.jpg does"}
    with pytest.raises(
        DataError,
        match=r"IMG_3: expected a picture with a camera, got one without: shows what IMG_2\.jpg does:",
    ):
        scaled(Capture("toy", train, test), train.cameras[0].name, "IMG_3", 1.0, why)


def test_names_that_are_mistyped_are_found_before_cameras_are_estimated(tmp_path: Path) -> None:
    for name in ("a/1.jpg", "b/1.jpg", "b/2.jpg"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(b"")
    check_scale(tmp_path, ("a/1.jpg", "2", 1.0))
    check_scale(tmp_path, ("a/1.jpg", "1.jpg", 1.0))  # of two, one may be a copy that is left out
    with pytest.raises(
        DataError, match=r"3.jpg: expected one picture of that name, got none: the first is called a/1"
    ):
        check_scale(tmp_path, ("a/1.jpg", "3.jpg", 1.0))


def test_names_that_are_mistyped_are_found_before_pictures_are_read(
    small_data: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delattr(PictureReader, "read")
    with pytest.raises(DataError, match="scale: IMG_9: expected one picture with a camera, got none"):
        load_scene(small_data, scale=("IMG_9", "IMG_8", 1.0))
