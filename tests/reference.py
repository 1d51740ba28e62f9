"""Oracles in float64: slow and readable, written from the formulas and not from the code that they check.

Vectors are rows: y = x @ W + b. Letters are those in the docstrings of the modules under test. Real spherical
harmonics carry the Condon-Shortley phase (-1)^m and are ordered l^2 + l + m, as in instant-ngp.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy import special


def spherical_harmonics(dirs: np.ndarray, degree: int) -> np.ndarray:
    """Return Y [n, degree^2] at unit `dirs` [n, 3], bands 0 .. degree - 1, from angles and associated
    Legendre functions.

    scipy's `lpmv` has the phase (-1)^m; for m < 0 the sine takes the place of the cosine, with the same
    phase.
    """
    cos_theta = np.clip(dirs[:, 2], -1, 1)
    phi = np.arctan2(dirs[:, 1], dirs[:, 0])
    bases = []
    for band in range(degree):
        for m in range(-band, band + 1):
            k = (2 * band + 1) / (4 * np.pi)
            k *= special.factorial(band - abs(m)) / special.factorial(band + abs(m))
            legendre = special.lpmv(abs(m), band, cos_theta)
            circular = np.ones_like(phi)
            if m:
                circular = np.sqrt(2) * (np.cos(m * phi) if m > 0 else np.sin(-m * phi))
            bases.append(np.sqrt(k) * legendre * circular)
    return np.stack(bases, axis=-1)


def gelu(x: np.ndarray) -> np.ndarray:
    """Return x Phi(x), with Phi the distribution function of the normal distribution (the exact form, not the
    approximation with tanh)."""
    return x * special.ndtr(x)


def hard_swish(x: np.ndarray) -> np.ndarray:
    return x * np.clip(x / 6 + 0.5, 0.0, 1.0)


ACTIVATIONS = {"gelu": gelu, "hard_swish": hard_swish}


def evaluate_head(weights: Any, features: np.ndarray, dirs: np.ndarray) -> np.ndarray:
    """Return the rgb [n, 3] of a head (`exporters.head.onnx_head.HeadWeights`) at `features` [n, n_channels]
    and `dirs` [n, 3]."""
    activation = ACTIVATIONS[weights.activation]
    h = np.asarray(features, np.float64)
    for weight, bias in weights.spatial:
        h = activation(h @ weight.astype(np.float64) + bias)
    weight, bias = weights.to_sh
    f = (h @ weight.astype(np.float64) + bias).reshape(len(h), weights.sh_degree**2, weights.n_sh_features)
    y = spherical_harmonics(np.asarray(dirs, np.float64), weights.sh_degree)
    e = (f * y[:, :, None]).reshape(len(h), f.shape[1] * f.shape[2])
    d_bottleneck, d_sh, bias = weights.directional_first
    z = activation(h @ d_bottleneck.astype(np.float64) + e @ d_sh.astype(np.float64) + bias)
    for weight, bias in weights.directional:
        z = activation(z @ weight.astype(np.float64) + bias)
    weight, bias = weights.output
    return special.expit(z @ weight.astype(np.float64) + bias)


def hash_grid_feature(
    point: np.ndarray, table: np.ndarray, resolutions: list[int], offsets: np.ndarray, size: int
) -> np.ndarray:
    """Return the features of one point [3] of the unit cube, computed level by level and corner by corner
    (Mueller et al. 2022, eq. 4).

    `table` [n_entries, 2] float64; a level with more than `size` vertices is hashed into `size` entries.
    """
    out = []
    for resolution, offset in zip(resolutions, offsets, strict=False):
        position = [float(x) * resolution for x in point]
        cell = [min(int(p), resolution - 1) for p in position]
        total = np.zeros(2)
        for corner in np.ndindex(2, 2, 2):
            weight = 1.0
            for axis in range(3):
                inside = position[axis] - cell[axis]
                weight *= inside if corner[axis] else 1 - inside
            x, y, z = (cell[axis] + corner[axis] for axis in range(3))
            side = resolution + 1
            if side**3 > size:
                row = (x ^ (y * 2654435761 % 2**32) ^ (z * 805459861 % 2**32)) % size
            else:
                row = (z * side + y) * side + x
            total += weight * table[offset + row]
        out.append(total)
    return np.concatenate(out)


def composite_ray(sigmas: np.ndarray, features: np.ndarray, step: float) -> tuple[np.ndarray, float]:
    """Evaluate equation 3 of the paper for one ray in float64: return (sum w_i F_i, 1 - exp(-tau))."""
    tau, total = 0.0, np.zeros(features.shape[1])
    for sigma, feature in zip(sigmas.astype(np.float64), features.astype(np.float64), strict=True):
        delta = sigma * step
        total += np.exp(-tau) * -np.expm1(-delta) * feature
        tau += delta
    return total, -np.expm1(-tau)


def contract(point: np.ndarray) -> np.ndarray:
    """Contract a point [3] by equation 10 of mip-NeRF 360; it must be finite."""
    norm = np.linalg.norm(point)
    return point if norm <= 1 else (2 - 1 / norm) * point / norm


def srgb_from_linear(linear: np.ndarray) -> np.ndarray:
    """Convert linear light in [0, 1] to sRGB values in [0, 1], by IEC 61966-2-1."""
    return np.where(linear <= 0.0031308, linear * 12.92, 1.055 * np.maximum(linear, 0) ** (1 / 2.4) - 0.055)
