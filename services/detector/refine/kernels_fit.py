"""Compiled arc fit with residuals along the viewing ray.

In the frame along the trunk (see ``model.Sight``) a pixel's ray is ``q = (q1, q2)`` per metre of depth, and its
coordinate along the trunk is ``h`` per metre of depth. A trunk is a circle of centre ``c + l * (z h)`` and radius r,
where ``l`` is the small lean against the map's axis. Its depth z solves |z (q - l h) - c|^2 = r^2, so that the
residual is (z_seen - z) / sigma_z with sigma_z of the sensor: depth noise lies along the ray, not across it.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from services.detector.refine.kernels_scan import (
    FIRST,
    FIRST_H,
    HOLE,
    LAST,
    LAST_H,
    LEFT_KIND,
    LEFT_RAD,
    RIGHT_KIND,
    RIGHT_RAD,
    ROW,
    SILHOUETTE,
)
from services.detector.refine.model import Depth, Matrix

PARAMETERS = 5
"""c away, c left, r, lean away, lean left."""
POINT_COLUMNS = 5
"""q1, q2, h, z, sigma_z."""
EDGE_COLUMNS = 4
"""Unit ray across the trunk (2), h per metre of distance across, side (+1 left, -1 right)."""

_MAX_STEP_M = 0.08
_DAMPING = 1e-6
_GRAZING = 0.12


@njit(cache=True, nogil=True, error_model="numpy")
def gather_points(
    depth: Depth, ray_x: Depth, ray_y: Depth, M: Matrix, runs: Matrix, label: NDArray[np.int64], count: int,
    wanted: int, max_points: int, noise: Matrix, points: Matrix,
) -> int:  # fmt: skip
    """Fill ``points`` (N, 5) with the pixels of one object, thinned evenly to about ``max_points``; return how many."""
    total = 0
    for k in range(count):
        if label[k] == wanted:
            total += int(runs[k, LAST] - runs[k, FIRST]) + 1
    stride = max(1, (total + max_points - 1) // max_points)
    n, phase = 0, 0
    for k in range(count):
        if label[k] != wanted:
            continue
        v = int(runs[k, ROW])
        for u in range(int(runs[k, FIRST]), int(runs[k, LAST]) + 1):
            phase += 1
            z = depth[v, u]
            if phase % stride != 0 or not z > 0.0 or n >= points.shape[0]:
                continue
            x, y = ray_x[v, u], ray_y[v, u]
            point = points[n]
            point[0] = M[0, 0] * x + M[0, 1] * y + M[0, 2]
            point[1] = M[1, 0] * x + M[1, 1] * y + M[1, 2]
            point[2] = M[2, 0] * x + M[2, 1] * y + M[2, 2]
            point[3] = z
            point[4] = noise[0] * z * z + noise[1]
            n += 1
    return n


@njit(cache=True, nogil=True, error_model="numpy")
def gather_edges(runs: Matrix, label: NDArray[np.int64], count: int, wanted: int, edges: Matrix) -> int:
    """Fill ``edges`` (N, 4) with the object's silhouettes (background, or no data, beside them); return how many."""
    n = 0
    for k in range(count):
        if label[k] != wanted:
            continue
        for side in (1, -1):
            kind = runs[k, LEFT_KIND] if side > 0 else runs[k, RIGHT_KIND]
            if (kind != SILHOUETTE and kind != HOLE) or n >= edges.shape[0]:
                continue
            angle = runs[k, LEFT_RAD] if side > 0 else runs[k, RIGHT_RAD]
            edges[n, 0], edges[n, 1] = math.cos(angle), math.sin(angle)
            edges[n, 2] = runs[k, FIRST_H] if side > 0 else runs[k, LAST_H]
            edges[n, 3] = side
            n += 1
    return n


@njit(cache=True, nogil=True, error_model="numpy")
def predicted_depth(q1: float, q2: float, h: float, p: Matrix) -> tuple[float, float]:
    """Return (depth, discriminant) of a ray on the trunk p; a ray that misses gives its nearest approach, and <= 0."""
    x, y = q1 - p[3] * h, q2 - p[4] * h
    a = x * x + y * y
    b = x * p[0] + y * p[1]
    d = b * b - a * (p[0] * p[0] + p[1] * p[1] - p[2] * p[2])
    return (b - math.sqrt(max(d, 0.0))) / a, d


