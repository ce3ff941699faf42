"""Circles in slices: RANSAC seeds, then a geometric fit with residuals along the viewing ray (see ``ray``)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from services.common.kernels import solve_positive
from services.detector.config import DetectorConfig
from services.detector.halves import both_halves
from services.detector.model import Floats, Ints
from services.detector.ray import point_sigma, residual
from services.detector.seeds import GOOD, best_seed, circle_score
from services.detector.voxels import Slices

Floats32 = NDArray[np.float32]
Ints32 = NDArray[np.int32]

_COLUMNS = 10
"""layer, x, y, z, radius, noise, points on, points inside, arc, range."""
_PER_CLUSTER = 5
_MOST = 120
"""Points of one circle that its fit uses at most: slices only propose, the joint fit of the trunk uses all."""
BINS = 36
"""Bins of the arc coverage, 10 degrees each."""
_PLENTY = 120
_SKIP = 4
"""Of a cluster of so many points every second is taken, of twice as many every third, of more every fourth."""
_TURNS = 4
_CLOSE_M = 1e-3
"""A step of this size ends the fit."""
_SURE = 12.0
"""A circle from below with such a score, and as good as it was there, needs no rival."""


@njit(cache=True, nogil=True)
def _neighbourhood(P: Floats, S: Floats, left: Ints, n: int, c: Floats, near: Ints) -> int:
    """List at most ``len(near)`` evenly taken points that the circle ``c`` might reach in the fit."""
    found = 0
    for q in range(n):
        i = left[q]
        d = np.sqrt((P[i, 0] - c[0]) ** 2 + (P[i, 1] - c[1]) ** 2)
        found += 1 if abs(d - c[2]) < 0.05 + 0.3 * c[2] + 2.0 * S[i] else 0
    every = 1 + (found - 1) // near.shape[0] if found > 0 else 1
    seen, m = 0, 0
    for q in range(n):
        i = left[q]
        d = np.sqrt((P[i, 0] - c[0]) ** 2 + (P[i, 1] - c[1]) ** 2)
        if abs(d - c[2]) < 0.05 + 0.3 * c[2] + 2.0 * S[i]:
            if seen % every == 0 and m < near.shape[0]:
                near[m] = i
                m += 1
            seen += 1
    return m


@njit(cache=True, nogil=True)
def _normal_step(J: Floats, m: int, e: Floats, sigma: Floats, scale: float, x: Floats) -> None:
    """Write the Gauss-Newton step of the circle to ``x`` (Tukey weights, a little damping)."""
    A, y = np.zeros((3, 3)), np.zeros(3)
    for q in range(m):
        t = e[q] / (4.0 * scale)
        if abs(t) >= 1.0:
            continue
        w = (1.0 - t * t) ** 2 / sigma[q]
        for a in range(3):
            y[a] -= w * e[q] * J[q, a]
            for b in range(a + 1):
                A[a, b] += w * J[q, a] * J[q, b] / sigma[q]
    for a in range(3):
        A[a, a] = A[a, a] * (1.0 + 1e-3) + 1e-6
    solve_positive(A, y, x)


@njit(cache=True, nogil=True)
def _refine(
    P: Floats, U: Floats, G: Floats, near: Ints, m: int, c: Floats, k_range: float, surface: float, r_min: float, r_max: float
) -> float:  # fmt: skip
    """Fit the circle ``c`` robustly (Gauss-Newton, Tukey weights on normalised residuals); return the scale factor.

    The scale factor multiplies the expected noise of each point to give the observed one.
    """
    J, x = np.empty((m, 3)), np.empty(3)
    e, sigma, size = np.empty(m), np.empty(m), np.empty(m)
    scale = 3.0
    for _ in range(_TURNS):
        held = 0
        for q in range(m):
            i = near[q]
            ray = U[i, 0] != 0.0 or U[i, 1] != 0.0
            s = ((c[0] - P[i, 0]) * U[i, 1] - (c[1] - P[i, 1]) * U[i, 0]) / c[2]
            sigma[q] = point_sigma(s, G[i], ray, k_range, surface)
            e[q] = residual(P[i, 0], P[i, 1], U[i, 0], U[i, 1], c[0], c[1], c[2], J[q]) / sigma[q]
            if abs(e[q]) < 4.5 * scale:
                size[held] = abs(e[q])
                held += 1
        if held < 4:
            return -1.0
        scale = max(1.0, 1.4826 * np.median(size[:held]))
        _normal_step(J, m, e, sigma, scale, x)
        step = np.sqrt(x[0] ** 2 + x[1] ** 2 + x[2] ** 2)
        limit = min(1.0, 0.5 * c[2] / max(step, 1e-12))
        for a in range(3):
            c[a] += limit * x[a]
        c[2] = min(max(c[2], 0.5 * r_min), 1.5 * r_max)
        if step < _CLOSE_M:
            break
    return scale


@njit(cache=True, nogil=True)
def _judge(
    P: Floats, U: Floats, G: Floats, left: Ints, n: int, c: Floats, scale: float, k_range: float, surface: float, out: Floats,
    taken: Ints,
) -> int:  # fmt: skip
    """Fill a row: circle, noise, points on it, points inside it, arc. Mark what it takes away; return the points on it."""
    bins = np.zeros(BINS, dtype=np.bool_)
    on, inside, z, noise = 0, 0, 0.0, 0.0
    J = np.empty(3)
    for q in range(n):
        i = left[q]
        dx, dy = P[i, 0] - c[0], P[i, 1] - c[1]
        ray = U[i, 0] != 0.0 or U[i, 1] != 0.0
        s = (-dx * U[i, 1] + dy * U[i, 0]) / c[2]
        sigma = scale * point_sigma(s, G[i], ray, k_range, surface)
        e = residual(P[i, 0], P[i, 1], U[i, 0], U[i, 1], c[0], c[1], c[2], J)
        taken[q] = 0
        if abs(e) < 3.0 * sigma and dx * U[i, 0] + dy * U[i, 1] <= 0.4 * c[2] + sigma:
            on += 1
            z += P[i, 2]
            noise += e * e
            angle = np.arctan2(dy, dx)
            bins[min(BINS - 1, int((angle + np.pi) / (2.0 * np.pi) * BINS))] = True
            taken[q] = 1
        elif dx * dx + dy * dy < (c[2] + sigma) ** 2:
            inside += 1
            taken[q] = 1
    covered = 0
    for b in range(BINS):
        covered += 1 if bins[b] or (bins[b - 1] and bins[(b + 1) % BINS]) else 0
    out[1], out[2], out[4] = c[0], c[1], c[2]
    out[3] = z / max(on, 1)
    out[5] = np.sqrt(noise / max(on, 1))
    out[6], out[7] = on, inside
    out[8] = covered * 2.0 * np.pi / BINS
    return on


@njit(cache=True, nogil=True)
def _load(
    xyz: Floats32, view: Ints32, origins: Floats, begin: int, end: int, every: int, k_range: float, surface: float,
    spacing: float, P: Floats, U: Floats, G: Floats, S: Floats,
) -> int:  # fmt: skip
    """Copy a cluster's points, unit rays in the plan, ranges, and how far a point may be from a seed circle."""
    q = 0
    with_views = view.shape[0] > 0
    for v in range(begin, end, every):
        for a in range(3):
            P[q, a] = xyz[v, a]
        U[q, 0], U[q, 1], G[q] = 0.0, 0.0, 0.0
        if with_views:
            rx, ry, rz = P[q, 0] - origins[view[v], 0], P[q, 1] - origins[view[v], 1], P[q, 2] - origins[view[v], 2]
            flat = np.sqrt(rx * rx + ry * ry)
            G[q] = np.sqrt(flat * flat + rz * rz)
            if flat > 1e-6:
                U[q, 0], U[q, 1] = rx / flat, ry / flat
        S[q] = 2.0 * np.sqrt((k_range * G[q] ** 2) ** 2 + surface * surface) + 0.25 * spacing
        q += 1
    return q


