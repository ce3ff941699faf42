"""Compiled: the points of all frames near stems, and the radius of one section with its rays."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from services.common.kernels import solve_positive
from services.detector.axis_fit import to_upright
from services.detector.ray import point_sigma, residual

Floats = NDArray[np.float64]
Floats32 = NDArray[np.float32]

ARC_BINS = 36
_TURNS = 12
_LEAST = 30


@njit(cache=True, nogil=True)
def nearest_stem(x: float, y: float, z: float, stems: Floats, reach: float) -> int:
    """Return the row of ``stems`` (S, 8: base, slopes dx/dz dy/dz, radius, low z, high z) within reach of a point, -1: none.

    Of several the one whose surface is nearest.
    """
    best, least = -1, reach
    for s in range(stems.shape[0]):
        if z < stems[s, 6] or z > stems[s, 7]:
            continue
        dz = z - stems[s, 2]
        dx, dy = x - stems[s, 0] - stems[s, 3] * dz, y - stems[s, 1] - stems[s, 4] * dz
        away = np.sqrt(dx * dx + dy * dy) - stems[s, 5]
        if away < least:
            best, least = s, away
    return best


@njit(cache=True, nogil=True)
def section_frame(
    xyz: Floats32,
    frame: NDArray[np.int32],
    origins: Floats,
    at: Floats,
    sx: float,
    sy: float,
    P: Floats,
    U: Floats,
    G: Floats,
) -> None:
    """Write points (N, 3), unit rays in the plan (N, 2) and ranges (N,) in the frame whose z is the axis through ``at``."""
    R = np.empty((3, 3))
    to_upright(sx, sy, R)
    for i in range(xyz.shape[0]):
        o = origins[frame[i]]
        dx, dy, dz = xyz[i, 0] - at[0], xyz[i, 1] - at[1], xyz[i, 2] - at[2]
        rx, ry, rz = xyz[i, 0] - o[0], xyz[i, 1] - o[1], xyz[i, 2] - o[2]
        for a in range(3):
            P[i, a] = R[a, 0] * dx + R[a, 1] * dy + R[a, 2] * dz
        ux = R[0, 0] * rx + R[0, 1] * ry + R[0, 2] * rz
        uy = R[1, 0] * rx + R[1, 1] * ry + R[1, 2] * rz
        flat = max(np.sqrt(ux * ux + uy * uy), 1e-6)
        U[i, 0], U[i, 1] = ux / flat, uy / flat
        G[i] = np.sqrt(rx * rx + ry * ry + rz * rz)


@njit(cache=True, nogil=True)
def fit_section(
    P: Floats, U: Floats, G: Floats, k_range: float, surface: float, centre_sigma: float, correlated: float, x: Floats
) -> int:  # fmt: skip
    """Improve ``x`` = (cx, cy, radius) of one section by robust Gauss-Newton along the rays; return the points on it.

    The centre stays within ``centre_sigma`` of where it is, in which so many ``correlated`` points count as one. 0: no fit.
    """
    n = P.shape[0]
    cx0, cy0 = x[0], x[1]
    J, A, y, step = np.empty(3), np.empty((3, 3)), np.empty(3), np.empty(3)
    size, on = np.empty(n), 0
    scale = 1.5
    for _ in range(_TURNS):
        A[:] = 0.0
        y[:] = 0.0
        m, on = 0, 0
        for i in range(n):
            s = ((x[0] - P[i, 0]) * U[i, 1] - (x[1] - P[i, 1]) * U[i, 0]) / x[2]
            sigma = point_sigma(s, G[i], ray=True, k_range=k_range, surface=surface)
            e = residual(P[i, 0], P[i, 1], U[i, 0], U[i, 1], x[0], x[1], x[2], J) / sigma
            if abs(e) < 4.5 * scale:
                size[m] = abs(e)
                m += 1
            t = e / (4.0 * scale)
            if abs(t) >= 1.0:
                continue
            on += 1 if abs(e) < 3.0 * scale else 0
            w = (1.0 - t * t) ** 2 / (sigma * correlated * scale * scale)
            for a in range(3):
                y[a] -= w * e * J[a]
                for b in range(3):
                    A[a, b] += w * J[a] * J[b] / sigma
        if m < _LEAST:
            return 0
        scale = max(1.0, 1.4826 * np.median(size[:m]))
        hold = 1.0 / (centre_sigma * centre_sigma)
        A[0, 0] += hold
        A[1, 1] += hold
        A[2, 2] += 1e-3
        y[0] += hold * (cx0 - x[0])
        y[1] += hold * (cy0 - x[1])
        solve_positive(A, y, step)
        length = np.sqrt(step[0] ** 2 + step[1] ** 2 + step[2] ** 2)
        limit = min(1.0, 0.3 * x[2] / max(length, 1e-12))
        for a in range(3):
            x[a] += limit * step[a]
        x[2] = max(x[2], 0.008)
        if length < 2e-5:
            break
    return on


@njit(cache=True, nogil=True)
def arc_of(P: Floats, U: Floats, G: Floats, x: Floats, k_range: float, surface: float) -> float:
    """Return the arc (radians) of a section's circle that shows points."""
    bins = np.zeros(ARC_BINS)
    J = np.empty(3)
    total = 0
    for i in range(P.shape[0]):
        s = ((x[0] - P[i, 0]) * U[i, 1] - (x[1] - P[i, 1]) * U[i, 0]) / x[2]
        sigma = point_sigma(s, G[i], ray=True, k_range=k_range, surface=surface)
        if abs(residual(P[i, 0], P[i, 1], U[i, 0], U[i, 1], x[0], x[1], x[2], J)) < 3.0 * sigma:
            angle = np.arctan2(P[i, 1] - x[1], P[i, 0] - x[0])
            bins[min(ARC_BINS - 1, int((angle + np.pi) / (2.0 * np.pi) * ARC_BINS))] += 1.0
            total += 1
    shown = 0
    for b in range(ARC_BINS):
        shown += 1 if bins[b] > 0.02 * total / 10.0 else 0
    return shown * 2.0 * np.pi / ARC_BINS
