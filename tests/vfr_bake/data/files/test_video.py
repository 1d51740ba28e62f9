"""Frames of a video: which of them are chosen, and videos that cannot be read."""

from __future__ import annotations

import os
from fractions import Fraction
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import av
import cv2
import numpy as np
import pytest
from PIL import Image

from player.errors import DataError
from tests.vfr_bake.data.test_poses import message, quiet, textured
from vfr_bake.data import poses
from vfr_bake.data.check.check import check_data
from vfr_bake.data.files import video
from vfr_bake.data.poses import estimate_cameras, is_video
from vfr_bake.data.store.working import WorkingSize


def write_video(path: Path, shifts: list[float], blurred: set[int] = frozenset()) -> Path:
    """Write a video with a frame for each of `shifts`, the pixels by which the picture has moved."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 10, (160, 120))
    for index, shift in enumerate(shifts):
        frame = np.roll(textured(6, 320, 120), round(shift), axis=1)[:, :160].copy()
        if index in blurred:
            frame = cv2.GaussianBlur(frame, (9, 9), 3)
        frame[:8] = 4 * index  # tells which frame it is
        writer.write(frame)
    writer.release()
    return path


@pytest.fixture
def short_video(tmp_path: Path) -> Path:
    """A video of twelve frames, each moved by 3 of 160 pixels, every second one blurred."""
    return write_video(tmp_path / "walk.avi", [3 * index for index in range(12)], set(range(1, 12, 2)))


def frame_numbers(folder: Path) -> list[int]:
    return [round(np.asarray(Image.open(path))[:5].mean() / 4) for path in sorted(folder.iterdir())]


def test_the_sharpest_frame_of_every_step(short_video: Path):
    calls: list[tuple[int, int]] = []
    folder = video.extract_frames(short_video, lambda *call: calls.append(call))
    assert folder == short_video.with_name("walk_frames") and calls[-1] == (12, 12)
    numbers = frame_numbers(folder / "images")
    assert not any(number % 2 for number in numbers) and 5 <= len(numbers) <= 6
    assert video.extract_frames(short_video, quiet_frames) == folder  # they are used as they are
    other = short_video.rename(short_video.with_suffix(".mov"))
    with pytest.raises(DataError, match=r"walk_frames: expected to be made from walk\.mov"):
        video.extract_frames(other, quiet_frames)


def quiet_frames(done: int, of: int) -> None:
    raise AssertionError("nothing is to be done")


def test_frames_are_chosen_by_how_far_the_camera_moves(tmp_path: Path):
    """More frames are chosen where the camera moves: it stands still for 20 frames and moves for 20."""
    path = write_video(tmp_path / "a.avi", [0.0] * 20 + [5.0 * index for index in range(1, 21)])
    numbers = frame_numbers(video.extract_frames(path, lambda done, of: None) / "images")
    assert sum(number < 20 for number in numbers) <= 1 and len(numbers) > 12
    still = write_video(tmp_path / "b.avi", [0.0] * 8)
    assert len(frame_numbers(video.extract_frames(still, lambda done, of: None) / "images")) == 1


def test_a_long_video_gives_no_more_frames(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(video, "MOST_FRAMES", 6)
    path = write_video(tmp_path / "a.avi", [6.0 * index for index in range(50)])
    numbers = frame_numbers(video.extract_frames(path, lambda done, of: None) / "images")
    assert 3 <= len(numbers) <= 6 and numbers == sorted(numbers)
    assert np.diff(numbers).min() >= 4 and numbers[-1] > 35  # spread over the whole video


def test_a_video_becomes_a_folder_of_pictures(short_video: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(poses, "look_at", lambda pictures, *_: pytest.fail(f"{len(pictures)} pictures"))
    assert is_video(short_video)
    with pytest.raises(pytest.fail.Exception, match="6 pictures"):
        estimate_cameras(short_video, quiet)


def test_an_interrupted_video_leaves_nothing(short_video: Path):
    def interrupt(done: int, of: int) -> None:
        if done == 7:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        video.extract_frames(short_video, interrupt)
    assert list(short_video.parent.iterdir()) == [short_video]


@pytest.mark.parametrize(("counted", "told"), [(13, False), (14, True)])
def test_a_video_that_ends_early_is_told_of(
    short_video: Path, monkeypatch: pytest.MonkeyPatch, counted: int, told: bool
):
    """The header of a video of 12 frames counts 13, as a guess may, or 14, of which 12 are too few."""

    whole = cv2.VideoCapture

    def with_count(path: str) -> SimpleNamespace:
        capture = whole(path)
        return SimpleNamespace(
            get=lambda key: counted, isOpened=capture.isOpened, read=capture.read, release=capture.release
        )

    monkeypatch.setattr(cv2, "VideoCapture", with_count)
    said: list[str] = []
    folder = video.extract_frames(short_video, lambda done, of: None, said.append)
    expected = (
        "12 of about 14 frames of walk.avi could be read: if it is longer than that, copy it again, and "
        f"remove {folder}"
    )
    assert said == ([expected] if told else [])


def test_the_check_of_a_video_reports_its_frames(short_video: Path):
    calls: list[tuple[int, int]] = []
    check_data(str(short_video), WorkingSize(), 60.0, lambda *call: calls.append(call))
    assert (12, 12) in calls


SRGB_COLOUR = (200, 90, 60)
WHITE_NITS = 203.0
"""Luminance of white in videos of high dynamic range (ITU-R BT.2408)."""
BT2020_FROM_BT709 = np.array([[0.6274, 0.3293, 0.0433], [0.0691, 0.9195, 0.0114], [0.0164, 0.0880, 0.8956]])


def hlg(linear: np.ndarray) -> np.ndarray:
    """Return the signal of ITU-R BT.2100, table 5, for a display of 1,000 nits; `linear`: 1 is white."""
    shown = BT2020_FROM_BT709 @ linear * WHITE_NITS / 1000
    light = shown * (shown @ [0.2627, 0.6780, 0.0593]) ** (1 / 1.2 - 1)
    bright = 0.17883277 * np.log((12 * light - 0.28466892).clip(1e-9)) + 0.55991073
    return np.where(light <= 1 / 12, np.sqrt(3 * light), bright)


def pq(linear: np.ndarray) -> np.ndarray:
    """Return the signal of ITU-R BT.2100, table 4; `linear`: 1 is white."""
    power = (BT2020_FROM_BT709 @ linear * WHITE_NITS / 10_000) ** 0.1593017578125
    return ((0.8359375 + 18.8515625 * power) / (1 + 18.6875 * power)) ** 78.84375


def bt709(linear: np.ndarray) -> np.ndarray:
    return np.array(SRGB_COLOUR) / 255


@pytest.mark.parametrize(
    ("signal", "codes", "shares", "most_off"),
    [
        # FFmpeg fits high dynamic range and wider primaries into sRGB by rules of its own.
        (hlg, (9, 18, 9), (0.2627, 0.0593), 16),
        (pq, (9, 16, 9), (0.2627, 0.0593), 16),
        (bt709, (1, 1, 1), (0.2126, 0.0722), 2),
    ],
)
def test_colours_of_a_video(
    tmp_path: Path, signal: Any, codes: Any, shares: tuple[float, float], most_off: int
) -> None:
    """Phones record BT.709, or in high dynamic range HLG or PQ with the primaries of BT.2020. `codes`:
    primaries, transfer and matrix (ITU-T H.273). `shares`: of red and blue in luma."""
    srgb = np.array(SRGB_COLOUR) / 255
    red, green, blue = signal(((srgb + 0.055) / 1.055) ** 2.4)
    luma = shares[0] * red + (1 - sum(shares)) * green + shares[1] * blue
    chroma = (blue - luma) / (1 - shares[1]), (red - luma) / (1 - shares[0])
    frame = av.VideoFrame(64, 64, "yuv420p10le")
    levels = 64 + 876 * luma, 512 + 448 * chroma[0], 512 + 448 * chroma[1]
    for plane, level in zip(frame.planes, levels, strict=True):
        plane.update(np.full(plane.buffer_size // 2, round(level), "<u2").tobytes())
    with av.open(tmp_path / "a.mov", "w") as file:
        stream = file.add_stream("libx265", 30, options={"x265-params": "log-level=none:lossless=1"})
        stream.width, stream.height, stream.pix_fmt = 64, 64, "yuv420p10le"
        context = stream.codec_context
        context.color_primaries, context.color_trc, context.colorspace = codes
        context.color_range = 1
        for number in range(3):
            frame.pts = number
            file.mux(stream.encode(frame))
        file.mux(stream.encode())
    folder = video.extract_frames(tmp_path / "a.mov", lambda done, of: None)
    with Image.open(folder / "images" / "0000.jpg") as picture:
        found = np.asarray(picture)[32, 32].astype(int)
    assert np.abs(found - SRGB_COLOUR).max() <= most_off


@pytest.mark.parametrize(
    ("shape", "turned", "expected"),
    [("4/3", 0, (213, 120)), ("1/2", 0, (80, 120)), ("4/3", 90, (120, 120)), ("0", 0, (160, 120))],
)
def test_pixels_that_are_no_squares(
    shape: str, turned: int, expected: tuple[int, int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """Frames of an anamorphic video get the shape in which it is to be shown."""
    path = tmp_path / "a.mp4"
    with av.open(str(path), "w") as file:
        stream = file.add_stream("mpeg4", 10, width=160, height=120, pix_fmt="yuv420p")
        stream.codec_context.sample_aspect_ratio = Fraction(shape)
        frame = av.VideoFrame.from_ndarray(textured(6, 160, 120), "bgr24")
        file.mux([*stream.encode(frame), *stream.encode(None)])
    whole = cv2.VideoCapture

    def on_its_side(path: str) -> SimpleNamespace:
        capture = whole(path)
        return SimpleNamespace(
            get=lambda key: turned if key == cv2.CAP_PROP_ORIENTATION_META else capture.get(key),
            isOpened=capture.isOpened,
            read=capture.read,
            release=capture.release,
        )

    monkeypatch.setattr(cv2, "VideoCapture", on_its_side)
    (kept,) = (video.extract_frames(path, lambda done, of: None) / "images").iterdir()
    with Image.open(kept) as picture:
        assert picture.size == expected


def test_a_file_that_is_no_video(tmp_path: Path, capfd: pytest.CaptureFixture[str]):
    path = tmp_path / "a.mp4"
    path.write_bytes(b"no video" * 100)
    assert message(path) == f"{path}: video: expected one that OpenCV can read, with frames in it"
    assert not video.frames_folder(path).exists()


@pytest.mark.skipif(os.name == "nt", reason="Windows has no such names")
def test_a_relative_name_with_a_colon(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    with av.open(str(tmp_path / "12-30.mp4"), "w") as container:
        stream = container.add_stream("libx264", rate=10)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        container.mux(stream.encode(av.VideoFrame(64, 48, "yuv420p")))
        container.mux(stream.encode())
    (tmp_path / "12-30.mp4").rename(tmp_path / "12:30.mp4")
    monkeypatch.chdir(tmp_path)
    folder = video.extract_frames(Path("12:30.mp4"), lambda done, of: None)
    assert folder == Path("12:30_frames") and len([*(folder / "images").iterdir()]) == 1


def test_a_name_that_is_no_text(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """OpenCV ends the process at a file name that is not UTF-8."""
    monkeypatch.setattr(cv2, "VideoCapture", lambda name: pytest.fail("the file is opened"))
    for path in (tmp_path / "wal\udce8k.mp4", tmp_path / "M\udcfcnchen" / "walk.mp4"):
        with pytest.raises(DataError, match="expected a name in UTF-8") as caught:
            video.extract_frames(path, quiet_frames)
        assert str(caught.value).isascii()


def test_a_video_without_frames(tmp_path: Path):
    path = tmp_path / "a.avi"
    cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 30, (64, 48)).release()
    assert path.is_file()
    assert message(path) == f"{path}: video: expected one that OpenCV can read, with frames in it"
