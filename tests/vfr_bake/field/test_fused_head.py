"""The head's compiled pass compared with its formulas in float64, forward and backward, on hard inputs."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
import torch

from tests.numerics.bounds import Row
from vfr_bake.config import FieldConfig
from vfr_bake.field.networks import HeadNetwork
from vfr_bake.kernels import njit
from vfr_bake.kernels.head import bfloat16
from vfr_bake.kernels.head.activations import (
    gelu,
    gelu_backward,
    relu_backward,
    times_basis,
    times_basis_backward,
)
from vfr_bake.kernels.head.bfloat16 import as_array, fast_products, get, put

HARD = np.array([0.0, -0.0, 1e-42, -1e-42, 1.0, -1.0, 7.9, -7.9, 8.1, -8.1, 90.0, -90.0, 1e18, -1e18])

KERNELS = "The head in training"
GELU = Row(
    KERNELS, "GELU in float32", "-13 to 13 and ±1e18, subnormal too", 1e-6, "times (1 + its size)",
    "NaN stays NaN; subnormal only where its argument is",
)  # fmt: skip
SLOPE = Row(KERNELS, "slope of GELU in float32", "the same", 5e-7)
ROUNDED = Row(
    KERNELS, "rounding to bfloat16 and back", "all of float32", unit="torch's bits",
    at_ends="ties to even; NaN, infinite and subnormal numbers too",
)  # fmt: skip
BFLOAT16_GELU = Row(
    KERNELS, "GELU and its slope in bfloat16", "-13 to 13 and ±1e18", 2**-8, "of it, and 1e-6"
)
BFLOAT16_BASIS = Row(
    KERNELS, "products with the harmonics in bfloat16", "normal numbers", 2**-8, "of it, and 1e-6", "no ray"
)
BASIS = Row(
    KERNELS, "products with the harmonics in float32", "normal numbers", 2**-22, "of it, and 1e-6", "no ray"
)
FLOAT32_HEAD = Row(
    KERNELS, "colours and gradients of the whole head in float32", "64 wide", 1e-5, "of their length",
    "rays without a gradient",
)  # fmt: skip
BFLOAT16_HEAD = Row(
    KERNELS, "colours and gradients of the whole head with products in bfloat16", "the same", 10 * 2**-9,
    "of their length", "rays without a gradient; pictures are shown in float32",
)  # fmt: skip


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
    GELU.check(ours, values.detach(), of=values.detach().abs() + 1)
    SLOPE.check(slopes, expected.grad)
    size = np.abs(x + bias)
    assert ours[(size > 1e-30) & (size < 7.95)].all(), "the tail is not lost"
    tiny = np.abs(np.concatenate([ours, slopes])) < np.finfo(np.float32).tiny
    assert np.abs(np.concatenate([ours, slopes]))[tiny].max() <= 1e-42, "subnormal only where x is"


def test_gelu_keeps_nan_and_takes_nothing() -> None:
    x, slopes = np.full((1, 3), np.nan, np.float32), np.empty((1, 3), np.float32)
    gelu(x, np.zeros(3, np.float32), slopes)
    GELU.holds(np.isnan(x) & np.isnan(slopes))
    gelu(np.empty((0, 3), np.float32), np.zeros(3, np.float32), np.empty((0, 3), np.float32))
    grad_bias = np.ones(3, np.float32)
    gelu_backward(np.empty((0, 3), np.float32), slopes, np.empty(0, np.int64), grad_bias)
    assert not grad_bias.any()


@njit()
def copy(source: np.ndarray, target: np.ndarray) -> None:
    for c in range(source.shape[1]):
        put(target, 0, c, get(source, 0, c))


def test_kernels_round_to_bfloat16_as_torch_does() -> None:
    ties = torch.tensor([[1 + 2**-8, 1 + 3 * 2**-8, 1 + 2**-8 + 2**-23, -1 - 2**-8, 3.4e38, 2.0**-133 * 1.5]])
    ends = torch.tensor([[torch.inf, -torch.inf, torch.nan, *HARD]], dtype=torch.float32)
    all_bits = torch.tensor([[0x7FFFFFFF, -1, 0x7F800001]], dtype=torch.int32).view(torch.float32)  # NaN
    values = torch.cat([ties, ends, all_bits, torch.randn(1, 1000)], dim=1)
    rounded, again = torch.empty(values.shape, dtype=torch.bfloat16), torch.empty_like(values)
    copy(as_array(values), as_array(rounded))
    torch.testing.assert_close(rounded, values.bfloat16(), rtol=0, atol=0, equal_nan=True)
    copy(as_array(rounded), as_array(again))
    torch.testing.assert_close(again, rounded.float(), rtol=0, atol=0, equal_nan=True)
    ROUNDED.holds()


def test_which_processors_multiply_in_bfloat16(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, has_them, expected in (
        ("znver4", True, torch.bfloat16), ("znver3", False, torch.float32),
        ("sapphirerapids", True, torch.float32), ("generic", False, torch.float32),
    ):  # fmt: skip
        monkeypatch.setattr(bfloat16.binding, "get_host_cpu_name", lambda name=name: name)
        features = {"avx512bf16": True} if has_them else {}
        monkeypatch.setattr(bfloat16.binding, "get_host_cpu_features", lambda features=features: features)
        assert fast_products() == expected, name


def test_activations_in_bfloat16_are_those_of_float64_rounded() -> None:
    x = torch.cat([torch.linspace(-12, 12, 4000), torch.tensor(HARD, dtype=torch.float32)])[None].bfloat16()
    bias, rows = np.linspace(-1, 1, x.shape[1]).astype(np.float32), np.array([1])
    exact = (x[0].double() + torch.from_numpy(bias).double()).requires_grad_()
    values = torch.nn.functional.gelu(exact)
    values.sum().backward()
    assert exact.grad is not None
    ours, slopes = x.clone(), torch.empty(2, x.shape[1]).bfloat16()
    gelu(as_array(ours), bias, as_array(slopes[1:]))
    # Rounding to bfloat16's eight binary digits changes half of the last one at most, beside the error that
    # float32 is allowed.
    for found, wanted in ((ours[0], values.detach()), (slopes[1], exact.grad)):
        BFLOAT16_GELU.check(found.double(), wanted, of=wanted.abs() + 1e-6 * 2**8)
    grad = torch.full_like(x, 3.0)
    grad_bias = np.empty(x.shape[1], np.float32)
    gelu_backward(as_array(grad), as_array(slopes), rows, grad_bias)
    torch.testing.assert_close(grad[0], 3 * slopes[1], rtol=0, atol=0)
    np.testing.assert_array_equal(grad_bias, grad[0].float().numpy())


@pytest.mark.parametrize("kind", [torch.float32, torch.bfloat16], ids=["float32", "bfloat16"])
def test_products_with_the_basis_match_float64(kind: torch.dtype) -> None:
    torch.manual_seed(0)
    rows = torch.tensor([4, 0, 2])
    x, grad, bias, basis = (
        torch.randn(5, 7).to(kind),
        torch.randn(3, 7).to(kind),
        torch.randn(7),
        torch.randn(5, 4),
    )
    basis[2] = 0
    factors = torch.cat([torch.ones(5, 3), basis], dim=1).double()
    expected, expected_grad = (x.double() + bias) * factors, grad.double() * factors[rows]
    grad_bias = torch.empty(7)
    times_basis(as_array(x), bias.numpy(), basis.numpy())
    times_basis_backward(as_array(grad), basis.numpy(), rows.numpy(), grad_bias.numpy())
    # At most half of the last of bfloat16's eight binary digits, or of float32's 24 in two roundings.
    row, digits = (BFLOAT16_BASIS, 2**-8) if kind == torch.bfloat16 else (BASIS, 2**-22)
    for found, wanted in ((x, expected), (grad, expected_grad)):
        row.check(found.double(), wanted, of=wanted.abs() + 1e-6 / digits)
    torch.testing.assert_close(grad_bias.double(), expected_grad.sum(dim=0), rtol=0, atol=9 * digits)
    nothing = np.empty((0, 7), np.float32), np.empty((0, 4), np.float32)
    times_basis(nothing[0], bias.numpy(), nothing[1])
    times_basis_backward(nothing[0], basis.numpy(), np.empty(0, np.int64), grad_bias.numpy())
    assert not grad_bias.any()


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_relu_backward_matches_autograd(dtype: type) -> None:
    random = np.random.default_rng(0)
    hidden, grad_out = random.normal(size=(7, 5)).astype(dtype), random.normal(size=7).astype(dtype)
    hidden[0], grad_out[1] = 0, 0
    bias, weights = random.normal(size=(2, 5)).astype(dtype)
    bias[2] = 0  # in row 0 exactly at the kink of the ReLU: no gradient, as in torch
    h, b, w = (torch.from_numpy(a.astype(np.float64)).requires_grad_() for a in (hidden, bias, weights))
    (torch.relu(h + b) @ w @ torch.from_numpy(grad_out.astype(np.float64))).backward()
    grad_weights, grad_bias = np.empty((2, 5), dtype)
    relu_backward(hidden, bias, weights, grad_out, grad_weights, grad_bias)
    for ours, theirs in ((hidden, h), (grad_weights, w), (grad_bias, b)):
        assert theirs.grad is not None
        np.testing.assert_allclose(ours, theirs.grad.numpy(), rtol=0, atol=2e-6)


def gradients(
    head: HeadNetwork, features: torch.Tensor, dirs: torch.Tensor, wanted: torch.Tensor
) -> list[torch.Tensor]:
    """Return the colours, and the gradients of features and parameters, for a gradient `wanted` of them."""
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
    head, exact = HeadNetwork(config), HeadNetwork(config).double()
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


@pytest.fixture
def without_onednn() -> Iterator[None]:
    """Use torch's own products of bfloat16, which give the same result on every machine."""
    before = torch.backends.mkldnn.set_flags(False)[0]
    yield
    torch.backends.mkldnn.set_flags(before)


