"""Tests of progress on stderr: a bar on a terminal, a line now and then elsewhere."""

from __future__ import annotations

import io
import sys

import pytest

from player import progress
from player.progress import Bar, Bars


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def clock(monkeypatch: pytest.MonkeyPatch, *times: float) -> None:
    left = iter(times)
    monkeypatch.setattr(progress.time, "monotonic", lambda: next(left))


def test_a_bar_is_drawn_over_itself_and_not_too_often(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stderr", terminal := Terminal())
    clock(monkeypatch, 0.0, 5.0, 5.05, 10.0)
    with Bar("training") as bar:
        bar.share(0.25, "loss 0.12345")
        bar.share(0.26, "never seen")
        bar.count(4, 4)
    first, last = (
        "training  25% |######                  | 5 s < 15 s  loss 0.12345",
        f"|{'#' * 24}| 10 s < 0 s  4/4",
    )
    assert terminal.getvalue() == f"\r{first}\r{f'training 100% {last}':{len(first)}}\n"


def test_a_bar_fits_into_the_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    """A bar is cut to the terminal's width, since a line that wraps could not be drawn over."""
    monkeypatch.setattr(sys, "stderr", terminal := Terminal())
    monkeypatch.setenv("COLUMNS", "40")
    with Bar() as bar:
        bar.share(0.0, "x" * 100)
    assert terminal.getvalue().startswith("\r  0% |") and len(terminal.getvalue()) == 1 + 39 + 1


def test_elsewhere_a_line_now_and_then(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    clock(monkeypatch, 0.0, 29.0, 40.0, 60.0, 100.0)
    with Bars() as bars:
        for done in range(1, 5):
            bars.count("baking", done, 4)
    assert capsys.readouterr().err == "baking: 50%, 40 s left, 2/4\nbaking: 100%, 0 s left, 4/4\n"


@pytest.mark.parametrize("options", [{"shown": False}, {"lines": False}])
def test_a_bar_that_is_not_wanted(
    options: dict[str, bool], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(progress, "SECONDS_BETWEEN_LINES", -1.0)
    with Bar("training", **options) as bar:
        bar.count(1, 1)
    assert capsys.readouterr().err == ""


def test_what_was_done_before_says_nothing_about_the_time_that_is_left(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(progress, "SECONDS_BETWEEN_LINES", -1.0)
    clock(monkeypatch, 0.0, 60.0, 60.0, 90.0)
    with Bar("training") as bar:
        bar.began(0.5)
        bar.share(0.5, "first")
        bar.share(0.75, "second")
    assert capsys.readouterr().err == "training: 50%, ? left, first\ntraining: 75%, 30 s left, second\n"


def test_nothing_to_do_is_done(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(progress, "SECONDS_BETWEEN_LINES", -1.0)
    with Bar("reading") as bar:
        bar.count(0, 0)
        bar.share(0.0, "none")
    assert capsys.readouterr().err == "reading: 100%, 0 s left, 0/0\nreading: 0%, ? left, none\n"
