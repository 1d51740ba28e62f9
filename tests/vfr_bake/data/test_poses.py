"""Cameras estimated from pictures alone, compared with known cameras, and everything that can be missing."""

from __future__ import annotations

import os
import shutil
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
import pytest
from PIL import Image

from player.errors import DataError, FormatError, MissingExtraError, OutputError
from vfr_bake.data import mapping, needs_cameras, poses
from vfr_bake.data.check.check import check_data
from vfr_bake.data.features import find_features, match
from vfr_bake.data.files.estimate_record import read_record
from vfr_bake.data.folders import load_folder
from vfr_bake.data.poses import added_since, estimate_cameras
from vfr_bake.data.store.working import WorkingSize

N_CAN = 10


def real_pictures(name: str) -> Path:
    root = os.environ.get("VFR_DATA")
    folder = (Path(root) if root else Path(__file__).resolve().parents[4] / "shared" / "data") / name
    if not (folder / "images").is_dir():
        pytest.fail(f"{folder}: expected the data set: set VFR_DATA to the folder that holds it")
    return folder


def quiet(stage: str, done: int, of: int) -> None:
    assert 0 <= done <= of, stage


def centres(model: Path) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Return camera centres [3] and rotations [3, 3], world to camera, by the names of the pictures."""
    images = [image for image in pycolmap.Reconstruction(model).images.values() if image.has_pose]
    rotations = {image.name: image.cam_from_world().rotation.matrix() for image in images}
    return {image.name: image.projection_center() for image in images}, rotations


def similarity(a: np.ndarray, b: np.ndarray) -> tuple[float, np.ndarray]:
    """Return scale and rotation [3, 3] that bring points `a` [n, 3] nearest to `b` (Umeyama, PAMI 1991)."""
    a, b = a - a.mean(axis=0), b - b.mean(axis=0)
    u, s, vt = np.linalg.svd(b.T @ a)
    sign = np.array([1, 1, np.linalg.det(u @ vt)])
    return float((s * sign).sum() / (a**2).sum()), u @ np.diag(sign) @ vt


def synthetic_model(n_cameras: int) -> Any:
    """Return a model with exact points, in which each camera has taken 24 pictures."""
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig = n_cameras, 1, 24
    options.num_points3D = 200
    pycolmap.set_random_seed(0)
    return pycolmap.synthesize_dataset(options)


def test_the_principal_point_is_found_without_a_word(capfd: pytest.CaptureFixture[str]):
    """The principal point of a camera is found silently, from exact points, if it is given 6 pixels off."""
    model = synthetic_model(1)
    (camera,) = model.cameras.values()
    truth = camera.principal_point_x
    camera.principal_point_x = truth + 6
    mapping.refine_principal_points(model)
    assert model.camera(camera.camera_id).principal_point_x == pytest.approx(truth, abs=0.1)
    assert capfd.readouterr() == ("", "")


def test_a_lens_of_few_pictures_keeps_its_principal_point_alone():
    model = synthetic_model(2)
    often, seldom = model.cameras
    for image in [image for image in model.images.values() if image.camera_id == seldom][5:]:
        model.deregister_frame(image.frame_id)
    truth, kept = model.camera(often).principal_point_x, model.camera(seldom).params.tolist()
    model.camera(often).principal_point_x = truth + 6
    mapping.refine_principal_points(model)
    assert model.camera(often).principal_point_x == pytest.approx(truth, abs=0.1)
    assert model.camera(seldom).params.tolist() == kept


@pytest.fixture(scope="module")
def can(
    tmp_path_factory: pytest.TempPathFactory,
) -> tuple[Path, poses.PoseReport, list[tuple[str, int, int]]]:
    """A folder with ten neighbouring pictures of the can, at half their size, and with estimated cameras."""
    folder = tmp_path_factory.mktemp("can")
    for path in sorted((real_pictures("can") / "images").iterdir())[:N_CAN]:
        with Image.open(path) as file:
            file.reduce(2).save(folder / path.name, quality=95)
    calls: list[tuple[str, int, int]] = []
    return folder, estimate_cameras(folder, lambda *call: calls.append(call)), calls


def test_the_cameras_are_those_that_are_known(can):
    folder, report, _ = can
    found, found_rotations = centres(folder / "sparse" / "0")
    given, given_rotations = centres(real_pictures("can") / "sparse" / "0")
    names = sorted(found)
    assert names == [f"{i:04d}.jpg" for i in range(N_CAN)]
    a, b = (np.array([c[name] for name in names]) for c in (found, given))
    scale, rotation = similarity(a, b)
    off = np.linalg.norm(scale * (a - a.mean(axis=0)) @ rotation.T - (b - b.mean(axis=0)), axis=1)
    # The given cameras are an estimate too, with a focal length each; these vary by 2 %.
    assert np.sqrt((off**2).mean()) < 0.01 * np.ptp(b, axis=0).max()
    # Rotations are aligned by themselves: the centres lie on a short arc, and hardly say how it is turned.
    turns = [found_rotations[name].T @ given_rotations[name] for name in names]
    u, _, vt = np.linalg.svd(sum(turns))
    for turn in turns:
        assert np.degrees(np.arccos(min(1, (np.trace(turn.T @ u @ vt) - 1) / 2))) < 1
    assert report.n_pictures == report.n_registered == N_CAN and report.folder == folder
    sizes = {path.name: path.stat().st_size for path in folder.glob("*.jpg")}
    assert read_record(folder / "sparse" / "0").n_bytes == sizes


def test_the_report_is_what_colmap_says_of_its_model(can):
    folder, report, _ = can
    model = pycolmap.Reconstruction(folder / "sparse" / "0")
    assert report.mean_error == pytest.approx(model.compute_mean_reprojection_error())
    assert report.mean_track_length == pytest.approx(model.compute_mean_track_length())
    assert report.mean_error < 1 and report.mean_track_length > 3
    (camera,) = model.cameras.values()
    assert camera.model_name == "RADIAL" and (camera.width, camera.height) == (360, 640)
    assert f"cameras of {N_CAN} of {N_CAN} pictures" in report.summary()


def test_progress_goes_forward_to_the_end_of_every_stage(can):
    _, _, calls = can
    stages = list(dict.fromkeys(stage for stage, _, _ in calls))
    assert stages == ["features", "pairs", "matches", "cameras"]
    for stage in stages:
        counts = [(done, of) for name, done, of in calls if name == stage]
        assert counts == sorted(counts) and counts[-1][0] == counts[-1][1]


def test_cameras_are_estimated_once(can, monkeypatch: pytest.MonkeyPatch):
    folder, report, _ = can
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    assert estimate_cameras(folder, quiet) == report


def test_a_cut_model_is_named(can, tmp_path: Path):
    shutil.copytree(can[0], tmp_path / "a")
    model = tmp_path / "a" / "sparse" / "0"
    points = model / "points3D.bin"
    points.write_bytes(points.read_bytes()[:-9])
    with pytest.raises(FormatError, match="cut short: remove"):
        estimate_cameras(tmp_path / "a", quiet)
    points.unlink()
    with pytest.raises(FormatError, match=r"points3D\.bin: expected a complete COLMAP model"):
        estimate_cameras(tmp_path / "a", quiet)


@pytest.mark.parametrize("where", ["sparse/0", "sparse", "colmap/sparse/0"])
def test_a_model_as_text_is_named(tmp_path: Path, where: str):
    photos = save(tmp_path, [textured(seed) for seed in range(3)])
    (photos / where).mkdir(parents=True)
    for name in ("cameras.txt", "images.txt", "points3D.txt"):
        (photos / where / name).write_text("# a comment\n")
    text = message(photos)
    assert text.startswith(f"{photos / where}: cameras: expected a COLMAP model in binary form, got one as ")
    assert "colmap model_converter --output_type BIN" in text


def test_text_beside_a_model_does_not_matter(can, tmp_path: Path):
    shutil.copytree(can[0], tmp_path / "a")
    model = tmp_path / "a" / "sparse" / "0"
    pycolmap.Reconstruction(model).write_text(model)
    assert estimate_cameras(tmp_path / "a", quiet).n_registered == N_CAN


@pytest.mark.parametrize("where", ["features", "pairs", "matches", "cameras"])
def test_interruption_leaves_nothing(can, tmp_path: Path, where: str):
    for path in sorted(can[0].glob("*.jpg"))[:4]:
        shutil.copy(path, tmp_path)

    def interrupt(stage: str, done: int, of: int) -> None:
        if stage == where:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        estimate_cameras(tmp_path, interrupt)
    assert len(list(tmp_path.iterdir())) == 4


def test_a_model_that_cannot_be_finished_leaves_none(can, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    for path in sorted(can[0].glob("*.jpg"))[:4]:
        shutil.copy(path, tmp_path)

    class HalfWritten:
        images: dict[int, object] = {}  # noqa: RUF012

        def num_reg_images(self) -> int:
            return 4

        def write_binary(self, folder: str) -> None:
            Path(folder, "cameras.bin").write_bytes(b"x")
            raise KeyboardInterrupt

    monkeypatch.setattr(poses, "map_pictures", lambda *_: [HalfWritten()])
    monkeypatch.setattr(poses, "refine_principal_points", lambda _: None)
    monkeypatch.setattr(poses, "_turn_upright", lambda _: None)
    with pytest.raises(KeyboardInterrupt):
        estimate_cameras(tmp_path, quiet)
    assert not list((tmp_path / "sparse").iterdir())


def first_pictures(can, folder: Path, n: int) -> Path:
    for path in sorted(can[0].glob("*.jpg"))[:n]:
        shutil.copy(path, folder)
    return folder


def test_an_interrupted_estimation_goes_on_where_it_was(can, tmp_path: Path, kept: Path, monkeypatch):
    photos = first_pictures(can, tmp_path, 5)

    def interrupt(stage: str, done: int, of: int) -> None:
        if stage == "cameras":
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        estimate_cameras(photos, interrupt)
    shutil.copy(sorted(can[0].glob("*.jpg"))[5], photos)
    looked, matched = [], []
    monkeypatch.setattr(
        "vfr_bake.data.looks.find_features", lambda rgba: looked.append(1) or find_features(rgba)
    )
    monkeypatch.setattr(mapping, "match", lambda a, b: matched.append(1) or match(a, b))
    assert estimate_cameras(photos, quiet).n_registered == 6
    assert (len(looked), len(matched)) == (1, 5)  # only those of the new picture
    assert not list(kept.rglob("*.bin"))


def test_pictures_that_are_added_later_are_told_of(can, tmp_path: Path) -> None:
    photos = first_pictures(can, tmp_path, N_CAN)
    shutil.copytree(can[0] / "sparse", photos / "sparse")
    assert added_since(photos) == []
    shutil.copy(min(photos.glob("*.jpg")), photos / "new.jpg")
    assert added_since(photos) == ["new.jpg"]
    checked = check_data(str(photos), WorkingSize(), 60.0)
    (new,) = (picture for picture in checked.pictures if picture.name == "new.jpg")
    assert new.found is False and "added after the cameras were estimated" in str(new.why)
    (photos / "sparse" / "0" / "pictures.json").unlink()  # cameras of another program
    assert added_since(photos) == []


def test_of_two_estimations_the_slower_one_takes_what_the_other_found(
    can, tmp_path: Path, monkeypatch
) -> None:
    photos = first_pictures(can, tmp_path, 4)

    def overtaken(*arguments: object) -> dict[str, str]:
        shutil.copytree(can[0] / "sparse", photos / "sparse")
        return {}

    monkeypatch.setattr(poses, "why_unplaced", overtaken)
    assert estimate_cameras(photos, quiet).n_registered == can[1].n_registered


def test_a_folder_that_cannot_be_written_is_refused_at_once(tmp_path: Path, monkeypatch):
    """A read-only folder is refused at once; `os.access` is replaced, as it allows root everything."""
    photos = save(tmp_path / "photos", [textured(seed) for seed in range(3)])
    monkeypatch.setattr("os.access", lambda path, mode: Path(path) != photos)
    stages: list[str] = []
    with pytest.raises(OutputError, match="is read-only: copy the pictures to a folder that you can write"):
        estimate_cameras(photos, lambda stage, *_: stages.append(stage))
    assert not stages


def test_a_folder_for_temporary_files_that_cannot_be_written_is_named(tmp_path: Path, monkeypatch):
    """COLMAP raises RuntimeError for a disk that is full, as for a folder that is not there."""
    photos = save(tmp_path, [textured(seed) for seed in range(3)])
    monkeypatch.setattr(poses, "write_database", lambda path, *_: pycolmap.Database.open(path / "none"))
    with pytest.raises(OutputError, match=r"database\.db: cannot write: .*: make room for temporary files"):
        estimate_cameras(photos, quiet)


def test_a_cache_that_cannot_be_written_is_done_without(can, tmp_path: Path, monkeypatch):
    (tmp_path / "file").write_bytes(b"")
    monkeypatch.setattr(poses, "cache_root", lambda: tmp_path / "file")
    (tmp_path / "photos").mkdir()
    photos = first_pictures(can, tmp_path / "photos", 3)
    said: list[str] = []
    assert estimate_cameras(photos, quiet, said.append).n_registered == 3
    assert len(said) == 1 and "no more features and matches are kept" in said[0]


def test_pictures_without_a_place_and_why(can, tmp_path: Path):
    photos = first_pictures(can, tmp_path, 8)
    with Image.open(photos / "0000.jpg") as file:
        size = file.size
    Image.new("RGB", size, (90, 90, 90)).save(photos / "blank.jpg")
    Image.fromarray(textured(3, *size)).save(photos / "other.jpg")
    report = estimate_cameras(photos, quiet)
    assert report.n_registered == 8
    assert report.record.unplaced == {
        "blank.jpg": "blank, blurred or out of focus: 0 features",
        "other.jpg": "nothing in common with any other picture",
    }


# --- what cannot be used ---


def textured(seed: int, width: int = 160, height: int = 120) -> np.ndarray:
    rng = np.random.default_rng(seed)
    small = Image.fromarray(rng.integers(0, 256, (height // 8, width // 8, 3), np.uint8))
    return np.asarray(small.resize((width, height), Image.Resampling.BICUBIC))


def save(folder: Path, pictures: list[np.ndarray]) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    for index, pixels in enumerate(pictures):
        Image.fromarray(pixels).save(folder / f"{index:03d}.png")
    return folder


def message(photos: Path) -> str:
    with pytest.raises(DataError) as raised:
        estimate_cameras(photos, quiet)
    assert "\n" not in str(raised.value)
    return str(raised.value)


def test_too_few_pictures(tmp_path: Path):
    assert "expected at least 3, got 2" in message(save(tmp_path, [textured(0), textured(1)]))


def test_pictures_of_another_kind_are_named(tmp_path: Path):
    (tmp_path / "a.DNG").write_bytes(b"")
    (tmp_path / "._a.jpg").write_bytes(b"")
    assert message(tmp_path).endswith("got 0; there are .dng files: save them as JPEG")
    assert not needs_cameras(tmp_path)


def test_nothing_there_and_a_file_of_another_kind(tmp_path: Path):
    assert "expected a folder of pictures or a video, got nothing" in message(tmp_path / "a")
    (tmp_path / "a.txt").write_text("x")
    assert "got a file of another kind" in message(tmp_path / "a.txt")


def test_blank_pictures(tmp_path: Path):
    text = message(save(tmp_path, [np.full((60, 80, 3), 200, np.uint8)] * 5))
    assert "expected at least 5 of 5, got 0" in text and "blank" in text


def test_cameras_of_a_form_that_is_not_read_are_named(tmp_path: Path):
    """DTU's cameras are not read; before others are estimated (here in vain), a line says so."""
    save(tmp_path / "image", [np.full((60, 80, 3), 200, np.uint8)] * 5)
    save(tmp_path / "mask", [np.full((60, 80, 3), 255, np.uint8)] * 5)
    (tmp_path / "cameras_sphere.npz").write_bytes(b"")
    said: list[str] = []
    with pytest.raises(DataError, match="expected at least 5 of 5, got 0"):
        estimate_cameras(tmp_path, quiet, said.append)
    assert said[0].startswith("cameras of the form of cameras_sphere.npz are not read: cameras are estimated")


