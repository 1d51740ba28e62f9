"""How every command ends: what it prints of an error, and its exit code."""

from __future__ import annotations

import errno
import json
import os
import select
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, TextIO

from player.errors import VfrError
from player.files.files import write_bytes
from player.terminal import printable

READER_GONE = 141
"""Exit code where nobody reads the output any more (`| head`): what a shell reports of other programs."""


def run(name: str, command: Callable[[], int]) -> int:
    """Run a command and return its exit code: 0 done, 1 an error in one line, 130 Ctrl-C, 141 for output that
    nobody reads.

    Errors on purpose (VfrError) and those that the system reports (a full disk, a name that is too long, a
    file that may not be read) are one line on stderr; anything else is a bug and keeps its traceback. An exit
    that the command line asks for (--help, wrong usage) goes on as SystemExit.

    A KeyboardInterrupt may carry what became of the work.

    >>> run("vfr-play", lambda: 0)
    0
    """
    try:
        try:
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
        if error.errno is None:  # no disk's: a library's, or ours
            raise
        _say(f"{name}: error: {printable(_described(error))}")
        return 1
    except KeyboardInterrupt as stop:
        _say(f"{name}: {'; '.join(['interrupted', *map(str, stop.args)])}")
        return 130


def write_result(target: str | Path | None, figures: dict[str, Any], sentence: str | None) -> None:
    """Write what a command has done.

    Args:
        target: a file for the figures as JSON, or "-" for standard output; None for no JSON.
        figures: what JSON can hold.
        sentence: lines for people, on standard output unless the JSON is there; None for no lines.

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


def _described(error: OSError) -> str:
    """What the system says of an error, with the file that it is about if there is one.

    >>> _described(OSError(errno.ENAMETOOLONG, "File name too long", "a" * 3))
    'aaa: File name too long'
    """
    where = "" if error.filename is None else f"{error.filename}: "
    return f"{where}{error.strerror or error}"


def _streams() -> list[tuple[str, TextIO]]:
    named = (("standard output", sys.stdout), ("standard error", sys.stderr))
    return [(name, stream) for name, stream in named if stream is not None]


def _flush() -> None:
    """Write out what is buffered. The interpreter would do so at its end, with its own words for an error."""
    for name, stream in _streams():
        try:
            stream.flush()
        except OSError as error:
            error.filename = name
            raise


def _nobody_reads() -> bool:
    """Whether one of our streams is a pipe with nobody at its other end.

    Called where a stream is broken: where the system does not tell, it is taken for such a pipe.
    """
    if not hasattr(select, "poll"):
        return True
    asked = select.poll()
    for _, stream in _streams():
        with suppress(OSError):  # a stream that is no file, as in tests
            asked.register(stream.fileno(), 0)  # errors alone
    return any(events & (select.POLLERR | select.POLLHUP) for _, events in asked.poll(0))


def _give_up_broken_streams() -> None:
    """Drop what a broken stream still holds: the interpreter would try to write it again at its end."""
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
