"""Tests of the picture above the `--info` page, where a terminal can show it."""

from __future__ import annotations

import io
import os
import re

import numpy as np
import pytest

from player.asset.asset import Asset
from player.cameras.transforms import read_cameras
from player.render import render
from player.terminal import ROWS, command_line, half_blocks, picture_lines


class Terminal(io.StringIO):
    encoding = "UTF-8"  # type: ignore[assignment]

    def isatty(self) -> bool:
        return True

    def fileno(self) -> int:
        return 1


def colours(lines: list[str]) -> np.ndarray:
    """Return the pixels that a terminal shows; each character has an upper and a lower one."""
    rows = []
    for line in lines:
        cells = re.findall(r"\x1b\[38;2;(\d+);(\d+);(\d+);48;2;(\d+);(\d+);(\d+)m▀", line)
        cells = np.array(cells, int).reshape(-1, 2, 3)
        rows += [cells[:, 0], cells[:, 1]]
    return np.array(rows)


def test_half_blocks_come_back() -> None:
    pixels = np.random.default_rng(0).integers(0, 256, (6, 5, 3), np.uint8)
    lines = half_blocks(pixels)
    assert len(lines) == 3 and (colours(lines) == pixels).all()
    assert all(line.endswith("\x1b[0m") for line in lines), "the terminal's own colours come back"


def test_the_picture_is_the_first_view(asset: Asset, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLORTERM", "truecolor")
    for width, columns in ((80, 38), (20, 20), (0, 38)):
        monkeypatch.setattr(os, "get_terminal_size", lambda fd, w=width: os.terminal_size((w, 24)))
        lines = picture_lines(asset, Terminal())
        assert lines[-1] == "" and len(lines) == ROWS + 1
        shown = colours(lines[:-1])
        assert shown.shape == (2 * ROWS, columns, 3)
        camera = read_cameras(asset.path("cameras.json"))[0].resized(columns, 2 * ROWS)
        assert np.abs(shown - render(asset, camera).to_uint8().astype(int)).mean() < 12


@pytest.mark.parametrize("lacks", ["colours", "terminal", "letters"])
def test_no_picture_where_it_cannot_be_shown(
    lacks: str, asset: Asset, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLORTERM", "" if lacks == "colours" else "24bit")
    stream = io.StringIO() if lacks == "terminal" else Terminal()
    if lacks == "letters":
        monkeypatch.setattr(Terminal, "encoding", "latin-1")
    assert picture_lines(asset, stream) == []


@pytest.mark.parametrize(
    ("system", "shown"),
    [
        ("posix", r"vfr-play 'C:\R&D\my out' 'D:\out' --info"),
        ("nt", r'vfr-play "C:\R&D\my out" D:\out --info'),
    ],
)
def test_a_command_can_be_pasted(system: str, shown: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "name", system)
    assert command_line("vfr-play", r"C:\R&D\my out", r"D:\out", "--info") == shown
