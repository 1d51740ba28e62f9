"""Density and optical depth at the ends of their ranges: the kernel, its twin, torch's version for GPUs and
the player, compared with mpmath with 50 digits."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache

import mpmath
import numpy as np
import pytest
import torch

from player.compiled import march as march_compiled
from player.march import march
from player.march.fetches import Samples, equal_mass_bins
from player.march.march import MAX_TAU
from tests.numerics.bounds import Row
from tests.vfr_bake import twins
from vfr_bake.field.networks import TruncatedExp
from vfr_bake.kernels.density import LARGEST_LOGIT
from vfr_bake.rendering.compositing import composite
from vfr_bake.torch_kernels.compositing import composite as composite_torch

Composite = Callable[..., tuple[torch.Tensor, torch.Tensor, torch.Tensor]]
COMPOSITES = [
    pytest.param(composite, id="numba"),
    pytest.param(twins.composite, id="twin"),
    pytest.param(composite_torch, id="torch"),
]
DTYPES = [
    pytest.param(dtype, id=str(dtype).removeprefix("torch.")) for dtype in (torch.float32, torch.float64)
]
mpmath.mp.dps = 50

DEPTH = "Density and optical depth"
PRE_ACTIVATION = Row(
    DEPTH, "activated density (training)", "any pre-activation, clamped to ±15", 4, "ulp of it",
    "±infinity is clamped, its gradient is that of the clamped value and never 0",
)  # fmt: skip
NAN_PRE_ACTIVATION = Row(
    DEPTH, "NaN before the activation", unit="NaN",
    at_ends="the loss shows it, and the step is skipped and counted",
)  # fmt: skip
WEIGHT = Row(
    DEPTH, "weight of a sample",
    "depths 0, subnormal, 1e-8 to 1e8, 1e6 first and last, 10,000 of 1e-7, one, none",
    2, "u (4 + i tau) of it for the i-th sample",
    "below the least normal number it may be lost; a first sample of depth 1e6 has all of it",
)  # fmt: skip
OPACITY = Row(
    DEPTH, "opacity", "the same", 2, "u (n + 2) of it",
    "never a product of (1 - alpha): 10,000 samples of 1e-7 are not lost",
)  # fmt: skip
SUM_OF_WEIGHTS = Row(DEPTH, "sum of the weights, against the opacity", "the same", 2, "ulp a sample")
DEPTH_GRADIENT = Row(
    DEPTH, "gradient of a depth", "the same, up to 100 samples", 60, "ulp (n + 1)", "finite at all of these"
)
FEATURE_GRADIENT = Row(
    DEPTH, "gradient of a feature", "the same, up to 100 samples", 30, "ulp (n + 1)", "finite at all of these"
)
HALF_STEPS = Row(
    DEPTH, "weight of two half steps, against one step", "densities exp(-20) to exp(4)", 10, "ulp tau of it"
)
HALF_STEPS_COMPOSED = Row(
    DEPTH, "opacity and features of 400 half steps, against 200 steps", "the same", 400, "ulp of it"
)
NAN_CELL = Row(
    DEPTH, "NaN in one cell", unit="stays in its ray", at_ends="spoils the rays that meet it, and no other"
)
PLAYERS_OPACITY = Row(
    DEPTH,
    "opacity (player)",
    "tau 0 to 1e6, subnormal too",
    2,
    "u of it, and the least subnormal number",
    "0 to 1",
)
FOG = Row(
    DEPTH, "opacity of a fog (player's march)", "optical depth of a step 0 to 1e6", 1e-5, "of it",
    "stops behind tau = 6.9; the first sample counts whole",
)  # fmt: skip
FOG_SAMPLES = Row(DEPTH, "samples of a ray through a fog", "the same", 1, "sample")
MEAN_PLACE = Row(
    "What is stored", "mean place of chosen samples", "any k", 1e-6, "of it",
    "ties, one sample, weights below float32's resolution, k over the samples",
)  # fmt: skip

DEPTHS: dict[str, list[float]] = {
    "none": [],
    "nothing": [0.0, 0.0, 0.0],
    "one": [0.7],
    "subnormal": [1e-42, 1e-40, 2e-39],
    "1e-8 to 1e8": [1e-8, 1e-6, 1e-4, 1e-2, 1.0, 1e2, 1e4, 1e8],
    "1e8 to 1e-8": [1e8, 1e4, 1e2, 1.0, 1e-2, 1e-8],
    "opaque first": [1e6, 1.0, 0.5],
    "opaque last": [1e-3, 0.2, 1e6],
    "10,000 thin": [1e-7] * 10_000,
    "10,000 thin, dense after": [1e-5] * 10_000 + [3.0],
    "growing": [2.0**-i for i in range(40, 0, -1)],
}


@cache
def exact(depths: tuple[float, ...]) -> tuple[list[mpmath.mpf], mpmath.mpf]:
    """Return weights and opacity."""
    tau, weights = mpmath.mpf(0), []
    for depth in depths:
        weights.append(mpmath.exp(-tau) * -mpmath.expm1(-mpmath.mpf(depth)))
        tau += mpmath.mpf(depth)
    return weights, -mpmath.expm1(-tau)


def one_ray(function: Composite, depths: torch.Tensor, features: torch.Tensor) -> tuple[torch.Tensor, ...]:
    n = len(depths)
    return function(depths, features, torch.ones_like(depths), torch.tensor([0]), torch.tensor([n]))


@pytest.mark.parametrize("function", COMPOSITES)
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("name", DEPTHS)
def test_weights_are_those_of_50_digits(function: Composite, dtype: torch.dtype, name: str) -> None:
    """Weights are those of 50 digits. The relative error has a rounding for each sum of depths before the
    sample, times the depth, and four of its own. Below the least normal number nothing is promised, and
    smaller amounts may be lost."""
    depths = torch.tensor(DEPTHS[name], dtype=dtype)
    _, opacity, weights = one_ray(function, depths, torch.ones(len(depths), 1, dtype=dtype))
    expected, alpha = exact(tuple(depths.tolist()))
    unit, tiny = torch.finfo(dtype).eps, torch.finfo(dtype).tiny
    tau = np.cumsum(np.minimum(depths.double().numpy(), 1e3))
    errors = [abs(mpmath.mpf(ours) - wanted) for ours, wanted in zip(weights.tolist(), expected, strict=True)]
    roundings = 4 + (np.arange(len(tau)) + 1) * np.minimum(tau, 800.0)
    WEIGHT.check(errors, of=(np.array(expected, np.float64) * unit * roundings + tiny) / 2)
    total = math.fsum(weights.tolist())
    off = abs(mpmath.mpf(opacity[0].item()) - alpha)
    OPACITY.check(off, of=(unit * (2 + len(depths)) * float(alpha) + tiny) / 2)
    SUM_OF_WEIGHTS.check(total, opacity[0].item(), of=unit * max(len(depths), 1) * total + tiny / 2)


@pytest.mark.parametrize("function", COMPOSITES)
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("name", [name for name in DEPTHS if len(DEPTHS[name]) < 100])
def test_gradients_are_those_of_50_digits(function: Composite, dtype: torch.dtype, name: str) -> None:
    """Gradients are those of L = sum_c g_c F_c + a A + sum_i v_i w_i, in 50 digits: dL/d d_i = T_{i+1} u_i -
    sum_{j>i} w_j u_j + a exp(-tau), with u_i = v_i + g.F_i."""
    torch.manual_seed(0)
    depths = torch.tensor(DEPTHS[name], dtype=dtype, requires_grad=True)
    features = torch.randn(len(depths), 3, dtype=dtype, requires_grad=True)
    out, opacity, weights = one_ray(function, depths, features)
    g, a = torch.randn(3, dtype=dtype), 0.75
    v = torch.randn(len(depths), dtype=dtype)
    ((out[0] * g).sum() + a * opacity[0] + (v * weights).sum()).backward()
    w, alpha = exact(tuple(depths.tolist()))
    inner = [mpmath.mpf(x) for x in (v.double() + features.detach().double() @ g.double()).tolist()]
    tau, through = mpmath.mpf(0), []
    for depth in depths.tolist():
        tau += mpmath.mpf(depth)
        through.append(mpmath.exp(-tau))
    unit = torch.finfo(dtype).eps
    for i in range(len(depths)):
        behind = mpmath.fsum(w[j] * inner[j] for j in range(i + 1, len(depths)))
        wanted = through[i] * inner[i] - behind + a * (1 - alpha)
        DEPTH_GRADIENT.check(abs(mpmath.mpf(depths.grad[i].item()) - wanted), of=unit * (1 + len(depths)))
        for c in range(3):
            of_feature = mpmath.mpf(features.grad[i, c].item())
            off = abs(of_feature - w[i] * mpmath.mpf(g[c].item()))
            FEATURE_GRADIENT.check(off, of=unit * (1 + len(depths)))


@pytest.mark.parametrize("function", COMPOSITES)
@pytest.mark.parametrize("dtype", DTYPES)
def test_two_half_steps_are_one_step(function: Composite, dtype: torch.dtype) -> None:
    torch.manual_seed(1)
    sigmas = torch.exp(torch.empty(200, dtype=dtype).uniform_(-20, 4))
    features = torch.rand(200, 2, dtype=dtype)
    whole = one_ray(function, sigmas, features)
    half = one_ray(function, sigmas.repeat_interleave(2) / 2, features.repeat_interleave(2, dim=0))
    unit = torch.finfo(dtype).eps
    for i in (0, 1):
        HALF_STEPS_COMPOSED.check(half[i], whole[i], of=unit * whole[i].abs())
    HALF_STEPS.check(half[2].reshape(-1, 2).sum(1), whole[2], of=float(sigmas.sum()) * unit * whole[2])


@pytest.mark.parametrize("function", COMPOSITES)
def test_a_nan_stays_in_its_ray(function: Composite) -> None:
    """A NaN in one cell spoils only the rays that meet the cell, and the optimiser then skips these."""
    sigmas = torch.tensor([1.0, 2.0, math.nan, 1.0, 3.0, 0.5], requires_grad=True)
    features = torch.ones(6, 2, requires_grad=True)
    starts, counts = torch.tensor([0, 2, 4]), torch.tensor([2, 2, 2])
    out, opacity, weights = function(sigmas, features, torch.ones(6), starts, counts)
    NAN_CELL.holds(torch.isnan(opacity[1]) and torch.isfinite(opacity[[0, 2]]).all())
    assert torch.isfinite(out[[0, 2]]).all() and torch.isfinite(weights[[0, 1, 4, 5]]).all()
    (out[[0, 2]].sum() + opacity[[0, 2]].sum()).backward()
    assert torch.isfinite(sigmas.grad[[0, 1, 4, 5]]).all()
    clean = function(sigmas.detach()[:2], features[:2], torch.ones(2), starts[:1], counts[:1])
    assert torch.equal(out[0], clean[0][0])


@pytest.mark.parametrize("logit", [math.inf, -math.inf, 1e30, -1e30, 15.0, np.nextafter(15.0, 16.0), -15.0])
@pytest.mark.parametrize("dtype", DTYPES)
def test_an_infinite_pre_activation_is_clamped(logit: float, dtype: torch.dtype) -> None:
    """An infinite pre-activation is clamped, with the gradient of the clamped value: it can come back."""
    x = torch.tensor([logit], dtype=dtype, requires_grad=True)
    y = TruncatedExp.apply(x)
    y.sum().backward()
    wanted = math.exp(min(max(float(x.item()), -LARGEST_LOGIT), LARGEST_LOGIT))
    PRE_ACTIVATION.check(y.item(), wanted, of=torch.finfo(dtype).eps * wanted)
    assert x.grad is not None and x.grad.item() == y.item()


def test_a_nan_pre_activation_stays_one() -> None:
    """A NaN stays NaN, so that the loss becomes NaN, and the step is skipped and counted."""
    NAN_PRE_ACTIVATION.holds(math.isnan(TruncatedExp.apply(torch.tensor([math.nan])).item()))


# --- the player ---


@pytest.mark.parametrize("tau", [0.0, 1e-45, 1e-38, 1e-20, 1e-8, 9.99e-6, 1e-5, 1.01e-5, 1e-3, 0.5, 6.9, 1e6])
def test_the_players_opacity_is_that_of_50_digits(tau: float) -> None:
    ours = float(march_compiled.opacity_of(np.float32(tau)))
    wanted = -mpmath.expm1(-mpmath.mpf(float(np.float32(tau))))
    PLAYERS_OPACITY.check(abs(mpmath.mpf(ours) - wanted), of=2**-24 * float(wanted) + 1e-45)
    assert 0 <= ours <= 1


@pytest.mark.parametrize("module", [march, march_compiled], ids=["numpy", "numba"])
@pytest.mark.parametrize(
    "optical", [0.0, 1e-38, 1e-8, 1e-4, 0.09, 0.0999, 0.1001, 0.5, 6.0, 7.0, 1e3, 1e6], ids=str
)
def test_a_fog_of_one_density(module: object, optical: float) -> None:
    """In a fog along x, tau is `optical` times the samples, the march stops behind MAX_TAU, and the opacity
    is that of 50 digits."""
    from tests.numerics.fog import fog

    grid = fog(optical)
    rays = np.float32([[-3, 0.05, 0.05]]), np.float32([[1, 0, 0]])
    result = module.march(grid, *rays, 0)  # type: ignore[attr-defined]
    step_tau = float(np.exp(np.float64(grid.density_low)) * np.float64(grid.step))
    limit = float(MAX_TAU)
    inside = round(2 / float(grid.step))
    taken = inside if step_tau == 0 else min(inside, math.floor(limit / step_tau) + 1)
    FOG_SAMPLES.check(result.n_density_samples[0], taken)
    wanted = -mpmath.expm1(-mpmath.mpf(step_tau) * int(result.n_density_samples[0]))
    FOG.check(abs(mpmath.mpf(float(result.opacity[0])) - wanted), of=float(wanted) + 1e-39)
    if len(result.hits):  # the feature is constant: the weights' sum
        total = float(result.features[0, 0]) / 100
        assert total == pytest.approx(float(result.opacity[0]), rel=2 * 2**-23 * taken + 1e-6)


@pytest.mark.parametrize(
    "weights", [[1e-38, 1.0, 1e-38], [1.0, 1e-45, 1.0], [1.0] * 7, [2.0**-i for i in range(60)]]
)
def test_bins_of_ties_and_of_weights_below_resolution(weights: list[float]) -> None:
    """Equal masses keep the mean place to float64's precision, however small the parts are."""
    s = np.arange(1, len(weights) + 1, dtype=np.float32)
    w = np.float32(weights)
    samples = Samples(np.zeros(len(s), np.int64), s, w)
    k = 2
    bins = equal_mass_bins(samples, k)
    mean = math.fsum((w.astype(np.float64) * s).tolist()) / math.fsum(w.astype(np.float64).tolist())
    MEAN_PLACE.check(bins.s.mean(), mean, of=mean)
    assert (np.diff(bins.s) >= 0).all() and bins.s.min() >= 1 and bins.s.max() <= len(s)