@pytest.mark.usefixtures("without_onednn")
def test_fused_head_in_bfloat16_is_near_float64() -> None:
    torch.manual_seed(0)
    config = FieldConfig(n_levels=4, head_width=64, sh_degree=3, n_sh_features=2)
    head, exact = HeadNetwork(config), HeadNetwork(config).double()
    exact.load_state_dict(head.state_dict())
    features, wanted = torch.randn(200, 8), torch.randn(200, 3)
    wanted[1::3] = 0
    dirs = torch.nn.functional.normalize(torch.randn(200, 3), dim=-1)
    theirs = gradients(exact, features.double(), dirs.double(), wanted.double())
    in_float32 = gradients(head, features, dirs, wanted)
    head.products = torch.bfloat16
    ours = gradients(head, features, dirs, wanted)
    for our, single, their in zip(ours, in_float32, theirs, strict=True):
        # Factors are rounded by 2^-9 in each of five layers, forward and back.
        assert our.dtype == torch.float32
        BFLOAT16_HEAD.check((our - their).norm(), of=their.norm())
        FLOAT32_HEAD.check((single - their).norm(), of=their.norm())
    assert (ours[0] != in_float32[0]).any() and not ours[1][1::3].any()
    with torch.no_grad():  # rendered pictures use the float32 weights
        torch.testing.assert_close(head(features, dirs), in_float32[0], rtol=0, atol=0)


