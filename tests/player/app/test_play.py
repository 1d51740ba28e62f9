"""Tests of the files that playing writes: pictures and videos."""

from __future__ import annotations

import json
import math
import os
import shutil
import subprocess
import sys
import weakref
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from player.app import cli
from player.app.frame_files import Target
from player.app.jobs import Done, Job, render_job
from player.app.options import PlaySettings
from player.app.play import LARGE_BYTES, MEMORY_BYTES, _check_sizes, play
from player.app.video import write_video
from player.asset.asset import Asset
from player.cameras.camera import orbit
from player.cameras.nerfstudio import write_camera_path
from player.cameras.transforms import read_cameras
from player.cameras.views import asset_cameras
from player.errors import ConfigError, OutputError
from player.files.images import png_bytes, read_key, webp_bytes
from player.march.interpolation import Quality
from player.render import FRAME_BYTES, Renderer, render

REPOSITORY = Path(__file__).resolve().parents[3]


def pixels(path: Path) -> np.ndarray:
    with Image.open(path) as picture:
        return np.asarray(picture)


def trained(folder: Path) -> list[str]:
    return [str(folder), "--cameras", str(folder / "cameras.json")]


def test_a_training_view_exactly(asset: Asset, shells_folder: Path, tmp_path: Path) -> None:
    cameras = read_cameras(asset.path("cameras.json"))
    for number, name in ((3, "view.png"), (-1, "last.webp")):
        assert cli.main([str(shells_folder), "--view", str(number), "--output", str(tmp_path / name)]) == 0
        assert (pixels(tmp_path / name) == render(asset, cameras[number]).to_uint8()).all()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["last.webp", "view.png"]


def test_another_aspect_ratio_stretches_nothing(asset: Asset, shells_folder: Path, tmp_path: Path) -> None:
    camera = read_cameras(asset.path("cameras.json"))[3]
    wide = replace(camera, width=96, cx=camera.cx + 24)
    options = ["--size", "96x40", "--output"]
    assert cli.main([str(shells_folder), "--view", "3", *options, str(tmp_path / "view.png")]) == 0
    assert cli.main([*trained(shells_folder), "--frames", "3", *options, str(tmp_path / "file.png")]) == 0
    for name in ("view.png", "file.png"):
        assert (pixels(tmp_path / name) == render(asset, wide).to_uint8()).all()


@pytest.mark.parametrize("background", ["white", "transparent"])
def test_webp_and_png_show_the_same(background: str, shells_folder: Path, tmp_path: Path) -> None:
    for form in ("png", "webp"):
        options = ["--output", str(tmp_path / form), "--format", form, "--background", background]
        assert cli.main([*trained(shells_folder), *options]) == 0
    for path in sorted((tmp_path / "png").iterdir()):
        webp = pixels(tmp_path / "webp" / f"{path.stem}.webp")
        png = pixels(path)
        assert webp.shape == png.shape == (40, 48, 4 if background == "transparent" else 3)
        assert (webp == png).all()


