"""Tests of what a killed process leaves beside its target, and of who finishes or removes it."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from player.asset.asset import Asset
from player.errors import FormatError, OutputError
from player.files.files import check_target, new_file, new_folder, write_bytes, write_together
from player.files.replace import MARK, clear_up, exchange, held, mark
from tests.player.conftest import write_shells

needs_locks = pytest.mark.skipif(os.name == "nt", reason="Windows has no locks on folders")
REPOSITORY = Path(__file__).resolve().parents[3]
LEFT = ".scene.a_3bc9xy.part"


def names(folder: Path) -> list[str]:
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*"))


def fill(folder: Path, content: str, *files: str) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    for name in files:
        (folder / name).write_text(content)
    return folder


@contextmanager
def somebody_writes_in(folder: Path) -> Iterator[None]:
    """Run another process that writes something in `folder` under a temporary name, while the block runs."""
    program = "import sys; from pathlib import Path; from player.files.replace import held; "
    program += "work = held(Path(sys.argv[1])); work.__enter__(); print(flush=True); input()"
    process = subprocess.Popen(
        [sys.executable, "-c", program, str(folder)],
        cwd=REPOSITORY, stdin=subprocess.PIPE, stdout=subprocess.PIPE,
    )  # fmt: skip
    assert process.stdin is not None and process.stdout is not None
    try:
        assert process.stdout.readline()
        yield
    finally:
        process.kill()
        process.communicate()


@pytest.mark.skipif(sys.platform not in ("linux", "darwin"), reason="no other system exchanges names")
def test_two_names_are_exchanged(tmp_path: Path) -> None:
    """Two names are exchanged. If this disk could not, replacing in one step would be tested nowhere."""
    one, other = fill(tmp_path / "one", "1", "a"), tmp_path / "other"
    other.write_text("2")
    assert exchange(one, other)
    assert one.read_text() == "2" and (other / "a").read_text() == "1"
    assert not exchange(one, tmp_path / "nothing") and one.read_text() == "2"


@pytest.mark.skipif(sys.platform not in ("linux", "darwin"), reason="no other system exchanges names")
def test_a_folder_that_is_replaced_always_has_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A folder that is replaced is exchanged with the new one, never renamed to another name."""
    fill(tmp_path / "scene", "old", "a")
    rename = Path.replace

    def replace(self: Path, target: Path) -> Path:
        assert self.name != "scene"
        return rename(self, target)

    monkeypatch.setattr(Path, "replace", replace)
    with new_folder(tmp_path / "scene", force=True) as new:
        fill(new, "new", "a")
    assert (tmp_path / "scene" / "a").read_text() == "new" and names(tmp_path) == ["scene", "scene/a"]


@pytest.mark.parametrize("command", ["check", "write", "open"])
def test_an_old_folder_gets_its_name_back(command: str, tmp_path: Path) -> None:
    """After a process was killed between two renames, on a system without an exchange, the next command gives
    the old folder its name back."""
    write_shells(tmp_path / "elsewhere" / "scene").rename(tmp_path / ".scene.replaced")
    if command == "open":
        Asset.open(tmp_path / "scene", verify=True)
    elif command == "check":
        with pytest.raises(OutputError, match="already exists"):
            check_target(tmp_path / "scene")
    else:
        write_bytes(tmp_path / "another", b"")
    assert (tmp_path / "scene" / "manifest.json").is_file() and not (tmp_path / ".scene.replaced").exists()


@needs_locks
def test_what_is_left_is_removed_by_the_next_command(tmp_path: Path) -> None:
    fill(tmp_path / "scene", "new", "a")
    fill(tmp_path / ".scene.replaced", "old", "a")
    fill(tmp_path / LEFT, "half", "a")
    fill(tmp_path, "half", ".model.pt.________.part")
    fill(tmp_path, "mine", ".hidden", "a.part", ".a.part", ".b.replaced.txt")
    check_target(tmp_path / "something else")
    assert names(tmp_path) == [".a.part", ".b.replaced.txt", ".hidden", "a.part", "scene", "scene/a"]
    assert (tmp_path / "scene" / "a").read_text() == "new"


@needs_locks
def test_nothing_is_removed_while_somebody_writes(tmp_path: Path) -> None:
    with somebody_writes_in(tmp_path):
        fill(tmp_path, "half", LEFT)
        check_target(tmp_path / "scene")
        write_bytes(tmp_path / "file", b"")
        assert names(tmp_path) == [LEFT, "file"]
    check_target(tmp_path / "scene")  # the other process is dead, and its lock with it
    assert names(tmp_path) == ["file"]


@needs_locks
def test_nothing_is_removed_while_this_process_writes(tmp_path: Path) -> None:
    with new_folder(tmp_path / "scene") as folder:
        clear_up(tmp_path)
        assert folder.is_dir()
        with new_file(tmp_path / "film.mp4") as film:
            film.write_bytes(b"film")
    assert names(tmp_path) == ["film.mp4", "scene"]