@njit(cache=True, nogil=True)
def _from_below(
    P: Floats, U: Floats, S: Floats, left: Ints, n: int, known: Floats, rows: int, level: float, best: Floats
) -> bool:
    """Try the circles of the two slices below (rows of ``known``): most trunks go on. Tell whether one is good enough."""
    x0, x1, y0, y1 = 1e30, -1e30, 1e30, -1e30
    for q in range(n):
        i = left[q]
        x0, x1 = min(x0, P[i, 0]), max(x1, P[i, 0])
        y0, y1 = min(y0, P[i, 1]), max(y1, P[i, 1])
    top, enough = 0.0, 1e30
    for k in range(rows - 1, -1, -1):
        if known[k, 0] < level - 2.0:
            break
        r = known[k, 4]
        if known[k, 0] >= level or not (x0 - r < known[k, 1] < x1 + r and y0 - r < known[k, 2] < y1 + r):
            continue
        c = np.array([known[k, 1], known[k, 2], r])
        score = circle_score(P, U, S, left, n, c, top)
        if score > top:
            top, enough = score, GOOD * known[k, 6]
            best[:] = c
    return top > min(GOOD * n, max(enough, _SURE))


@njit(cache=True, nogil=True)
def _circles_of_cluster(
    P: Floats, U: Floats, G: Floats, S: Floats, n: int, k_range: float, surface: float, r_min: float, r_max: float,
    min_points: int, trials: int, state: Ints, known: Floats, before: int, level: float, out: Floats,
) -> int:  # fmt: skip
    """Take circle after circle out of a cluster; fill rows of ``out`` and return their number."""
    left, taken, near = np.arange(n), np.empty(n, dtype=np.int64), np.empty(_MOST, dtype=np.int64)
    circle = np.empty(3)
    rows, first = 0, n
    while rows < out.shape[0] and n >= max(min_points, 0.1 * first):
        sure = _from_below(P, U, S, left, n, known, before, level, circle)
        if not sure and best_seed(P, U, S, left, n, state, trials, r_min, r_max, circle) < 0.5 * min_points:
            break
        m = _neighbourhood(P, S, left, n, circle, near)
        scale = _refine(P, U, G, near, m, circle, k_range, surface, r_min, r_max)
        if scale < 0.0:
            break
        on = _judge(P, U, G, left, n, circle, scale, k_range, surface, out[rows], taken)
        out[rows, 0] = level
        out[rows, 9] = G[left[0]]
        good = on >= min_points and r_min <= circle[2] <= r_max
        rows += 1 if good else 0
        kept = 0
        for q in range(n):
            if taken[q] == 0:
                left[kept] = left[q]
                kept += 1
        if kept == n:
            break
        n = kept
    return rows


