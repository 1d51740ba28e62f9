"""A ZIP of pictures is unpacked once, and never takes more than its folder, its disk and its size allow."""

from __future__ import annotations

import io
import stat
import zipfile
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from player.errors import DataError
from vfr_bake.data import load_scene, needs_cameras, unpacked
from vfr_bake.data.files import archives
from vfr_bake.data.files.archives import unpack
from vfr_bake.data.files.listing import find_pictures
from vfr_bake.data.poses import estimate_cameras


def quiet(done: int, of: int) -> None:
    assert 0 < done <= of


def picture() -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(np.zeros((4, 6, 3), np.uint8)).save(buffer, "PNG")
    return buffer.getvalue()


def pack(path: Path, files: dict[str, bytes], compression: int = zipfile.ZIP_STORED) -> Path:
    with zipfile.ZipFile(path, "w", compression) as file:
        for name, data in files.items():
            file.writestr(name, data)
    return path


def test_a_zip_as_phones_share_it(tmp_path: Path) -> None:
    names = ["Urlaub/IMG_9.png", "Urlaub/IMG_10.PNG", "Urlaub/\u56fe\u7247/a.png"]
    archive = pack(
        tmp_path / "photos.zip",
        dict.fromkeys([*names, "__MACOSX/Urlaub/._IMG_9.png", "Urlaub/.hidden.png"], picture())
        | {"Urlaub/notes.txt": b"x", "Urlaub/": b""},
    )
    folder = unpack(archive, quiet)
    assert folder == tmp_path / "photos_unpacked" / "Urlaub"
    place, found = find_pictures(folder)
    assert [path.relative_to(place).as_posix() for path in found] == [
        "IMG_9.png",
        "IMG_10.PNG",
        "\u56fe\u7247/a.png",
    ]
    assert needs_cameras(folder) and not (tmp_path / "__MACOSX").exists()
    (folder.parent / ".DS_Store").write_bytes(b"")  # as systems leave behind when a folder is looked at
    (folder.parent / "desktop.ini").write_bytes(b"")
    assert unpacked(archive) == folder


def test_another_zip_of_the_same_name_is_not_taken_for_the_one_that_was_unpacked(tmp_path: Path) -> None:
    archive = pack(tmp_path / "photos.zip", {"a.png": picture()})
    folder = unpack(archive, quiet)
    pack(archive, {"a.png": picture(), "b.png": picture()})
    with pytest.raises(
        DataError, match=r"photos_unpacked: expected to be made from photos\.zip as it is now"
    ):
        unpack(archive, quiet)
    (folder / "source.txt").unlink()  # as an earlier version left it
    assert unpack(archive, quiet) == folder


def test_a_zip_of_a_data_set(small_data: Path, tmp_path: Path) -> None:
    files = {
        str(path.relative_to(small_data)): path.read_bytes()
        for path in small_data.rglob("*")
        if path.is_file()
    }
    assert len(load_scene(pack(tmp_path / "a.zip", files)).train.images) == 12


def test_a_zip_with_a_model_as_text_meets_the_same_refusal_as_its_folder(tmp_path: Path) -> None:
    model = dict.fromkeys(["sparse/0/cameras.txt", "sparse/0/images.txt", "sparse/0/points3D.txt"], b"#")
    folder = unpack(pack(tmp_path / "a.zip", {"images/a.png": picture(), "readme.txt": b"x"} | model), quiet)
    assert not (folder / "readme.txt").exists() and (folder / "sparse/0/points3D.txt").exists()
    with pytest.raises(DataError, match="expected a COLMAP model in binary form, got one as text"):
        estimate_cameras(folder, lambda stage, done, of: None)


def test_names_of_what_stays_packed_do_not_matter(tmp_path: Path) -> None:
    """Names of entries that stay packed do not matter, such as that of macOS' icon, with a return in it."""
    files = dict.fromkeys(["IMG_1.png", "Icon\r", "notes 12:30.txt", "__MACOSX/a 12:30.png"], picture())
    folder = unpack(pack(tmp_path / "a.zip", files), quiet)
    assert sorted(path.name for path in folder.iterdir()) == ["IMG_1.png", "source.txt"]


def link(path: Path) -> None:
    entry = zipfile.ZipInfo("a.png")
    entry.external_attr = (stat.S_IFLNK | 0o777) << 16
    with zipfile.ZipFile(path, "w") as file:
        file.writestr(entry, "/etc/passwd")


def with_a_password(path: Path) -> None:
    data = bytearray(pack(path, {"a.png": picture()}).read_bytes())
    at = data.index(b"PK\x01\x02")
    data[at + 8] |= 1
    path.write_bytes(data)


