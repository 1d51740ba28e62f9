"""Pictures on the disk: every pixel is stored once, in its place, found again, and deleted in time."""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from player.cameras.transforms import write_cameras
from player.errors import OutputError
from player.files.replace import clear_up
from vfr_bake.data import load_scene
from vfr_bake.data.demo import demo_cameras
from vfr_bake.data.store import cache, reading, stored
from vfr_bake.data.store.capture import PosedImages
from vfr_bake.data.store.reading import PictureReader
from vfr_bake.data.store.stored import StoredImages, StoreLayout, in_order, map_pictures, write_picture
from vfr_bake.data.store.working import WorkingSize
from vfr_bake.data.witnesses import choose_witnesses
from vfr_bake.training.rays import DevicePixelSampler, PixelSampler

SIZES = [(40, 30), (30, 40), (41, 7), (1, 1), (40, 30)]


@pytest.fixture(autouse=True)
def small_pieces(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make pieces so small that even small pictures have several chunks."""
    monkeypatch.setattr(stored, "PIXELS_OF_A_PIECE", 150)


def pictures(n_channels: int) -> list[np.ndarray]:
    random = np.random.default_rng(0)
    images = [random.integers(0, 256, (height, width, 4), np.uint8) for width, height in SIZES]
    for image in images:
        image[..., 3] |= 255 if n_channels == 3 else 0
    return images


def written(folder: Path, images: list[np.ndarray], n_channels: int) -> StoredImages:
    layout = StoreLayout.of((image.shape[1], image.shape[0]) for image in images)
    path = folder / "pixels.bin"
    cache.reserve(path, int(layout.chunks[-1]) * n_channels)
    with path.open("r+b") as file:
        for number, image in enumerate(images):
            write_picture(file, layout, number, in_order(image, n_channels))
    return map_pictures(path, layout, n_channels, frozenset())


@pytest.mark.parametrize("n_channels", [3, 4])
def test_pictures_come_back_as_they_were(tmp_path: Path, n_channels: int) -> None:
    images = pictures(n_channels)
    found = written(tmp_path, images, n_channels)
    assert found.n_chunks > 3
    for number, image in enumerate(images):
        np.testing.assert_array_equal(found[number], image)
        wanted = np.random.default_rng(1).integers(0, image.shape[0] * image.shape[1], 20)
        np.testing.assert_array_equal(found.pixels(number, wanted), image.reshape(-1, 4)[wanted])
    some = found[1:5:2]
    np.testing.assert_array_equal(some[1], images[3])
    assert some.size(0) == SIZES[1]  # type: ignore[attr-defined]


def test_chunks_have_every_pixel_once_and_spread(tmp_path: Path) -> None:
    images = pictures(4)
    found = written(tmp_path, images, 4).some([4, 0, 1])
    seen: list[list[int]] = [[], [], []]
    for chunk in range(found.n_chunks):
        rgba, (first, behind) = found.chunk(chunk), found.chunk_places(chunk)
        assert len(rgba) == (behind - first).sum()
        row = 0
        for k, which in enumerate((4, 0, 1)):
            flat = images[which].reshape(-1, 4)
            numbers = np.arange(first[k], behind[k]) * found.strides[k] % len(flat)
            np.testing.assert_array_equal(rgba[row : row + len(numbers)], flat[numbers])
            # Spread: by the three-gap theorem no gap is wider than the mean times the largest quotient and 2.
            assert np.diff(np.sort(numbers)).max() <= 5 * len(flat) / len(numbers)
            seen[k] += numbers.tolist()
            row += len(numbers)
    assert [sorted(numbers) for numbers in seen] == [list(range(1200))] * 3


def test_random_pixels_are_those_of_the_pictures_and_no_witnesses(
    tmp_path: Path, device: torch.device
) -> None:
    width, height, n_views = 40, 30, 24
    numbers = np.arange(width * height * n_views, dtype=np.uint32).reshape(n_views, height, width, 1)
    images = list((numbers >> [0, 8, 16, 24]).astype(np.uint8) | np.array([0, 0, 0, 255], np.uint8))
    cameras = [camera.resized(width, height) for camera in demo_cameras(8, n_views)]
    views = PosedImages(cameras, written(tmp_path, images, 3))
    witnesses = choose_witnesses(views)
    np.testing.assert_array_equal(witnesses.rgba, choose_witnesses(PosedImages(cameras, images)).rgba)
    kept = witnesses.views() * width * height + witnesses.pixels
    rays_d = np.concatenate([camera.rays()[1] for camera in cameras])
    for kind, place in ((PixelSampler, torch.device("cpu")), (DevicePixelSampler, device)):
        sampler = kind(views, torch.Generator(place).manual_seed(0), witnesses)
        counts = np.zeros(numbers.size, int)
        chunks = set()
        for _ in range(400):
            batch = sampler.draw(500)
            chunks.add(sampler.position[0])
            levels = (batch.rgba.cpu().numpy() * 255).round().astype(int)
            drawn = levels[:, 0] + 256 * levels[:, 1] + 65536 * levels[:, 2]
            np.testing.assert_allclose(batch.rays_d.cpu().numpy(), rays_d[drawn], atol=1e-6)
            assert (levels[:, 3] == 255).all()
            counts += np.bincount(drawn, minlength=len(counts))
        assert len(chunks) == views.images.n_chunks  # type: ignore[attr-defined]
        assert counts[kept].sum() == 0
        whole = np.isin(np.arange(n_views), witnesses.whole)
        of_views = counts.reshape(n_views, -1).sum(axis=1)
        assert (of_views[whole] == 0).all()
        # 8,700 draws a view are expected of 200,000: five standard deviations, and half a turn of the chunks.
        assert np.ptp(of_views[~whole]) < 0.15 * 8700
        again = kind(views, torch.Generator(place).manual_seed(1), witnesses)
        again.restore(sampler.position)
        assert again.position == sampler.position


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Ten opaque JPEG pictures with cameras."""
    data = tmp_path / "data"
    data.mkdir()
    cameras = demo_cameras(48, 10, prefix="r_")
    random = np.random.default_rng(0)
    for number in range(10):
        Image.fromarray(random.integers(0, 256, (48, 48, 3), np.uint8)).save(data / f"r_{number}.jpg")
    (data / "transforms.json").write_bytes(write_cameras(cameras))
    return data


@pytest.fixture
def root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The cache's folder, with settings that hold no pictures in memory."""
    monkeypatch.setattr(cache, "cache_folder", lambda: tmp_path / "cache" / "pictures")
    monkeypatch.setattr(reading, "held_bytes", lambda: 0)
    return tmp_path / "cache" / "pictures"


def load(folder: Path, model: Path | None = None, **settings: object) -> tuple[PosedImages, list[str]]:
    said: list[str] = []
    reader = PictureReader(WorkingSize(32), model, True, say=said.append, **settings)  # type: ignore[arg-type]
    return load_scene(folder, reader=reader).train, said


def n_sets(root: Path) -> int:
    return len(list(root.iterdir())) if root.is_dir() else 0


def test_pictures_are_decoded_once_and_again_when_one_changed(
    folder: Path, root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = tmp_path / "model.pt"
    held = load_scene(folder, reader=PictureReader(WorkingSize(32))).train
    first, said = load(folder, model, kept=True)
    assert isinstance(first.images, StoredImages)
    assert said[0].startswith("10 pictures of 48x48, reduced to 32x32")
    for one, other, camera, same in zip(first.images, held.images, first.cameras, held.cameras, strict=True):
        np.testing.assert_array_equal(one, other)
        assert (camera.fx, camera.cy, camera.name) == (same.fx, same.cy, same.name)
        np.testing.assert_allclose(camera.c2w, same.c2w)
    (kept,) = root.iterdir()
    assert (kept / "models.txt").read_text() == str(model)

    def never(*_: object) -> None:
        raise AssertionError("decoded again")

    with monkeypatch.context() as without:
        without.setattr(WorkingSize, "read", never)
        again, said = load(folder, model, kept=True)
        assert "kept in" in said[0]
        np.testing.assert_array_equal(again.images[3], first.images[3])
    Image.fromarray(np.full((48, 48, 3), 9, np.uint8)).save(folder / "r_5.jpg")
    changed, _ = load(folder, model, kept=True)
    assert any((image[..., :3] == 9).all() for image in changed.images) and n_sets(root) == 2
    # A stored set that is cut short is made again.
    picture = changed.images[3]
    for each in root.iterdir():
        (each / "pixels.bin").unlink()
        (each / "pixels.bin").write_bytes(bytes(100))
    np.testing.assert_array_equal(load(folder, model, kept=True)[0].images[3], picture)


def test_without_a_cache_nothing_stays(folder: Path, root: Path, tmp_path: Path) -> None:
    load(folder, tmp_path / "model.pt", kept=True)
    assert n_sets(root) == 1
    views, _ = load(folder, tmp_path / "model.pt", kept=False)
    assert n_sets(root) == 0
    assert views.images[0].shape == (32, 32, 4)


NOT_ON_MACOS = pytest.mark.skipif(sys.platform == "darwin", reason="macOS has no names but UTF-8")


@pytest.mark.parametrize("name", ["model.pt", pytest.param("mod\udce8l.pt", marks=NOT_ON_MACOS)])
def test_a_set_goes_with_its_models(name: str, folder: Path, root: Path, tmp_path: Path) -> None:
    model = tmp_path / name
    model.write_bytes(b"")
    load(folder, model, kept=True)
    (kept,) = root.iterdir()
    long_ago = time.time() - 2 * cache.GRACE
    other = root / "other"
    cache.remove_unused(root, 0, other)
    model.unlink()
    cache.remove_unused(root, 0, other)
    assert kept.is_dir(), "used just now"
    os.utime(kept / "models.txt", (long_ago, long_ago))
    cache.remove_unused(root, 0, kept)
    assert kept.is_dir(), "this is the one that is wanted"
    cache.remove_unused(root, 0, other)
    assert not kept.exists()


def test_sets_take_no_more_than_their_share(
    folder: Path, root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = tmp_path / "model.pt"
    model.write_bytes(b"")
    load(folder, model, kept=True)
    (kept,) = root.iterdir()
    long_ago = time.time() - 2 * cache.GRACE
    os.utime(kept / "models.txt", (long_ago, long_ago))
    cache.remove_unused(root, 1000, root / "other")
    assert kept.is_dir()
    monkeypatch.setattr(cache, "MOST_BYTES", 10_000)
    cache.remove_unused(root, 1000, root / "other")
    assert not kept.exists()


def test_pictures_with_alpha_keep_it(tmp_path: Path, root: Path, small_data: Path) -> None:
    held = load_scene(small_data)
    scene = load_scene(small_data, reader=PictureReader(on_disk=True))
    assert scene.has_alpha and isinstance(scene.train.images, StoredImages)
    for one, other in zip(scene.train.images, held.train.images, strict=True):
        np.testing.assert_array_equal(one, other)
    np.testing.assert_array_equal(scene.world_from_model, held.world_from_model)


def test_a_disk_without_room(folder: Path, root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reading, "LEAST_SIDE", 16)
    monkeypatch.setattr(cache, "free_bytes", lambda place: 10 * 20 * 20 * 3)
    with pytest.raises(OutputError, match=r"expected 0.00 GB of free disk .* --max-side"):
        load(folder)
    views, said = load(folder, may_shrink=True)
    assert (views.cameras[0].width, views.images[0].shape[0]) == (16, 16)
    assert "the longest side is 16 instead" in said[0]
    monkeypatch.setattr(cache, "free_bytes", lambda place: 100)
    with pytest.raises(OutputError, match="free disk"):
        load(folder, may_shrink=True)


def test_a_disk_that_is_full_in_the_middle(
    folder: Path, root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(reading, "write_picture", full)
    for kept in (True, False):
        with pytest.raises(OutputError, match=r"free disk for the pictures.*No space left"):
            load(folder, tmp_path / "model.pt", kept=kept)
        assert n_sets(root) == 0


def test_pictures_that_are_being_written_are_not_cleared_up(
    folder: Path, root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Files that are being written survive another process that clears the cache of what nobody holds."""

    def write(*arguments: Any) -> None:
        clear_up(root)
        write_picture(*arguments)

    monkeypatch.setattr(reading, "write_picture", write)
    for kept in (True, False):
        views, _ = load(folder, tmp_path / "model.pt", kept=kept)
        assert views.images[0].shape == (32, 32, 4)


def test_a_cache_that_cannot_be_written(
    folder: Path, root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(*_: object) -> None:
        raise OSError(13, "Permission denied")

    monkeypatch.setattr(cache, "reserve", refused)
    for kept in (True, False):
        with pytest.raises(OutputError, match="cannot keep the pictures: Permission denied: set XDG_CACHE"):
            load(folder, tmp_path / "model.pt", kept=kept)
        assert n_sets(root) == 0


def test_pictures_that_were_made_smaller_are_found_again(
    folder: Path, root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = tmp_path / "model.pt"
    monkeypatch.setattr(reading, "LEAST_SIDE", 16)
    monkeypatch.setattr(reading, "STEP", 8)
    free = {"bytes": 10 * 20 * 20 * 3}
    monkeypatch.setattr(cache, "free_bytes", lambda place: free["bytes"])
    views, _ = load(folder, model, kept=True, may_shrink=True)
    assert views.images[0].shape == (16, 16, 4)
    free["bytes"] = 0  # the stored set takes all the room
    views, said = load(folder, model, kept=True, may_shrink=True)
    assert views.images[0].shape == (16, 16, 4) and "reduced to 16x16 as they were kept in" in said[0]
    for n_bytes, side in ((10 * 24 * 24 * 3, 24), (10 * 32 * 32 * 3, 32)):  # more room, more detail
        free["bytes"] = n_bytes
        views, _ = load(folder, model, kept=True, may_shrink=True)
        assert views.images[0].shape == (side, side, 4)
    assert n_sets(root) == 3
    load(folder, model, kept=False, may_shrink=True)
    assert n_sets(root) == 0


def test_room_is_wanted_for_as_many_channels_as_are_stored(
    folder: Path, root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cache, "free_bytes", lambda place: 10 * 32 * 32 * 3)
    load(folder)
    for path in folder.glob("*.jpg"):
        path.rename(path.with_suffix(".heic"))  # the format follows from the content
    load(folder)
    (folder / "masks").mkdir()
    Image.new("L", (48, 48)).save(folder / "masks" / "r_3.png")
    with pytest.raises(OutputError, match="free disk"):
        load(folder)
    monkeypatch.setattr(cache, "free_bytes", lambda place: 10 * 32 * 32 * 4)
    assert isinstance(load(folder)[0].images, StoredImages)
