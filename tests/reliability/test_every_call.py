"""Kills before every call that changes the disk: a short form of `tests.reliability.every_call`."""

from __future__ import annotations

import shutil
import signal
import sys
from pathlib import Path

import pytest

from player.files.files import check_target, new_folder
from tests.reliability.test_reliability import run, run_program

if sys.platform != "linux":
    pytest.skip("processes are stopped with Linux's ptrace and seccomp", allow_module_level=True)

PROGRAM = """
import sys, threading
from pathlib import Path
from player.files import files
from player.files import replace
from tests.reliability import stops
if {fallback}:
    replace.exchange = lambda one, other: False
folder = Path(sys.argv[1])
kill_at = int(sys.argv[2])
calls = []
def work():
    {work}
    return 0
def stop(call):
    calls.append(call)
    return len(calls) - 1 == kill_at
code = stops.run(work, folder, stop)
import json; print(json.dumps({{"code": code, "calls": calls}}))
"""


def watched(folder: Path, work: str, kill_at: int = -1, fallback: bool = False) -> tuple[int, list[str]]:
    """Return the exit code and the calls of `work`, run in a process without other threads."""
    result = run_program(PROGRAM.format(work=work, fallback=fallback), str(folder), str(kill_at))
    return result["code"], result["calls"]


def test_calls_are_seen_whoever_makes_them(tmp_path: Path) -> None:
    """Calls of threads and other programs are seen too, but not calls elsewhere, nor reading."""
    work = (
        "import subprocess; (folder / 'a').write_bytes(b'1'); (folder / 'a').read_bytes(); "
        "thread = threading.Thread(target=(folder / 'a').rename, args=(folder / 'b',)); "
        "thread.start(); thread.join(); Path(f'{folder}.else').write_bytes(b''); "
        "subprocess.run(['/bin/sh', '-c', 'echo hallo > c'], cwd=folder, check=True); "
        "import os; handle = os.open(folder, os.O_RDONLY); os.unlink('c', dir_fd=handle)"
    )
    code, calls = watched(tmp_path, work)
    assert code == 0
    assert calls == ["openat a", "write a", "rename a b", "openat c", "write c", "unlinkat c"]


@pytest.mark.parametrize("kill_at", range(3))
def test_a_kill_is_before_the_call(kill_at: int, tmp_path: Path) -> None:
    work = "(folder / 'a').write_bytes(b'1'); (folder / 'a').rename(folder / 'b')"
    code, calls = watched(tmp_path, work, kill_at)
    assert code == -signal.SIGKILL and len(calls) == kill_at + 1
    assert [(path.name, path.read_bytes()) for path in tmp_path.iterdir()] == [
        [],
        [("a", b"")],
        [("a", b"1")],
    ][kill_at]


@pytest.mark.parametrize("fallback", [False, True])
def test_a_folder_is_old_or_new_at_every_call(fallback: bool, tmp_path: Path) -> None:
    """A folder is old or new at every call; if names cannot be exchanged, it may be missing for a while."""
    work = (
        "context = files.new_folder(folder / 'scene', True); new = context.__enter__(); "
        "[(new / name).write_bytes(b'new') for name in 'xyz']; context.__exit__(None, None, None)"
    )
    away, states = 0, []
    for number in range(100):
        place = tmp_path / str(number)
        (place / "scene").mkdir(parents=True)
        for name in "xy":
            (place / "scene" / name).write_bytes(b"old")
        code, calls = watched(place, work, number, fallback)
        if code == 0:
            break
        away += not (place / "scene").exists()
        check_target(place / "scene", force=True)
        states.append({path.name: path.read_bytes() for path in (place / "scene").iterdir()})
        assert [path.name for path in place.iterdir()] == ["scene"], calls[-1]
        with new_folder(place / "scene", force=True) as new:
            shutil.copy(__file__, new)
        assert [path.name for path in place.iterdir()] == ["scene"]
    old, new_one = dict.fromkeys("xy", b"old"), dict.fromkeys("xyz", b"new")
    assert len(states) >= 11 and away == fallback
    assert states == [old] * states.count(old) + [new_one] * states.count(new_one)
    assert old in states and new_one in states


def test_commands_leave_the_old_or_the_new_at_every_call() -> None:
    result = run(
        *("tests.reliability.every_call", "--once", "--again", "100", "--commands"),
        *("play video", "export obj", "export colmap"),
    )
    assert result["failures"] == []
    counts = {name: facts["calls"] for name, facts in result["commands"].items()}
    assert min(counts.values()) >= 12 and len(counts) == 3, counts
