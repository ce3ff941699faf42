"""Kernels of the joint fit of one trunk: its points in the frame of its axis, robust Gauss-Newton, an offset per view.

What one keyframe shows of a trunk lies beside what another shows, as their poses are slam's and the sensor's fixed pattern
goes with the camera. Fitted as one ring that smear makes the trunk thicker (0.7 cm at an error of 1 cm); so each view may
lie a little beside the axis, held to zero by how large such errors are, and the radius is told by what each view shows.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from services.common.kernels import solve_positive
from services.detector.cylinder_kernels import girth_correction
from services.detector.model import Floats, Ints
from services.detector.ray import point_sigma, residual

Floats32 = NDArray[np.float32]
Ints32 = NDArray[np.int32]

_TURNS = (12, 2)
"""Steps of the first and the second fit at most."""
_MOST = (400, 4000)
"""Points that they use at most; with 1000 in the second place of centres was 0.3 cm worse (single scenes, cm: 0.96, 0.68)."""
_SHOWN = 1500
"""About so many points of a trunk with views are handed on to be judged."""
_CLOSE_M = 1e-4
"""A step of this size ends the fit."""
_MOST_VIEWS = 64
_BINS = 90
_NEVER = 1e11
"""Offsets held by such an inverse variance stay zero."""


@njit(cache=True, nogil=True)
def _near(
    xyz: Floats32, x: float, y: float, z: float, sx: float, sy: float, reach: float, z0: float, z1: float, out: Ints
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
def _ray_to(xyz: Floats32, v: int, view: Ints32, origins: Floats, told: Floats, out: Floats) -> None:
    """Write the ray from the eye to a voxel; zero where nothing tells it.

    ``told`` is (kind, x, y): kind 0, the voxel's view tells; 1, (x, y) is the ray for all; 2, (x, y) is the eye in the plan.
    """
    out[:] = 0.0
    if told[0] == 1.0:
        out[0], out[1] = told[1], told[2]
    elif told[0] == 2.0:
        out[0], out[1] = xyz[v, 0] - told[1], xyz[v, 1] - told[2]
    elif view.shape[0] > 0:
        for a in range(3):
            out[a] = xyz[v, a] - origins[view[v], a]


@njit(cache=True, nogil=True)
def _axis_frame(
    xyz: Floats32, view: Ints32, origins: Floats, told: Floats, near: Ints, n: int, every: int, at: Floats, sx: float,
    sy: float, reach: float, R: Floats, P: Floats, U: Floats, G: Floats, W: Ints32,
) -> int:  # fmt: skip
    """Write points, unit rays in the plan, ranges and views of every so many near voxels in the frame whose z is the axis."""
    m = 0
    to_upright(sx, sy, R)
    ray = np.empty(3)
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
        _ray_to(xyz, v, view, origins, told, ray)
        G[m] = np.sqrt(ray[0] ** 2 + ray[1] ** 2 + ray[2] ** 2)
        ux = R[0, 0] * ray[0] + R[0, 1] * ray[1] + R[0, 2] * ray[2]
        uy = R[1, 0] * ray[0] + R[1, 1] * ray[1] + R[1, 2] * ray[2]
        flat = np.sqrt(ux * ux + uy * uy)
        U[m, 0] = ux / flat if flat > 1e-6 else 0.0
        U[m, 1] = uy / flat if flat > 1e-6 else 0.0
        W[m] = view[v] if view.shape[0] > 0 else 0
        m += 1
    return m


@njit(cache=True, nogil=True)
def _number_views(W: Ints32, m: int, number_of: Ints32, known: int) -> int:
    """Exchange views for small numbers, in order of first appearance; return how many there are. Many share the last."""
    for i in range(m):
        v = W[i]
        if number_of[v] < 0:
            number_of[v] = min(known, _MOST_VIEWS - 1)
            known = min(known + 1, _MOST_VIEWS)
        W[i] = number_of[v]
    return known


@njit(cache=True, nogil=True)
def _half_way(bins: Ints, scale: float) -> float:
    """Return the median of absolute residuals counted in bins of ``4.5 scale / len(bins)``; -1 of fewer than ten."""
    total = bins.sum()
    if total < 10:
        return -1.0
    seen, k = 0, 0
    while 2 * (seen + bins[k]) < total:
        seen += bins[k]
        k += 1
    return (k + (0.5 * total - seen) / bins[k]) * 4.5 * scale / bins.shape[0]


@njit(cache=True, nogil=True)
def _gather(
    P: Floats, U: Floats, G: Floats, W: Ints32, offset: Floats, weight: float, x: Floats, k_range: float, surface: float,
    scale: float, A: Floats, y: Floats, bins: Ints,
) -> None:  # fmt: skip
    """Sum each view's normal matrix (lower half) and right side, Tukey weights at ``scale``; count the residuals' sizes."""
    J, K = np.empty(3), np.empty(6)
    A[:] = 0.0
    y[:] = 0.0
    bins[:] = 0
    per_bin = bins.shape[0] / (4.5 * scale)
    for i in range(P.shape[0]):
        z, w = P[i, 2], W[i]
        cx, cy, r = x[0] + offset[w, 0] + x[2] * z, x[1] + offset[w, 1] + x[3] * z, max(x[4] + x[5] * z, 0.005)
        s = ((cx - P[i, 0]) * U[i, 1] - (cy - P[i, 1]) * U[i, 0]) / r
        sigma = point_sigma(s, G[i], U[i, 0] != 0.0 or U[i, 1] != 0.0, k_range, surface)
        e = residual(P[i, 0], P[i, 1], U[i, 0], U[i, 1], cx, cy, r, J)
        t = abs(e) / sigma
        if t < 4.5 * scale:
            bins[min(int(t * per_bin), bins.shape[0] - 1)] += 1
        t /= 4.0 * scale
        if t >= 1.0:
            continue
        K[0], K[1], K[2], K[3], K[4], K[5] = J[0], J[1], J[0] * z, J[1] * z, J[2], J[2] * z
        share = (1.0 - t * t) / (scale * sigma)
        share = weight * share * share
        for a in range(6):
            f = share * K[a]
            y[w, a] -= f * e
            for b in range(a + 1):
                A[w, a, b] += f * K[b]


@njit(cache=True, nogil=True)
def _without_offsets(
    A: Floats, y: Floats, offset: Floats, views: int, held: float, normal: Floats, right: Floats
) -> None:
    """Add the views up with each view's own offset eliminated (Schur complement).

    An offset moves the circle in one view as the centre does in all, so its derivatives are the centre's; ``held`` is the
    inverse variance that ties it to zero.
    """
    normal[:] = 0.0
    right[:] = 0.0
    for w in range(views):
        b00, b10, b11 = A[w, 0, 0] + held, A[w, 1, 0], A[w, 1, 1] + held
        det = b00 * b11 - b10 * b10
        i00, i10, i11 = b11 / det, -b10 / det, b00 / det
        r0, r1 = y[w, 0] - held * offset[w, 0], y[w, 1] - held * offset[w, 1]
        for a in range(6):
            c0, c1 = A[w, a, 0], A[w, a, 1] if a > 0 else A[w, 1, 0]
            g0, g1 = c0 * i00 + c1 * i10, c0 * i10 + c1 * i11
            right[a] += y[w, a] - g0 * r0 - g1 * r1
            for b in range(a + 1):
                normal[a, b] += A[w, a, b] - g0 * A[w, b, 0] - g1 * (A[w, b, 1] if b > 0 else A[w, 1, 0])
    for a in range(6):
        for b in range(a):
            normal[b, a] = normal[a, b]


@njit(cache=True, nogil=True)
def _move_offsets(A: Floats, y: Floats, offset: Floats, views: int, held: float, step: Floats, limit: float) -> None:
    """Let each view's offset follow a step of the trunk."""
    for w in range(views):
        b00, b10, b11 = A[w, 0, 0] + held, A[w, 1, 0], A[w, 1, 1] + held
        det = b00 * b11 - b10 * b10
        r0, r1 = y[w, 0] - held * offset[w, 0], y[w, 1] - held * offset[w, 1]
        for a in range(6):
            r0 -= A[w, a, 0] * step[a]
            r1 -= (A[w, a, 1] if a > 0 else A[w, 1, 0]) * step[a]
        offset[w, 0] += limit * (b11 * r0 - b10 * r1) / det
        offset[w, 1] += limit * (b00 * r1 - b10 * r0) / det


