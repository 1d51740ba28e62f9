"""Random pixels: the right rays, the right colours, every pixel but a witness as often as any other."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from vfr_bake.data.capture import PosedImages
from vfr_bake.data.demo import demo_cameras
from vfr_bake.data.witnesses import Witnesses
from vfr_bake.training.rays import DevicePixelSampler, PixelSampler


def mixed_views() -> PosedImages:
    """Three pictures of different sizes; no two pixels have one colour."""
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


def test_every_pixel_is_as_likely_as_any_other() -> None:
    n_rays = 59_000
    batch = PixelSampler(mixed_views(), torch.Generator().manual_seed(1)).draw(n_rays)
    counts = np.bincount((batch.rgba[:, 0] * 255).round().long().numpy(), minlength=59)
    # 1000 expected, standard deviation 31: five of them, for 59 pixels.
    assert np.abs(counts - 1000).max() < 5 * 31.4


def some_witnesses() -> Witnesses:
    """The second picture is whole; of the others the first and the last pixel, and neighbours."""
    kept = {0: [0, 1, 2, 7, 11], 1: [3, 30], 2: [0, 5, 6, 11]}
    return Witnesses(
        np.array([len(pixels) for pixels in kept.values()], np.int32),
        np.concatenate(list(kept.values())).astype(np.int32),
        np.zeros((11, 4), np.uint8),
        np.array([1], np.int32),
    )


def test_no_witness_is_ever_drawn_and_every_other_pixel_alike_often(device: torch.device) -> None:
    views, witnesses = mixed_views(), some_witnesses()
    drawn = [
        *(n for n in range(12) if n not in (0, 1, 2, 7, 11)),
        *(47 + n for n in (1, 2, 3, 4, 7, 8, 9, 10)),
    ]
    assert len(drawn) == 15
    rays_d = np.concatenate([camera.rays()[1] for camera in views.cameras])
    for kind, place in ((PixelSampler, torch.device("cpu")), (DevicePixelSampler, device)):
        batch = kind(views, torch.Generator(place).manual_seed(3), witnesses).draw(15_000)
        number = (batch.rgba[:, 0] * 255).round().long().cpu().numpy()
        counts = np.bincount(number, minlength=59)
        assert np.flatnonzero(counts).tolist() == drawn
        # 1000 expected, standard deviation 31: five of them, for 15 pixels.
        assert np.abs(counts[drawn] - 1000).max() < 5 * 31
        np.testing.assert_allclose(batch.rays_d.cpu().numpy(), rays_d[number], atol=1e-6)


def test_witnesses_of_no_pixels_leave_nothing_out() -> None:
    none = Witnesses(
        *(np.zeros(n, np.int32) for n in (3, 0)), np.zeros((0, 4), np.uint8), np.zeros(0, np.int32)
    )
    draws = [
        PixelSampler(mixed_views(), torch.Generator().manual_seed(0), witnesses).draw(500).rgba
        for witnesses in (none, None)
    ]
    assert torch.equal(*draws)