@pytest.mark.usefixtures("without_onednn")
def test_products_in_bfloat16_have_few_sizes(monkeypatch: pytest.MonkeyPatch) -> None:
    head = HeadNetwork(FieldConfig(n_levels=2, head_width=8))
    head.products = torch.bfloat16
    multiply, sizes = torch.mm, set[tuple[torch.Size, torch.Size]]()

    def mm(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
        sizes.add((a.shape, b.shape))
        return multiply(a, b)

    monkeypatch.setattr(torch, "mm", mm)
    found = []
    for n_rays in (33, 47, 64):  # all pad to 64 rows, as do the rows that remain when rays are left out
        wanted = torch.ones(n_rays, 3)
        wanted[34::3] = 0
        gradients(head, torch.randn(n_rays, 4), torch.ones(n_rays, 3), wanted)
        found.append(sizes.copy())
        sizes.clear()
    assert found[0] == found[1] == found[2]


@pytest.mark.usefixtures("without_onednn")
@pytest.mark.parametrize("products", [torch.float32, torch.bfloat16])
def test_fused_head_takes_nothing_and_keeps_nan(products: torch.dtype) -> None:
    head = HeadNetwork(FieldConfig(n_levels=2, head_width=8))
    head.products = products
    none = gradients(head, torch.empty(0, 4), torch.empty(0, 3), torch.empty(0, 3))
    assert none[0].shape == (0, 3) and not any(gradient.any() for gradient in none[1:])
    features, dirs = torch.full((2, 4), torch.nan), torch.tensor([[0.0, 0.0, 1.0]] * 2)
    assert torch.isnan(head(features, dirs)).all()
