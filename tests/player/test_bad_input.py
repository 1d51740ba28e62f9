"""Tests of bad input to `vfr-play`, by mistake or malice: it gives a clear message or the right picture."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from player.app import cli
from player.asset.manifest import VERSION
from tests.player.conftest import head_bytes, look_at


def play(folder: Path, views: Any, out: Path, *options: str) -> int:
    """Run the command on one frame, or on a whole document."""
    document = views if "frames" in views else {"w": 24, "h": 20, "camera_angle_x": 1.0, "frames": [views]}
    path = out.parent / "views.json"
    path.write_text(json.dumps(document))
    return cli.main([str(folder), "--cameras", str(path), "--output", str(out), *options])


def frame(c2w: np.ndarray, **more: Any) -> dict[str, Any]:
    return {"file_path": "a", "transform_matrix": np.asarray(c2w).tolist(), **more}


def refused(capsys: pytest.CaptureFixture[str], out: Path, *fragments: str) -> None:
    """Check that stderr has one line with all fragments, and that nothing was written."""
    error = capsys.readouterr().err
    assert error.startswith("vfr-play: error: ") and error.count("\n") == 1, error
    for fragment in fragments:
        assert fragment in error, error
    assert not out.exists()


OUTSIDE = look_at((7, 2, 5), (1, 2, 3))


# --- cameras ---


@pytest.mark.parametrize(
    ("c2w", "met"),
    [
        (look_at((1, 2, 3.2), (3, 2, 3)), 1.0),  # inside the inner shell, all around is wall
        (look_at((1, 2 + 2 * 0.75, 3), (3, 2, 3)), 1.0),  # between the shells
        (look_at((7, 2, 5), (13, 2, 7)), 0.0),  # the volume is behind
        (look_at((1e8, 2, 3), (1, 2, 3)), 0.0),  # smaller than a pixel
        (look_at((-1e8, 1e8, 1e8), (1, 2, 3)), 0.0),
    ],
)
def test_strange_places_give_the_right_picture(
    c2w: np.ndarray, met: float, shells_folder: Path, tmp_path: Path
) -> None:
    out = tmp_path / "o"
    assert play(shells_folder, frame(c2w), out, "--background", "transparent") == 0
    with Image.open(out / "a.png") as picture:
        alpha = np.asarray(picture)[..., 3] / 255
    assert abs((alpha > 0.5).mean() - met) < 0.02


ZERO = np.zeros((4, 4))
SHEARED = OUTSIDE @ np.array([[1, 0.2, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])


@pytest.mark.parametrize(
    ("views", "message"),
    [
        (frame(ZERO), "camera matrix: expected a rotation and a translation"),
        (frame(SHEARED), "camera matrix: expected a rotation and a translation"),
        (frame(OUTSIDE * np.array([[2], [2], [2], [1]])), "camera matrix: expected a rotation"),
        (frame(OUTSIDE + np.diag([0, 0, 0, 1])), "camera matrix: expected a rotation and a translation"),
        (frame(OUTSIDE, camera_angle_x=0), "camera_angle_x: expected radians between 0 and pi, got 0"),
        (frame(OUTSIDE, camera_angle_x=np.pi), "camera_angle_x: expected radians between 0 and pi, got 3.14"),
        (frame(OUTSIDE, w=0, h=0), "w: expected 1 to 65536 whole pixels, got 0"),
        (frame(OUTSIDE, w=20000, h=20000), "got 20000x20000, which would take 12.0 GB of memory"),
    ],
)
def test_impossible_cameras_are_refused_before_anything_is_rendered(
    views: dict[str, Any],
    message: str,
    shells_folder: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """An impossible camera is refused, also as the fourth frame of a file whose others are in order."""
    out = tmp_path / "o"
    assert play(shells_folder, views, out) == 1
    refused(capsys, out, message)
    many = [frame(OUTSIDE), frame(OUTSIDE), frame(OUTSIDE), views]
    assert play(shells_folder, {"w": 24, "h": 20, "camera_angle_x": 1.0, "frames": many}, out) == 1
    refused(capsys, out, message, *(["frame 3 (a)"] if "GB" not in message else []))


@pytest.mark.parametrize(("fov", "code"), [(0, 1), (180, 1), (-10, 1), (1e-6, 0), (179.9999, 0)])
def test_fields_of_view_of_a_path(
    fov: float, code: int, shells_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, out = tmp_path / "camera_path.json", tmp_path / "o"
    frames = [{"camera_to_world": OUTSIDE.reshape(-1).tolist(), "fov": fov}]
    path.write_text(json.dumps({"render_width": 9, "render_height": 7, "camera_path": frames}))
    assert cli.main([str(shells_folder), "--cameras", str(path), "--output", str(out)]) == code
    if code:
        refused(capsys, out, "frame 0: fov: expected degrees between 0 and 180")


def test_a_size_of_nothing_and_one_for_a_warehouse(
    shells_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    views = [str(shells_folder), "--view", "0", "--output", str(tmp_path / "o")]
    assert cli.main([*views, "--size", "0x0"]) == 2
    assert (
        "--size: expected WIDTHxHEIGHT, 1 to 1000000 each, such as 800x600, got '0x0'"
        in capsys.readouterr().err
    )
    assert cli.main([*views, "--size", "20000x20000"]) == 1
    refused(capsys, tmp_path / "o", "expected at most 67108864 pixels (8192x8192)", "12.0 GB of memory")
    # a large size that is allowed is reported before rendering starts, which is prevented here
    monkeypatch.setattr("player.app.play.Renderer", _NoRenderer)
    with pytest.raises(_StartError):
        cli.main([*views, "--size", "8000x8000"])
    assert capsys.readouterr().err == "vfr-play: a picture of 8000x8000 takes 1.9 GB of memory\n"


class _StartError(Exception):
    """Raised where rendering would begin."""


class _NoRenderer:
    def __init__(self, *_: object) -> None:
        raise _StartError


def test_cameras_that_are_no_file(
    shells_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for path in ("/dev/zero", str(tmp_path), "nowhere.json"):
        assert cli.main([str(shells_folder), "--cameras", path, "--output", str(tmp_path / "o")]) == 1
        refused(capsys, tmp_path / "o", path, "expected a")


# --- assets ---


def rewrite(folder: Path, change: Callable[[dict[str, Any]], object]) -> None:
    path = folder / "manifest.json"
    document = json.loads(path.read_text())
    change(document)
    path.write_text(json.dumps(document))


def replace_head(folder: Path, data: bytes) -> None:
    """Replace the head, and its size and checksum in the manifest."""
    (folder / "head.onnx").write_bytes(data)
    entry = {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}
    rewrite(folder, lambda document: document["files"].update({"head.onnx": entry}))


COMMANDS = [
    *(["--info"], ["--check"], ["--view", "0", "--output", "O"]),
    pytest.param([], marks=pytest.mark.extra, id="viewer"),
]


@pytest.mark.parametrize("command", COMMANDS)
def test_an_asset_from_the_future(
    command: list[str], broken_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rewrite(broken_folder, lambda document: document.update(version=[VERSION[0] + 1, 0], more=1))
    out = tmp_path / "o"
    assert cli.main([str(broken_folder), *(str(out) if word == "O" else word for word in command)]) == 1
    refused(
        capsys,
        out,
        f"version: expected 3.x or {VERSION[0]}.x, got {VERSION[0] + 1}.0: install a newer vfr-bake",
    )


@pytest.mark.parametrize("name", ["../secret", "/etc/passwd", "a/b", "..", "C:x", "nul\x00", "manifest.json"])
@pytest.mark.parametrize("command", COMMANDS)
def test_a_manifest_that_points_outside_its_folder(
    name: str, command: list[str], broken_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "secret").write_bytes(b"x")
    entry = {"bytes": 1, "sha256": hashlib.sha256(b"x").hexdigest()}
    rewrite(broken_folder, lambda document: document["files"].update({name: entry}))
    out = tmp_path / "o"
    assert cli.main([str(broken_folder), *(str(out) if word == "O" else word for word in command)]) == 1
    refused(capsys, out, "files: expected plain file names, got")


# --- heads ---


@pytest.mark.parametrize("command", [["--check"], ["--info"], ["--view", "0", "--output", "O"]])
@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "head.onnx: expected an ONNX graph"),
        (head_bytes(5), "head.onnx: features: expected float [n, 4]"),
    ],
    ids=["empty", "5 channels"],
)
def test_heads_that_are_not_ours(
    data: bytes, message: str, command: list[str], broken_folder: Path, tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    """Heads that are not ours are refused in one line. (`capfd`: onnxruntime would print past Python.) What
    else is refused: tests/player/head/test_head_graph.py."""
    replace_head(broken_folder, data)
    out = tmp_path / "o"
    assert cli.main([str(broken_folder), *(str(out) if word == "O" else word for word in command)]) == 1
    refused(capfd, out, message)
