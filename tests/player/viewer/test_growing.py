"""Tests of a viewer that opens at the first part and sharpens as the others come."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from player.asset.asset import Asset
from player.errors import FormatError
from player.render import Renderer
from player.viewer.growing import grow
from player.viewer.server import ServeSettings, serve
from tests.player.in_parts import write_in_parts
from tests.player.viewer.viewer_client import SECONDS, Client, Server
from tests.reliability.fuzz.targets import small_view


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_in_parts(tmp_path_factory.mktemp("parts") / "asset")


def picture(asset: Asset) -> np.ndarray:
    with Renderer(asset, 1, "numpy") as renderer:
        return renderer.render(small_view()).rgb


def test_a_renderer_goes_on_with_more_parts_and_keeps_pictures_that_have_begun(folder: Path) -> None:
    first, whole = Asset.open(folder, parts=1), Asset.open(folder)
    with Renderer(first, 1, "numpy") as renderer:
        begun = renderer.render(small_view())
        renderer.show(whole)
        assert np.array_equal(renderer.render(small_view()).rgb, picture(whole))
        assert renderer.asset is whole
    with Renderer(first, 1, "numpy") as renderer:
        wanted = renderer.render(small_view(), layers=True)
    assert np.array_equal(begun.rgb, wanted.rgb)
    assert np.array_equal(begun.normals, wanted.normals), "they are of what the picture shows"
    assert not np.array_equal(begun.rgb, picture(whole))


def test_it_shows_what_there_is_and_tells_of_every_part(folder: Path) -> None:
    """The picture shows the parts that were read so far."""
    parts, seen, said = Asset.growing(folder), [], []
    with Renderer(next(parts), 1, "numpy") as renderer:

        def look() -> None:
            seen.append(renderer.render(small_view()).rgb)

        look()
        grow([(renderer, parts)], look, said.append, threading.Event())
    assert len(seen) == len(Asset.open(folder).manifest.parts)
    for number, rgb in enumerate(seen, start=1):
        assert np.array_equal(rgb, picture(Asset.open(folder, parts=number)))
    assert said == []


def test_nothing_more_is_shown_once_it_is_stopped(folder: Path) -> None:
    parts, stopped = Asset.growing(folder), threading.Event()
    with Renderer(next(parts), 1, "numpy") as renderer:
        grow([(renderer, parts)], stopped.set, print, stopped)
        assert renderer.asset.n_parts == 2


def test_what_cannot_be_read_is_one_line_and_the_rest_is_shown(folder: Path) -> None:
    def breaks() -> Iterator[Asset]:
        yield Asset.open(folder, parts=2)
        raise FormatError("part_2.bin: expected 3 bytes, got 2")

    said: list[str] = []
    with Renderer(Asset.open(folder, parts=1), 1, "numpy") as renderer:
        grow([(renderer, breaks())], lambda: None, said.append, threading.Event())
        assert renderer.asset.n_parts == 2
    assert said == ["warning: part_2.bin: expected 3 bytes, got 2: shown as its first 2 parts have it"]


def test_a_program_serves_an_asset_that_grows(folder: Path) -> None:
    parts, said = Asset.growing(folder), []
    with serve(parts, ServeSettings(march="numpy"), said.append) as address:
        assert address.startswith("http://127.0.0.1:")
    broken = iter(())
    with pytest.raises(FormatError), serve([_refused(), broken]):
        pass
    assert said == []


def _refused() -> Iterator[Asset]:
    raise FormatError("part_0.bin: expected a file, got nothing")
    yield


def test_the_command_serves_an_asset_whose_last_part_is_missing(folder: Path, tmp_path: Path) -> None:
    whole = write_in_parts(tmp_path / "asset")
    n = len(Asset.open(whole).manifest.parts)
    (whole / f"part_{n - 1}.bin").unlink()
    server = Server(tmp_path / "errors.txt", whole, "--march", "numpy")
    with Client(server) as client:
        client.move()
        assert len(client.picture()) > 100
    until = time.monotonic() + SECONDS  # the parts are read while pictures are shown
    while "warning" not in server.errors.read_text() and time.monotonic() < until:
        time.sleep(0.05)
    assert server.stop() == 130
    said = server.errors.read_text()
    warnings = [line for line in said.splitlines() if "warning" in line]
    assert len(warnings) == 1 and warnings[0].startswith("vfr-play: warning: ")
    assert f"part_{n - 1}.bin: " in warnings[0]
    assert warnings[0].endswith(f"shown as the first {n - 1} of {n} parts have it")
