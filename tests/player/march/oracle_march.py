"""The march and the choice of samples as a naive loop: no skipping, no bricks, no compaction.

The cell of a sample is part of the format and computed in float32, as `player.march.march` says; the rest is
float64.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

F32 = np.float32


@dataclass
class Scene:
    """A grid with the codes and features of its stored vertices, by grid index."""

    resolution: int
    aabb: np.ndarray
    step: float
    density_range: tuple[float, float]
    codes: dict[tuple[int, int, int], int]
    features: dict[tuple[int, int, int], np.ndarray]


@dataclass
class Ray:
    """Result of one ray; `samples` are (s, weight), `fetches` (s, weight) after merging."""

    opacity: float
    depth: float
    taken: int
    features: np.ndarray
    samples: list[tuple[float, float]]
    fetches: list[tuple[float, float]]


def corners(cell: tuple[int, ...]) -> list[tuple[int, int, int]]:
    x, y, z = cell
    return [(x + i, y + j, z + k) for i in (0, 1) for j in (0, 1) for k in (0, 1)]


def interpolate(scene: Scene, g: np.ndarray, values: dict) -> tuple[np.ndarray | float, float]:
    """Return the sum of weight times value over a cell's stored corners, and the sum of their weights."""
    cell = [min(max(math.floor(x), 0), scene.resolution - 1) for x in g]
    total, out = 0.0, 0.0
    for corner in corners(tuple(cell)):
        if corner in values:
            share = math.prod(1 - abs(float(x) - c) for x, c in zip(g, corner, strict=True))
            out, total = out + share * np.asarray(values[corner], np.float64), total + share
    return out, total


def enter(scene: Scene, ray_o: np.ndarray, ray_d: np.ndarray) -> tuple[F32, F32, np.ndarray, np.ndarray]:
    scale = (scene.resolution / (scene.aabb[1] - scene.aabb[0])).astype(F32)
    o, d = (ray_o - scene.aabb[0].astype(F32)) * scale, ray_d * scale
    t_in, t_out = F32(0), F32(np.inf)
    for axis in range(3):
        if d[axis] == 0:
            if not 0 <= o[axis] <= scene.resolution:
                return t_in, F32(-1), o, d
            continue
        a, b = (F32(0) - o[axis]) / d[axis], (F32(scene.resolution) - o[axis]) / d[axis]
        t_in, t_out = max(t_in, min(a, b)), min(t_out, max(a, b))
    return t_in, t_out - t_in, np.clip(o + t_in * d, F32(0), F32(scene.resolution)), d


def march_ray(scene: Scene, ray_o: np.ndarray, ray_d: np.ndarray, k: int) -> Ray:
    t_in, length, e, d = enter(scene, ray_o, ray_d)
    low, high = scene.density_range
    tau, taken, n, samples = 0.0, 0, 0, []
    while (s := (F32(n) + F32(0.5)) * F32(scene.step)) < length:
        n += 1
        g = e + s * d
        cell = tuple(int(min(max(math.floor(x), 0), scene.resolution - 1)) for x in g)
        if not all(corner in scene.codes for corner in corners(cell)):
            continue
        code, _ = interpolate(scene, g, scene.codes)
        optical = math.exp(low + (high - low) * float(code) / 255) * float(F32(scene.step))
        samples.append((float(s), math.exp(-tau) * -math.expm1(-optical)))
        taken += 1
        tau += optical
        if math.exp(-tau) < 1e-3:
            break
    opacity = -math.expm1(-tau)
    samples = [sample for sample in samples if sample[1] > 0]
    if not samples:
        return Ray(opacity, 0.0, taken, np.zeros(0), [], [])
    total = sum(w for _, w in samples)
    depth = float(t_in) + sum(s * w for s, w in samples) / total
    features, fetches = fetch(scene, e.astype(np.float64), d.astype(np.float64), samples, opacity, k)
    return Ray(opacity, depth, taken, features, samples, fetches)


def fetch(
    scene: Scene, e: np.ndarray, d: np.ndarray, samples: list[tuple[float, float]], opacity: float, k: int
) -> tuple[np.ndarray, list[tuple[float, float]]]:
    if k == 0 or len(samples) <= k:
        chosen = [(s, w, s) for s, w in samples]
    else:
        chosen = [(s, opacity / k, heaviest) for s, heaviest in bins(samples, k)]
    out, fetches = 0.0, []
    for s, w, heaviest in chosen:
        value, total = interpolate(scene, e + s * d, scene.features)
        if total < 1e-3:
            s = heaviest
            value, total = interpolate(scene, e + s * d, scene.features)
        out, fetches = out + w * np.asarray(value) / total, [*fetches, (s, w)]
    return np.asarray(out), fetches


def bins(samples: list[tuple[float, float]], k: int) -> list[tuple[float, float]]:
    """Return the centroid and the heaviest sample of each of k bins of equal mass, from the overlap of every
    sample with every bin."""
    share = sum(w for _, w in samples) / k
    out = []
    for j in range(k):
        start, moment, most, heaviest = 0.0, 0.0, 0.0, samples[0][0]
        for s, w in samples:
            part = max(0.0, min(start + w, (j + 1) * share) - max(start, j * share))
            start, moment = start + w, moment + part * s
            if part > most * (1 + 1e-6):
                most, heaviest = part, s
        out.append((moment / share, heaviest))
    return out