@njit(cache=True, nogil=True)
def fit_views(
    P: Floats, U: Floats, G: Floats, W: Ints32, offset: Floats, views: int, held: float, weight: float, x: Floats,
    k_range: float, surface: float, start: float, prior: Floats, normal: Floats, turns: int,
) -> float:  # fmt: skip
    """Improve ``x`` = (cx, cy, slope x, slope y, radius, taper) in the axis frame, and each view's offset; return the scale.

    The scale multiplies the expected noise to give the observed one. ``prior`` (6, 2) holds mean and inverse variance of
    each parameter; ``normal`` receives the normal matrix.
    """
    A, y, M = np.empty((views, 6, 6)), np.empty((views, 6)), np.empty((6, 6))
    right, step, bins = np.empty(6), np.empty(6), np.empty(_BINS, dtype=np.int64)
    scale, turn, again = start, 0, 2
    while turn < turns:
        _gather(P, U, G, W, offset, weight, x, k_range, surface, scale, A, y, bins)
        half = _half_way(bins, scale)
        if half < 0.0:
            return -1.0
        seen = max(1.0, 1.4826 * half)
        if turn == 0 and again > 0 and abs(seen - scale) > 0.2 * scale:
            scale = seen  # what was gathered had the wrong weights: once more
            again -= 1
            continue
        _without_offsets(A, y, offset, views, held, normal, right)
        for a in range(6):
            normal[a, a] += prior[a, 1]
            right[a] += prior[a, 1] * (prior[a, 0] - x[a])
        M[:] = normal
        solve_positive(M, right, step)
        size = np.sqrt(step[0] ** 2 + step[1] ** 2 + step[4] ** 2)
        limit = min(1.0, 0.3 * x[4] / max(size, 1e-12))
        if held < _NEVER:
            _move_offsets(A, y, offset, views, held, step, limit)
        for a in range(6):
            x[a] += limit * step[a]
        x[4] = max(x[4], 0.008)
        scale = seen
        turn += 1
        if size < _CLOSE_M:
            break
    return scale