def test_a_program_plays_as_the_command_does(
    asset: Asset, shells_folder: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """`play` writes the same files as the command, but prints nothing: messages are handed to the caller."""
    there, here, said, shown = tmp_path / "there", tmp_path / "here", [], []
    options = ["--frames", "1:3", "--samples", "1000", "--background", "black", "--march", "numpy"]
    assert cli.main([*trained(shells_folder), *options, "--output", str(there)]) == 0
    capfd.readouterr()
    settings = PlaySettings(here, frames=slice(1, 3), samples=1000, background=(0.0, 0.0, 0.0), march="numpy")
    played = play(asset, asset_cameras(asset), settings, said.append, lambda *numbers: shown.append(numbers))
    assert capfd.readouterr() == ("", "")
    assert [path.name for path in sorted(here.iterdir())] == ["r_1.png", "r_2.png"]
    assert all((there / path.name).read_bytes() == path.read_bytes() for path in here.iterdir())
    (line,) = said
    assert line.startswith("--samples 1000: a ray has ")
    assert [numbers[:2] for numbers in shown] == [(1, 2), (2, 2)] and played.n_kept == 0
    with pytest.raises(OutputError, match="not empty: add --force"):
        play(asset, asset_cameras(asset), settings)
    played = play(asset, asset_cameras(asset), replace(settings, output=f"{here}/", resume=True))
    assert (played.n_kept, played.figures["frames"]) == (2, 0)


@pytest.mark.parametrize("name", ["frames", pytest.param("turn.mp4", marks=pytest.mark.extra)])
def test_settings_with_numbers_of_any_kind_resume_a_run(
    name: str, asset: Asset, shells_folder: Path, tmp_path: Path
) -> None:
    """Whole numbers and arrays are the settings that the command line has read from the same digits."""
    output = tmp_path / name
    options = ["--background", "white", "--samples", "3", "--march", "numpy", "--output", str(output)]
    options += ["--fps", "7"] if name == "turn.mp4" else []
    assert cli.main([*trained(shells_folder), *options]) == 0
    for white, samples in (((1, 1, 1), np.int64(3)), (np.ones(3), 3), ([1, 1, np.float32(1)], np.uint8(3))):
        settings = PlaySettings(output, None, None, 7, True, background=white, samples=samples, march="numpy")  # type: ignore[arg-type]
        assert play(asset, asset_cameras(asset), settings).n_kept == 5


@pytest.mark.parametrize(
    ("name", "what", "n_bytes"),
    [("turn", "picture", FRAME_BYTES), ("a.webp", "picture", 50), ("turn.mp4", "video", 240)],
)
def test_what_takes_much_memory_is_told_of(asset: Asset, name: str, what: str, n_bytes: int) -> None:
    """The largest picture asked for is reported if it takes much memory, whatever the order of pictures."""
    small = read_cameras(asset.path("cameras.json"))[0]
    target = Target.of(PlaySettings(Path(name)))
    pixels = math.ceil(LARGE_BYTES / n_bytes)
    wide, square = (
        small.resized(pixels // 2000 + 1, 2000),
        small.resized(math.isqrt(pixels) - 1, math.isqrt(pixels) - 1),
    )
    said: list[str] = []
    _check_sizes([square] if target.is_video else [small, square], target, said.append)
    assert not said
    for cameras in [[wide]] if target.is_video else [[wide, small, square], [square, small, wide], [wide]]:
        said.clear()
        _check_sizes(cameras, target, said.append)
        gigabytes = wide.width * 2000 * n_bytes / 1e9
        assert said == [f"a {what} of {wide.width}x2000 takes {gigabytes:.1f} GB of memory"]


@pytest.mark.parametrize(
    ("name", "most"), [("a.webp", 16383), pytest.param("a.mp4", 16384, marks=pytest.mark.extra)]
)
def test_sides_too_long_for_a_format_are_refused_at_once(
    name: str, most: int, asset: Asset, tmp_path: Path
) -> None:
    camera, settings = asset_cameras(asset)[0], PlaySettings(tmp_path / name, march="numpy")
    for size in ((most + 1, 2), (2, most + 1)):
        with pytest.raises(ConfigError, match=f"expected at most {most} pixels a side"):
            play(asset, [camera.resized(*size)], settings)
    assert not list(tmp_path.iterdir())
    play(asset, [camera.resized(most, 2)], settings)
    assert (tmp_path / name).exists()


PEAK = """
import sys
from pathlib import Path
import numpy as np
from player.app.jobs import Job, render_job
from player.app.play import peak_rss_mb
from player.app.video import write_video
from player.render import Frame

class Noise:
    march, n_threads = "", 1

    def render(self, n, *_, **__):
        planes = (np.zeros((n, n), np.float32) for _ in range(3))
        return Frame(np.random.default_rng(0).random((n, n, 3), np.float32), *planes, (0.0, 0.0, 0.0))

def make(n):
    if path.suffix != ".mp4":
        render_job(Noise(), Job(0, n, None, None, "exact", "", path.suffix))
    else:
        wave = np.uint8(127 + 120 * np.sin(np.arange(n) / 9))
        picture = np.add.outer(wave, wave)[..., None].repeat(3, -1)
        write_video(path, (np.roll(picture, 7 * i, 1) for i in range(60)), 30, "")

path = Path(sys.argv[1])
make(32)  # imports and compiles
before = peak_rss_mb() or 0
make(int(sys.argv[2]))
print(1e6 * ((peak_rss_mb() or 0) - before))
"""
"""Prints the bytes of memory that it takes to make a picture or a video of so many pixels a side; less where
the system tells a process only of a peak that it has inherited, or of none."""


@pytest.mark.parametrize(
    ("name", "side"), [("a.webp", 1500), pytest.param("a.mp4", 768, marks=pytest.mark.extra)]
)
def test_making_a_picture_or_a_video_takes_no_more_memory_than_is_told(
    name: str, side: int, tmp_path: Path
) -> None:
    done = subprocess.run(
        [sys.executable, "-c", PEAK, str(tmp_path / name), str(side)],
        env=os.environ | {"PYTHONPATH": str(REPOSITORY)}, check=True, capture_output=True, text=True,
    )  # fmt: skip
    assert float(done.stdout) <= MEMORY_BYTES[Path(name).suffix] * side**2


def test_one_picture_wants_one_view(
    shells_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    target = tmp_path / "a.png"
    assert cli.main([*trained(shells_folder), "--output", str(target)]) == 1
    assert "expected one view for one picture, got 5" in capsys.readouterr().err
    assert cli.main([*trained(shells_folder), "--output", str(target), "--frames", "2"]) == 0
    assert cli.main([*trained(shells_folder), "--output", str(target), "--frames", "2"]) == 1
    assert f"{target}: already exists: add --force to replace it" in capsys.readouterr().err
    assert cli.main([*trained(shells_folder), "--output", str(target), "--frames", "2", "--force"]) == 0


def test_keys_survive_in_both_formats(tmp_path: Path) -> None:
    image = np.random.default_rng(0).integers(0, 255, (3, 4, 4), np.uint8)
    for name, encode in (("a.png", png_bytes), ("a.webp", webp_bytes)):
        path = tmp_path / name
        path.write_bytes(encode(image, "0123abc"))
        assert read_key(path) == "0123abc" and (pixels(path) == image).all()
        path.write_bytes(encode(image))
        assert read_key(path) is None
        path.write_bytes(encode(image, "0123abc")[:-30])
        assert read_key(path) is None, "cut short"
    assert read_key(tmp_path / "nowhere.png") is None
    with pytest.raises(OutputError, match="WebP: expected at most 16383 pixels a side"):
        webp_bytes(np.zeros((1, 16384, 3), np.uint8))


def test_the_file_of_one_frame_is_in_memory_at_a_time(
    asset: Asset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[weakref.ref[Done]] = []
    n_kept: list[int] = []

    def remembered(renderer: Renderer, job: Job) -> Done:
        done = render_job(renderer, job)
        made.append(weakref.ref(done))
        return done

    def count(*_: float) -> None:
        n_kept.append(sum(done() is not None for done in made))

    monkeypatch.setattr("player.app.play.render_job", remembered)
    played = play(asset, asset_cameras(asset), PlaySettings(tmp_path / "o", march="numpy"), advance=count)
    assert n_kept == [1] * 5 and played.figures["frames"] == 5


# --- video ---


def decode(path: Path) -> list[np.ndarray]:
    import av

    with av.open(str(path)) as container:
        return [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]


@pytest.mark.extra
def test_a_video_shows_the_frames_at_the_paths_rate(
    asset: Asset, shells_folder: Path, tmp_path: Path
) -> None:
    """A video shows the frames at the path's rate. An odd size, which H.264 cannot store, is padded by copies
    of the last column and row."""
    import av

    turn = orbit(read_cameras(asset.path("cameras.json")), 6, (65, 49))
    path = tmp_path / "path.json"
    path.write_bytes(write_camera_path(turn, 12))
    target = tmp_path / "turn.mp4"
    assert cli.main([str(shells_folder), "--cameras", str(path), "--output", str(target)]) == 0
    with av.open(str(target)) as container:
        stream = container.streams.video[0]
        assert float(stream.average_rate or 0) == 12 and stream.codec_context.name == "h264"
        assert stream.codec_context.pix_fmt == "yuv420p", "what browsers show"
    frames = decode(target)
    assert len(frames) == 6 and frames[0].shape == (50, 66, 3)
    with Renderer(asset, 1) as renderer:
        for decoded, camera in zip(frames, turn, strict=True):
            picture = renderer.render(camera).to_uint8().astype(int)
            # colour at half resolution loses noise of single pixels; the mean shows that colours are right
            assert np.abs(decoded[:49, :65] - picture).mean() < 8
            assert np.abs(decoded[:49, :65].mean(axis=(0, 1)) - picture.mean(axis=(0, 1))).max() < 2.5
    again = ["--cameras", str(path), "--output", str(target), "--fps", "7", "--force"]
    assert cli.main([str(shells_folder), *again]) == 0
    with av.open(str(target)) as container:
        assert float(container.streams.video[0].average_rate or 0) == 7
    assert sorted(p.name for p in tmp_path.iterdir()) == ["path.json", "turn.mp4"]


@pytest.mark.extra
def test_a_resumed_video_that_is_complete_is_kept(
    shells_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The same command again renders nothing. A video of other views, settings or rates, or one that this
    program has not made, is refused, unless frames of an interrupted run that was to replace it are there."""
    target = tmp_path / "turn.mp4"
    command = [*trained(shells_folder), "--output", str(target)]
    assert cli.main([*command, "--resume"]) == 0
    made = target.read_bytes(), target.stat().st_mtime_ns
    capsys.readouterr()
    assert cli.main([*command, "--resume"]) == 0
    assert "0 pictures (5 were there already) of 48x40, nothing left to render" in capsys.readouterr().out
    frames = tmp_path / "turn.mp4.frames"
    frames.mkdir()
    (frames / ".DS_Store").touch()  # of Finder, which has kept the folder from being removed
    assert cli.main([*command, "--resume"]) == 0
    assert "0 pictures (5 were there already) of 48x40, nothing left to render" in capsys.readouterr().out
    shutil.rmtree(frames)
    for options in (["--samples", "2"], ["--frames", "1:3"], ["--fps", "7"]):
        assert cli.main([*command, "--resume", *options]) == 1
        assert f"{target}: --resume: expected a video of this asset, these views" in capsys.readouterr().err
    assert (target.read_bytes(), target.stat().st_mtime_ns) == made
    assert [path.name for path in tmp_path.iterdir()] == ["turn.mp4"]
    target.write_bytes(b"mine")
    assert cli.main([*command, "--resume"]) == 1 and target.read_bytes() == b"mine"
    assert cli.main([*trained(shells_folder), "--output", str(frames), "--frames", "1:3"]) == 0
    assert cli.main([*command, "--resume"]) == 0
    assert len(decode(target)) == 5 and not frames.exists()
    assert cli.main([*command, "--resume"]) == 0 and "0 pictures (5" in capsys.readouterr().out


@pytest.mark.extra
def test_plain_colours_of_a_video_are_right(tmp_path: Path) -> None:
    colours = [(255, 255, 255), (0, 0, 0), (200, 30, 30), (30, 200, 30), (30, 30, 200)]
    write_video(tmp_path / "a.mp4", [np.full((32, 32, 3), c, np.uint8) for c in colours], 29.97, "key")
    for frame, colour in zip(decode(tmp_path / "a.mp4"), colours, strict=True):
        assert np.abs(frame.mean(axis=(0, 1)) - colour).max() < 4


@pytest.mark.extra
def test_videos_that_cannot_be(
    shells_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    target = tmp_path / "turn.mp4"
    views = json.loads((shells_folder / "cameras.json").read_text())
    views["frames"][2] |= {"w": 20, "h": 20}
    mixed = tmp_path / "mixed.json"
    mixed.write_text(json.dumps(views))
    assert cli.main([str(shells_folder), "--cameras", str(mixed), "--output", str(target)]) == 1
    assert "expected views of one size for a video, got [(20, 20), (48, 40)]" in capsys.readouterr().err
    with pytest.raises(OutputError, match=r"turn\.mp4: cannot write: "):
        write_video(target, [np.zeros((8, 40_000, 3), np.uint8)], 30, "key")
    monkeypatch.setitem(sys.modules, "av", None)
    assert cli.main([*trained(shells_folder), "--output", str(target)]) == 1
    assert "pip install 'vfr-bake[video]'; or write pictures: --output DIR" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["mixed.json"], "said before anything was rendered"


@pytest.mark.parametrize("quality", ["high", "fast"])
def test_a_frame_is_the_same_alone_and_in_a_film_of_a_quality(
    quality: Quality, asset: Asset, tmp_path: Path
) -> None:
    """A frame is the same alone and in a film; resuming a film with another quality is refused."""
    cameras = orbit(read_cameras(asset.path("cameras.json")), 3, (61, 47))
    film = PlaySettings(tmp_path / "film", quality=quality, march="numpy")
    assert play(asset, cameras, film).figures["quality"] == quality
    play(asset, cameras, PlaySettings(tmp_path / "one", frames=slice(1, 2), quality=quality, march="numpy"))
    name = "orbit_001.png"
    assert (tmp_path / "one" / name).read_bytes() == (tmp_path / "film" / name).read_bytes()
    (tmp_path / "film" / name).unlink()
    again = replace(film, resume=True)
    assert play(asset, cameras, again).n_kept == 2
    assert (tmp_path / "one" / name).read_bytes() == (tmp_path / "film" / name).read_bytes()
    with pytest.raises(ConfigError, match="--resume: expected a frame of this asset"):
        play(asset, cameras, replace(again, quality="exact"))
