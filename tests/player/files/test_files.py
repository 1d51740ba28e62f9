"""Tests of writing: what a name holds before, during and after, and when something goes wrong."""

from __future__ import annotations

import errno
import io
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from player.errors import OutputError, VfrError
from player.files.files import check_target, new_folder, write_bytes

FULL = "No space left on device"


def refuse(number: int) -> Callable[..., Any]:
    """Return a substitute for a system function that fails with this error number."""

    def refused(*arguments: object, **options: object) -> None:
        raise OSError(number, os.strerror(number))

    return refused


class FullDisk(io.FileIO):
    """A file on a disk that has room for three bytes."""

    def write(self, data: Any) -> int:
        super().write(data[:3])
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def tree(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@contextmanager
def umask(mask: int) -> Iterator[None]:
    before = os.umask(mask)
    try:
        yield
    finally:
        os.umask(before)


@pytest.fixture
def old(tmp_path: Path) -> Path:
    """Create a folder `result` with a file in it, alone in its parent."""
    folder = tmp_path / "place" / "result"
    folder.mkdir(parents=True)
    (folder / "old").write_bytes(b"old")
    return folder


@pytest.fixture
def no_exchange(monkeypatch: pytest.MonkeyPatch) -> None:
    """Imitate a system, or a disk, that cannot exchange two names in one step."""
    monkeypatch.setattr("player.files.replace.exchange", lambda one, other: False)


@pytest.fixture
def read_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    folder = tmp_path / "read only"
    folder.mkdir()
    folder.chmod(0o555)
    if os.access(folder, os.W_OK):  # root may write: imitate the system's answer
        monkeypatch.setattr("player.files.files._temporary_name", refuse(errno.EACCES))
    yield folder
    folder.chmod(0o755)


# --- check_target ---


@pytest.mark.parametrize("may_write", [True, False])
def test_on_windows_a_folder_is_tried(
    may_write: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Windows says of every folder that it can be written to, so a file is made there and removed."""
    monkeypatch.setattr("player.files.files.sys.platform", "win32")
    monkeypatch.setattr(os, "access", lambda path, mode: True)
    if may_write:
        check_target(tmp_path / "target")
    else:
        monkeypatch.setattr(Path, "touch", refuse(errno.EACCES))
        with pytest.raises(OutputError, match="is read-only"):
            check_target(tmp_path / "target")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("n_refused", "arrives"), [(0, True), (2, True), (4, False)])
def test_on_windows_a_name_is_given_again_while_a_program_has_the_file_open(
    n_refused: int, arrives: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("player.files.replace.sys.platform", "win32")
    monkeypatch.setattr("player.files.replace.PAUSES", (0.0, 0.0, 0.0))
    usual, refusals = Path.replace, iter([True] * n_refused)

    def replace(path: Path, to: Path) -> Path:
        if next(refusals, False):
            raise PermissionError(errno.EACCES, "in use")
        return usual(path, to)

    monkeypatch.setattr(Path, "replace", replace)
    target = tmp_path / "a.bin"
    if arrives:
        write_bytes(target, b"new")
        assert target.read_bytes() == b"new"
    else:
        with pytest.raises(OutputError, match="cannot write: in use"):
            write_bytes(target, b"new")
        assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("kind", ["file", "folder"])
def test_a_target_that_exists_is_refused_unless_forced(tmp_path: Path, kind: str) -> None:
    target = tmp_path / "target"
    check_target(target)
    target.mkdir() if kind == "folder" else target.write_bytes(b"")
    with pytest.raises(OutputError) as caught:
        check_target(target)
    assert str(caught.value) == f"{target}: already exists: add --force to replace it"
    assert isinstance(caught.value, VfrError)
    check_target(target, force=True)


def test_a_folder_is_not_replaced_by_a_file(tmp_path: Path) -> None:
    for force in (False, True):
        with pytest.raises(OutputError, match="expected a file to write, got a folder: name a file in it"):
            check_target(tmp_path, force, is_file=True)


@pytest.mark.parametrize("force", [False, True])
def test_the_current_folder_and_a_root_are_refused(
    force: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whoever is in a folder that is replaced would be left in the old one; a root has no name to give."""
    monkeypatch.chdir(tmp_path)
    for path in (Path(), tmp_path, Path("../") / tmp_path.name):
        with pytest.raises(OutputError, match="expected a new folder, got the current one, which cannot"):
            check_target(path, force)
        with pytest.raises(OutputError, match="got the current one"), new_folder(path, force):
            pytest.fail("the block was entered")
    with pytest.raises(OutputError, match="got the root of a disk: name one in it"):
        check_target(Path(tmp_path.anchor), force)
    for path in (Path(), Path("..")):
        with pytest.raises(OutputError, match="cannot write: it is a folder"):
            write_bytes(path, b"data")
    assert names(tmp_path) == []


def test_a_folder_that_is_named_from_within_another(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "site" / "in it").mkdir(parents=True)
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    with new_folder(Path("../site/in it/.."), force=True) as folder:
        (folder / "file").write_bytes(b"data")
    assert tree(tmp_path / "site") == {"file": b"data"} and names(tmp_path) == ["elsewhere", "site"]


# --- write_bytes ---


def test_write_bytes_makes_parents_and_replaces(tmp_path: Path) -> None:
    path = tmp_path / "a" / "b" / "file.bin"
    for data in (b"one", b"", b"another" * 1000):
        write_bytes(path, data)
        assert tree(path.parent) == {"file.bin": data}


@pytest.mark.parametrize("step", ["write", "fsync", "rename"])
def test_a_failure_midway_leaves_the_old_file(
    step: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "file.bin"
    path.write_bytes(b"old content")
    if step == "write":
        monkeypatch.setattr(Path, "open", lambda path, mode, **_: FullDisk(path, mode))
    elif step == "fsync":
        monkeypatch.setattr(os, "fsync", refuse(errno.ENOSPC))
    else:
        monkeypatch.setattr(Path, "replace", refuse(errno.ENOSPC))
    with pytest.raises(OutputError) as caught:
        write_bytes(path, b"new content")
    assert str(caught.value) == f"{path}: cannot write: {FULL}"
    assert tree(tmp_path) == {"file.bin": b"old content"}


def test_an_interrupt_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(handle: int) -> None:
        raise KeyboardInterrupt

    path = tmp_path / "file.bin"
    path.write_bytes(b"old content")
    monkeypatch.setattr(os, "fsync", interrupt)
    with pytest.raises(KeyboardInterrupt):
        write_bytes(path, b"new content")
    assert tree(tmp_path) == {"file.bin": b"old content"}


def test_a_failure_leaves_nothing_where_nothing_was(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Path, "open", lambda path, mode, **_: FullDisk(path, mode))
    with pytest.raises(OutputError, match=FULL):
        write_bytes(tmp_path / "file.bin", b"new content")
    assert names(tmp_path) == []


def test_write_bytes_into_a_read_only_folder(read_only: Path) -> None:
    path = read_only / "file.bin"
    with pytest.raises(OutputError) as caught:
        write_bytes(path, b"data")
    assert str(caught.value) == f"{path}: cannot write: {os.strerror(errno.EACCES)}"
    assert names(read_only) == []


def test_write_bytes_where_it_cannot_be(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").write_bytes(b"mine")
    for path in (tmp_path / "folder", tmp_path / "file" / "below"):
        with pytest.raises(OutputError, match="cannot write") as caught:
            write_bytes(path, b"data")
        assert str(caught.value).startswith(f"{path}: ")
    assert names(tmp_path) == ["file", "folder"] and names(tmp_path / "folder") == []
    assert (tmp_path / "file").read_bytes() == b"mine"


# --- new_folder ---


def test_a_folder_appears_complete(tmp_path: Path) -> None:
    path = tmp_path / "a" / "result"
    with new_folder(path) as folder:
        assert folder.parent == path.parent  # a rename never crosses to another disk
        (folder / "file").write_bytes(b"data")
        (folder / "sub").mkdir()
        assert not path.exists()
    assert names(path) == ["file", "sub"] and names(path.parent) == ["result"]


@pytest.mark.parametrize("error", [ValueError("mine"), KeyboardInterrupt(), OutputError("a/b: says enough")])
@pytest.mark.parametrize("force", [False, True])
def test_an_exception_inside_passes_and_removes_the_folder(
    error: BaseException, force: bool, tmp_path: Path
) -> None:
    path = tmp_path / "result"
    if force:
        path.mkdir()
        (path / "old").write_bytes(b"old")
    with pytest.raises(type(error)) as caught, new_folder(path, force) as folder:
        (folder / "file").write_bytes(b"data")
        raise error
    assert caught.value is error
    assert names(tmp_path) == (["result"] if force else [])
    assert not force or tree(path) == {"old": b"old"}


def test_a_full_disk_inside_names_the_folder(tmp_path: Path) -> None:
    path = tmp_path / "result"
    with pytest.raises(OutputError) as caught, new_folder(path) as folder:
        with FullDisk(str(folder / "file"), "w") as file:
            file.write(b"data")
    assert str(caught.value) == f"{path}: cannot write: {FULL}"
    assert names(tmp_path) == []


def test_a_folder_that_exists_is_refused_before_the_work(old: Path) -> None:
    with pytest.raises(OutputError, match="already exists"), new_folder(old):
        pytest.fail("the block was entered")
    assert tree(old) == {"old": b"old"} and names(old.parent) == ["result"]


@pytest.mark.parametrize("kind", ["folder", "file"])
@pytest.mark.parametrize("in_one_step", [True, False])
def test_force_replaces_at_the_end(
    kind: str, in_one_step: bool, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    if not in_one_step:
        request.getfixturevalue("no_exchange")
    path = tmp_path / "result"
    if kind == "folder":
        path.mkdir()
        (path / "old").write_bytes(b"old")
    else:
        path.write_bytes(b"old")
    with new_folder(path, force=True) as folder:
        (folder / "new").write_bytes(b"new")
        assert (path / "old" if kind == "folder" else path).read_bytes() == b"old"
    assert tree(path) == {"new": b"new"} and names(tmp_path) == ["result"]


@pytest.mark.parametrize("failing", [1, 2])
def test_a_failure_in_replacing_restores_the_old_folder(
    failing: int, old: Path, no_exchange: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The old folder is restored if either rename fails: the first puts it aside, the second puts the new one
    in its place."""
    rename, calls = Path.replace, []

    def replace(self: Path, target: Path) -> Path:
        calls.append(target)
        return refuse(errno.EACCES)() if len(calls) == failing else rename(self, target)

    monkeypatch.setattr(Path, "replace", replace)
    with pytest.raises(OutputError) as caught, new_folder(old, force=True) as folder:
        (folder / "new").write_bytes(b"new")
    assert str(caught.value) == f"{old}: cannot write: {os.strerror(errno.EACCES)}"
    assert tree(old) == {"old": b"old"} and names(old.parent) == ["result"]


def test_an_old_folder_that_cannot_be_restored_is_kept(
    old: Path, no_exchange: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    rename, calls = Path.replace, []

    def replace(self: Path, target: Path) -> Path:
        calls.append(target)
        return refuse(errno.EIO)() if len(calls) > 1 else rename(self, target)

    monkeypatch.setattr(Path, "replace", replace)
    with pytest.raises(OutputError) as caught, new_folder(old, force=True) as folder:
        (folder / "new").write_bytes(b"new")
    kept = Path(calls[0])
    assert str(caught.value).startswith(f"{old}: cannot put the old one back: ")
    assert str(caught.value).endswith(f"it is in {kept}")
    assert tree(kept) == {"old": b"old"} and names(old.parent) == [kept.name]


def test_new_folder_in_a_read_only_folder(read_only: Path) -> None:
    path = read_only / "result"
    with pytest.raises(OutputError) as caught, new_folder(path):
        pytest.fail("the block was entered")
    assert str(caught.value) == f"{path}: cannot write: {os.strerror(errno.EACCES)}"
    assert names(read_only) == []


# --- permissions ---


@pytest.mark.parametrize("mask", [0o000, 0o022, 0o027, 0o077])
def test_permissions_are_those_of_anything_new(mask: int, tmp_path: Path) -> None:
    """Files and folders get the permissions that `open` and `mkdir` give."""
    with umask(mask):
        (tmp_path / "plain").write_bytes(b"")
        (tmp_path / "plain folder").mkdir()
        write_bytes(tmp_path / "file", b"data")
        with new_folder(tmp_path / "folder"):
            pass
        assert os.umask(mask) == mask  # reading the mask did not change it
    assert (tmp_path / "file").stat().st_mode == (tmp_path / "plain").stat().st_mode
    assert (tmp_path / "folder").stat().st_mode == (tmp_path / "plain folder").stat().st_mode


def test_target_in_a_file_or_a_read_only_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Targets in a file or a read-only folder are refused before any work. `os.access` is replaced, because
    root may write anywhere."""
    (tmp_path / "file").write_text("mine")
    with pytest.raises(OutputError, match="file is a file, not a folder"):
        check_target(tmp_path / "file" / "a" / "b.png")
    check_target(tmp_path / "a" / "b.png")
    monkeypatch.setattr("os.access", lambda path, mode: Path(path) != tmp_path)
    with pytest.raises(OutputError, match=r"the folder .* is read-only"):
        check_target(tmp_path / "a" / "b.png")
    monkeypatch.setattr("os.access", lambda path, mode: Path(path).name != "file")
    with pytest.raises(OutputError, match="file: cannot write: it is read-only"):
        check_target(tmp_path / "file", force=True)
