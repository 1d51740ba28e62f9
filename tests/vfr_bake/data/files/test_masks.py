"""Masks are found by name and have the right size; what they hide is neither drawn nor scored."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from player.cameras.transforms import write_cameras
from player.errors import DataError
from vfr_bake.config import TrainConfig
from vfr_bake.data import load_scene, load_scene_as
from vfr_bake.data.demo import demo_views
from vfr_bake.data.features import find_features
from vfr_bake.data.files.masks import apply_mask, mask_of, stray_masks
from vfr_bake.data.poses import estimate_cameras
from vfr_bake.data.store.reading import PictureReader
from vfr_bake.training.rays import PixelSampler
from vfr_bake.training.scores.metrics import score_view
from vfr_bake.training.trainer import Trainer


def masked_folder(folder: Path, share: float = 0.5) -> Path:
    """Write 24 opaque views, whose left parts are red and masked."""
    train, _ = demo_views(32, 24, 1)
    (folder / "images").mkdir()
    (folder / "masks").mkdir()
    cameras = []
    for index, (camera, image) in enumerate(zip(train.cameras, train.images, strict=True)):
        pixels, mask = image[..., :3].copy(), np.full((32, 32), 255, np.uint8)
        hidden = round(32 * share)
        pixels[:, :hidden], mask[:, :hidden] = (255, 0, 0), 0
        Image.fromarray(pixels).save(folder / "images" / f"{index:02d}.png")
        Image.fromarray(mask).save(
            folder / "masks" / (f"{index:02d}.png" if index % 2 else f"{index:02d}.png.png")
        )
        cameras.append(replace(camera, name=f"images/{index:02d}.png"))
    (folder / "transforms.json").write_bytes(write_cameras(cameras))
    return folder


def test_what_is_masked_is_not_drawn(tmp_path: Path) -> None:
    scene = load_scene(masked_folder(tmp_path), kind="unbounded")
    assert scene.masked and not scene.has_alpha
    assert all(
        (image[:, :16, 3] == 0).all() and (image[:, 16:, 3] == 255).all() for image in scene.train.images
    )
    sampler = PixelSampler(scene.train, torch.Generator().manual_seed(0), masked=True)
    batch = sampler.draw(3000)
    assert len(batch.rgba) == len(batch.rays_o) == len(batch.rays_d) == 3000
    assert (batch.rgba[:, 3] == 1).all() and not ((batch.rgba[:, 0] == 1) & (batch.rgba[:, 1] == 0)).any()
    trainer = Trainer(scene, TrainConfig(device="cpu", batch_rays=64))
    assert (trainer.witnesses.rgba[:, 3] == 255).all() and len(trainer.witnesses.pixels) > 100
    assert (trainer._draw(500).rgba[:, 3] == 1).all()


@pytest.mark.parametrize("separator", ["/", "\\"])
def test_a_frame_may_name_its_mask(tmp_path: Path, separator: str) -> None:
    """A frame names its mask by nerfstudio's `mask_path`, which a program on Windows writes with backslashes,
    as it does `file_path`."""
    folder = masked_folder(tmp_path)
    (folder / "masks").rename(folder / "hidden")
    document = json.loads((folder / "transforms.json").read_text())
    document["frames"][1]["mask_path"] = f"hidden{separator}01.png"
    (folder / "transforms.json").write_text(json.dumps(document))
    scene = load_scene(folder, kind="unbounded")
    assert [bool((image[:, :16, 3] == 0).all()) for image in scene.train.images[:2]] == [True, False]
    document["frames"][1]["mask_path"] = f"hidden{separator}none.png"
    (folder / "transforms.json").write_text(json.dumps(document))
    with pytest.raises(
        DataError, match=r"frame 1 \(images/01\.png\): mask_path: expected a picture, got hidden"
    ):
        load_scene(folder)


def test_a_masked_scene_is_none_with_an_object(tmp_path: Path) -> None:
    """Masks do not make a scene an object: the unmasked parts of the pictures are as opaque as before."""
    scene = load_scene(masked_folder(tmp_path))
    assert scene.masked and not scene.has_alpha


def test_a_hole_in_one_picture_is_masked_and_told_of(tmp_path: Path) -> None:
    folder, said = masked_folder(tmp_path), []
    shutil.rmtree(folder / "masks")
    with Image.open(folder / "images" / "03.png") as file:
        holed = file.convert("RGBA")
    holed.putpixel((20, 20), (0, 0, 0, 0))
    holed.save(folder / "images" / "03.png")
    scene = load_scene(folder, reader=PictureReader(say=said.append))
    assert scene.unbounded and scene.masked
    assert [text for text in said if text.startswith("less than half of the pictures have transparent")]
    assert load_scene_as({}, False, folder).has_alpha and load_scene_as({}, True, folder).masked


@pytest.mark.parametrize("n_masks", [24, 1])
def test_masks_of_an_object_with_transparent_surroundings_are_refused(n_masks: int, tmp_path: Path) -> None:
    """A transparent pixel is either masked or one where nothing is, and a mask in one picture would make it
    masked in all."""
    folder = masked_folder(tmp_path)
    for number, view in enumerate(demo_views(32, 24, 1)[0].images):
        Image.fromarray(view).save(folder / "images" / f"{number:02d}.png")
    for mask in sorted((folder / "masks").iterdir())[n_masks:]:
        mask.unlink()
    for kind in ("auto", "object"):
        with pytest.raises(DataError, match="expected transparent surroundings or masks, got both"):
            load_scene(folder, kind=kind)
    assert load_scene(folder, kind="unbounded").masked
    shutil.rmtree(folder / "masks")
    assert load_scene(folder).has_alpha


def test_everything_masked(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"masks: expected some of the pictures to be seen, got 0 of"):
        load_scene(masked_folder(tmp_path, 1.0))


def test_a_mask_of_another_size(tmp_path: Path) -> None:
    folder = masked_folder(tmp_path)
    Image.new("L", (16, 16)).save(folder / "masks" / "01.png")
    with pytest.raises(
        DataError, match=r"01\.png: mask: expected 32x32 pixels as 01\.png has, got 16x16: save"
    ):
        load_scene(folder)


def test_names(tmp_path: Path) -> None:
    (tmp_path / "masks" / "sub").mkdir(parents=True)
    for name in ("a.png", "b.jpg.png", "sub/c.png"):
        (tmp_path / "masks" / name).write_bytes(b"")
    for name, mask in {"a.jpg": "a.png", "images/b.jpg": "b.jpg.png", "sub/c.heic": "sub/c.png"}.items():
        assert mask_of(tmp_path, name) == tmp_path / "masks" / mask
    assert mask_of(tmp_path, "d.jpg") is None and mask_of(tmp_path, "../a.jpg") is None
    assert mask_of(tmp_path, "d" * 251 + ".jpg") is None  # with .png behind it, it is too long for a system


def test_masks_that_belong_to_no_picture_are_told_of(tmp_path: Path) -> None:
    for name in ("images/a.jpg", "images/b.JPG", "sub/c.heic", "d.jpg"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(b"")
    (tmp_path / "masks" / "sub").mkdir(parents=True)
    for name in ("a.png", "b.JPG.png", "sub/c.png", ".d.png", "notes.txt", "other.png"):
        (tmp_path / "masks" / name).write_bytes(b"")
    assert stray_masks(tmp_path, {tmp_path / "masks" / "other.png"}) is None
    for name in ("a_mask.png", "c.png", "d.jpg"):
        (tmp_path / "masks" / name).write_bytes(b"")
    assert stray_masks(tmp_path, {tmp_path / "masks" / "other.png"}) == (
        "3 of 7 masks belong to no picture (a_mask.png): masks/NAME.png belongs to NAME.jpg"
    )


def test_stray_masks_are_told_of_when_pictures_are_read_and_estimated(tmp_path: Path) -> None:
    folder, said = masked_folder(tmp_path), []
    (folder / "masks" / "01.png").rename(folder / "masks" / "01_mask.png")
    load_scene(folder, kind="unbounded", reader=PictureReader(say=said.append))
    (folder / "transforms.json").unlink()
    with pytest.raises(DataError, match=r"expected at least .* of 24, got 0"):
        estimate_cameras(folder, lambda *_: None, said.append)
    told = [text for text in said if "masks belong to no picture" in text]
    assert (
        told == ["1 of 24 masks belong to no picture (01_mask.png): masks/NAME.png belongs to NAME.jpg"] * 2
    )


@pytest.mark.parametrize("share", [1.0, 0.5])
def test_masks_are_named_where_no_cameras_are_found(tmp_path: Path, share: float) -> None:
    folder = masked_folder(tmp_path, share)
    (folder / "transforms.json").unlink()
    expected = "masks: expected some of the pictures to be seen, got 0 of 24576 pixels: a mask is white where"
    with pytest.raises(DataError, match=expected if share == 1 else "24 of 24 pictures have masks: check"):
        estimate_cameras(folder, lambda *_: None)


def test_a_mask_of_labels(tmp_path: Path) -> None:
    """A mask of 0 and 1 is one of labels; 1 in a mask with other levels is nearly black."""
    Image.new("RGB", (40, 30)).save(tmp_path / "a.png")
    levels = np.zeros((30, 40), np.uint8)
    levels[:, 20:] = 1
    for brightest, expected in ((1, levels == 1), (255, levels > 1)):
        levels[0, 39] = brightest
        Image.fromarray(levels).save(tmp_path / "mask.png")
        masked = apply_mask(
            np.full((30, 40, 4), 255, np.uint8), tmp_path / "a.png", tmp_path / "mask.png", upright=False
        )
        np.testing.assert_array_equal(masked[1:, :, 3] == 255, expected[1:])


@pytest.mark.parametrize(
    ("palette", "seen"),
    [
        ([0, 0, 0, 128, 0, 0], 1),  # the colours of labels in Pascal VOC
        ([0, 0, 0, 255, 255, 255], 1),
        ([255, 255, 255, 0, 0, 0], 0),  # a program has chosen the order of the two colours
    ],
)
def test_a_mask_with_a_palette(palette: list[int], seen: int, tmp_path: Path) -> None:
    Image.new("RGB", (40, 30)).save(tmp_path / "a.png")
    labels = np.zeros((30, 40), np.uint8)
    labels[:, 20:] = 1
    mask = Image.fromarray(labels, "P")
    mask.putpalette(palette)
    mask.save(tmp_path / "mask.png")
    rgba = np.full((30, 40, 4), 255, np.uint8)
    masked = apply_mask(rgba, tmp_path / "a.png", tmp_path / "mask.png", upright=False)
    np.testing.assert_array_equal(masked[..., 3] == 255, labels == seen)


@pytest.mark.parametrize("mode", ["RGBA", "LA"])
def test_what_is_transparent_in_a_mask_is_masked(mode: str, tmp_path: Path) -> None:
    Image.new("RGB", (40, 30)).save(tmp_path / "a.png")
    alpha = np.full((30, 40), 255, np.uint8)
    alpha[:, :20] = 0
    mask = Image.new(mode, (40, 30), "white")
    mask.putalpha(Image.fromarray(alpha))
    mask.save(tmp_path / "mask.png")
    rgba = np.full((30, 40, 4), 255, np.uint8)
    masked = apply_mask(rgba, tmp_path / "a.png", tmp_path / "mask.png", upright=False)
    np.testing.assert_array_equal(masked[..., 3], alpha)


def test_a_mask_of_the_stored_pixels_of_a_turned_picture(tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.new("RGB", (40, 30)).save(tmp_path / "a.png", exif=exif)
    stored = np.full((30, 40), 255, np.uint8)
    stored[:10] = 0  # on the right when turned clockwise
    upright = np.ascontiguousarray(np.rot90(stored, -1))
    for pixels in (stored, upright):
        Image.fromarray(pixels).save(tmp_path / "mask.png")
        rgba = np.full((40, 30, 4), 255, np.uint8)
        masked = apply_mask(rgba, tmp_path / "a.png", tmp_path / "mask.png", upright=True)
        np.testing.assert_array_equal(masked[..., 3], upright)
        assert not masked[:, 20:, 3].any() and masked[:, :20, 3].all()


def test_nothing_is_matched_where_a_picture_is_masked() -> None:
    rgba = np.full((120, 160, 4), 255, np.uint8)
    rgba[..., :3] = np.random.default_rng(0).integers(0, 256, (120, 160, 3))
    rgba[:, :80, 3] = 0
    points = find_features(rgba).points
    assert len(points) and points[:, 0].min() > 79


def test_scores_are_of_what_is_seen() -> None:
    random = np.random.default_rng(0)
    rgb, photograph = random.random((2, 16, 16, 3)).astype(np.float32)
    alone = score_view("a", rgb[:8].repeat(2, axis=0), photograph[:8].repeat(2, axis=0))
    half = np.concatenate([photograph[:8], rgb[8:]])
    seen = np.repeat(np.arange(16)[:, None] < 8, 16, axis=1)
    assert score_view("a", rgb, half, seen=seen).psnr_float == pytest.approx(alone.psnr_float, abs=1e-4)
