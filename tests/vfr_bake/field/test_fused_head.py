"""The head's compiled pass against the same formulas in float64, forward and backward, on hard inputs too."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from vfr_bake.config import FieldConfig
from vfr_bake.field.networks import Head
from vfr_bake.kernels.activations import gelu, gelu_backward, relu_backward

HARD = np.array([0.0, -0.0, 1e-42, -1e-42, 1.0, -1.0, 7.9, -7.9, 8.1, -8.1, 90.0, -90.0, 1e18, -1e18])


def test_gelu_and_its_slope_match_float64() -> None:
    x = np.concatenate([np.linspace(-12, 12, 4000), HARD]).astype(np.float32).reshape(2, -1)
    bias = np.linspace(-1, 1, x.shape[1]).astype(np.float32)
    bias[-len(HARD) :] = 0
    expected = torch.from_numpy((x + bias).astype(np.float64)).requires_grad_()
    values = torch.nn.functional.gelu(expected)
    values.sum().backward()
    assert expected.grad is not None
    ours, slopes = x.copy(), np.empty_like(x)
    gelu(ours, bias, slopes)
    # The sum with the bias is rounded, too: seven digits of numbers up to 13.
    np.testing.assert_allclose(ours, values.detach().numpy(), rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(slopes, expected.grad.numpy(), rtol=0, atol=5e-7)
    assert not (ours[(ours != 0) & (np.abs(x) > 1e-30)] == 0).any()
    tiny = np.abs(np.concatenate([ours, slopes])) < np.finfo(np.float32).tiny
    assert np.abs(np.concatenate([ours, slopes]))[tiny].max() <= 1e-42, "subnormal only where x is"


def test_gelu_keeps_nan_and_takes_nothing() -> None:
    x, slopes = np.full((1, 3), np.nan, np.float32), np.empty((1, 3), np.float32)
    gelu(x, np.zeros(3, np.float32), slopes)
    assert np.isnan(x).all() and np.isnan(slopes).all()
    gelu(np.empty((0, 3), np.float32), np.zeros(3, np.float32), np.empty((0, 3), np.float32))
    grad_bias = np.ones(3, np.float32)
    gelu_backward(np.empty((0, 3), np.float32), slopes, np.empty(0, np.int64), grad_bias)
    assert not grad_bias.any()


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_relu_backward_matches_autograd(dtype: type) -> None:
    random = np.random.default_rng(0)
    hidden, grad_out = random.normal(size=(7, 5)).astype(dtype), random.normal(size=7).astype(dtype)
    hidden[0], grad_out[1] = 0, 0
    bias, weights = random.normal(size=(2, 5)).astype(dtype)
    bias[2] = 0  # exactly at the corner in row 0: no gradient, as torch has it
    h, b, w = (torch.from_numpy(a.astype(np.float64)).requires_grad_() for a in (hidden, bias, weights))
    (torch.relu(h + b) @ w @ torch.from_numpy(grad_out.astype(np.float64))).backward()
    grad_weights, grad_bias = np.empty((2, 5), dtype)
    relu_backward(hidden, bias, weights, grad_out, grad_weights, grad_bias)
    for ours, theirs in ((hidden, h), (grad_weights, w), (grad_bias, b)):
        assert theirs.grad is not None
        np.testing.assert_allclose(ours, theirs.grad.numpy(), rtol=0, atol=2e-6)


def gradients(
    head: Head, features: torch.Tensor, dirs: torch.Tensor, wanted: torch.Tensor
) -> list[torch.Tensor]:
    """Colours, gradient of the features and of all parameters, for a gradient `wanted` of the colours."""
    features = features.clone().requires_grad_()
    head.zero_grad()
    colours = head(features, dirs)
    colours.backward(wanted)
    parameters = [parameter.grad for parameter in head.parameters() if parameter.grad is not None]
    return [colours.detach(), features.grad, *parameters]  # type: ignore[list-item]


@pytest.mark.parametrize("n_rays", [1, 37])
@pytest.mark.parametrize("n_layers", [1, 4])
def test_fused_head_matches_float64(n_rays: int, n_layers: int) -> None:
    torch.manual_seed(0)
    config = FieldConfig(
        n_levels=3, head_width=20, sh_degree=3, n_sh_features=2, n_directional_layers=n_layers
    )
    head, exact = Head(config), Head(config).double()
    for parameter in head.parameters():
        torch.nn.init.normal_(parameter, std=0.4)
    exact.load_state_dict(head.state_dict())
    features = 2 * torch.randn(n_rays, 6)
    features[0] = 0
    dirs = torch.nn.functional.normalize(torch.randn(n_rays, 3), dim=-1)
    wanted = torch.randn(n_rays, 3)
    wanted[1::3] = 0  # rays that are not learned from
    ours = gradients(head, features, dirs, wanted)
    theirs = gradients(exact, features.double(), dirs.double(), wanted.double())
    assert len(ours) == len(theirs) == 2 + 2 * (3 + n_layers)
    for our, their in zip(ours, theirs, strict=True):
        scale = max(float(their.abs().max()), 1.0)
        torch.testing.assert_close(our.double(), their, rtol=0, atol=1e-5 * scale)
    assert not ours[1][1::3].any()


def test_fused_head_takes_nothing_and_keeps_nan() -> None:
    head = Head(FieldConfig(n_levels=2, head_width=8))
    none = gradients(head, torch.empty(0, 4), torch.empty(0, 3), torch.empty(0, 3))
    assert none[0].shape == (0, 3) and not any(gradient.any() for gradient in none[1:])
    features, dirs = torch.full((2, 4), torch.nan), torch.tensor([[0.0, 0.0, 1.0]] * 2)
    assert torch.isnan(head(features, dirs)).all()
