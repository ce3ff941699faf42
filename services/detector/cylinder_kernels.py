"""Kernels of the joint fit of one trunk: its points in the frame of its axis, robust Gauss-Newton, what lies around."""

from __future__ import annotations

import numpy as np
from numba import njit

from services.common.kernels import solve_positive
from services.detector.arcs import BINS
from services.detector.model import Floats, Ints
from services.detector.ray import point_sigma, residual

_TURNS = 12
_MOST = (500, 1500)
"""Points that the first and the second turn of a fit use at most."""


@njit(cache=True, nogil=True)
def _near(
    xyz: Floats, x: float, y: float, z: float, sx: float, sy: float, reach: float, z0: float, z1: float, out: Ints
) -> int:
    """List the voxels between two heights that are nearer to a lean line than ``reach``."""
    n = 0
    for i in range(xyz.shape[0]):
        dz = xyz[i, 2] - z
        dx, dy = xyz[i, 0] - x - sx * dz, xyz[i, 1] - y - sy * dz
        if dx * dx + dy * dy < reach * reach and z0 <= xyz[i, 2] <= z1:
            out[n] = i
            n += 1
    return n


@njit(cache=True, nogil=True)
def to_upright(sx: float, sy: float, R: Floats) -> None:
    """Write the rotation that turns the direction (sx, sy, 1) upright (Rodrigues)."""
    length = np.sqrt(1.0 + sx * sx + sy * sy)
    vx, vy, c = sy / length, -sx / length, 1.0 / length
    f = 1.0 / (1.0 + c)
    R[0, 0], R[0, 1], R[0, 2] = 1.0 - f * vy * vy, f * vx * vy, vy
    R[1, 0], R[1, 1], R[1, 2] = f * vx * vy, 1.0 - f * vx * vx, -vx
    R[2, 0], R[2, 1], R[2, 2] = -vy, vx, c


@njit(cache=True, nogil=True)
def _axis_frame(
    xyz: Floats, ray: Floats, near: Ints, n: int, every: int, at: Floats, sx: float, sy: float, reach: float, R: Floats,
    P: Floats, U: Floats, G: Floats,
) -> int:  # fmt: skip
    """Write points, unit rays in the plan and ranges of every so many near voxels in the frame whose z is the axis."""
    m = 0
    to_upright(sx, sy, R)
    seen = 0
    for q in range(n):
        v = near[q]
        dx, dy, dz = xyz[v, 0] - at[0], xyz[v, 1] - at[1], xyz[v, 2] - at[2]
        ox, oy = dx - sx * dz, dy - sy * dz
        if ox * ox + oy * oy >= reach * reach:
            continue
        seen += 1
        if (seen - 1) % every != 0:
            continue
        for a in range(3):
            P[m, a] = R[a, 0] * dx + R[a, 1] * dy + R[a, 2] * dz
        rx, ry, rz = ray[v, 0], ray[v, 1], ray[v, 2]
        G[m] = np.sqrt(rx * rx + ry * ry + rz * rz)
        ux = R[0, 0] * rx + R[0, 1] * ry + R[0, 2] * rz
        uy = R[1, 0] * rx + R[1, 1] * ry + R[1, 2] * rz
        flat = np.sqrt(ux * ux + uy * uy)
        U[m, 0] = ux / flat if flat > 1e-6 else 0.0
        U[m, 1] = uy / flat if flat > 1e-6 else 0.0
        m += 1
    return m


@njit(cache=True, nogil=True)
def _residuals(
    P: Floats, U: Floats, G: Floats, x: Floats, k_range: float, surface: float, e: Floats, sigma: Floats, J: Floats
) -> None:
    """Write each point's residual as a share of its expected noise, that noise, and the residual's derivatives."""
    for i in range(P.shape[0]):
        z = P[i, 2]
        cx, cy, r = x[0] + x[2] * z, x[1] + x[3] * z, max(x[4] + x[5] * z, 0.005)
        s = ((cx - P[i, 0]) * U[i, 1] - (cy - P[i, 1]) * U[i, 0]) / r
        sigma[i] = point_sigma(s, G[i], U[i, 0] != 0.0 or U[i, 1] != 0.0, k_range, surface)
        e[i] = residual(P[i, 0], P[i, 1], U[i, 0], U[i, 1], cx, cy, r, J[i]) / sigma[i]


