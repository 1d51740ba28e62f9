"""What the six commands have in common: wrong values, useless options, system errors and closed pipes."""

from __future__ import annotations

import argparse
import errno
import os
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import pytest

from exporters.cli import main as export_main
from exporters.cli import make_parser as export_parser
from player.app import commands
from player.app.cli import main as play_main
from player.app.options import MODES, USED_BY, make_parser
from vfr_bake import cli as bake_cli
from vfr_bake import demo
from vfr_bake import options as bake_options

MAINS: dict[str, Callable[[list[str]], int]] = {
    "vfr-train": bake_cli.train_main,
    "vfr-bake": bake_cli.bake_main,
    "vfr-eval": bake_cli.eval_main,
    "vfr-bench": bake_cli.bench_main,
    "vfr-play": play_main,
    "vfr-export": export_main,
}
ENTRIES = {
    "vfr-train": "vfr_bake.cli:train_main",
    "vfr-bake": "vfr_bake.cli:bake_main",
    "vfr-eval": "vfr_bake.cli:eval_main",
    "vfr-bench": "vfr_bake.cli:bench_main",
    "vfr-play": "player.app.cli:main",
    "vfr-export": "exporters.cli:main",
}


def code_of(main: Callable[[list[str]], int], arguments: list[str]) -> int:
    try:
        return main(arguments)
    except SystemExit as leave:
        assert isinstance(leave.code, int)
        return leave.code


# --- wrong values ---


def typed(parser: argparse.ArgumentParser) -> list[argparse.Action]:
    """Return the options that take a value other than a name or a file."""
    return [a for a in parser._actions if a.option_strings and (a.choices or a.type not in (None, Path))]


TYPED = [
    *(("vfr-play", action) for action in typed(make_parser())),
    *(("vfr-export", action) for action in typed(export_parser())),
]


def test_every_option_with_a_value_is_here() -> None:
    """Every option with a value is either a choice or read by `player.app.option_types`, never by a function
    of Python itself."""
    assert len(TYPED) == 25
    for _, action in TYPED:
        assert action.choices or getattr(action.type, "__module__", "") == "player.app.option_types", action


@pytest.mark.parametrize(("command", "action"), TYPED, ids=[f"{c} {a.option_strings[0]}" for c, a in TYPED])
def test_a_wrong_value_is_told_with_what_is_expected(
    command: str, action: argparse.Action, capsys: pytest.CaptureFixture[str]
) -> None:
    name = action.option_strings[0]
    places = ["a", "b.ply"] if command == "vfr-export" else ["a"]
    assert code_of(MAINS[command], [*places, f"{name}=wr.ong"]) == 2
    told = capsys.readouterr().err.splitlines()[-1]
    assert told.startswith(f"{command}: error: argument {name}: ") and "wr.ong" in told
    _no_names_of_python(told)
    if not action.choices:
        found = re.fullmatch(r".*: expected .+, such as (\S+), got 'wr\.ong'", told)
        assert found and callable(action.type), told
        action.type(found[1])  # the example in the message is valid


def numbers(options: Any) -> Iterator[str]:
    """Yield the names of the fields that are numbers, including those of nested settings."""
    for field in fields(options):
        nested = getattr(field, "default_factory", None)
        if is_dataclass(nested):
            yield from numbers(nested)
        elif re.match(r"(int|float|tuple\[int)", str(field.type)):
            yield field.name.replace("_", "-")


SETTINGS = [
    (f"vfr-{kind.lower()}", name)
    for kind in ("Train", "Bake", "Eval", "Bench")
    for name in numbers(getattr(bake_options, kind))
]


def test_settings_of_the_bake_are_here() -> None:
    assert len(SETTINGS) > 40 and {command for command, _ in SETTINGS} == {
        "vfr-train",
        "vfr-bake",
        "vfr-eval",
        "vfr-bench",
    }