@njit(cache=True, nogil=True)
def fit_axis(
    xyz: Floats32, view: Ints32, origins: Floats, told: Floats, at: Floats, slope: Floats, radius: float, margin: float,
    z0: float, z1: float, scale: float, correlated: float, held: float, k_range: float, surface: float, prior: Floats,
    normal: Floats, x: Floats,
) -> tuple[float, Floats, Floats, Floats]:  # fmt: skip
    """Fit twice, the second time around the first answer with more points.

    ``at`` (3,) and ``slope`` (2,) are moved to the axis found; ``x`` and ``normal`` are those of the last turn. Returns
    the scale (-1: no fit) and some of the last turn's points (each view's offset taken off), unit rays in the plan and ranges.
    """
    reach = radius + margin
    near = np.empty(xyz.shape[0], dtype=np.int64)
    n = _near(xyz, at[0], at[1], at[2], slope[0], slope[1], reach + 0.05, z0, z1, near)
    P, U, G, R = np.empty((n, 3)), np.empty((n, 2)), np.empty(n), np.empty((3, 3))
    W = np.empty(n, dtype=np.int32)
    number_of, offset = np.full(max(origins.shape[0], 1), -1, dtype=np.int32), np.zeros((_MOST_VIEWS, 2))
    x[:] = 0.0
    x[4], x[5] = radius, prior[5, 0]
    first, m, views = radius, 0, 0
    for turn in range(2):
        every = 1 + n // _MOST[turn]
        reach = radius + margin
        m = _axis_frame(xyz, view, origins, told, near, n, every, at, slope[0], slope[1], reach, R, P, U, G, W)
        if m * every < 15:
            return -1.0, P[:0], U[:0], G[:0]
        views = _number_views(W, m, number_of, views)
        x[:4] = 0.0
        weight = every / correlated
        scale = fit_views(
            P[:m], U[:m], G[:m], W, offset, views, held, weight, x, k_range, surface, scale, prior, normal, _TURNS[turn]
        )  # fmt: skip
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
        reach = radius + margin
        m = _axis_frame(xyz, view, origins, told, near, n, 1, at, slope[0], slope[1], reach, R, P, U, G, W)
        x[:4] = 0.0
        whole[:4] = 0.0
        x[4] += girth_correction(P[:m], whole)
        return scale, P[:m].copy(), U[:m].copy(), G[:m].copy()
    skip = 1 + m // _SHOWN
    kept = 0
    for i in range(0, m, skip):
        P[kept, 0], P[kept, 1], P[kept, 2] = P[i, 0] - offset[W[i], 0], P[i, 1] - offset[W[i], 1], P[i, 2]
        U[kept, 0], U[kept, 1], G[kept] = U[i, 0], U[i, 1], G[i]
        kept += 1
    return scale, P[:kept].copy(), U[:kept].copy(), G[:kept].copy()
