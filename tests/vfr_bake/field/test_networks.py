"""Density network, head and pilot: the properties that the paper states, and extreme inputs."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from tests.reference import spherical_harmonics
from tests.vfr_bake import twins
from vfr_bake.config import FieldConfig
from vfr_bake.field.field import VfrField
from vfr_bake.field.networks import (
    DensityNetwork,
    HeadNetwork,
    Pilot,
    SphericalHarmonics,
    TruncatedExp,
)
from vfr_bake.kernels.density import LARGEST_LOGIT, density_logits


def test_density_is_bounded_and_its_gradient_never_dies() -> None:
    x = torch.tensor([-1e30, -100.0, 0.0, LARGEST_LOGIT, 40.0, 1e30], requires_grad=True)
    y = TruncatedExp.apply(x)
    y.sum().backward()
    assert torch.isfinite(y).all() and (y >= 0).all()
    assert y[0].item() == pytest.approx(np.exp(-LARGEST_LOGIT), rel=1e-6)
    assert y[-1].item() == pytest.approx(np.exp(LARGEST_LOGIT), rel=1e-6)
    assert torch.equal(x.grad, y.detach())


@pytest.mark.parametrize("width", [0, 64])
def test_compiled_density_equals_the_network(width: int) -> None:
    torch.manual_seed(0)
    field = VfrField(FieldConfig(n_levels=3, log2_table_size=10, density_width=width, head_width=16))
    torch.nn.init.uniform_(field.grid.table, -1, 1)
    points = torch.rand(3000, 3)
    out = np.empty(3000, np.float32)
    density_logits(points.numpy(), field.arrays(), out)
    with torch.no_grad():
        expected = field.density.logits(twins.encode(field.grid, points)).numpy()
    np.testing.assert_allclose(out, expected, rtol=0, atol=2e-5)


def test_head_has_the_papers_shape() -> None:
    head = HeadNetwork(FieldConfig())
    shapes = [tuple(layer.weight.shape) for layer in (*head.spatial, *head.directional, head.out)]
    assert shapes == [(256, 32), (320, 256), (256, 320), (256, 256), (256, 256), (256, 256), (3, 256)]
    assert sum(rows * columns for rows, columns in shapes) == 369_408


def test_plain_encoding_predicts_no_features() -> None:
    head = HeadNetwork(
        FieldConfig(view_encoding="sh", activation="relu", n_directional_layers=2, head_width=64)
    )
    shapes = [tuple(layer.weight.shape) for layer in (*head.spatial, *head.directional, head.out)]
    assert shapes == [(64, 32), (64, 64), (64, 80), (64, 64), (3, 64)]
    assert head.activation is torch.nn.functional.relu


def test_head_depends_on_the_direction_through_the_basis_alone() -> None:
    torch.manual_seed(0)
    head = HeadNetwork(FieldConfig(n_levels=2, head_width=32, sh_degree=1))
    features = torch.randn(6, 4)
    dirs = torch.nn.functional.normalize(torch.randn(6, 3), dim=-1)
    torch.testing.assert_close(head(features, dirs), head(features, -dirs))  # degree 1: a constant basis
    head = HeadNetwork(FieldConfig(n_levels=2, head_width=32, sh_degree=2))
    assert not torch.allclose(head(features, dirs), head(features, -dirs), atol=1e-4)


def test_harmonics_match_the_oracle() -> None:
    dirs = np.random.default_rng(0).normal(size=(40, 3))
    dirs = np.concatenate([dirs / np.linalg.norm(dirs, axis=-1, keepdims=True), np.eye(3), -np.eye(3)])
    ours = SphericalHarmonics(4)(torch.from_numpy(dirs)).numpy()
    np.testing.assert_allclose(ours, spherical_harmonics(dirs, 4), rtol=0, atol=1e-6)


def test_pilot_sees_every_sample_along_its_own_ray() -> None:
    torch.manual_seed(0)
    pilot = Pilot(FieldConfig(n_levels=2))
    features, dirs = torch.randn(3, 4), torch.nn.functional.normalize(torch.randn(2, 3), dim=-1)
    together = pilot(features, dirs[[0, 0, 1]])
    alone = pilot(features[2:], dirs[1:])
    torch.testing.assert_close(together[2:], alone)


def test_a_density_network_in_double_precision_stays_so() -> None:
    network = DensityNetwork(4, 8).double()
    assert network(torch.zeros(2, 4, dtype=torch.float64)).dtype == torch.float64
