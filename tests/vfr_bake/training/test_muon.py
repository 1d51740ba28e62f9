"""Muon compared with the singular value decomposition, and how far it moves parameters."""

from __future__ import annotations

import pytest
import torch

from vfr_bake.training.muon import NARROWEST, Muon, orthogonal


@pytest.mark.parametrize("shape", [(9, 9), (16, 64), (64, 16), (64, 64)])
@pytest.mark.parametrize("scale", [1e-12, 1.0, 1e12])
def test_singular_vectors_stay_and_singular_values_become_about_one(
    shape: tuple[int, int], scale: float
) -> None:
    torch.manual_seed(0)
    matrices = scale * torch.randn(3, *shape)
    u, s, vt = torch.linalg.svd(matrices.double(), full_matrices=False)
    found = u.mT @ orthogonal(matrices).double() @ vt.mT
    values = found.diagonal(dim1=1, dim2=2)
    large = s > 0.02 * s.norm(dim=1, keepdim=True)  # smaller ones have not got there after five iterations
    assert 0.6 < float(values[large].min()) and float(values.max()) < 1.25 and float(values.min()) > -1e-4
    off = found - torch.diag_embed(values)
    assert float(off.abs().max()) < 1e-4


def test_one_direction_and_none() -> None:
    """A matrix of rank one keeps its direction and gets a norm of about 1; a matrix of zeros stays 0."""
    one = torch.outer(torch.linspace(-1, 1, 12), torch.ones(10))[None]
    found = orthogonal(torch.cat([one, 0 * one]))
    assert float(torch.linalg.matrix_norm(found[0])) == pytest.approx(0.95, abs=0.3)
    assert float(torch.nn.functional.cosine_similarity(found[0].flatten(), one.flatten(), dim=0)) > 0.9999
    assert not found[1].any()


def test_every_entry_moves_by_about_the_rate() -> None:
    torch.manual_seed(0)
    parameters = [
        torch.nn.Parameter(torch.zeros(shape)) for shape in ((NARROWEST, 40), (40, NARROWEST), (40, 3), (40,))
    ]
    muon = Muon(parameters)
    for p in parameters:
        p.grad = torch.randn(p.shape)
    signs = [p.grad.sign() for p in parameters if p.grad is not None]
    muon.step(0.01)
    for p, sign in zip(parameters, signs, strict=True):
        assert p.grad is None
        assert float(p.detach().square().mean().sqrt()) == pytest.approx(0.01, rel=0.3), p.shape
        assert float((p.detach() * sign).mean()) < -0.005, "against the gradient"


def test_it_learns_directions_of_small_gradients() -> None:
    """Muon learns directions of small gradients. For a linear map of inputs 300 times as large in some
    directions as in others, Adam keeps most of the error after 200 steps, and Muon almost none."""

    def error(make: type[Muon] | None) -> float:
        torch.manual_seed(0)
        turn, _ = torch.linalg.qr(torch.randn(16, 16))
        x = torch.randn(512, 16) * torch.logspace(0, -2.5, 16) @ turn
        wanted = x @ torch.randn(16, 16)
        weight, bias = torch.nn.Parameter(torch.zeros(16, 16)), torch.nn.Parameter(torch.zeros(16))
        adam = torch.optim.Adam([weight, bias])
        muon = Muon([weight, bias])
        for step in range(200):
            rate = 0.05 * (1 - step / 200)
            ((x @ weight + bias - wanted) ** 2).mean().backward()
            if make is None:
                adam.param_groups[0]["lr"] = rate
                adam.step()
                adam.zero_grad()
            else:
                muon.step(rate)
        return float(((x @ weight + bias - wanted) ** 2).mean().detach())

    assert error(Muon) < 0.2 * error(None)
