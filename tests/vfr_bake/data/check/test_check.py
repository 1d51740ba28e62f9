"""`vfr-train --check`: its verdicts on good, blurred, unconnected and uneven sets; its page and its data."""

from __future__ import annotations

import json
import re
import shutil
import sys
from dataclasses import replace
from pathlib import Path, PurePath

import numpy as np
import pytest
from PIL import Image, ImageFilter

from player.cameras.camera import Camera, world_up
from player.cameras.transforms import write_cameras
from player.errors import ConfigError, DataError, MissingExtraError
from tests.vfr_bake.data.test_colmap import write_model
from vfr_bake.cli import train_main
from vfr_bake.data.check.check import Check, check_data
from vfr_bake.data.check.page import check_page
from vfr_bake.data.check.verdict import BAD, widest_gap
from vfr_bake.data.demo import demo_cameras
from vfr_bake.data.store.working import WorkingSize

MINUTES = 60.0
"""Seconds that the check may take: enough for a slow machine to look at everything."""


def wall(seed: int) -> Image.Image:
    """Return a picture of a long wall full of blots of all sizes, along which a window can move."""
    random = np.random.default_rng(seed)
    layers = np.zeros((400, 2000))
    for size in (4, 8, 16, 40):
        coarse = random.normal(0, 1, (400 // size + 1, 2000 // size + 1))
        layers += np.kron(coarse, np.ones((size, size)))[:400, :2000]
    levels = (128 + 40 * layers).clip(0, 255).astype(np.uint8)
    return Image.fromarray(levels).filter(ImageFilter.GaussianBlur(1.2)).convert("RGB")


def walk(folder: Path, n: int = 12, seed: int = 0, step: int = 60, prefix: str = "p") -> Path:
    """Write `n` pictures of 480 x 400 pixels, each one step further along the wall."""
    folder.mkdir(exist_ok=True)
    picture = wall(seed)
    for number in range(n):
        window = picture.crop((number * step, 0, number * step + 480, 400))
        window.save(folder / f"{prefix}{number:02d}.jpg", quality=92)
    return folder


def checked(folder: Path) -> Check:
    return check_data(str(folder), WorkingSize(320), MINUTES)


def test_a_good_walk(tmp_path: Path) -> None:
    check = checked(walk(tmp_path / "walk", 24))
    assert check.verdict == "good" and check.advice == []
    figures = check.figures
    assert (figures["n_pictures"], figures["n_looked_at"], figures["n_blurred"]) == (24, 24, 0)
    assert figures["share_in_one_group"] == 1 and figures["sizes"] == {"480x400": 24}
    assert figures["sizes_used"] == {"320x267": 24} and figures["exposure_spread"] < 0.1
    assert all(picture.found is None and picture.why is None for picture in check.pictures)


def test_a_blurred_picture_is_named(tmp_path: Path) -> None:
    folder = walk(tmp_path / "walk")
    blurred = Image.open(folder / "p05.jpg").filter(ImageFilter.GaussianBlur(5))
    blurred.save(folder / "p05.jpg")
    check = checked(folder)
    assert [picture.name for picture in check.pictures if picture.why == "blurred"] == ["p05.jpg"]
    assert any("1 blurred" in line for line in check.advice)


def test_pictures_of_two_places_fall_apart(tmp_path: Path) -> None:
    folder = walk(tmp_path / "walk", 8, 0, prefix="a")
    walk(folder, 8, 1, prefix="b")
    check = checked(folder)
    assert check.figures["share_in_one_group"] == 0.5 and check.verdict == BAD
    assert any("about 8 of 16" in line for line in check.likely)
    groups = "they show 2 places that have nothing in common, in 8 (a00.jpg to a07.jpg) and 8 (b00.jpg to b07"
    assert sum(line.startswith(groups) for line in check.advice) == 1
    walk(folder, 16, 0, prefix="a")
    check = checked(folder)
    assert check.verdict == "doubtful", "a training would take the larger place, with two in three pictures"


@pytest.mark.parametrize(("n_places", "verdict"), [(1, BAD), (2, BAD), (3, "doubtful")])
def test_pictures_that_show_the_same_count_once(n_places: int, verdict: str, tmp_path: Path) -> None:
    folder = walk(tmp_path / "walk", n_places)
    for number in range(n_places, 10):
        shutil.copy(folder / f"p{number % n_places:02d}.jpg", folder / f"p{number:02d}.jpg")
    check = checked(folder)
    assert check.figures["n_repeated"] == 10 - n_places and check.verdict == verdict
    assert f"about {n_places} of {n_places} pictures hang together" in check.likely[0]
    assert any("move around the subject" in line for line in check.advice) == (verdict == BAD)


def test_all_blurred_and_plain(tmp_path: Path) -> None:
    folder = walk(tmp_path / "walk", 8)
    for path in folder.iterdir():
        Image.open(path).filter(ImageFilter.GaussianBlur(12)).save(path)
    check = checked(folder)
    assert any("soft" in line for line in check.advice) and check.verdict != "good"
    for path in folder.iterdir():
        Image.new("RGB", (480, 400), (90, 80, 70)).save(path)
    check = checked(folder)
    assert check.verdict == BAD and check.figures["n_plain"] == 8


def test_exposure_that_changes(tmp_path: Path) -> None:
    folder = walk(tmp_path / "walk", 8)
    for path in sorted(folder.iterdir())[::2]:
        values = np.asarray(Image.open(path)).astype(float)
        Image.fromarray((values * 0.6).astype(np.uint8)).save(path)
    check = checked(folder)
    assert 1.0 < check.figures["exposure_spread"] < 2.5  # 0.6 of the levels: 1.6 powers of two in light
    assert any("lock the exposure" in line for line in check.advice)


@pytest.mark.parametrize("with_cameras", [False, True])
def test_what_is_masked_does_not_count(with_cameras: bool, tmp_path: Path) -> None:
    """A bright sign that moves with the camera is masked: features are found below it alone, and the exposure
    is that of the darker rest."""
    folder = walk(tmp_path / "walk", 8)
    (folder / "masks").mkdir()
    if with_cameras:
        frames = [replace(camera, name=f"p{i:02d}.jpg") for i, camera in enumerate(demo_cameras(480, 8))]
        cameras = [replace(camera, height=400, cy=200.0) for camera in frames]
        (folder / "transforms.json").write_bytes(write_cameras(cameras))
    mask = Image.new("L", (480, 400), 255)
    mask.paste(0, (0, 0, 480, 300))
    sign = wall(9).crop((0, 0, 480, 300)).point(lambda level: level // 2 + 128)
    for path in folder.glob("*.jpg"):
        with Image.open(path) as picture:
            signed = picture.copy()
        signed.paste(sign)
        signed.save(path, quality=95)
    without = checked(folder)
    for path in folder.glob("*.jpg"):
        mask.save(folder / "masks" / f"{path.stem}.png")
    check = checked(folder)
    looks = [picture.look for picture in check.pictures]
    assert all(look is not None and (look.points[:, 1] > 0.19).all() for look in looks)
    for one, other in zip(check.pictures, without.pictures, strict=True):
        assert one.look is not None and other.look is not None
        assert one.look.exposure < other.look.exposure - 0.3


def test_a_file_that_is_no_picture_is_named(tmp_path: Path) -> None:
    folder = walk(tmp_path / "walk", 6)
    (folder / "p03.jpg").write_bytes(b"no picture")
    check = checked(folder)
    (broken,) = (picture for picture in check.pictures if picture.size is None)
    assert broken.name == "p03.jpg" and "p03.jpg" in str(broken.why)
    assert json.dumps(check.document())


def cut_short(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-2000])


def test_pictures_that_are_cut_short_are_bad_and_named(tmp_path: Path) -> None:
    """Pictures that are cut short, although their headers can be read, are bad: training would stop there."""
    folder = walk(tmp_path / "walk", 24)
    cut_short(folder / "p03.jpg")
    check = checked(folder)
    assert check.verdict == BAD and check.figures["n_unreadable"] == 1
    assert any("copy p03.jpg again" in line for line in check.advice)
    for number in (5, 9, 12, 20):
        cut_short(folder / f"p{number:02d}.jpg")
    check = checked(folder)
    assert check.figures["n_unreadable"] == 5 and check.figures["sizes"] == {"480x400": 19}
    assert any("copy p03.jpg, p05.jpg, p09.jpg and 2 others again" in line for line in check.advice)


def test_a_mask_of_another_size_is_named(tmp_path: Path) -> None:
    """The picture itself is whole, so that another copy of it would change nothing."""
    folder = walk(tmp_path / "walk", 24)
    (folder / "masks").mkdir()
    for name in ("p03.png", "p04.png"):
        Image.new("L", (48, 40), 255).save(folder / "masks" / name)
    check = checked(folder)
    assert check.verdict == BAD and check.figures["n_unreadable"] == 0
    (told,) = (line for line in check.advice if "p03" in line)
    assert "p03.png: mask: expected 480x400 pixels as p03.jpg has, got 48x40: save it in the size" in told
    assert told.endswith("or remove it; masks that are wrong, in all: 2.")


def test_a_picture_without_a_camera_is_not_read_by_training(tmp_path: Path) -> None:
    folder = write_model(tmp_path / "toy", demo_cameras(24, 10))
    walk(folder / "images", 1)
    cut_short(folder / "images" / "p00.jpg")
    check = checked(folder)
    assert check.verdict != BAD and check.figures["n_unreadable"] == 1
    assert not any("p00.jpg" in line for line in check.advice)


def test_pictures_without_cameras_are_found_in_linear_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The check of a folder in which 40 of 50 pictures have no camera hashes no path more than a few times:
    a folder may have thousands."""
    folder = write_model(tmp_path / "toy", demo_cameras(24, 10))
    for number in range(40):
        (folder / "images" / f"p{number:02d}.jpg").write_bytes(b"")
    n_hashed, whole = 0, PurePath.__hash__

    def counted(path: PurePath) -> int:
        nonlocal n_hashed
        n_hashed += 1
        return whole(path)

    monkeypatch.setattr(PurePath, "__hash__", counted)
    assert len(check_data(str(folder), WorkingSize(), seconds=0).pictures) == 50
    assert n_hashed < 4 * 50


def test_a_package_that_is_missing_is_no_fault_of_the_pictures(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    walk(tmp_path / "walk", 1)
    (tmp_path / "walk" / "a.heic").write_bytes(b"\0\0\0\x14ftypheic\0\0\0\0heic")
    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    with pytest.raises(MissingExtraError, match="expected pillow-heif"):
        checked(tmp_path / "walk")


def test_time_that_is_over_leaves_a_sample(tmp_path: Path) -> None:
    check = check_data(str(walk(tmp_path / "walk")), WorkingSize(), seconds=0)
    assert check.figures["n_looked_at"] == 0 and len(check.pictures) == 12
    assert check_data(str(tmp_path / "walk"), WorkingSize(), MINUTES, most=4).figures["n_looked_at"] == 4


def test_cameras_that_come_with_the_pictures(small_data: Path, tmp_path: Path) -> None:
    check = check_data(str(small_data), WorkingSize(), MINUTES)
    assert check.kind == "transforms.json" and check.figures["n_found"] == 14
    assert all(picture.found for picture in check.pictures) and len(check.cameras) == 14
    page = check_page(check).decode()
    assert page.count("<svg") == 2 and page.count("<circle") == 2 * 15
    (turnable,) = re.findall(r"const cameras = (\[.*?\]);", page)
    drawn = np.array(json.loads(turnable))
    assert drawn.shape == (14, 6) and "http" not in page
    places = np.stack([camera.c2w[:3, 3] for camera in check.cameras])
    heights = (places - places.mean(axis=0)) @ world_up(check.cameras)
    ratio = (drawn[:, 2] - drawn[:, 2].mean()) / heights  # one scale, and up is up
    assert ratio.min() > 0 and np.ptp(ratio) < 0.02 * ratio.mean()


def test_the_widest_gap_of_a_walk() -> None:
    def ring(degrees: np.ndarray) -> list[Camera]:
        cameras = []
        for angle in np.radians(degrees):
            back = np.array([np.cos(angle), np.sin(angle), 0.2])
            back /= np.linalg.norm(back)
            right = np.array([-np.sin(angle), np.cos(angle), 0.0])
            c2w = np.eye(4)
            c2w[:3] = np.stack([right, np.cross(back, right), back, 3 * back], axis=-1)
            cameras.append(Camera("a", c2w, 8, 8, 9.0, 9.0, 4.0, 4.0))
        return cameras

    assert widest_gap(ring(np.arange(0, 360, 20))) == pytest.approx(20)
    assert widest_gap(ring(np.arange(0, 181, 10))) == pytest.approx(180, abs=0.1)
    assert widest_gap(ring(np.array([0.0]))) is None
    assert (widest_gap(demo_cameras(8, 64)) or 0) < 30


def test_the_command_writes_a_page_and_data(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = walk(tmp_path / "my <walk>", 6)
    monkeypatch.chdir(tmp_path)
    arguments = [str(folder), "--check", "--json", "check.json", "--max-side", "240"]
    assert train_main(arguments) == 0
    page = (tmp_path / "my <walk>_check.html").read_text(encoding="utf-8")
    assert "my &lt;walk&gt;" in page and "<walk>" not in page
    assert page.count("data:image/jpeg;base64,") == 6
    assert not re.findall(r"(?:src|href)=(?![\"']?data:)|url\(|@import|https?:", page)
    images = json.loads((tmp_path / "check.json").read_text())["images"]
    assert [image["name"] for image in images] == [f"p{number:02d}.jpg" for number in range(6)]
    assert {(image["width"], image["height"]) for image in images} == {(240, 200)}
    assert all(image["sharpness"] > 0 for image in images if image["n_features"] is not None)
    assert "6 pictures of 480x400, used at 240x200" in capsys.readouterr().out
    assert train_main(arguments) == 0, "its own page may be replaced"
    (tmp_path / "my <walk>_check.html").write_text("something else")
    assert train_main(arguments) == 1
    assert train_main([str(folder)]) == 2
    assert "expected a model file" in capsys.readouterr().err


def test_what_cannot_be_checked(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="demo"):
        check_data("demo", WorkingSize())
    with pytest.raises(DataError, match="expected a folder of pictures or a video, got none"):
        check_data(str(tmp_path), WorkingSize())
    (tmp_path / "transforms.json").write_bytes(write_cameras(demo_cameras(8, 3)))
    with pytest.raises(DataError, match="picture is missing"):
        check_data(str(tmp_path), WorkingSize())