@njit(cache=True, nogil=True)
def _robust_scale(e: Floats, scale: float) -> float:
    """Return the spread of the residuals near zero (median absolute deviation), at least 1; -1 when too few are near."""
    near = 0
    size = np.empty(e.shape[0])
    for i in range(e.shape[0]):
        if abs(e[i]) < 4.5 * scale:
            size[near] = abs(e[i])
            near += 1
    return max(1.0, 1.4826 * np.median(size[:near])) if near >= 10 else -1.0


@njit(cache=True, nogil=True)
def _normal_equations(
    P: Floats, J: Floats, weight: float, e: Floats, sigma: Floats, scale: float, A: Floats, y: Floats
) -> None:
    """Sum the weighted normal matrix and its right side."""
    K = np.empty(6)
    A[:] = 0.0
    y[:] = 0.0
    for i in range(P.shape[0]):
        t = e[i] / (4.0 * scale)
        if abs(t) >= 1.0:
            continue
        z = P[i, 2]
        K[0], K[1], K[2], K[3], K[4], K[5] = J[i, 0], J[i, 1], J[i, 0] * z, J[i, 1] * z, J[i, 2], J[i, 2] * z
        w = weight * (1.0 - t * t) ** 2 / (scale * scale * sigma[i])
        for a in range(6):
            y[a] -= w * e[i] * K[a]
            for b in range(a + 1):
                A[a, b] += w * K[a] * K[b] / sigma[i]
    for a in range(6):
        for b in range(a):
            A[b, a] = A[a, b]


@njit(cache=True, nogil=True)
def _fit(
    P: Floats, U: Floats, G: Floats, weight: float, x: Floats, k_range: float, surface: float, start: float,
    prior: Floats, normal: Floats,
) -> float:  # fmt: skip
    """Improve ``x`` = (cx, cy, slope x, slope y, radius, taper) in the axis frame; return the scale factor.

    ``prior`` (6, 2) holds mean and inverse variance of each parameter; ``normal`` receives the normal matrix.
    """
    A, y, step = np.empty((6, 6)), np.empty(6), np.empty(6)
    e, sigma, J = np.empty(P.shape[0]), np.empty(P.shape[0]), np.empty((P.shape[0], 3))
    scale = start
    for _ in range(_TURNS):
        _residuals(P, U, G, x, k_range, surface, e, sigma, J)
        scale = _robust_scale(e, scale)
        if scale < 0.0:
            return -1.0
        _normal_equations(P, J, weight, e, sigma, scale, A, y)
        for a in range(6):
            A[a, a] += prior[a, 1]
            y[a] += prior[a, 1] * (prior[a, 0] - x[a])
        normal[:] = A
        solve_positive(A, y, step)
        size = np.sqrt(step[0] ** 2 + step[1] ** 2 + step[4] ** 2)
        limit = min(1.0, 0.3 * x[4] / max(size, 1e-12))
        for a in range(6):
            x[a] += limit * step[a]
        x[4] = max(x[4], 0.008)
        if size < 5e-5:
            break
    return scale


@njit(cache=True, nogil=True)
def assess(
    P: Floats, U: Floats, G: Floats, x: Floats, scale: float, k_range: float, surface: float, on: Ints, counts: Floats,
    bands: Ints, z_low: float,
) -> None:  # fmt: skip
    """Fill counts: on, inside, around, arc, noise, mean range, core, skin. Mark the points on the surface; count them per band."""
    bins = np.zeros(BINS)
    J = np.empty(3)
    counts[:] = 0.0
    for i in range(P.shape[0]):
        z = P[i, 2]
        cx, cy, r = x[0] + x[2] * z, x[1] + x[3] * z, max(x[4] + x[5] * z, 0.005)
        dx, dy = P[i, 0] - cx, P[i, 1] - cy
        ray = U[i, 0] != 0.0 or U[i, 1] != 0.0
        s = (dy * U[i, 0] - dx * U[i, 1]) / r
        sigma = scale * point_sigma(s, G[i], ray, k_range, surface)
        e = residual(P[i, 0], P[i, 1], U[i, 0], U[i, 1], cx, cy, r, J)
        d = np.sqrt(dx * dx + dy * dy)
        if d < 0.6 * r:
            counts[6] += 1
        elif 0.8 * r < d < 1.2 * r:
            counts[7] += 1
        on[i] = 0
        if abs(e) < 3.0 * sigma:
            on[i] = 1
            counts[0] += 1
            counts[4] += e * e
            counts[5] += G[i]
            bins[min(BINS - 1, int((np.arctan2(dy, dx) + np.pi) / (2.0 * np.pi) * BINS))] += 1.0
            band = int((z - z_low) / 0.1)
            if 0 <= band < bands.shape[0]:
                bands[band] += 1
        elif d < r:
            counts[1] += 1
        elif d < r + 0.1:
            counts[2] += 1
    few = 0.02 * counts[0] / 10.0
    for b in range(BINS):
        if bins[b] > few:
            counts[3] += 2.0 * np.pi / BINS
    if counts[0] > 0:
        counts[4] = np.sqrt(counts[4] / counts[0])
        counts[5] /= counts[0]


