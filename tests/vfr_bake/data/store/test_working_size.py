"""The working size: a smaller pixel shows what its camera looks at."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from player.cameras.camera import Camera
from vfr_bake.config import TrainConfig
from vfr_bake.data import training_reader, working_size
from vfr_bake.data.files.pictures import DescribedView
from vfr_bake.data.store.working import MAX_SIDE, WorkingSize, resized


def camera_of(width: int, height: int) -> Camera:
    return Camera("a", np.eye(4), width, height, 310.0, 290.0, width / 2 + 7, height / 2 - 5)


def ramp(width: int, height: int) -> np.ndarray:
    """Return a picture of the slopes of its rays, to the right in red and downwards in green: 128 plus 100
    levels a unit of slope."""
    camera = camera_of(width, height)
    x = (np.arange(width) + 0.5 - camera.cx) / camera.fx
    y = (np.arange(height) + 0.5 - camera.cy) / camera.fy
    rgba = np.full((height, width, 4), 255.0)
    rgba[..., 0], rgba[..., 1], rgba[..., 2] = 128 + 100 * x, 128 + 100 * y[:, None], 128
    return (rgba + 0.5).clip(0, 255).astype(np.uint8)


def off(camera: Camera, image: np.ndarray) -> float:
    """Return the largest difference, in slopes of rays, between where pixels look and what they show."""
    x = (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx
    y = (np.arange(camera.height) + 0.5 - camera.cy) / camera.fy
    red, green = (image[..., k].astype(float) for k in (0, 1))
    return max(np.abs(red - 128 - 100 * x).max(), np.abs(green - 128 - 100 * y[:, None]).max()) / 100


@pytest.mark.parametrize("size", [(100, 75), (173, 130), (399, 299), (400, 1)])
def test_a_smaller_pixel_looks_where_the_pixels_under_it_did(size: tuple[int, int]) -> None:
    camera, image = resized(camera_of(400, 300), ramp(400, 300), *size)
    assert (camera.width, camera.height) == size == image.shape[1::-1]
    if size[1] > 1:
        assert off(camera, image) < 0.011  # two roundings to half a level, of 100 a unit


@pytest.mark.parametrize("suffix", ["jpg", "png"])
@pytest.mark.parametrize("side", [50, 99, 150, 399, 401, 2000])
def test_files_are_read_at_the_working_size(tmp_path: Path, suffix: str, side: int) -> None:
    """Files of 401 x 301 pixels, which have no whole half: decoders round up, and the camera must not."""
    path = tmp_path / f"a.{suffix}"
    Image.fromarray(ramp(401, 301)).convert("RGB").save(path, quality=98, subsampling=0)
    camera, image = WorkingSize(side).read(DescribedView(path, camera_of(401, 301), {}))
    assert max(camera.width, camera.height) == min(side, 401)
    inner = image[:-1, :-1]  # the last row and column may repeat the edge
    cut = Camera("b", np.eye(4), camera.width - 1, camera.height - 1, *[
        getattr(camera, name) for name in ("fx", "fy", "cx", "cy")])  # fmt: skip
    assert off(cut, inner) < 0.035


def test_a_lens_is_undone_at_any_size(tmp_path: Path) -> None:
    """A lens is undone at any size: the straight picture shows the same through a smaller camera."""
    path = tmp_path / "a.png"
    Image.fromarray(ramp(400, 300)).save(path)
    view = DescribedView(path, camera_of(400, 300), {"k1": -0.1})
    whole, full = WorkingSize().read(view)
    for side in (90, 170, 250):
        camera, image = WorkingSize(side).read(view)
        expected = resized(whole, full, camera.width, camera.height)[1]
        inner = (slice(3, -3), slice(3, -3), slice(0, 2))
        assert np.abs(image[inner].astype(int) - expected[inner]).max() <= 3


def test_colours_behind_alpha_do_not_bleed() -> None:
    image = np.zeros((4, 6, 4), np.uint8)
    image[:, :, 0] = 255  # red that nobody sees
    image[:, ::2] = (0, 200, 0, 255)
    _, smaller = resized(camera_of(6, 4), image, 3, 2)
    np.testing.assert_array_equal(smaller[..., :3], np.broadcast_to([0, 200, 0], (2, 3, 3)))
    np.testing.assert_allclose(smaller[..., 3], 128, atol=1)


def test_what_is_asked_for_decides(tmp_path: Path) -> None:
    assert working_size(TrainConfig()).max_side == MAX_SIDE == 1600
    assert working_size(TrainConfig(max_side=800)).size(4000, 3000) == (800, 600)
    assert working_size(TrainConfig(downscale=2)).size(4001, 3000) == (2000, 1500)
    assert working_size(TrainConfig(max_side=800, downscale=1)).size(4000, 3000) == (4000, 3000)
    assert training_reader(TrainConfig(), tmp_path / "m.pt", True, None).size.max_side == 1600