@njit(cache=True, nogil=True)
def _all_slices(
    xyz: Floats32, view: Ints32, origins: Floats, begin: Ints, from_cluster: int, to_cluster: int, z_low: float,
    layer_m: float, k_range: float, surface: float, spacing: float, r_min: float, r_max: float, min_points: int, trials: int,
    seed: int, out: Floats,
) -> int:  # fmt: skip
    rows, largest = 0, 0
    for c in range(from_cluster, to_cluster):
        largest = max(largest, begin[c + 1] - begin[c])
    P, U, G, S = np.empty((largest, 3)), np.empty((largest, 2)), np.empty(largest), np.empty(largest)
    state = np.empty(1, dtype=np.int64)
    for c in range(from_cluster, to_cluster):
        size = begin[c + 1] - begin[c]
        if size < min_points:
            continue
        state[0] = seed + 7919 * c
        every = min(_SKIP, 1 + size // _PLENTY)
        n = _load(xyz, view, origins, begin[c], begin[c + 1], every, k_range, surface, spacing, P, U, G, S)
        tries = trials if size < 3 * _PLENTY else 2 * trials
        level = np.floor((P[0, 2] - z_low) / layer_m)
        room = out[rows : min(rows + _PER_CLUSTER, out.shape[0])]
        rows += _circles_of_cluster(
            P, U, G, S, n, k_range, surface, r_min, r_max, min_points, tries, state, out, rows, level, room
        )  # fmt: skip
    return rows


@dataclass(frozen=True, slots=True)
class Circles:
    """Circles of all slices, one row each."""

    layer: Ints
    xyz_m: Floats
    """(K, 3) centre and mean height of the points, upright frame."""
    radius_m: Floats
    noise_m: Floats
    on: Ints
    inside: Ints
    arc_rad: Floats
    range_m: Floats


def fit_slices(slices: Slices, low: Floats, config: DetectorConfig) -> Circles:
    """Return the circles found in every cluster of every slice (several where a cluster holds several)."""
    begin, voxels = slices.begin, slices.voxels
    last = len(begin) - 1
    ends = ((0, slices.split), (slices.split, last))
    outs: list[Floats] = [np.zeros((0, _COLUMNS)), np.zeros((0, _COLUMNS))]

    def work(half: int) -> None:
        first, end = ends[half]
        clusters = int(np.count_nonzero(np.diff(begin[first : end + 1]) >= config.min_slice_points))
        out = np.zeros((_PER_CLUSTER * clusters + 8, _COLUMNS))
        rows = _all_slices(
            voxels.xyz_m, voxels.view, voxels.origins_m, begin, first, end, float(low[2]), slices.layer_m, config.range_noise_per_m,
            config.surface_noise_m, slices.spacing_m, config.min_radius_m, config.max_radius_m, config.min_slice_points,
            config.trials, config.seed, out,
        )  # fmt: skip
        outs[half] = out[: int(rows)]

    both_halves(work, 20 * len(voxels.xyz_m))
    out = np.concatenate(outs)
    keep = (out[:, 7] <= 0.6 * out[:, 6]) & (out[:, 8] >= 0.7 * config.min_arc_rad)
    keep &= (out[:, 5] <= 0.5 * out[:, 4]) | (out[:, 9] > 0.0)
    out = out[keep]
    return Circles(
        out[:, 0].astype(np.int64), np.ascontiguousarray(out[:, 1:4]), np.ascontiguousarray(out[:, 4]), out[:, 5].copy(),
        out[:, 6].astype(np.int64), out[:, 7].astype(np.int64), out[:, 8].copy(), out[:, 9].copy(),
    )  # fmt: skip