@njit(cache=True, nogil=True)
def girth_correction(P: Floats, x: Floats) -> float:
    """Return what to add to the radius so that every direction counts alike, not every point.

    Trunks are not round and scans are denser on one side; a tape goes round all sides. Mean over 36 sectors of the
    median residual; sectors with fewer than 8 points count as the fitted circle.
    """
    n = P.shape[0]
    e, sector = np.empty(n), np.full(n, -1)
    for i in range(n):
        z = P[i, 2]
        dx, dy = P[i, 0] - x[0] - x[2] * z, P[i, 1] - x[1] - x[3] * z
        e[i] = np.sqrt(dx * dx + dy * dy) - (x[4] + x[5] * z)
        if abs(e[i]) < min(0.08, 0.5 * x[4]):
            sector[i] = min(BINS - 1, int((np.arctan2(dy, dx) + np.pi) / (2.0 * np.pi) * BINS))
    total, own = 0.0, np.empty(n)
    for b in range(BINS):
        m = 0
        for i in range(n):
            if sector[i] == b:
                own[m] = e[i]
                m += 1
        total += np.median(own[:m]) if m >= 8 else 0.0
    return total / BINS


@njit(cache=True, nogil=True)
def fit_axis(
    xyz: Floats, ray: Floats, at: Floats, slope: Floats, radius: float, margin: float, z0: float, z1: float, scale: float,
    correlated: float, k_range: float, surface: float, prior: Floats, normal: Floats, x: Floats,
) -> tuple[float, Floats, Floats, Floats]:  # fmt: skip
    """Fit twice, the second time around the first answer with more points.

    ``at`` (3,) and ``slope`` (2,) are moved to the axis found; ``x`` and ``normal`` are those of the last turn. Returns
    the scale (-1: no fit) and the last turn's points, unit rays in the plan and ranges.
    """
    reach = radius + margin
    near = np.empty(xyz.shape[0], dtype=np.int64)
    n = _near(xyz, at[0], at[1], at[2], slope[0], slope[1], reach + 0.05, z0, z1, near)
    P, U, G, R = np.empty((n, 3)), np.empty((n, 2)), np.empty(n), np.empty((3, 3))
    x[:] = 0.0
    x[4], x[5] = radius, prior[5, 0]
    first, m = radius, 0
    for turn in range(2):
        every = 1 + n // _MOST[turn]
        m = _axis_frame(xyz, ray, near, n, every, at, slope[0], slope[1], radius + margin, R, P, U, G)
        if m * every < 15:
            return -1.0, P[:0], U[:0], G[:0]
        x[:4] = 0.0
        scale = _fit(P[:m], U[:m], G[:m], every / correlated, x, k_range, surface, scale, prior, normal)
        if scale < 0.0 or not 0.01 <= x[4] <= 1.5:
            return -1.0, P[:0], U[:0], G[:0]
        axis = R.T @ np.array([x[2], x[3], 1.0])
        at += R.T @ np.array([x[0], x[1], 0.0])
        slope[0], slope[1] = axis[0] / axis[2], axis[1] / axis[2]
        radius = x[4]
        if np.hypot(slope[0], slope[1]) > 1.5 or abs(radius - first) > 0.35 * first + 0.01:
            return -1.0, P[:0], U[:0], G[:0]
    if not U[:m].any():  # no views: the girth of a scanned ring wants all of its points
        whole, P, U, G = x.copy(), np.empty((n, 3)), np.empty((n, 2)), np.empty(n)
        m = _axis_frame(xyz, ray, near, n, 1, at, slope[0], slope[1], radius + margin, R, P, U, G)
        x[:4] = 0.0
        whole[:4] = 0.0
        x[4] += girth_correction(P[:m], whole)
    return scale, P[:m].copy(), U[:m].copy(), G[:m].copy()
