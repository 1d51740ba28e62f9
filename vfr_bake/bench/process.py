"""A process that renders on request, so that nothing else that the bench does disturbs its frame times.

One line of JSON asks for a frame, and one line answers. Pictures travel as .npy files,
so that lines stay short.
"""

from __future__ import annotations

import json
import subprocess
import threading
import time
from collections.abc import Callable
from typing import Any, TextIO

from player.child import python_command
from player.errors import VfrError

Answer = Callable[[dict[str, Any]], dict[str, Any]]


class Process:
    """`vfr_bake.bench.frames` as a program of its own, with the given arguments; a context manager."""

    def __init__(self, *arguments: str) -> None:
        self._name = f"{arguments[0]}_frames"
        self._process = subprocess.Popen(
            python_command("vfr_bake.bench.frames", *arguments),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            encoding="utf-8",
        )

    def __enter__(self) -> Process:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._process.communicate()

    def ask(self, **request: Any) -> dict[str, Any]:
        """Send a request and return the answer. Raises VfrError: the process failed, with its
        own message, or it ended."""
        requests, answers = self._process.stdin, self._process.stdout
        assert requests is not None and answers is not None
        try:
            requests.write(json.dumps(request) + "\n")
            requests.flush()
        except OSError:  # the process ended; if it wrote an error before, that is read below
            pass
        line = answers.readline()
        if not line:
            raise VfrError(f"{self._name}: expected an answer, got none: the process ended")
        answer = json.loads(line)
        if "error" in answer:
            raise VfrError(answer["error"])
        return answer


def serve(start: Callable[[], Answer], requests: TextIO, answers: TextIO) -> None:
    """Answer each request until there are no more; a VfrError is written as the last answer.

    >>> import io
    >>> out = io.StringIO()
    >>> serve(lambda: lambda request: {"twice": 2 * request["n"]}, io.StringIO('{"n": 4}\\n'), out)
    >>> out.getvalue()
    '{"twice": 8}\\n'
    """
    try:
        answer = start()
        for line in requests:
            answers.write(json.dumps(answer(json.loads(line))) + "\n")
            answers.flush()
    except VfrError as error:
        answers.write(json.dumps({"error": str(error)}) + "\n")
        answers.flush()


class Clock:
    """Wrapper of a function that sums the time spent in it over all threads."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self.seconds = 0.0
        self._function = function
        self._lock = threading.Lock()

    def __call__(self, *arguments: Any) -> Any:
        start = time.perf_counter()
        try:
            return self._function(*arguments)
        finally:
            passed = time.perf_counter() - start
            with self._lock:
                self.seconds += passed