@njit(cache=True, nogil=True, error_model="numpy")
def point_row(point: Matrix, p: Matrix, lateral: float, jacobian: Matrix) -> tuple[float, float]:
    """Return (residual, sigma), metres of depth, and fill ``jacobian`` (5,) = d residual / d p.

    ``lateral``: one pixel's share of the depth (edge_px / f): near the silhouette it moves the depth, so sigma grows.
    For a ray that misses the circle the residual is how far it misses.
    """
    q1, q2, h, z, sigma = point[0], point[1], point[2], point[3], point[4]
    x, y = q1 - p[3] * h, q2 - p[4] * h
    length = math.sqrt(x * x + y * y)
    predicted, d = predicted_depth(q1, q2, h, p)
    n1, n2 = predicted * x - p[0], predicted * y - p[1]
    if d <= 0.0:
        side = math.sqrt(n1 * n1 + n2 * n2)
        n1, n2 = n1 / side, n2 / side
        jacobian[0], jacobian[1], jacobian[2] = -n1, -n2, -1.0
        jacobian[3], jacobian[4] = -n1 * predicted * h, -n2 * predicted * h
        return side - p[2], lateral * z + sigma
    n1, n2 = n1 / p[2], n2 / p[2]
    cosine = -(n1 * x + n2 * y) / length
    across = max(cosine, _GRAZING) * length
    jacobian[0], jacobian[1], jacobian[2] = n1 / across, n2 / across, 1.0 / across
    jacobian[3], jacobian[4] = n1 * predicted * h / across, n2 * predicted * h / across
    tangent = math.sqrt(max(1.0 - cosine * cosine, 0.0)) / max(cosine, _GRAZING)
    slope = lateral * z * tangent
    return z - predicted, math.sqrt(sigma * sigma + slope * slope)


@njit(cache=True, nogil=True, error_model="numpy")
def _edge_row(edge: Matrix, p: Matrix, jacobian: Matrix) -> float:
    """Return the residual, metres, of a ray that should touch the circle: signed distance of the centre, less r."""
    reach = edge[0] * p[0] + edge[1] * p[1]
    x, y = edge[0] - p[3] * edge[2], edge[1] - p[4] * edge[2]
    length = math.sqrt(x * x + y * y)
    n1, n2 = y * edge[3] / length, -x * edge[3] / length
    jacobian[0], jacobian[1], jacobian[2] = n1, n2, -1.0
    jacobian[3], jacobian[4] = n1 * reach * edge[2], n2 * reach * edge[2]
    return n1 * p[0] + n2 * p[1] - p[2]


@njit(cache=True, nogil=True, error_model="numpy")
def _accumulate(H: Matrix, g: Matrix, jacobian: Matrix, residual: float, weight: float) -> None:
    for i in range(PARAMETERS):
        wj = weight * jacobian[i]
        g[i] += wj * residual
        for j in range(i, PARAMETERS):
            H[i, j] += wj * jacobian[j]


@njit(cache=True, nogil=True, error_model="numpy")
def _add_points(
    points: Matrix, n: int, p: Matrix, lateral: float, tukey: float, scale: float, H: Matrix, g: Matrix, stats: Matrix
) -> None:
    """Add the depth residuals; ``stats``: inliers, sum of their squares, points."""
    jacobian = np.empty(PARAMETERS)
    for k in range(n):
        residual, sigma = point_row(points[k], p, lateral, jacobian)
        s = residual / (sigma * scale)
        if abs(s) >= tukey:
            continue
        share = 1.0 - (s / tukey) ** 2
        _accumulate(H, g, jacobian, residual, share * share / (sigma * sigma))
        stats[0] += 1.0
        stats[1] += (residual / sigma) ** 2
    stats[2] = n


