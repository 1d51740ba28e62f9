"""The end of every command: the message that it prints for an error, and its exit code."""

from __future__ import annotations

import errno
import io
import json
import os
import select
import sys
from collections.abc import Callable, Iterable, Set
from contextlib import suppress
from pathlib import Path
from typing import Any, TextIO

from player.errors import FormatError, OutputError, VfrError
from player.files.content import has_content
from player.files.files import check_target, write_bytes
from player.files.json_files import parse_json, read_json
from player.terminal import printable

READER_GONE = 141
"""Exit code if nobody reads the output any more (`| head`): the one that shells report for other programs."""


def run(name: str, command: Callable[[], int]) -> int:
    """Run a command and return its exit code: 0 done, 1 an error in one line, 130 Ctrl-C, 141 for output that
    nobody reads.

    Errors raised on purpose (VfrError) and those that the system reports (a full disk, a name that is too
    long, a file that may not be read, too little memory) are printed as one line on stderr. Anything else is
    a bug and keeps its traceback. An exit that the command line asks for (--help, wrong usage) goes on as
    SystemExit.

    The argument of a KeyboardInterrupt, if any, is printed, too: it may say what became of the work.

    Characters that standard output cannot hold, for example those of a path, are written as escapes.

    >>> run("vfr-play", lambda: 0)
    0
    """
    try:
        try:
            if isinstance(sys.stdout, io.TextIOWrapper):  # not so in a notebook, which takes every character
                sys.stdout.reconfigure(errors="backslashreplace")
            return command()
        finally:
            _flush()
    except VfrError as error:
        _say(f"{name}: error: {printable(str(error))}")
        return 1
    except OSError as error:
        broken = isinstance(error, BrokenPipeError) or (os.name == "nt" and error.errno == errno.EINVAL)
        unread = broken and _nobody_reads()
        _give_up_broken_streams()
        if unread:
            return READER_GONE
        if error.errno is None:  # not from the system, but raised by a library or by this project
            raise
        _say(f"{name}: error: {printable(_described(error))}")
        return 1
    except MemoryError as error:
        got = printable(str(error)) or "an error"
        advice = "ask for less (fewer points, smaller pictures), or use a machine that has more"
        _say(f"{name}: error: memory: expected enough of it, got: {got}: {advice}")
        return 1
    except KeyboardInterrupt as stop:
        _say(f"{name}: {'; '.join(['interrupted', *map(str, stop.args)])}")
        return 130


def check_result(
    target: str | Path | None,
    inputs: Iterable[Path],
    kinds: Iterable[Set[str]],
    output: Path | None = None,
    force: bool = True,
) -> None:
    """Check the file of `write_result` before long work.

    Args:
        target: a file, "-" for standard output, or None for no JSON.
        inputs: files and folders that the command reads; neither they nor anything in them is replaced.
        kinds: keys by which a JSON file is known as an earlier result: all of one kind are in it.
        output: what else the command writes.
        force: whether an earlier result, or an empty file, is replaced; nothing else ever is.

    Raises OutputError: the file cannot be written, is or lies in an input, is the output, or is no result.

    >>> check_result("out/manifest.json", [Path("out")], [{"frames"}])
    Traceback (most recent call last):
    player.errors.OutputError: out/manifest.json: --json: expected a file outside out, which is read
    """
    if target is None or str(target) == "-":
        return
    path = Path(target)
    check_target(path, force, is_file=True)
    place = path.resolve()
    for read in inputs:
        if place.is_relative_to(read.resolve()):
            where = "another file than" if read.is_file() else "a file outside"
            raise OutputError(f"{path}: --json: expected {where} {read}, which is read")
    if output is not None and place == output.resolve():
        raise OutputError(f"{path}: --json: expected another file than --output")
    if has_content(path) and not _is_result(path, kinds):
        raise OutputError(
            f"{path}: --json: expected a new file or an earlier result, got another file: name a new one"
        )


def write_result(target: str | Path | None, figures: dict[str, Any], sentence: str | None) -> None:
    """Write the result of a command.

    Args:
        target: a file for the figures as JSON, or "-" for standard output; None for no JSON.
        figures: the results, in types that JSON can hold.
        sentence: lines for people, written to standard output unless the JSON is written there; None for no
            lines.

    Raises OutputError: the file cannot be written.

    >>> write_result(None, {"frames": 1}, "one picture")
    one picture
    """
    text = json.dumps(figures, indent=1, sort_keys=True) + "\n"
    if str(target) == "-":
        sys.stdout.write(text)
        return
    if target is not None:
        write_bytes(Path(target), text.encode())
    if sentence is not None:
        sys.stdout.write(f"{sentence}\n")


def _is_result(path: Path, kinds: Iterable[Set[str]]) -> bool:
    try:
        document = parse_json(read_json(path, "a result"), str(path))
    except FormatError:
        return False
    return isinstance(document, dict) and any(keys <= set(document) for keys in kinds)


def _described(error: OSError) -> str:
    """Return the system's message for an error, with the file that it is about, if there is one.

    >>> _described(OSError(errno.ENAMETOOLONG, "File name too long", "a" * 3))
    'aaa: File name too long'
    """
    where = "" if error.filename is None else f"{error.filename}: "
    return f"{where}{error.strerror or error}"


def _streams() -> list[tuple[str, TextIO]]:
    named = (("standard output", sys.stdout), ("standard error", sys.stderr))
    return [(name, stream) for name, stream in named if stream is not None]


def _flush() -> None:
    """Write out what is buffered. Otherwise the interpreter would do so at its end, with its own message for
    an error."""
    for name, stream in _streams():
        try:
            stream.flush()
        except OSError as error:
            error.filename = name
            raise


def _nobody_reads() -> bool:
    """Return whether standard output or standard error is a pipe with nobody at its other end.

    This is asked only when a stream is broken. If the system does not tell, the stream is taken for such a
    pipe.
    """
    if not hasattr(select, "poll"):
        return True
    asked = select.poll()
    for _, stream in _streams():
        with suppress(OSError):  # the stream is no file, as in tests
            asked.register(stream.fileno(), select.POLLOUT)  # macOS reports no errors if nothing is asked for
    return any(events & (select.POLLERR | select.POLLHUP) for _, events in asked.poll(0))


def _give_up_broken_streams() -> None:
    """Drop what a broken stream still holds: otherwise the interpreter would try to write it again at its
    end."""
    for _, stream in _streams():
        try:
            stream.flush()
        except OSError:
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, stream.fileno())
            os.close(nowhere)


def _say(text: str) -> None:
    try:
        sys.stderr.write(text + "\n")
        sys.stderr.flush()
    except OSError:
        _give_up_broken_streams()
