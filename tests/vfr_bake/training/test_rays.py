"""Random pixels: their rays and colours are right, witnesses are never drawn, and every other pixel is drawn
as often as any other, or as often as its detail asks for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from player.errors import TrainingError
from vfr_bake.data.demo import demo_cameras
from vfr_bake.data.store.capture import PosedImages
from vfr_bake.data.witnesses import Witnesses
from vfr_bake.training.detail import detail_lots
from vfr_bake.training.rays import RUN, DevicePixelSampler, Lottery, PixelSampler, RayBatch


def mixed_views() -> PosedImages:
    """Return three pictures of different sizes, in which no two pixels have the same colour."""
    sizes = [(4, 3), (7, 5), (2, 6)]
    cameras = [
        replace(camera, width=width, height=height, cx=width / 2 + 0.3, fy=9.0 + index)
        for index, (camera, (width, height)) in enumerate(zip(demo_cameras(8, 3), sizes, strict=True))
    ]
    numbers = np.arange(4 * 3 + 7 * 5 + 2 * 6, dtype=np.uint8)
    pixels = np.stack([numbers, numbers + 60, numbers + 120, 255 - numbers], axis=-1)
    images = [
        part.reshape(height, width, 4)
        for part, (width, height) in zip(np.split(pixels, [12, 47]), sizes, strict=True)
    ]
    return PosedImages(cameras, images)


def test_rays_and_colours_are_those_of_the_pixels_of_pictures_of_mixed_sizes() -> None:
    views = mixed_views()
    batch = PixelSampler(views, torch.Generator().manual_seed(0)).draw(4000)
    rays = [camera.rays() for camera in views.cameras]
    rays_o = np.concatenate([o for o, _ in rays])
    rays_d = np.concatenate([d for _, d in rays])
    number = (batch.rgba[:, 0] * 255).round().long().numpy()
    assert set(number.tolist()) == set(range(59))
    np.testing.assert_allclose(batch.rays_o.numpy(), rays_o[number], atol=1e-6)
    np.testing.assert_allclose(batch.rays_d.numpy(), rays_d[number], atol=1e-6)
    np.testing.assert_allclose(batch.rgba[:, 3].numpy() * 255, 255 - number, atol=1e-4)


def test_a_gpus_sampler_draws_the_same(device: torch.device) -> None:
    views = mixed_views()
    ours = DevicePixelSampler(views, torch.Generator(device).manual_seed(0)).draw(4000)
    rays = [camera.rays() for camera in views.cameras]
    number = (ours.rgba[:, 0] * 255).round().long().cpu().numpy()
    assert set(number.tolist()) == set(range(59))
    for k, values in enumerate((ours.rays_o, ours.rays_d)):
        expected = np.concatenate([pair[k] for pair in rays])[number]
        np.testing.assert_allclose(values.cpu().numpy(), expected, atol=1e-6)
    np.testing.assert_allclose(ours.rgba[:, 3].cpu().numpy() * 255, 255 - number, atol=1e-4)
    if device.type == "cpu":  # one generator: the same pixels
        numpys = PixelSampler(views, torch.Generator().manual_seed(0)).draw(4000)
        torch.testing.assert_close(ours.rgba, numpys.rgba, rtol=0, atol=1e-7)
        torch.testing.assert_close(ours.rays_d, numpys.rays_d, rtol=0, atol=1e-6)


def number_of(batch: RayBatch) -> np.ndarray:
    return (batch.rgba[:, 0] * 255).round().long().cpu().numpy()


def check_draws(batch: RayBatch, lots: np.ndarray) -> None:
    """Assert that every pixel has been drawn as often as its `lots` [n] say."""
    counts = np.bincount(number_of(batch), minlength=len(lots))
    expected = len(batch.rgba) * lots / lots.sum()
    # Five standard deviations of the counts, which are Poisson distributed.
    assert (np.abs(counts - expected) <= 5 * np.sqrt(expected)).all()


def lots_by_detail(views: PosedImages) -> np.ndarray:
    return np.concatenate([detail_lots(image).reshape(-1) for image in views.images]).astype(float)


def test_pixels_are_drawn_alike_or_by_their_detail(device: torch.device) -> None:
    views = mixed_views()
    views.images[1][2:, :, 3] = 0
    views.images[2][0, 0, 2] = 250
    lots = lots_by_detail(views)
    assert lots.max() > 2 * lots.min() > 0
    for kind, place in ((PixelSampler, torch.device("cpu")), (DevicePixelSampler, device)):
        for by_detail, expected in ((False, np.ones(59)), (True, lots)):
            generator = torch.Generator(place).manual_seed(1)
            check_draws(kind(views, generator, by_detail=by_detail).draw(59_000), expected)


def test_a_lottery_draws_each_number_as_often_as_it_has_lots(device: torch.device) -> None:
    random = np.random.default_rng(0)
    most = np.full(3 * RUN, 255)  # the largest sums of a run
    gaps = np.where(np.arange(700) % 300 == 299, 7, 0)  # runs without a lot, and an incomplete last one
    for lots in (random.integers(0, 256, 1000), most, gaps, np.array([0, 0, 1]), np.array([5])):
        lottery = Lottery(lots.astype(np.uint8))
        every = np.arange(lots.sum())
        assert lottery.n_lots == len(every)
        numbers = lottery.numbers(every)
        np.testing.assert_array_equal(numbers, np.repeat(np.arange(len(lots)), lots))
        assert lottery.numbers(every[:0]).shape == (0,)
        lottery.to(device)
        np.testing.assert_array_equal(
            lottery.numbers(torch.from_numpy(every).to(device)).cpu().numpy(), numbers
        )


def test_pictures_without_a_pixel_to_draw() -> None:
    views = mixed_views()
    for image in views.images:
        image[..., 3] = 0
    with pytest.raises(TrainingError, match="expected pixels that are not masked, found none"):
        PixelSampler(views, torch.Generator(), masked=True)


def some_witnesses() -> Witnesses:
    """Return witnesses: of a patch of 2 x 2 pixels, of a whole picture, and of a patch of 1 x 2 pixels."""
    kept = {0: [2, 7], 1: [3, 30], 2: [5, 7]}
    return Witnesses(
        np.array([len(pixels) for pixels in kept.values()], np.int32),
        np.concatenate(list(kept.values())).astype(np.int32),
        np.zeros((6, 4), np.uint8),
        np.array([1], np.int32),
    )


def test_no_witness_and_nothing_masked_is_ever_drawn(device: torch.device) -> None:
    views, witnesses = mixed_views(), some_witnesses()
    rays_d = np.concatenate([camera.rays()[1] for camera in views.cameras])
    kept = [2, 3, 6, 7, *range(12, 47), 47 + 5, 47 + 7]
    for image in views.images:
        image[..., 3] = 255
    hidden = [4, 5, 57]
    views.images[0].reshape(-1, 4)[[4, 5], 3] = 0
    views.images[2].reshape(-1, 4)[10, 3] = 254
    for masked, by_detail in ((False, False), (True, False), (False, True), (True, True)):
        lots = lots_by_detail(views) if by_detail else np.ones(59)
        lots[kept + hidden if masked else kept] = 0
        for kind, place in ((PixelSampler, torch.device("cpu")), (DevicePixelSampler, device)):
            generator = torch.Generator(place).manual_seed(3)
            batch = kind(views, generator, witnesses, masked, by_detail).draw(15_000)
            check_draws(batch, lots)
            np.testing.assert_allclose(batch.rays_d.cpu().numpy(), rays_d[number_of(batch)], atol=1e-6)


def test_witnesses_of_no_pixels_leave_nothing_out() -> None:
    none = Witnesses(
        *(np.zeros(n, np.int32) for n in (3, 0)), np.zeros((0, 4), np.uint8), np.zeros(0, np.int32)
    )
    draws = [
        PixelSampler(mixed_views(), torch.Generator().manual_seed(0), witnesses).draw(500).rgba
        for witnesses in (none, None)
    ]
    assert torch.equal(*draws)
