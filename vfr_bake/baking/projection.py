"""Fewer feature channels, at the least loss for the head.

Compositing is linear, so a linear map of the features can be applied per vertex before it and undone after
it: W1 sum w_i F_i = (W1 U) sum w_i (P F_i). With the second moment G = E[x x^T] of the rendered features x =
sum w_i F_i, the rank-r maps that change the first layer's output least in the mean square are P = A^T W1 and
W1 U = A, where A holds the first r left singular vectors of W1 G^(1/2) (Eckart-Young).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Projection:
    """Stored channels are P F; the head's first layer becomes `first`."""

    matrix: np.ndarray
    """P [n_stored, n_channels]."""
    first: np.ndarray
    """[width, n_stored]; `first @ P` replaces the first layer's weights."""
    kept: float
    """Share of the first layer's mean square output that is kept, in [0, 1]."""


def project(first_layer: np.ndarray, rendered: np.ndarray, n_stored: int) -> Projection:
    """The best projection to `n_stored` channels.

    `first_layer` [width, n_channels] are the head's first weights, `rendered` [n, n_channels] rendered
    features. With all channels kept nothing is lost.

    >>> p = project(np.eye(3), np.diag([3.0, 2.0, 1e-9]), 2)
    >>> bool(np.allclose(p.first @ p.matrix, np.diag([1, 1, 0]), atol=1e-6)), round(p.kept, 6)
    (True, 1.0)
    """
    weights = first_layer.astype(np.float64)
    n_stored = min(n_stored, *weights.shape)
    moment = rendered.astype(np.float64).T @ rendered.astype(np.float64) / max(len(rendered), 1)
    values, vectors = np.linalg.eigh(moment)
    root = vectors * np.sqrt(np.maximum(values, 0))
    left, singular, _ = np.linalg.svd(weights @ root, full_matrices=False)
    basis = left[:, :n_stored]
    energy = singular**2
    kept = float(energy[:n_stored].sum() / energy.sum()) if energy.sum() > 0 else 1.0
    return Projection(basis.T @ weights, basis, kept)


def code_scales(vertex_features: np.ndarray) -> np.ndarray:
    """Step [n_stored] of each channel's signed 8-bit code: its largest magnitude at 127; 1 for a channel of
    zeros.

    >>> code_scales(np.array([[127.0, 0.0], [-254.0, 0.0]])).tolist()
    [2.0, 1.0]
    """
    largest = np.abs(vertex_features).max(axis=0)
    return np.where(largest > 0, largest / 127, 1.0)


def encode_features(vertex_features: np.ndarray, scales: np.ndarray) -> np.ndarray:
    """Signed 8-bit codes [n_vertices, n_stored] of `vertex_features`, rounded to nearest."""
    return np.clip(np.rint(vertex_features / scales), -127, 127).astype(np.int8)