def cut_short(path: Path) -> None:
    data = pack(path, {"a.png": picture()}).read_bytes()
    path.write_bytes(data[: len(data) // 2])


def with_a_name_that_is_no_utf8(path: Path) -> None:
    path.write_bytes(pack(path, {"\u00fc.png": picture()}).read_bytes().replace(b"\xc3\xbc", b"\xff\xff"))


def test_a_zip_of_a_video_says_so(tmp_path: Path) -> None:
    archive = pack(tmp_path / "a.zip", {"DCIM/walk.MOV": b"x", "DCIM/a.orf": b"x"})
    with pytest.raises(
        DataError, match=r"in it, got none; there are \.orf files: save them as JPEG; "
    ) as caught:
        unpacked(archive)
    assert str(caught.value).endswith("; there is a video, DCIM/walk.MOV: unpack it, and name it")
    with pytest.raises(DataError, match=r"there is a video, a\\nb\.mov") as caught:
        unpacked(pack(tmp_path / "b.zip", {"a\nb.mov": b"x"}))
    assert "\n" not in str(caught.value)


def damaged(path: Path) -> None:
    data = bytearray(pack(path, {"a.png": bytes(5000)}).read_bytes())
    data[1000] ^= 255
    path.write_bytes(data)


def with_damaged(compression: int, path: Path) -> None:
    """Damage the middle of what an entry is packed to."""
    content = np.random.default_rng(0).bytes(5000)
    data = bytearray(pack(path, {"a.png": content}, compression).read_bytes())
    data[2000:2500] = bytes(500)
    path.write_bytes(data)


def without_its_beginning(path: Path) -> None:
    path.write_bytes(pack(path, {"a.png": bytes(5000)}).read_bytes()[20:])


@pytest.mark.parametrize(
    ("make", "expected"),
    [
        (lambda path: pack(path, {"../a.png": picture()}), "expected names that stay in its folder"),
        (lambda path: pack(path, {"/tmp/a.png": picture()}), "expected names that stay in its folder"),
        (lambda path: pack(path, {"a\\..\\..\\b.png": picture()}), "expected names that stay in its folder"),
        (lambda path: pack(path, {"C:/a.png": picture()}), "expected names that stay in its folder"),
        (lambda path: pack(path, {"b.png": picture(), "../a.txt": b"x"}), "expected names that stay in its"),
        (lambda path: pack(path, {"at 12:30.png": picture()}), "expected names without colons and control"),
        (lambda path: pack(path, {"a\rb.png": picture()}), "expected names without colons and control"),
        (
            lambda path: pack(path, {"a.png": b"", "A.PNG": b""}),
            "different names, got a.png 2 times",
        ),
        (lambda path: pack(path, {"a.txt": b"x"}), r"expected pictures \(\.png"),
        (link, "expected files, got a link"),
        (with_a_password, "expected one without a password"),
        (cut_short, "cannot be read to its end"),
        (with_a_name_that_is_no_utf8, "cannot be read to its end: 'utf-8' codec"),
        (damaged, "cannot be read to its end"),
        (partial(with_damaged, zipfile.ZIP_DEFLATED), "cannot be read to its end"),
        (partial(with_damaged, zipfile.ZIP_BZIP2), "cannot be read to its end"),
        (partial(with_damaged, zipfile.ZIP_LZMA), "cannot be read to its end"),
        (without_its_beginning, "cannot be read to its end"),
        (lambda path: path.write_bytes(b"no zip"), "cannot be read to its end"),
    ],
)
def test_what_is_refused(make: Callable[[Path], object], expected: str, tmp_path: Path) -> None:
    archive = tmp_path / "a.zip"
    make(archive)
    with pytest.raises(DataError, match=expected) as raised:
        unpack(archive, lambda done, of: None)
    assert str(raised.value).startswith(f"{archive}: ZIP: ") and "\n" not in str(raised.value)
    assert list(tmp_path.iterdir()) == [archive]


def test_a_zip_that_unpacks_to_too_much(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A ZIP that would unpack to too much is refused by its directory, and nothing is unpacked."""
    monkeypatch.setattr(archives, "SPARED", 1 << 20)
    archive = pack(tmp_path / "a.zip", {"a.png": bytes(4 << 20)}, zipfile.ZIP_DEFLATED)
    with pytest.raises(DataError, match=r"expected at most 0\.0 GB of pictures"):
        unpack(archive, quiet)
    assert list(tmp_path.iterdir()) == [archive]