@njit(cache=True, nogil=True, error_model="numpy")
def _add_edges(edges: Matrix, n: int, p: Matrix, sigma: float, tukey: float, H: Matrix, g: Matrix) -> None:
    """Add the silhouettes; each side has the weight of one row, as its error is common to all rows."""
    jacobian = np.empty(PARAMETERS)
    for side in (1.0, -1.0):
        rows = 0
        for k in range(n):
            rows += edges[k, 3] == side
        for k in range(n):
            if edges[k, 3] != side:
                continue
            residual = _edge_row(edges[k], p, jacobian)
            s = residual / sigma
            if abs(s) < tukey:
                share = 1.0 - (s / tukey) ** 2
                _accumulate(H, g, jacobian, residual, share * share / (sigma * sigma * rows))


@njit(cache=True, nogil=True, error_model="numpy")
def solve(H: Matrix, g: Matrix, x: Matrix) -> bool:
    """Solve H x = g (symmetric, upper triangle given) by Cholesky; False when H is not positive definite."""
    n = g.size
    L = np.zeros((n, n))
    for j in range(n):
        for i in range(j, n):
            s = H[j, i]
            for k in range(j):
                s -= L[i, k] * L[j, k]
            if i == j:
                if not s > 0.0:
                    return False
                L[j, j] = math.sqrt(s)
            else:
                L[i, j] = s / L[j, j]
    for i in range(n):
        s = g[i]
        for k in range(i):
            s -= L[i, k] * x[k]
        x[i] = s / L[i, i]
    for i in range(n - 1, -1, -1):
        s = x[i]
        for k in range(i + 1, n):
            s -= L[k, i] * x[k]
        x[i] = s / L[i, i]
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def invert(H: Matrix, inverse: Matrix) -> bool:
    """Fill the inverse of a symmetric positive definite matrix; False when it is none."""
    unit, column = np.zeros(H.shape[0]), np.empty(H.shape[0])
    for k in range(H.shape[0]):
        unit[:] = 0.0
        unit[k] = 1.0
        if not solve(H, unit, column):
            return False
        inverse[:, k] = column
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def fit_trunk(
    points: Matrix, n: int, edges: Matrix, n_edges: int, start: Matrix, prior: Matrix, prior_sigma: Matrix,
    lateral: float, tukey: float, iterations: int, narrowing: int, p: Matrix, H: Matrix, stats: Matrix,
) -> bool:  # fmt: skip
    """Robust damped Gauss-Newton from ``start`` (5,) with a weak prior (5,); fills p, the information H and stats.

    The Tukey scale shrinks over the first ``narrowing`` iterations, so that a start that is centimetres off still sees its points.
    ``stats`` (3,): inliers, their summed squared residuals in sigmas, points.
    """
    g, step = np.empty(PARAMETERS), np.empty(PARAMETERS)
    p[:] = start
    for iteration in range(iterations + 1):
        H[:] = 0.0
        g[:] = 0.0
        stats[:] = 0.0
        scale = 1.0 + 3.0 * max(0.0, 1.0 - iteration / narrowing)
        _add_points(points, n, p, lateral, tukey, scale, H, g, stats)
        _add_edges(edges, n_edges, p, lateral * math.sqrt(p[0] ** 2 + p[1] ** 2), tukey * scale, H, g)
        for i in range(PARAMETERS):
            H[i, i] += 1.0 / prior_sigma[i] ** 2
            g[i] += (p[i] - prior[i]) / prior_sigma[i] ** 2
        if iteration == iterations:
            break
        for i in range(PARAMETERS):
            H[i, i] *= 1.0 + _DAMPING
        if not solve(H, g, step):
            return False
        largest = max(abs(step[0]), abs(step[1]), abs(step[2]))
        factor = min(1.0, _MAX_STEP_M / max(largest, 1e-12))
        for i in range(PARAMETERS):
            p[i] -= factor * step[i]
        p[2] = max(p[2], 0.005)
        if largest < 1e-4 and iteration > narrowing:
            break
    for i in range(PARAMETERS):
        for j in range(i):
            H[i, j] = H[j, i]
    return bool(np.all(np.isfinite(p)))
