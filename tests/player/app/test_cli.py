"""Tests of the command line of `vfr-play`, on which other programs rely."""

from __future__ import annotations

import errno
import io
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from player import compiling
from player.app import cli, commands
from player.files import files
from player.render import Renderer
from tests.player.asset.test_parts import vouch

REPOSITORY = Path(__file__).resolve().parents[3]


def views(shells_folder: Path) -> list[str]:
    return [str(shells_folder), "--cameras", str(shells_folder / "cameras.json")]


def test_one_picture_a_frame_and_figures(
    shells_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, figures = tmp_path / "frames", tmp_path / "figures.json"
    options = ["--output", str(out), "--threads", "2", "--json", str(figures)]
    assert cli.main([*views(shells_folder), *options]) == 0
    assert sorted(p.name for p in out.iterdir()) == [f"r_{i}.png" for i in range(5)]
    with Image.open(out / "r_0.png") as picture:
        assert picture.size == (48, 40) and picture.mode == "RGB"
    got = json.loads(figures.read_text())
    assert set(got) == {
        "ms_median", "ms_p95", "frames", "width", "height", "threads", "march", "peak_rss_mb", "n_fetches",
        "quality",
    }  # fmt: skip
    assert (got["frames"], got["width"], got["height"], got["threads"], got["n_fetches"]) == (5, 48, 40, 2, 5)
    assert got["march"] == ("numba" if compiling.available() else "numpy")
    assert 0 < got["ms_median"] <= got["ms_p95"]
    assert got["peak_rss_mb"] is None or got["peak_rss_mb"] > 10
    printed = capsys.readouterr()
    assert printed.err == "" and printed.out.count("\n") == 1 and str(out) in printed.out


def test_lens_distortion_of_cameras_is_named(
    shells_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given = tmp_path / "given.json"
    given.write_text(json.dumps({**json.loads((shells_folder / "cameras.json").read_text()), "k1": 0.1}))
    options = ["--cameras", str(given), "--frames", "0", "--output", str(tmp_path / "a.png")]
    assert cli.main([str(shells_folder), *options]) == 0
    said = f"vfr-play: {given}: lens distortion of 5 of 5 cameras is ignored\n"
    assert capsys.readouterr().err == said


def test_json_on_stdout_and_slices(
    shells_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for text, names in (
        ("1:3", ["r_1", "r_2"]),
        ("::2", ["r_0", "r_2", "r_4"]),
        ("-1:", ["r_4"]),
        ("2", ["r_2"]),
    ):
        out = tmp_path / text.replace(":", "_")
        options = [
            "--output",
            str(out),
            "--frames",
            text,
            "--march",
            "numpy",
            "--json",
            "-",
            "--samples",
            "0",
        ]
        assert cli.main([*views(shells_folder), *options]) == 0
        got = json.loads(capsys.readouterr().out)
        assert sorted(p.stem for p in out.iterdir()) == names and got["frames"] == len(names)
        assert got["march"] == "numpy" and got["n_fetches"] == 0


def test_json_replaces_no_input_and_is_checked_first(
    shells_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """--json never replaces the asset, the cameras or the pictures, and a file that cannot be written is
    refused before anything is rendered."""
    cameras, view = tmp_path / "cameras.json", tmp_path / "view.png"
    shutil.copy(shells_folder / "cameras.json", cameras)
    (tmp_path / "file").write_text("mine")
    (tmp_path / "mine.json").write_text('{"frames": []}')
    manifest = shells_folder / "manifest.json"
    before = {path: path.read_bytes() for path in (manifest, cameras)}
    asset, files = str(shells_folder), ["--cameras", str(cameras), "--frames", "0", "--output", str(view)]
    for options, target, message in (
        (["--info"], manifest, f"--json: expected a file outside {asset}, which is read"),
        (["--check"], manifest, f"--json: expected a file outside {asset}, which is read"),
        (files, cameras, f"--json: expected another file than {cameras}, which is read"),
        (files, view, "--json: expected another file than --output"),
        (files, tmp_path / "file" / "x.json", "cannot write: "),
        (files, tmp_path, "expected a file to write, got a folder"),
        (files, tmp_path / "file", "--json: expected a new file or an earlier result, got another file"),
        (["--info"], tmp_path / "mine.json", "--json: expected a new file or an earlier result, got another"),
    ):
        assert cli.main([asset, *options, "--json", str(target)]) == 1
        printed = capsys.readouterr()
        assert printed.err.startswith(f"vfr-play: error: {target}: {message}") and not printed.out
    assert {path: path.read_bytes() for path in before} == before and not view.exists()
    assert cli.main([asset, *files, "--json", str(tmp_path / "play.json")]) == 0
    for options in ([*files, "--force"], ["--info"], ["--check"], ["--info"]):
        assert cli.main([asset, *options, "--json", str(tmp_path / "play.json")]) == 0


@pytest.mark.parametrize(
    ("background", "mode", "corner"),
    [("white", "RGB", (255,) * 3), ("black", "RGB", (0,) * 3), ("10,200,30", "RGB", (10, 200, 30)),
     ("transparent", "RGBA", (0,) * 4)],
)  # fmt: skip
def test_backgrounds(
    background: str, mode: str, corner: tuple[int, ...], shells_folder: Path, tmp_path: Path
) -> None:
    options = [
        "--output",
        str(tmp_path / "o"),
        "--frames",
        "0:1",
        "--background",
        background,
        "--size",
        "32x24",
    ]
    assert cli.main([*views(shells_folder), *options]) == 0
    with Image.open(tmp_path / "o" / "r_0.png") as picture:
        assert (picture.mode, picture.size) == (mode, (32, 24))
        pixels = np.asarray(picture)
    assert tuple(pixels[0, 0].tolist()) == corner and tuple(pixels[12, 16].tolist()) != corner


def test_orbit(shells_folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "turn"
    assert cli.main([str(shells_folder), "--orbit", "3", "--output", str(out), "--size", "24x16"]) == 0
    pictures = sorted(out.iterdir())
    assert len(pictures) == 3
    for path in pictures:
        with Image.open(path) as picture:
            assert picture.size == (24, 16) and np.asarray(picture)[8, 12].min() < 255


def test_output_that_is_not_empty(
    shells_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "o"
    out.mkdir()
    options = ["--output", str(out), "--frames", "0:1"]
    assert cli.main([*views(shells_folder), *options]) == 0, "an empty folder will do"
    (out / "mine.txt").write_text("mine")
    (out / "r_0.png").write_text("old")
    assert cli.main([*views(shells_folder), *options]) == 1
    error = capsys.readouterr().err
    assert (
        error == f"vfr-play: error: {out}: not empty: add --force to write into it, replacing frames of "
        "equal name, or --resume to go on with a run that was interrupted\n"
    )
    assert (out / "r_0.png").read_text() == "old"
    assert cli.main([*views(shells_folder), *options, "--force"]) == 0
    assert (out / "mine.txt").read_text() == "mine" and (out / "r_0.png").read_bytes()[:4] == b"\x89PNG"
    assert cli.main([*views(shells_folder), "--output", str(out / "mine.txt"), "--force"]) == 1
    assert "expected a folder for the pictures, got a file" in capsys.readouterr().err


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux has a figure that is not inherited")
def test_the_peak_of_memory_is_that_of_the_process_alone() -> None:
    np.ones(300_000_000, np.uint8)  # the parent process's memory does not count
    code = "from player.app.play import peak_rss_mb; print(peak_rss_mb())"
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert 10 < float(done.stdout) < 250


def test_info(shells_folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([str(shells_folder), "--info"]) == 0
    page = capsys.readouterr().out
    for text in ("vfr-asset 4.0", "64 cells per axis", "4 channels", "at 5 places a ray", "161 parameters",
                 "5 training views of 48x40", "psnr", "4 x 4 x 4 units, from -1, 0, 1 to 3, 4, 5",
                 "head.onnx"):  # fmt: skip
        assert text in page, text
    assert cli.main([str(shells_folder), "--info", "--json", "-"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["bytes_total"] == sum(facts["bytes"].values()) and facts["n_channels"] == 4
    assert facts["world_units_per_model_unit"] == 2 and facts["provenance"] == {"psnr": 30.5}


def test_commands_that_are_printed_can_be_typed(
    shells_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The folder's name is one word of every command that is printed, also with spaces in it."""
    folder = shutil.copytree(shells_folder, tmp_path / "my scene's bake")
    assert cli.main([str(folder), "--info"]) == 0
    printed = capsys.readouterr().out
    monkeypatch.setitem(sys.modules, "viser", None)
    assert cli.main([str(folder)]) == 1
    printed += capsys.readouterr().err
    monkeypatch.setattr(cli, "_has_display", lambda: False)
    cli._advise(folder, "http://127.0.0.1:8080", "http://127.0.0.1:8080")
    printed += capsys.readouterr().err
    typed = re.findall(r"vfr-play ([/'\"].*)", printed)
    assert [shlex.split(words)[:2] for words in typed] == [
        [str(folder)], *[[str(folder), "--orbit"]] * 3
    ]  # fmt: skip


def test_the_tunnel_ends_where_the_viewer_listens(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(cli, "_has_display", lambda: False)
    for place in ("127.0.0.1:8080", "192.168.1.5:8080", "[::1]:8080"):
        cli._advise(Path("out"), f"http://{place}", f"http://{place}")
        said = capsys.readouterr().err
        assert f"ssh -L 8080:{place} to this" in said and "open http://127.0.0.1:8080 there" in said


def test_check(broken_folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([str(broken_folder), "--check"]) == 0
    assert len(re.findall(r"^ok ", capsys.readouterr().out, re.M)) == 4
    data = bytearray((broken_folder / "mesh.ply").read_bytes())
    data[0] ^= 1
    (broken_folder / "mesh.ply").write_bytes(bytes(data))
    (broken_folder / "part_0.bin").unlink()
    assert cli.main([str(broken_folder), "--check"]) == 1
    printed = capsys.readouterr()
    assert len(re.findall(r"^ok ", printed.out, re.M)) == 2
    assert re.search(r"^FAILED  mesh\.ply .*sha256", printed.out, re.M)
    assert re.search(r"^FAILED  part_0\.bin .*no such file", printed.out, re.M)
    assert printed.err == f"vfr-play: error: {broken_folder}: 2 of 4 files failed\n"
    assert cli.main([str(broken_folder), "--check", "--json", "-"]) == 1
    assert json.loads(capsys.readouterr().out)["files"]["head.onnx"] == "ok"


@pytest.mark.parametrize("name", ["part_0.bin", "head.onnx"])
def test_check_looks_into_files_whose_checksums_hold(
    name: str, broken_folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = (broken_folder / name).read_bytes()
    vouch(broken_folder, name, data[: len(data) // 2] + bytes(len(data) - len(data) // 2))
    assert cli.main([str(broken_folder), "--check", "--json", "-"]) == 1
    found = json.loads(capsys.readouterr().out)
    assert set(found["files"].values()) == {"ok"} and not found["ok"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--orbit", "3"], "--output: add where the pictures go"),
        (
            ["--force"],
            "--force: does nothing for the viewer; it is for pictures and videos, with --output and",
        ),
        (["--frames", "3"], "--frames: does nothing for the viewer; it is for pictures and videos"),
        (["--info", "--output", "o"], "--output: does nothing for --info; it is for pictures and videos"),
        (["--check", "--samples", "0"], "--samples: does nothing for --check; it is for the viewer"),
        (
            ["--orbit", "3", "--output", "o", "--port", "1"],
            "--port: does nothing for pictures and videos; it is for",
        ),
        (["--port", "65536"], "expected a whole number, 1 to 65535, such as 8080, got '65536'"),
        (["--orbit", "3", "--output", "o", "--resume", "--force"], "--resume: not allowed with --force"),
        (["--orbit", "3", "--output", "o.mp4", "--format", "png"], "--format: o.mp4 says"),
        *(
            (
                ["--orbit", "3", "--output", name],
                f"--output: expected a folder, a picture (.png, .webp) or a video (.mp4), got {name}",
            )
            for name in ("view.jpg", "turn.GIF", "turn.webm", "turn.mov")
        ),
        (["--orbit", "3", "--output", "o", "--fps", "3"], "--fps: expected a video"),
        (
            ["--orbit", "3", "--output", "o.mp4", "--fps", "0.0009"],
            "--fps: expected 0.001 to 1000 frames a second, got 0.0009",
        ),
        (["--orbit", "3", "--output", "o.mp4", "--fps", "inf"], "a number, such as 30, got 'inf'"),
        (["--orbit", "3", "--output", "o.mp4", "--background", "transparent"], "a video has no transparency"),
        (["--orbit", "3", "--output", "o", "--size", "0x0"], "1 to 1000000 each, such as 800x600, got '0x0'"),
        (
            ["--orbit", "3", "--output", "o", "--size", "9" * 320 + "x64"],
            "1 to 1000000 each, such as 800x600",
        ),
        (["--view", "x", "--output", "o"], "expected a whole number, such as 3, got 'x'"),
        (["--output", "o"], "--output: add the views"),
        (["--orbit", "0", "--output", "o"], "--orbit"),
        (["--orbit", "3", "--info"], "not allowed with"),
        (["--info", "--size", "800"], "--size"),
        (["--info", "--background", "1,2"], "--background"),
        (["--info", "--background", "1,2,256"], "--background"),
        (["--info", "--frames", "::0"], "--frames"),
        (["--info", "--samples", "-1"], "--samples"),
        (["--info", "--nonsense"], "unrecognized"),
    ],
)
def test_usage(
    options: list[str], message: str, shells_folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main([str(shells_folder), *options]) == 2
    assert message in capsys.readouterr().err


def test_an_asset_that_is_not_named_is_missed_once(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([]) == 2
    assert capsys.readouterr().err.endswith("the following arguments are required: asset\n")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--cameras", "nowhere.json"], "nowhere.json"),
        (["--orbit", "1", "--size", "20000x20000"], "got 20000x20000, which would take 12.0 GB of memory"),
        (["--view", "5"], "--view: expected 0 to 4, got 5"),
        (["--orbit", "1", "--frames", "5:9"], "--frames: expected at least one of the 1 views"),
    ],
)
def test_errors_are_one_line(
    options: list[str], message: str, shells_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main([str(shells_folder), *options, "--output", str(tmp_path / "o")]) == 1
    error = capsys.readouterr().err
    assert error.startswith("vfr-play: error: ") and error.count("\n") == 1 and message in error
    assert not (tmp_path / "o").exists()


def test_not_an_asset(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for option in (["--info"], ["--check"], ["--orbit", "1", "--output", str(tmp_path / "o")]):
        assert cli.main([str(tmp_path / "nowhere"), *option]) == 1
        assert "nowhere: expected the folder of an asset, got nothing" in capsys.readouterr().err


def test_what_the_output_cannot_hold_is_escaped(
    shells_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = Path(shutil.copytree(shells_folder, tmp_path / "b\u00e4r"))
    for options in (["--info"], ["--view", "0", "--output", f"{folder}.png", "--march", "numpy"]):
        written = io.BytesIO()
        output = io.TextIOWrapper(written, encoding="ascii")
        monkeypatch.setattr(sys, "stdout", output)
        assert cli.main([str(folder), *options]) == 0
        assert b"b\\xe4r" in written.getvalue()


def test_full_disk(
    shells_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(files.os, "fsync", full)
    assert cli.main([*views(shells_folder), "--output", str(tmp_path / "o")]) == 1
    assert "r_0.png: cannot write: No space left on device" in capsys.readouterr().err
    assert list((tmp_path / "o").iterdir()) == []


def test_too_little_memory_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    """numpy says at once that it cannot have so much; Python's own error has no text."""

    def numpy_s() -> int:
        return len(np.empty(1 << 58, np.uint8))

    def python_s() -> int:
        raise MemoryError

    for command, got in ((numpy_s, "Unable to allocate "), (python_s, "an error: ask")):
        assert commands.run("vfr-play", command) == 1
        printed = capsys.readouterr().err
        assert printed.startswith(f"vfr-play: error: memory: expected enough of it, got: {got}")
        assert printed.endswith("or use a machine that has more\n") and printed.count("\n") == 1


def test_ctrl_c_keeps_finished_frames(
    shells_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    original, calls = Renderer.render, []

    def stop(self: Renderer, *args: object, **kwargs: object) -> object:
        calls.append(1)
        if len(calls) == 4:  # after one to warm up and two frames
            raise KeyboardInterrupt
        return original(self, *args, **kwargs)  # type: ignore[arg-type]

    monkeypatch.setattr(Renderer, "render", stop)
    assert cli.main([*views(shells_folder), "--output", str(tmp_path / "o")]) == 130
    assert sorted(p.name for p in (tmp_path / "o").iterdir()) == ["r_0.png", "r_1.png"]
    assert f"kept in {tmp_path / 'o'}; --resume goes on" in capsys.readouterr().err


@pytest.mark.extra
@pytest.mark.parametrize("first", [False, True])
def test_progress_on_a_terminal(
    first: bool, shells_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    child = [sys.executable, "-I", "-c", "print('right')"]
    monkeypatch.setattr("player.proof._record", lambda: tmp_path / "proof.txt")
    monkeypatch.setattr("player.proof.python_command", lambda _: child)
    monkeypatch.setattr("player.proof.first_use", lambda: first)
    assert cli.main([*views(shells_folder), "--output", str(tmp_path / "o"), "--frames", ":2"]) == 0
    shown = terminal.getvalue()
    assert "frame 2/2" in shown and ("compiling for this processor" in shown) == first


def run(code: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    environment = os.environ | {"PYTHONPATH": str(REPOSITORY)}
    return subprocess.run(
        [sys.executable, "-c", code, *arguments], env=environment, capture_output=True, text=True, check=False
    )


def test_plays_where_torch_numba_and_the_rest_are_blocked(shells_folder: Path, tmp_path: Path) -> None:
    blocked = ("torch", "numba", "scipy", "cv2", "onnx", "skimage", "tqdm", "vfr_bake", "exporters")
    code = f"import sys; sys.modules.update(dict.fromkeys({blocked!r}))\n"
    code += "from player.app.cli import main; sys.exit(main())"
    out = tmp_path / "o"
    done = run(code, *views(shells_folder), "--output", str(out), "--frames", "0:1", "--json", "-")
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["march"] == "numpy" and (out / "r_0.png").is_file()


def test_help_and_import_are_light() -> None:
    code = "import sys, player; from player.app.cli import main; main(['--help']); print(player.Camera)\n"
    done = run(code + "print(sorted({'onnxruntime', 'numba', 'PIL', 'torch'} & set(sys.modules)))")
    assert done.returncode == 0 and done.stdout.splitlines()[-1] == "[]"
    done = run("import sys; from player.app.cli import main; main(['--help']); print('numpy' in sys.modules)")
    assert done.stdout.splitlines()[-1] == "False" and "--orbit" in done.stdout
