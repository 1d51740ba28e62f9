"""Which pictures of a folder are found, and in which order."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from PIL import Image

from player.errors import DataError
from vfr_bake.data import load_scene
from vfr_bake.data.check.check import check_data
from vfr_bake.data.files import listing
from vfr_bake.data.files.listing import find_pictures, other_kinds, passed_over, unread_cameras
from vfr_bake.data.files.source import note_source
from vfr_bake.data.poses import estimate_cameras
from vfr_bake.data.store.working import WorkingSize


def touch(folder: Path, *names: str) -> None:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(b"")


def names(folder: Path) -> list[str]:
    place, found = find_pictures(folder)
    return [path.relative_to(place).as_posix() for path in found]


def test_folders_within_the_folder(tmp_path: Path) -> None:
    touch(tmp_path, "DCIM/101/IMG_2.jpg", "DCIM/100/IMG_10.HEIC", "DCIM/100/IMG_9.heic", "a.webp", "b.txt")
    touch(
        tmp_path, "masks/a.png", "mask/b.png", "sparse/0/c.png", ".trash/d.png", "._e.jpg", "__MACOSX/f.jpg"
    )
    touch(tmp_path, "other/transforms.json", "other/g.png", "out/manifest.json", "out/h.png")
    assert names(tmp_path) == ["a.webp", "DCIM/100/IMG_9.heic", "DCIM/100/IMG_10.HEIC", "DCIM/101/IMG_2.jpg"]


def test_suffixes_that_programs_and_cameras_write(tmp_path: Path) -> None:
    touch(tmp_path, "1.hif", "2.JFIF", "3.jpe")
    assert names(tmp_path) == ["1.hif", "2.JFIF", "3.jpe"]


def test_what_was_written_beside_the_photographs_is_none(tmp_path: Path) -> None:
    touch(tmp_path, "1.jpg", "walk.mp4", "walk_frames/images/0000.jpg", "garden.preview.png", "b/2.jpg")
    note_source(tmp_path / "walk_frames", tmp_path / "walk.mp4")
    (tmp_path / "b" / "source.txt").write_text("photographs of a friend")
    assert names(tmp_path) == ["1.jpg", "b/2.jpg"]
    assert names(tmp_path / "walk_frames") == ["0000.jpg"]


def test_videos_and_raw_files_are_named_wherever_they_are(tmp_path: Path) -> None:
    touch(tmp_path, "DCIM/100/a.RW2", "DCIM/walk.MOV", "DCIM/other.mov", "masks/b.dng", "c.txt")
    assert other_kinds(tmp_path) == (
        "; there are .rw2 files: save them as JPEG; there is a video, DCIM/other.mov: name it"
    )
    assert other_kinds(tmp_path / "masks") == "; there are .dng files: save them as JPEG"
    assert other_kinds(tmp_path / "none") == ""


def test_frames_of_several_videos_are_named_where_nothing_else_is_found(tmp_path: Path) -> None:
    """Frames in a folder of videos are not searched; an error says what to do, and that works."""
    for stem in ("b", "a"):
        touch(tmp_path, f"{stem}.mp4", f"{stem}_frames/images/0000.jpg")
        note_source(tmp_path / f"{stem}_frames", tmp_path / f"{stem}.mp4")
        (tmp_path / f"{stem}.mp4").unlink()
    expected = "; a_frames was made from a video or a ZIP: name it, or copy the pictures of several such"
    for load in (load_scene, lambda data: check_data(data, WorkingSize())):
        with pytest.raises(DataError, match=f"{expected} folders into a new one, in a folder each$"):
            load(str(tmp_path))
    for stem in ("b", "a"):
        (tmp_path / "both").mkdir(exist_ok=True)
        (tmp_path / f"{stem}_frames" / "images").rename(tmp_path / "both" / stem)
    assert names(tmp_path / "both") == ["a/0000.jpg", "b/0000.jpg"]


def test_images_come_first(tmp_path: Path) -> None:
    touch(tmp_path, "images/left/1.png", "images/2.png", "preview.png")
    assert names(tmp_path) == ["2.png", "left/1.png"]
    assert find_pictures(tmp_path)[0] == tmp_path / "images"


def test_linked_folders_are_searched_once(tmp_path: Path) -> None:
    """A link may lead out of the folder, or back into it."""
    touch(tmp_path, "walk/1.jpg", "walk/b/2.jpg", "elsewhere/3.jpg")
    links = {"linked": "elsewhere", "again": "elsewhere", "own": "walk/b", "b/back": "walk"}
    for link, target in links.items():
        (tmp_path / "walk" / link).symlink_to(tmp_path / target)
    found = find_pictures(tmp_path / "walk")[1]
    assert sorted(path.name for path in found) == ["1.jpg", "2.jpg", "3.jpg"]


def test_pictures_that_are_not_used_are_told_of(tmp_path: Path) -> None:
    """A raw file that belongs to a photograph is none, and neither is a mask."""
    touch(tmp_path, "a.jpg", "a.dng", "masks/a.png", "walk.preview.png", "walk.mp4", "images.txt")
    assert passed_over(tmp_path) is None
    touch(tmp_path, "b.BMP", "in/c.dng")
    assert passed_over(tmp_path) == (
        "pictures that are not used: 2 .bmp and .dng files, which have to be saved as JPEG"
    )
    touch(tmp_path, "images/9.jpg")
    assert passed_over(tmp_path) == (
        "pictures that are not used: 1 outside of images/ (a.jpg); 3 .bmp and .dng files, which have to be "
        "saved as JPEG"
    )
    said: list[str] = []
    for name in ("7.jpg", "8.jpg", "9.jpg"):
        Image.new("RGB", (40, 30)).save(tmp_path / "images" / name)
    with pytest.raises(DataError, match="with something to recognise"):
        estimate_cameras(tmp_path, lambda *_: None, said.append)
    assert said == [passed_over(tmp_path)]


@pytest.mark.parametrize("name", ["cameras_sphere.npz", "poses_bounds.npy", "pose/0_0001.txt"])
def test_cameras_of_other_forms_are_found(tmp_path: Path, name: str) -> None:
    touch(tmp_path, "images/a.png", "intrinsics.txt", "cameras.json")
    assert unread_cameras(tmp_path) is None
    touch(tmp_path, name)
    assert unread_cameras(tmp_path) == name


def test_a_whole_disk_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    touch(tmp_path, *(f"{index}.png" for index in range(4)))
    monkeypatch.setattr(listing, "MOST", 3)
    with pytest.raises(DataError, match="expected at most 3 pictures of one scene"):
        find_pictures(tmp_path)


def test_a_name_that_is_no_text(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A file name that is not UTF-8, as Linux allows and other systems do not, is refused."""
    monkeypatch.setattr(Path, "is_file", lambda path: True)
    for folder, name in (("", "\udcff.png"), ("M\udcfcnchen", "a.png")):
        found = (folder, [], [name])
        monkeypatch.setattr(os, "walk", lambda place, found=found, **_: [(f"{place}/{found[0]}", *found[1:])])
        with pytest.raises(DataError, match="expected a name in UTF-8"):
            find_pictures(tmp_path)
