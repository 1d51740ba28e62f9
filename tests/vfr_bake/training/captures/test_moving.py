"""Cells that contradict the other pictures: errors of one sign stand out, errors of both signs do not."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from vfr_bake.training.captures.moving import (
    IS_OVER,
    STANDS_OUT,
    contradicting,
    mean_errors,
    something_moves,
    widened,
)


def sums_of(errors: np.ndarray) -> torch.Tensor:
    """Return sums [n_cells, 5] over errors [n_cells, n, 3]: number, errors by channel, squared errors."""
    n_cells, n, _ = errors.shape
    squared = (errors**2).sum(axis=(1, 2))[:, None]
    return torch.from_numpy(np.concatenate([np.full((n_cells, 1), n), errors.sum(axis=1), squared], axis=1))


@pytest.mark.parametrize("seed", range(3))
def test_detail_that_is_not_learned_does_not_stand_out(seed: int) -> None:
    """Detail that is not learned does not stand out: its errors are large, but of both signs."""
    random = np.random.default_rng(seed)
    detail = random.normal(0, 0.3, (2000, 12, 3))
    found = mean_errors(sums_of(detail))
    assert float((found > STANDS_OUT).double().mean()) < 0.01
    assert float((mean_errors(sums_of(detail + 0.4)) > STANDS_OUT).double().mean()) > 0.99


def test_the_mean_error_is_without_bias() -> None:
    errors = 0.2 + np.random.default_rng(0).normal(0, 0.1, (20_000, 10, 3))
    squares = mean_errors(sums_of(errors)).square()
    assert float(squares.mean()) == pytest.approx(0.04, rel=0.02)


def test_cells_that_stood_out_stay_until_they_are_right() -> None:
    errors = torch.tensor([[[STANDS_OUT + 0.01, 0.5 * (STANDS_OUT + IS_OVER), IS_OVER - 0.01]]])
    none, all_cells = torch.zeros(1, 1, 3, dtype=torch.bool), torch.ones(1, 1, 3, dtype=torch.bool)
    assert contradicting(errors).tolist() == contradicting(errors, none).tolist() == [[[True, False, False]]]
    assert contradicting(errors, all_cells).tolist() == [[[True, True, False]]]


def test_neighbours_are_left_out_too_but_not_those_of_other_pictures() -> None:
    cells = torch.zeros(3, 5, 5, dtype=torch.bool)
    cells[1, 2, 4] = True
    wide = widened(cells)
    assert wide.sum() == 6 and wide[1, 1:4, 3:].all()


@pytest.mark.parametrize("seed", range(3))
def test_a_field_that_is_not_done_has_no_two_kinds_of_cells(seed: int) -> None:
    random = np.random.default_rng(seed)
    early = torch.from_numpy(random.exponential(0.04, 10_000))
    assert float((early > STANDS_OUT).double().mean()) > 0.01
    assert not something_moves(early)
    moving = early / 4
    moving[:200] = 0.4
    assert something_moves(moving)
