"""Features and matches that are kept on the disk are read again, except broken ones."""

from __future__ import annotations

import errno
import io
import os
from pathlib import Path

import numpy as np
import pytest

from vfr_bake.data.features import Features
from vfr_bake.data.kept_matches import MOST_SECONDS, SIDE, KeptFeatures, KeptMatches, stamp

A, B, C = (bytes([number]) * 16 for number in range(3))


def made(seed: int, n: int) -> KeptFeatures:
    rng = np.random.default_rng(seed)
    points = rng.uniform(0, 4000, (n, 2)).astype(np.float32).astype(np.float64)
    features = Features(points, rng.integers(0, 256, (n, 128), np.uint8))
    return KeptFeatures(4000, 3000, features, rng.integers(0, 256, SIDE * SIDE, np.uint8), rng.uniform())


def same(a: KeptFeatures | None, b: KeptFeatures) -> bool:
    return (
        a is not None
        and (a.width, a.height, a.sharpness) == (b.width, b.height, b.sharpness)
        and np.array_equal(a.thumbnail, b.thumbnail)
        and np.array_equal(a.features.points, b.features.points)
        and np.array_equal(a.features.sift, b.features.sift)
    )


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with two pictures' features, of which one has none, and with their matches."""
    kept = KeptMatches(tmp_path)
    kept.keep_look(A, made(0, 7))
    kept.keep_look(B, made(1, 0))
    kept.keep_matches(A, B, np.array([[6, 2], [0, 1]], np.uint32))
    return tmp_path


def test_what_was_kept_comes_back(folder: Path):
    kept = KeptMatches(folder)
    assert same(kept.look(A), made(0, 7)) and same(kept.look(B), made(1, 0))
    assert kept.look(C) is None and kept.matches(B, A, 9, 9) is None
    matches = kept.matches(A, B, 7, 3)
    assert matches is not None and matches.tolist() == [[6, 2], [0, 1]]


def test_matches_of_features_that_are_not_there_do_not_count(folder: Path):
    assert KeptMatches(folder).matches(A, B, 6, 3) is None


@pytest.mark.parametrize("name", ["features.bin", "matches.bin"])
def test_a_record_that_is_cut_short_is_left_out_wherever_it_is_cut(folder: Path, name: str):
    content = (folder / name).read_bytes()
    whole = made(0, 7)
    for size in range(0, len(content), 61):
        (folder / name).write_bytes(content[:size])
        kept = KeptMatches(folder)
        assert kept.look(A) is None or same(kept.look(A), whole)
        kept.keep_look(C, made(2, 3))
        kept.keep_matches(B, C, np.zeros((0, 2)))
        again = KeptMatches(folder)
        assert same(again.look(C), made(2, 3)) and again.matches(B, C, 0, 3) is not None


def test_a_number_that_cannot_be_ends_the_file(folder: Path):
    path = folder / "features.bin"
    content = bytearray(path.read_bytes())
    content[32:36] = b"\xff" * 4
    path.write_bytes(content)
    kept = KeptMatches(folder)
    assert kept.look(A) is None
    kept.keep_look(C, made(2, 0))
    assert same(KeptMatches(folder).look(C), made(2, 0))
    assert path.stat().st_size == 36 + SIDE * SIDE


def test_of_two_processes_the_one_that_notices_the_other_keeps_no_more(folder: Path):
    said: list[str] = []
    first, second = KeptMatches(folder), KeptMatches(folder, said.append)
    for number in range(3):
        first.keep_look(bytes([number]) * 16, made(number, 4))
        second.keep_look(bytes([100 + number]) * 16, made(number, 5))
    assert len(said) == 1 and "another process" in said[0]
    for kept in (first, KeptMatches(folder)):
        assert all(same(kept.look(bytes([number]) * 16), made(number, 4)) for number in range(3))
    assert second.look(bytes([100]) * 16) is None and same(second.look(A), made(0, 7))


def test_a_picture_that_changed_has_another_stamp(tmp_path: Path):
    path = tmp_path / "a.jpg"
    path.write_bytes(b"abc")
    first = stamp(path)
    assert stamp(path) == first and len(first) == 16
    os.utime(path, (1, 1))
    assert stamp(path) != first


def test_a_folder_that_cannot_be_made_is_done_without(tmp_path: Path):
    (tmp_path / "file").write_bytes(b"")
    said: list[str] = []
    kept = KeptMatches.of(tmp_path, tmp_path / "file", said.append)
    kept.keep_look(A, made(0, 7))
    kept.keep_matches(A, B, np.array([[6, 2]], np.uint32))
    assert kept.look(A) is None and kept.matches(A, B, 7, 3) is None
    assert len(said) == 1 and said[0].startswith(str(tmp_path / "file"))
    kept.remove()


def test_a_full_disk_ends_the_keeping_alone(folder: Path, monkeypatch: pytest.MonkeyPatch):
    class Full(io.FileIO):
        def write(self, data) -> int:
            super().write(data[: len(data) // 2])
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    said: list[str] = []
    kept = KeptMatches(folder, said.append)
    with monkeypatch.context() as full:
        full.setattr(Path, "open", lambda path, mode: Full(path, mode))
        kept.keep_look(C, made(2, 3))
        kept.keep_matches(B, C, np.zeros((4, 2)))
    kept.keep_look(C, made(2, 3))
    assert len(said) == 1 and os.strerror(errno.ENOSPC) in said[0]
    for each in (kept, KeptMatches(folder)):
        assert same(each.look(A), made(0, 7)) and each.matches(A, B, 7, 3) is not None
        assert each.look(C) is None and each.matches(B, C, 9, 9) is None


def test_what_nobody_came_back_to_is_deleted(tmp_path: Path):
    old, new = (KeptMatches.of(tmp_path / name, tmp_path / "root") for name in "ab")
    for kept in (old, new):
        kept.keep_look(A, made(0, 1))
    path = old._looks_path
    os.utime(path, (path.stat().st_mtime - MOST_SECONDS - 60,) * 2)
    KeptMatches.of(tmp_path / "c", tmp_path / "root")
    assert not path.exists() and new._looks_path.exists()
