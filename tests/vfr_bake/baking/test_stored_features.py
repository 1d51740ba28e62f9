"""Steps of stored codes: gradients compared with torch, and the same result for any number of parts."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from vfr_bake.kernels.latent_rows import CHANNELS, PARTS
from vfr_bake.kernels.stored_features import (
    BLOCK,
    compose,
    composite,
    descend,
    descend_density,
    interpolate,
    padded,
    slants,
    table,
    weigh,
)


def latents(values: np.ndarray) -> np.ndarray:
    """Return `values` [n_vertices, n_channels] as a table of latent features."""
    found = table(*values.shape)
    found[:] = values
    return found


def with_padding(gradient: np.ndarray) -> np.ndarray:
    """Return `gradient` [n, n_channels] with columns of 0 up to whole registers."""
    return np.pad(gradient, ((0, 0), (0, padded(gradient.shape[1]) - gradient.shape[1])))


@pytest.mark.parametrize("n", [1, 40, BLOCK, BLOCK + 1])
def test_density_gradient_is_that_of_the_composite(n: int) -> None:
    # Compared with torch, on whole codes. After very steep slopes, Adagrad moves by rate * gradient / 1e15.
    random = np.random.default_rng(0)
    n_vertices, n_densities, k = 200, 300, 6

    def corners(n_rows: int) -> tuple[np.ndarray, np.ndarray]:
        shares = random.random((n * k, 8)).astype(np.float32)
        return random.integers(0, n_rows, (n * k, 8)).astype(np.int32), shares / shares.sum(1, keepdims=True)

    (rows, shares), of_densities = corners(n_vertices), corners(n_densities)
    starts = np.arange(0, n * k + 1, k)
    density = random.integers(100, 200, n_densities).astype(np.float32)
    values = random.integers(-90 * PARTS, 90 * PARTS, (n_vertices, 3)).astype(np.int16)
    low, slope = np.float32(-7), np.float32(0.05)
    lengths = random.uniform(0.02, 0.1, n * k).astype(np.float32)
    weights, opacity = np.zeros(n * k, np.float32), np.zeros(n, np.float32)
    opaque = np.float32(1e9)
    weigh(starts, *of_densities, density, low, slope, lengths, opaque, weights, opacity)
    gx, ga = random.normal(size=(n, 3)).astype(np.float32), random.normal(size=n).astype(np.float32)

    latent = torch.tensor(density, dtype=torch.float64, requires_grad=True)
    code = (latent[of_densities[0].astype(int)] * torch.from_numpy(of_densities[1]).double()).sum(dim=1)
    delta = (torch.exp(float(low) + float(slope) * code) * torch.from_numpy(lengths)).reshape(n, k)
    before = torch.cumsum(delta, dim=1) - delta
    w = torch.exp(-before) * -torch.expm1(-delta)
    composed, interpolated = np.empty((n, 3), np.float32), np.empty((n * k, CHANNELS), np.float32)
    interpolate(rows, shares, weights, latents(values), interpolated)
    composite(starts, weights, interpolated, composed)
    np.testing.assert_allclose(weights.reshape(n, k), w.detach().numpy(), atol=1e-6)
    codes = torch.from_numpy(np.floor(values / PARTS + 0.5).astype(np.float32))
    f = (codes[rows.astype(int)] * torch.from_numpy(shares)[..., None]).sum(dim=1).double()
    x = (w[..., None] * f.reshape(n, k, 3)).sum(dim=1)
    np.testing.assert_allclose(composed, x.detach().numpy(), rtol=0, atol=2e-4)
    total = 1 - torch.exp(-delta.sum(dim=1))
    np.testing.assert_allclose(opacity, total.detach().numpy(), atol=1e-6)
    ((x * torch.from_numpy(gx)).sum() + (total * torch.from_numpy(ga)).sum()).backward()
    assert latent.grad is not None

    found = np.empty(n * k, np.float32)
    slants(
        starts, *of_densities, weights, opacity, interpolated, with_padding(gx), ga, low, slope, lengths,
        density, found,
    )  # fmt: skip
    moved = density.copy()
    steepness = np.full(n_densities, 1e30, np.float32)
    descend_density(*of_densities, found, np.float32(1e13), 2, moved, steepness)
    moved = (density - moved) * 100
    wanted = latent.grad.numpy()
    # Codes from 128 on are rounded to 2^-16 where they have moved.
    np.testing.assert_allclose(moved, wanted, rtol=0, atol=0.02 * np.abs(wanted).max() + 100 * 2**-17)


@pytest.mark.parametrize("n_channels", [1, 3, 12, CHANNELS, 22, 2 * CHANNELS, 33])
def test_interpolated_features_compose_as_the_codes_do(n_channels: int) -> None:
    # All rows, the last one of the table too; fetches without weight, and rays without fetches.
    random = np.random.default_rng(n_channels)
    starts = np.array([0, 0, 5, 70, 70, 200])
    values = random.integers(-127 * PARTS, 127 * PARTS, (60, n_channels), endpoint=True).astype(np.int16)
    rows, shares = (
        random.integers(0, 60, (200, 8)).astype(np.int32),
        random.random((200, 8)).astype(np.float32),
    )
    rows[7] = 59
    weights = (random.random(200) * (random.random(200) < 0.8)).astype(np.float32)
    interpolated, found, wanted = (
        np.empty(size, np.float32) for size in ((200, padded(n_channels)), (5, n_channels), (5, n_channels))
    )
    interpolate(rows, shares, weights, latents(values), interpolated)
    codes = np.floor(values.astype(np.float64) / PARTS + 0.5)[rows]
    of_fetches = (codes * shares[..., None]).sum(axis=1) * (weights > 0)[:, None]
    np.testing.assert_allclose(interpolated[:, :n_channels], of_fetches, rtol=0, atol=2e-4)
    composite(starts, weights, interpolated, found)
    compose(starts, rows, shares, weights, values, wanted)
    np.testing.assert_allclose(found, wanted, rtol=3e-6, atol=1e-3)
    assert (found[[0, 3]] == 0).all() and np.abs(found).max() > 100


@pytest.mark.parametrize("n_channels", [1, 12, CHANNELS, 22])
def test_a_step_moves_the_channels_of_its_rows_alone(n_channels: int) -> None:
    # Row 1 of three; what is behind a row in memory belongs to another row, or to another thread.
    start = np.arange(3 * n_channels).reshape(3, n_channels).astype(np.int16)
    moved, steep = latents(start), np.ones(3, np.float32)
    rows, shares = np.ones((1, 8), np.int32), np.eye(1, 8, dtype=np.float32)
    gradient = with_padding(np.full((1, n_channels), 2.0, np.float32))
    ones = np.ones(1, np.float32)
    descend(np.array([0, 1]), rows, shares, ones, gradient, np.float32(5), 1, moved, steep, 1)
    wanted = start[1] - PARTS * 5 * 2 / np.sqrt(1 + 4)
    assert (moved[[0, 2]] == start[[0, 2]]).all() and np.abs(moved[1] - wanted).max() < 1
    assert steep.tolist() == [1, 5, 1]


def test_steps_of_the_features_are_adagrad() -> None:
    """Steps of features are Adagrad's of a float64 loop, fetch after fetch, whether they stay inside
    -127..127 or leave it. No step is rounded by a whole part of a code, and the mean rounding over many
    numbers of a step is 0."""
    random = np.random.default_rng(3)
    starts = np.array([0, 2, 3, 7])
    rows = random.integers(0, 12, (7, 8)).astype(np.int32)
    shares, weights = random.random((7, 8)).astype(np.float32), random.random(7).astype(np.float32)
    gradient = random.normal(size=(3, 2)).astype(np.float32)
    shares[random.random((7, 8)) < 0.2] = 0
    start = random.integers(-126 * PARTS, 126 * PARTS, (12, 2)).astype(np.int16)
    padding = with_padding(gradient)
    for rate in (0.001, 0.1, 30.0):
        found = np.empty((500, 12, 2))
        for number in range(len(found)):
            latent, steep = latents(start), np.full(12, 0.25, np.float32)
            descend(starts, rows, shares, weights, padding, np.float32(rate), 2, latent, steep, number)
            found[number] = latent
        wanted, steepness = start / PARTS, np.full(12, 0.25)
        for ray, slope in enumerate(gradient.astype(np.float64)):
            for j in range(starts[ray], starts[ray + 1]):
                for row, share in zip(rows[j], weights[j] * shares[j].astype(np.float64), strict=True):
                    steepness[row] += share**2 * np.mean(slope**2)
                    step = rate * share / np.sqrt(steepness[row]) * slope
                    wanted[row] = np.clip(wanted[row] - step, -127, 127)
        n_moves = 1 + np.bincount(rows.reshape(-1), minlength=12).max()
        np.testing.assert_allclose(found / PARTS, np.broadcast_to(wanted, found.shape), atol=n_moves / PARTS)
        np.testing.assert_allclose(found.mean(axis=0) / PARTS, wanted, rtol=0, atol=0.2 / PARTS)
        np.testing.assert_allclose(steep, steepness, rtol=1e-5)
        assert (np.abs(found).max() == 127 * PARTS) == (rate > 1)


def test_gradients_whose_squares_underflow_move_nothing() -> None:
    starts, ones = np.array([0, 1]), np.ones(1, np.float32)
    rows, shares = np.zeros((1, 8), np.int32), np.full((1, 8), 1 / 8, np.float32)
    tiny = np.full((1, 2), 1e-22, np.float32)
    density, values = np.full(1, 100.0, np.float32), np.full((1, 2), 50 * PARTS, np.int16)
    steep = np.zeros(1, np.float32)
    descend_density(rows, shares, tiny[0, :1], np.float32(1), 1, density, steep)
    values = latents(values)
    descend(starts, rows, shares, ones, with_padding(tiny), np.float32(1), 1, values, steep, 0)
    assert density[0] == 100 and (values == 50 * PARTS).all() and steep[0] == 0


def test_a_step_does_not_depend_on_the_number_of_parts() -> None:
    random = np.random.default_rng(0)
    starts = np.arange(0, 601, 6)
    rows = random.integers(0, 300, (600, 8)).astype(np.int32)
    shares, weights = random.random((600, 8)).astype(np.float32), random.random(600).astype(np.float32)
    gradient, found = (random.normal(size=size).astype(np.float32) for size in ((100, 3), 600))
    gradient = with_padding(gradient)
    results = []
    rate = np.float32(0.1)
    for n_parts in (1, 3):
        values, density = latents(np.full((300, 3), 50 * PARTS)), np.full(300, 100.0, np.float32)
        steep = np.zeros((2, 300), np.float32)
        descend(starts, rows, shares, weights, gradient, rate, n_parts, values, steep[0], 7)
        descend_density(rows, shares, found, rate, n_parts, density, steep[1])
        results.append((values, density))
    for one, other in zip(*results, strict=True):
        assert np.array_equal(one, other) and np.ptp(one) > 0