@pytest.mark.parametrize(("command", "name"), SETTINGS)
def test_a_wrong_setting_is_told_with_what_is_expected(
    command: str, name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    places = ["a", "--data", "d"] if command == "vfr-bench" else ["a", "b"]
    assert code_of(MAINS[command], [*places, f"--{name}", "wr.ong"]) == 2
    told = " ".join(line.strip("│ ") for line in capsys.readouterr().err.splitlines()[1:3])
    assert re.search(rf"Error parsing --{name}: expected .*a (whole )?number, such as", told), told
    _no_names_of_python(told)


def test_a_wrong_time_of_the_demo(capsys: pytest.CaptureFixture[str]) -> None:
    assert code_of(lambda words: demo.main(words), ["--minutes", "wr.ong"]) == 2
    expected = "expected minutes, a number over 0, such as 2.5, got 'wr.ong'"
    assert expected in capsys.readouterr().err


def _no_names_of_python(told: str) -> None:
    assert not re.search(r"\b_\w|\w_\w|invalid (int|float)|<class|typing\.|Traceback|literal", told), told


# --- options that do nothing ---


def given(name: str) -> list[str]:
    """Return an option of `vfr-play` as on a command line, with a value that it takes."""
    values = {"cameras": "c.json", "orbit": "2", "view": "1", "output": "o", "format": "png", "frames": "1:2",
              "fps": "5", "json": "j.json", "dask": "tcp://127.0.0.1:1", "size": "8x8", "background": "white",
              "samples": "0", "quality": "fast", "threads": "1", "march": "auto", "host": "127.0.0.1",
              "port": "1", "max_memory": "4"}  # fmt: skip
    if name == "others":
        return ["more"]
    option = f"--{name.replace('_', '-')}"
    return [option, values[name]] if name in values else [option]


def test_every_option_of_the_player_has_its_modes() -> None:
    names = {action.dest for action in make_parser()._actions} - {"help", "asset"}
    assert names == set(USED_BY) and all({*modes} <= {*MODES} and modes for modes in USED_BY.values())


ASKED = {
    "viewer": [],
    "files": ["--view", "1", "--output", "o.mp4"],
    "info": ["--info"],
    "check": ["--check"],
}
ALONE = {"cameras", "orbit", "view", "info", "check"}
"""Options that exclude each other in argparse, so that one that chooses a mode is refused in other modes."""

PAIRS = [
    (name, mode)
    for name in USED_BY
    for mode in MODES
    if name not in ALONE or (mode == "viewer" and name not in ("info", "check"))
]


@pytest.mark.parametrize(("name", "mode"), PAIRS)
def test_an_option_does_something_or_is_refused(
    name: str, mode: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """An option is either used, so that only the missing asset is an error (exit code 1), or refused."""
    monkeypatch.chdir(tmp_path)
    asked = ["--view", "1", "--output", "o"] if name == "format" and mode == "files" else ASKED[mode]
    code = code_of(play_main, ["asset", *given(name), *asked])
    told = capsys.readouterr().err
    if mode in USED_BY[name]:
        assert code == 1 and "asset: expected the folder of an asset, got nothing" in told
    elif name == "others":
        assert code == 2 and "more: one asset at a time, but in the viewer" in told
    elif mode == "viewer" and name in ("output", *ALONE):  # one half of a request for files
        assert code == 2 and "--output: add" in told
    else:
        wanted = ", or for ".join(MODES[used] for used in USED_BY[name])
        assert (
            code == 2
            and f"--{name}: does nothing for {MODES[mode].split(',')[0]}; it is for {wanted}" in told
        )


# --- errors of the system ---


def refuse_imports(error: BaseException) -> Callable[..., Any]:
    def refuse(*_: object, **__: object) -> Any:
        raise error

    return refuse


SYSTEM = [
    OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)),
    OSError(errno.EIO, os.strerror(errno.EIO), "some/file"),
    FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), "a\nb"),
    PermissionError(errno.EACCES, os.strerror(errno.EACCES), "some/file"),
    IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), "some/file"),
    ConnectionRefusedError(errno.ECONNREFUSED, os.strerror(errno.ECONNREFUSED)),
]


