"""Samples of rays through contracted space, chosen by densities that are kept in a grid of it.

Letters: as in `player.march.contracted`, a place on a ray is an angle phi: with p the ray's point nearest to
the origin, at t = t_p, and w = max(1, |p|), t = t_p + w tan(phi), and the point is (p cos(phi) + w d
sin(phi)) / cos(phi). A ray is cut into steps of equal angle, from `near` to almost pi/2; in contracted space
they are about equally long. The grid gives a step an optical depth, at most `most_depth`; the step is dead if
that is below `threshold`, and live otherwise.

Along the live steps a ray gathers mass: T (1 - exp(-depth)) a step, at least `floor`, T being what the
samples so far let through. There is a sample wherever another `mass` is full, the first after a random share
of one. This is the inverse of a distribution function, taken as the ray goes: samples are dense where the
grid says that the weight is, and what the grid takes for opaque is looked behind as long as the field itself
lets light through. A sample stands for the length `mass` / rate, the rate being the mass of a model unit
there, so the sum of sigma delta is the integral of sigma over the live steps, on the average over the random
share, however wrong the grid is.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import prange

from vfr_bake.kernels import njit
from vfr_bake.kernels.density import look_up
from vfr_bake.kernels.hash_grid import FLAGS, cell_of

END = 1e-3
"""Rays end so many radians before pi/2: a thousand model units behind the point nearest to the origin."""


class Pace(NamedTuple):
    """How samples follow from densities; numbers of the rays' type."""

    near: np.floating
    """Where rays begin, model units from their origins."""
    step: np.floating
    """Longest step, radians."""
    threshold: np.floating
    """Optical depth below which a step is dead."""
    most_depth: np.floating
    """Optical depth that the grid gives a step at most."""
    mass: np.floating
    """Mass from one sample to the next."""
    floor: np.floating
    """Mass of a live step, at least."""


class Found(NamedTuple):
    """Room for `n` samples on each ray; ray r's are the rows from r n on."""

    t_mid: np.ndarray
    """[n_rays * n]."""
    deltas: np.ndarray
    """[n_rays * n] lengths that the samples stand for, model units."""
    points: np.ndarray
    """[n_rays * n, 3] in the unit cube."""
    features: np.ndarray
    """[n_rays * n, n_channels]."""
    sigmas: np.ndarray
    """[n_rays * n]."""
    angles: np.ndarray
    """[n_rays * n] phi."""
    widths: np.ndarray
    """[n_rays * n] radians that the samples stand for."""


@njit(fastmath=FLAGS, error_model="numpy")
def ray_frame(rays_o, rays_d, ray, near, end):
    """(p, t_p, w, phi where the ray begins and where it ends), computed in float64: a camera may be far."""
    ox, oy, oz = np.float64(rays_o[ray, 0]), np.float64(rays_o[ray, 1]), np.float64(rays_o[ray, 2])
    dx, dy, dz = np.float64(rays_d[ray, 0]), np.float64(rays_d[ray, 1]), np.float64(rays_d[ray, 2])
    t_p = -(ox * dx + oy * dy + oz * dz)
    px, py, pz = ox + t_p * dx, oy + t_p * dy, oz + t_p * dz
    w = max(1.0, np.sqrt(px * px + py * py + pz * pz))
    last = 0.5 * np.pi - end
    first = min(np.arctan((near - t_p) / w), last)
    kind = rays_o.dtype.type
    return kind(px), kind(py), kind(pz), kind(t_p), kind(w), kind(first), kind(last)


@njit(inline="always")
def unit_point(vx, vy, vz, cos):
    """The point of the unit cube for the point v / cos of the model frame; cos > 0."""
    kind = type(cos)
    one, two, quarter, half = kind(1), kind(2), kind(0.25), kind(0.5)
    norm = np.sqrt(vx * vx + vy * vy + vz * vz)
    scale = quarter * (one / cos if norm <= cos else (two - cos / norm) / norm)
    return vx * scale + half, vy * scale + half, vz * scale + half