@needs_locks
def test_a_second_folder_is_held_by_one_process(tmp_path: Path) -> None:
    """A process that writes in one folder may clear up another: only the first is locked."""
    fill(tmp_path / "a", "half", LEFT)
    (tmp_path / "b").mkdir()
    with held(tmp_path / "b"):
        clear_up(tmp_path / "a")
    assert names(tmp_path) == ["a", "b"]


def test_files_that_belong_together_are_all_new_after_the_next_command(tmp_path: Path) -> None:
    """After a process was killed after the first of three moves, the next command does the other two."""
    fill(tmp_path, "old", "a.mtl", "a.png")
    fill(tmp_path, "new", "a.obj")
    mark(fill(tmp_path / ".a.obj.together", "new", "a.mtl", "a.png"))
    with pytest.raises(OutputError, match="already exists"):
        check_target(tmp_path / "a.obj")
    assert names(tmp_path) == ["a.mtl", "a.obj", "a.png"]
    assert {path.read_text() for path in tmp_path.iterdir()} == {"new"}


def test_what_another_process_has_begun_to_move_is_moved_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("player.files.replace.clear_up", lambda folder: None)
    monkeypatch.setattr("player.files.replace._clear_up_once", lambda folder: None)
    mark(fill(tmp_path / ".a.obj.together", "first", "a.mtl", "a.lod1.obj"))
    write_together({tmp_path / "a.obj": b"second", tmp_path / "a.mtl": b"second"})
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == {
        "a.obj": "second",
        "a.mtl": "second",
        "a.lod1.obj": "first",
    }


def test_an_unpacked_folder_replaces_nothing_else(tmp_path: Path) -> None:
    """A folder from an archive that looks like an interrupted move replaces no files, even with the mark of
    one that was copied."""
    fill(tmp_path, "mine", "a.docx", "report.docx", ".bashrc")
    hostile = fill(tmp_path / ".a.obj.together", "theirs", "a.docx", "report.docx", ".bashrc", "a.png")
    for number in ("", "1", str(hostile.stat().st_ino)):
        (hostile / MARK).write_text(number)
        check_target(tmp_path / "a.obj")
        with pytest.raises(FormatError, match="got nothing"):
            Asset.open(tmp_path / "mistyped")
        with pytest.raises(OutputError, match=r"\.a\.obj\.together: cannot write: remove this folder"):
            write_together({tmp_path / "a.obj": b"", tmp_path / "a.mtl": b""})
        assert {path.read_text() for path in tmp_path.iterdir() if path.is_file()} == {"mine"}
        assert not {"a.obj", "a.png"} & set(names(tmp_path))


def test_a_move_takes_only_files_that_belong_to_the_name(tmp_path: Path) -> None:
    fill(tmp_path, "mine", "report.docx", ".bashrc")
    folder = fill(tmp_path / ".a.obj.together", "theirs", "report.docx", ".bashrc", "a.png")
    (folder / "a").mkdir()
    (folder / "a.lnk").symlink_to(tmp_path / "report.docx")
    mark(folder)
    check_target(tmp_path / "a.obj")
    assert (tmp_path / "report.docx").read_text() == (tmp_path / ".bashrc").read_text() == "mine"
    assert (tmp_path / "a.png").is_file() and not (tmp_path / "a").exists()
    with pytest.raises(OutputError, match="cannot write"):
        write_together({tmp_path / "a.obj": b"", tmp_path / "a.mtl": b""})
    assert not (tmp_path / "a.obj").exists()


def test_a_file_that_is_called_like_a_replaced_folder_stays(tmp_path: Path) -> None:
    fill(tmp_path, "mine", ".bashrc.replaced", ".a.replaced", "a")
    check_target(tmp_path / "scene")
    assert names(tmp_path) == [".a.replaced", ".bashrc.replaced", "a"]


def test_files_are_written_together_or_not_at_all(tmp_path: Path) -> None:
    (tmp_path / "a.png").mkdir()
    with pytest.raises(OutputError, match=r"a\.png: cannot write: it is a folder"):
        write_together({tmp_path / "a.obj": b"1", tmp_path / "a.png": b"2"})
    assert names(tmp_path) == ["a.png"]
    write_together({tmp_path / "a.obj": b"1", tmp_path / "a.mtl": b"2"})
    assert names(tmp_path) == ["a.mtl", "a.obj", "a.png"] and (tmp_path / "a.mtl").read_bytes() == b"2"


@pytest.mark.parametrize("error", [ValueError("mine"), OutputError("a/b: says enough"), OSError("disk")])
def test_a_file_that_fails_leaves_the_old_one(error: Exception, tmp_path: Path) -> None:
    path = tmp_path / "film.mp4"
    path.write_bytes(b"old")
    with pytest.raises(OutputError if isinstance(error, OSError) else type(error)), new_file(path) as film:
        film.write_bytes(b"half")
        raise error
    assert names(tmp_path) == ["film.mp4"] and path.read_bytes() == b"old"


def test_an_asset_that_is_nowhere(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="expected the folder of an asset, got nothing"):
        Asset.open(tmp_path / "a" / "b")