@pytest.mark.parametrize("error", SYSTEM, ids=lambda error: errno.errorcode[error.errno])
@pytest.mark.parametrize("command", MAINS)
def test_what_the_system_reports_is_one_line(
    command: str, error: OSError, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    _fail_with(command, error, monkeypatch)
    assert code_of(MAINS[command], []) == 1
    told = capsys.readouterr().err
    assert told.startswith(f"{command}: error: ") and told.count("\n") == 1 and str(error.strerror) in told
    assert error.filename is None or error.filename.replace("\n", "\\n") in told


@pytest.mark.parametrize("error", [OSError("truncated"), ValueError("a bug"), KeyError("a bug")])
@pytest.mark.parametrize("command", MAINS)
def test_a_bug_keeps_its_traceback(command: str, error: Exception, monkeypatch: pytest.MonkeyPatch) -> None:
    _fail_with(command, error, monkeypatch)
    with pytest.raises(type(error)):
        MAINS[command]([])


@pytest.mark.parametrize("command", MAINS)
def test_ctrl_c_is_130(
    command: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    _fail_with(command, KeyboardInterrupt(), monkeypatch)
    assert code_of(MAINS[command], []) == 130
    assert capsys.readouterr().err == f"{command}: interrupted\n"


def _fail_with(command: str, error: BaseException, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the first thing that a command does fail with `error`."""
    refuse = refuse_imports(error)
    if command == "vfr-play":
        monkeypatch.setattr("player.app.cli.parse", refuse)
    elif command == "vfr-export":
        monkeypatch.setattr("exporters.cli.make_parser", refuse)
    else:
        monkeypatch.setattr("vfr_bake.cli._parse", refuse)


@pytest.mark.parametrize("name", ["n" * 300, "file/below"])
def test_names_that_no_file_can_have(
    name: str, shells_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("a file")
    target = str(tmp_path / name)
    runs = [
        (play_main, [str(shells_folder), "--view", "0", "--output", target]),
        (play_main, [str(shells_folder), "--view", "0", "--output", f"{target}.png"]),
        (play_main, [str(shells_folder), "--cameras", target, "--output", str(tmp_path / "o")]),
        (play_main, [str(shells_folder), "--info", "--json", target]),
        (play_main, [target, "--info"]),
        (play_main, [target]),
        (export_main, [str(shells_folder), f"{target}.json"]),
        (export_main, [target, str(tmp_path / "a.json")]),
        (bake_cli.train_main, ["demo", target]),
        (bake_cli.train_main, [target, str(tmp_path / "model.pt")]),
        (bake_cli.bake_main, [target, str(tmp_path / "asset")]),
        (bake_cli.eval_main, [target, "demo"]),
        (bake_cli.bench_main, [target, "--data", "demo"]),
    ]
    for main, arguments in runs:
        assert code_of(main, arguments) == 1, arguments
        told = capsys.readouterr().err.splitlines()
        assert ": error: " in told[-1] and len(told) == 1, told


# --- pipes ---


def start(command: str, *arguments: str, before: str = "") -> list[str]:
    module, name = ENTRIES[command].split(":")
    return [
        sys.executable,
        "-c",
        f"{before}\nimport sys\nfrom {module} import {name}\nsys.exit({name}())",
        *arguments,
    ]


@pytest.mark.skipif(os.name == "nt", reason="a shell of POSIX")
@pytest.mark.parametrize("together", [False, True])
@pytest.mark.parametrize("command", ENTRIES)
def test_a_reader_that_goes_ends_it_quietly(command: str, together: bool, tmp_path: Path) -> None:
    """A command whose reader is gone, as in `--help | true`, ends quietly when it writes, or at the latest
    when the interpreter exits."""
    _closed_pipe(start(command, "--help"), together, tmp_path)


@pytest.mark.skipif(os.name == "nt", reason="a shell of POSIX")
@pytest.mark.parametrize("options", [["--info"], ["--check"], ["--info", "--json", "-"], ["--view", "0"]])
def test_a_reader_of_the_player_that_goes(options: list[str], shells_folder: Path, tmp_path: Path) -> None:
    more = ["--output", str(tmp_path / "o")] if options[0] == "--view" else []
    _closed_pipe(start("vfr-play", str(shells_folder), *options, *more), False, tmp_path)


def environment(unbuffered: bool = False) -> dict[str, str]:
    """Return the environment for a command that writes every word at once (`unbuffered`), or much of its
    output only when it ends."""
    plain = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
    return plain | ({"PYTHONUNBUFFERED": "1"} if unbuffered else {})


def _closed_pipe(run: list[str], together: bool, tmp_path: Path) -> None:
    read, write = os.pipe()
    os.close(read)
    errors = tmp_path / "errors.txt"
    with errors.open("wb") as file:
        process = subprocess.Popen(run, stdout=write, stderr=write if together else file, env=environment())
        os.close(write)
        assert process.wait(120) == commands.READER_GONE
    assert errors.read_bytes() == b""


@pytest.mark.skipif(os.name == "nt", reason="a shell of POSIX")
@pytest.mark.parametrize("unbuffered", [False, True])
@pytest.mark.parametrize("command", ENTRIES)
def test_head_gets_its_line(command: str, unbuffered: bool, tmp_path: Path) -> None:
    """A command that writes more than a pipe holds ends quietly after `head` has read its line."""
    module = ENTRIES[command].split(":")[0]
    chatty = f"""
import {module} as module
from player.app import commands
module.run = lambda name, _: commands.run(name, lambda: print("line\\n" * 100_000) or 0)
"""
    errors = tmp_path / "errors.txt"
    with errors.open("wb") as file:
        process = subprocess.Popen(
            start(command, before=chatty), stdout=subprocess.PIPE, stderr=file, env=environment(unbuffered)
        )
        head = subprocess.run(["head", "-1"], stdin=process.stdout, capture_output=True, check=True)
        assert process.stdout is not None
        process.stdout.close()
        code = process.wait(120)
    assert head.stdout == b"line\n"
    assert code == commands.READER_GONE and errors.read_bytes() == b""


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="a device of Linux")
@pytest.mark.parametrize("command", ENTRIES)
def test_a_full_disk_behind_the_output(command: str) -> None:
    with Path("/dev/full").open("wb") as full:
        done = subprocess.run(
            start(command, "--help"),
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
            check=False,
            env=environment(),
        )
    assert done.returncode == 1
    assert re.fullmatch(rf"{command}: error: (standard output: )?No space left on device\n", done.stderr)