def test_all_blurred(tmp_path: Path):
    pictures = [cv2.GaussianBlur(textured(seed, 320, 240), (0, 0), 25) for seed in range(5)]
    text = message(save(tmp_path, pictures))
    assert "expected at least 5 of 5, got 0" in text and "blurred" in text


def test_three_pictures_must_all_find_their_place(can, tmp_path: Path):
    photos = first_pictures(can, tmp_path, 3)
    assert estimate_cameras(photos, quiet).n_registered == 3
    text = message(save(tmp_path / "walls", [textured(seed) for seed in range(3)]))
    assert "of at least 3 of 3 pictures, got 0" in text


def test_a_handful_is_placed_by_another_attempt(can, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """A handful of pictures is placed by the fourth attempt if the first three find nothing."""
    attempts = []

    def map_pictures(*arguments):
        attempts.append(arguments[-1])
        return [pycolmap.Reconstruction(can[0] / "sparse" / "0")] if len(attempts) == 4 else []

    monkeypatch.setattr(poses, "map_pictures", map_pictures)
    stages: list[str] = []
    pictures = first_pictures(can, tmp_path, N_CAN)
    monkeypatch.setattr(poses, "refine_principal_points", lambda model: stages.append("refined"))
    report = estimate_cameras(pictures, lambda stage, *_: stages.append(stage))
    assert report.n_registered == N_CAN and stages.count("refined") == 1
    assert attempts == [mapping.FIRST_ATTEMPT, *mapping.FURTHER_ATTEMPTS]


def test_the_same_picture_again_and_again(tmp_path: Path):
    assert "got 6 times the same" in message(save(tmp_path, [textured(0)] * 6))


def test_pictures_that_have_nothing_in_common(tmp_path: Path):
    text = message(save(tmp_path / "images", [textured(seed) for seed in range(6)]))
    assert "of at least 6 of 6 pictures, got 0" in text and "more overlap" in text


def test_pictures_of_two_places_are_told_of(can, tmp_path: Path):
    """Two places are named: five pictures of the can, and five of a wall that the camera passes."""
    wall = textured(9, 1200, 300)
    for index, path in enumerate(sorted(can[0].glob("*.jpg"))[:5]):
        shutil.copy(path, tmp_path / f"a_{index}.jpg")
        view = Image.fromarray(wall[:, 60 * index : 60 * index + 700])
        view.resize((700, 300 - 4 * index)).save(tmp_path / f"b_{index}.jpg", quality=95)
    text = message(tmp_path)
    assert "they show 2 places that have nothing in common, in 5 (a_0.jpg to a_4.jpg) and" in text
    assert "name a folder of one place" in text


def test_bursts_and_copies_are_left_out(can, tmp_path: Path):
    for path in sorted(can[0].glob("*.jpg"))[:4]:
        shutil.copy(path, tmp_path)
    (tmp_path / "copy").mkdir()
    shutil.copy(tmp_path / "0001.jpg", tmp_path / "copy" / "IMG_7.jpg")
    pixels = np.asarray(Image.open(tmp_path / "0002.jpg"))
    shaken = cv2.GaussianBlur(np.roll(pixels, 1, axis=1), (5, 5), 1)
    Image.fromarray(shaken).save(tmp_path / "0002_burst.jpg", quality=95)
    report = estimate_cameras(tmp_path, quiet)
    assert report.record.repeated == {"0002_burst.jpg": "0002.jpg", "copy/IMG_7.jpg": "0001.jpg"}
    assert report.n_pictures == report.n_registered == 4
    told = "; 0002_burst.jpg and 1 more show what another picture (0002.jpg) does, and are left out"
    assert report.summary().endswith(told)
    assert estimate_cameras(tmp_path, quiet) == report


def test_up_is_z_and_masks_hide_what_they_hide(can, tmp_path: Path):
    """In pictures stored on their side, with a masked part each, up is z and no feature is masked."""
    (tmp_path / "masks").mkdir()
    for path in sorted(can[0].glob("*.jpg")):
        exif = Image.Exif()
        exif[0x0112] = 6
        with Image.open(path) as file:
            stored = file.transpose(Image.Transpose.ROTATE_90)
        stored.save(tmp_path / f"{path.stem} \u00fc.jpg", quality=95, exif=exif)
        mask = np.full((640, 360), 255, np.uint8)
        mask[:, 300:] = 0
        Image.fromarray(mask).save(tmp_path / "masks" / f"{path.stem} \u00fc.png")
    estimate_cameras(tmp_path, quiet)
    model = pycolmap.Reconstruction(tmp_path / "sparse" / "0")
    assert all((camera.width, camera.height) == (360, 640) for camera in model.cameras.values())
    for image in model.images.values():
        assert max(point.xy[0] for point in image.points2D) < 301
        up = -image.cam_from_world().rotation.matrix()[1]
        assert up[2] > 0.7  # the can was photographed from above
    views = load_folder(tmp_path)
    assert views.masked and views.train.images[0].shape[:2] == (640, 360)
    assert not views.train.images[0][:, 310:, 3].any() and views.train.images[0][:, :290, 3].all()


def test_an_unreadable_picture(tmp_path: Path):
    save(tmp_path, [textured(seed) for seed in range(4)])
    (tmp_path / "002.png").write_bytes(b"no picture")
    assert str(tmp_path / "002.png") in message(tmp_path)


def test_how_many_are_needed():
    assert [poses._n_needed(n) for n in (3, 8, 10, 13, 14, 100)] == [3, 8, 8, 8, 9, 60]


def test_without_pycolmap_it_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'vfr-bake\[poses\]'"):
        estimate_cameras(save(tmp_path, [textured(seed) for seed in range(3)]), quiet)


def test_of_groups_that_have_nothing_in_common_the_largest_is_taken_and_said(can, tmp_path: Path):
    """The largest group is taken and others are named: eight of the can, and four of a wall in two planes."""
    photos = first_pictures(can, tmp_path, 8)
    wall = textured(9, 1600, 300)
    for index in range(4):
        near = Image.fromarray(wall[:150, 80 * index : 80 * index + 700])
        far = Image.fromarray(wall[150:, 40 * index : 40 * index + 700])
        both = Image.new("RGB", (700, 300))
        both.paste(near, (0, 150))
        both.paste(far, (0, 0))
        both.save(photos / f"b_{index}.jpg", quality=95)
    report = estimate_cameras(photos, quiet)
    assert report.n_registered == 8 and set(report.record.unplaced) == {
        f"b_{index}.jpg" for index in range(4)
    }
    assert estimate_cameras(photos, quiet) == report
    checked = check_data(str(photos), WorkingSize(), 60.0)
    assert {p.name: p.why for p in checked.pictures if p.found is False} == report.record.unplaced
    apart = replace(report, record=replace(report.record, apart=(4,)))
    assert apart.summary().endswith("the largest is taken, the other has 4")