@njit(fastmath=FLAGS, error_model="numpy")
def _march_ray(rays_o, rays_d, ray, jitter, pace, densities, field, limits, n, hidden, found):
    """Write at most `n` samples of a ray to the rows from ray n on of what is `found`; returns how many."""
    kind = rays_o.dtype.type
    one, half, end = kind(1), kind(0.5), kind(END)
    near, longest, threshold, most_depth, mass, floor = pace
    t_mid, deltas, points, features, sigmas, angles, widths = found
    cells, last = kind(densities.shape[0]), np.int32(densities.shape[0] - 1)
    px, py, pz, t_p, w, phi_0, phi_1 = ray_frame(rays_o, rays_d, ray, near, end)
    dx, dy, dz = w * rays_d[ray, 0], w * rays_d[ray, 1], w * rays_d[ray, 2]
    n_steps = max(np.int64((phi_1 - phi_0) / longest), 1)
    step = (phi_1 - phi_0) / kind(n_steps)
    cos, sin = np.cos(phi_0 + half * step), np.sin(phi_0 + half * step)
    cos_step, sin_step = np.cos(step), np.sin(step)
    cos_half, sin_half = np.cos(half * step), np.sin(half * step)
    count = 0
    tau, trans = kind(0), one
    gathered, goal = kind(0), mass * jitter[ray]
    for i in range(n_steps):
        c = max(cos, end)
        x, y, z = unit_point(c * px + sin * dx, c * py + sin * dy, c * pz + sin * dz, c)
        before, behind = cos * cos_half + sin * sin_half, cos * cos_half - sin * sin_half
        way = w * sin_step / (max(before, end) * max(behind, end))
        cos, sin = cos * cos_step - sin * sin_step, sin * cos_step + cos * sin_step
        cell = densities[cell_of(x * cells, last), cell_of(y * cells, last), cell_of(z * cells, last)]
        depth = min(cell * way, most_depth)
        if depth < threshold:
            continue
        alpha, left = -np.expm1(-depth), one
        while True:
            rate = max(trans * alpha, floor)
            if not gathered + rate * left >= goal:
                gathered += rate * left
                break
            left -= (goal - gathered) / rate
            gathered, goal = kind(0), mass
            phi = phi_0 + (kind(i) + one - left) * step
            k = ray * n + count
            c, s = max(np.cos(phi), end), np.sin(phi)
            x, y, z = unit_point(c * px + s * dx, c * py + s * dy, c * pz + s * dz, c)
            sigma = look_up(x, y, z, field, limits, features[k], hidden)
            t_mid[k] = t_p + w * s / c
            deltas[k] = way * mass / rate
            points[k, 0], points[k, 1], points[k, 2] = x, y, z
            sigmas[k] = sigma
            angles[k] = phi
            widths[k] = step * mass / rate
            tau += sigma * deltas[k]
            trans = np.exp(-tau)
            count += 1
            if count == n or not tau <= limits.opaque_depth:
                return count
    return count


@njit(parallel=True, cache=True, fastmath=FLAGS, error_model="numpy")
def march_space(rays_o, rays_d, jitter, pace, densities, field, limits, n, counts, found):
    """At most `n` samples of each ray, up to where it is opaque: `counts` [n_rays] and what is `found`.

    `jitter` [n_rays] in [0, 1): the share of `mass` that is gathered before a ray's first sample.
    """
    block = 16
    n_rays = rays_o.shape[0]
    for start in prange((n_rays + block - 1) // block):
        hidden = np.zeros(field.b1.shape[0], rays_o.dtype)
        for ray in range(start * block, min((start + 1) * block, n_rays)):
            counts[ray] = _march_ray(
                rays_o, rays_d, ray, jitter, pace, densities, field, limits, n, hidden, found
            )  # fmt: skip


@njit(cache=True, fastmath=FLAGS, error_model="numpy")
def gather(points, sigmas, sums, counts):
    """Add `sigmas` [n_points] to `sums` [n, n, n], and 1 to `counts` [n, n, n], in the cells in which
    `points` [n_points, 3] of the unit cube lie; all that are not numbers are left out."""
    cells, last = points.dtype.type(sums.shape[0]), np.int32(sums.shape[0] - 1)
    for k in range(points.shape[0]):
        if not sigmas[k] == sigmas[k]:
            continue
        x, y, z = (
            cell_of(points[k, 0] * cells, last),
            cell_of(points[k, 1] * cells, last),
            cell_of(points[k, 2] * cells, last),
        )
        sums[x, y, z] += sigmas[k]
        counts[x, y, z] += sums.dtype.type(1)


@njit(parallel=True, cache=True, error_model="numpy")
def settle(sums, counts, fall, densities):
    """Move each cell of `densities` [n, n, n] to the mean of what was gathered there, if anything was: at
    once if that is more, and by the share `fall` if it is less; `sums` and `counts` are 0 again."""
    kind = densities.dtype.type
    for x in prange(densities.shape[0]):
        for y in range(densities.shape[1]):
            for z in range(densities.shape[2]):
                n = counts[x, y, z]
                if n == 0:
                    continue
                old, new = densities[x, y, z], sums[x, y, z] / n
                densities[x, y, z] = new if new > old else old + fall * (new - old)
                sums[x, y, z], counts[x, y, z] = kind(0), kind(0)
