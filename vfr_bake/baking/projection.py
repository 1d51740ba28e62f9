"""Fewer feature channels, at the least loss for the colours.

Compositing is linear, so a linear map of the features can be applied per vertex before it and undone after
it: W1 sum w_i F_i ~ (W1 Q) sum w_i (P F_i). With the second moment G = E[x x^T] of the rendered features x =
sum w_i F_i and the mean square M = E[J^T J] of the colours' derivatives J = A d rgb / dx, the colours' error
E |J (x - Q P x)|^2 is least, J and x taken as independent, for P = U^T S and Q = S^-1 U, where S = M^(1/2)
and U holds the first r eigenvectors of S G S (Eckart-Young).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from vfr_bake.field.head import Head

ROWS_AT_ONCE = 1 << 18
LEAST_SENSITIVITY = 1e-6
"""Share of the mean that every direction of M keeps, so that S has an inverse."""


@dataclass(frozen=True)
class Projection:
    """Stored channels are P F; the head is given Q P x."""

    matrix: np.ndarray
    """P [n_stored, n_channels]."""
    back: np.ndarray
    """Q [n_channels, n_stored]."""

    def first(self, n: int) -> Projection:
        """The best projection to the first n of its channels: the most important come first."""
        return Projection(self.matrix[:n], self.back[:, :n])


def project(sensitivity: np.ndarray, rendered: np.ndarray, n_stored: int) -> Projection:
    """The best projection to `n_stored` channels, or to all where there are no more.

    `sensitivity` [n_channels, n_channels] is M, `rendered` [n, n_channels] rendered features.

    >>> p = project(np.eye(3), np.diag([3.0, 2.0, 1e-9]), 2)
    >>> bool(np.allclose(p.back @ p.matrix, np.diag([1, 1, 0]), atol=1e-6))
    True
    """
    n_channels = len(sensitivity)
    least = LEAST_SENSITIVITY * max(float(np.trace(sensitivity)) / n_channels, 1e-30)
    values, vectors = np.linalg.eigh(sensitivity.astype(np.float64))
    root = np.sqrt(np.maximum(values, least))
    s, inverse = (vectors * root) @ vectors.T, (vectors / root) @ vectors.T
    moment = rendered.astype(np.float64).T @ rendered.astype(np.float64) / max(len(rendered), 1)
    _, basis = np.linalg.eigh(s @ moment @ s)
    basis = basis[:, ::-1][:, :n_stored]
    return Projection(basis.T @ s, inverse @ basis)


def head_sensitivity(head: Head, rendered: np.ndarray, dirs: np.ndarray, opacity: np.ndarray) -> np.ndarray:
    """M [n_channels, n_channels]: mean square of the derivatives of the shown colours, at `rendered` features
    [n, n_channels] seen along `dirs` [n, 3] with `opacity` [n]."""
    features = torch.from_numpy(rendered).requires_grad_(True)
    colours = head(features, torch.from_numpy(dirs)) * torch.from_numpy(opacity)[:, None]
    total = np.zeros((rendered.shape[1],) * 2)
    for channel in range(3):
        (slope,) = torch.autograd.grad(colours[:, channel].sum(), features, retain_graph=channel < 2)
        total += slope.double().numpy().T @ slope.double().numpy()
    return total / max(len(rendered), 1)


def code_step(values: np.ndarray, levels: int = 127) -> float:
    """Step of the signed codes of projected `values` [n, n_stored]: the largest magnitude is at `levels`; 1
    for zeros.

    It is the same for all channels: P makes an error in any of them weigh alike in the colours, so that the
    least bytes for a given error are those of one step, and a channel of little use takes few bits by itself.

    >>> code_step(np.array([[127.0, 0.0], [-254.0, 1.0]]))
    2.0
    """
    largest = float(max(values.max(initial=0), -values.min(initial=0)))  # a copy of `values` may not fit
    return largest / levels if largest > 0 else 1.0


def encode_features(codes: np.ndarray) -> np.ndarray:
    """Codes that need not be whole [n_vertices, n_stored] as signed bytes, rounded to nearest."""
    whole = np.empty(codes.shape, np.int8)
    for first in range(0, len(codes), ROWS_AT_ONCE):
        rows = slice(first, first + ROWS_AT_ONCE)
        whole[rows] = np.clip(np.rint(codes[rows]), -127, 127)
    return whole
