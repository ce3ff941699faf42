"""Compiled geometry of one trunk and one camera: on numbers this small the interpreter costs ten times the sums."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from services.detector.refine.model import Matrix

_WINDOW_SAMPLES = 9
_MIN_FORWARD_M = 0.15


@njit(cache=True, nogil=True)
def trunk_frame(R: Matrix, axis: Matrix, min_horizontal: float, basis: Matrix, forward: Matrix) -> bool:
    """Fill ``basis`` (3, 3; rows: away, left, along the trunk) and ``forward`` (2,); False without a heading."""
    length = math.hypot(R[0, 2], R[1, 2])
    if length < min_horizontal:
        return False
    fx, fy = R[0, 2] / length, R[1, 2] / length
    along = fx * axis[0] + fy * axis[1]
    wx, wy, wz = fx - axis[0] * along, fy - axis[1] * along, -axis[2] * along
    norm = math.sqrt(wx * wx + wy * wy + wz * wz)
    wx, wy, wz = wx / norm, wy / norm, wz / norm
    basis[0, 0], basis[0, 1], basis[0, 2] = wx, wy, wz
    basis[1, 0] = axis[1] * wz - axis[2] * wy
    basis[1, 1] = axis[2] * wx - axis[0] * wz
    basis[1, 2] = axis[0] * wy - axis[1] * wx
    basis[2] = axis
    forward[0], forward[1] = fx, fy
    return True


@njit(cache=True, nogil=True)
def window_bounds(low: Matrix, high: Matrix, T: Matrix, lens: Matrix, reach_m: float, bounds: Matrix) -> bool:
    """Fill ``bounds`` (u0, u1, v0, v1) of a trunk between two points of map, widened by ``reach_m``.

    ``lens``: fx, fy, cx, cy, k1, k2, p1, p2, k3. False when no part of the trunk is before the camera.
    """
    bounds[0], bounds[1], bounds[2], bounds[3] = np.inf, -np.inf, np.inf, -np.inf
    extra = 0.0
    for k in range(_WINDOW_SAMPLES):
        share = k / (_WINDOW_SAMPLES - 1)
        x, y, z = 0.0, 0.0, 0.0
        for j in range(3):
            d = low[j] + share * (high[j] - low[j]) - T[j, 3]
            x, y, z = x + T[j, 0] * d, y + T[j, 1] * d, z + T[j, 2] * d
        if z <= _MIN_FORWARD_M:
            continue
        u, v = _pixel(x / z, y / z, lens)
        near = max(z - reach_m, _MIN_FORWARD_M)
        half = lens[0] * reach_m / near
        extra = max(extra, lens[1] * reach_m / near)
        bounds[0], bounds[1] = min(bounds[0], u - half), max(bounds[1], u + half)
        bounds[2], bounds[3] = min(bounds[2], v), max(bounds[3], v)
    bounds[2] -= 0.3 * extra
    bounds[3] += 0.3 * extra
    return bool(bounds[0] <= bounds[1])


@njit(cache=True, nogil=True)
def _pixel(x: float, y: float, lens: Matrix) -> tuple[float, float]:
    r2 = x * x + y * y
    radial = 1.0 + r2 * (lens[4] + r2 * (lens[5] + r2 * lens[8]))
    xd = x * radial + 2.0 * lens[6] * x * y + lens[7] * (r2 + 2.0 * x * x)
    yd = y * radial + lens[6] * (r2 + 2.0 * y * y) + 2.0 * lens[7] * x * y
    return lens[0] * xd + lens[2], lens[1] * yd + lens[3]


@njit(cache=True, nogil=True)
def polar(
    parameters: Matrix, covariance: Matrix, basis: Matrix, systematic_m: float, offset: Matrix, place: Matrix,
    polar_covariance: Matrix,
) -> float:  # fmt: skip
    """Return the distance of the fitted axis at the camera's height, and fill what belongs to it.

    ``offset`` (2,): the axis from the camera in map's axes; ``place`` (3, 3): covariance of (offset, radius), with
    ``systematic_m``, which more pixels do not average: along the ray and in the radius, and a third of it across, as
    both silhouettes are seen (measured on simulated views); ``polar_covariance`` (3, 3): of (bearing, range, radius).
    """
    J = np.zeros((3, 5))
    _axis_offset(parameters, basis, offset, J)
    distance = math.hypot(offset[0], offset[1])
    place[:] = J @ covariance @ J.T
    x, y = offset[0] / distance, offset[1] / distance
    along, across = systematic_m**2, (systematic_m / 3.0) ** 2
    d = along - across
    place[0, 0] += across + d * x * x
    place[0, 1] += d * x * y
    place[1, 0] += d * x * y
    place[1, 1] += across + d * y * y
    place[2, 2] += along
    G = np.zeros((3, 3))
    G[0, 0], G[0, 1] = -y / distance, x / distance
    G[1, 0], G[1, 1] = x, y
    G[2, 2] = 1.0
    polar_covariance[:] = G @ place @ G.T
    return distance


@njit(cache=True, nogil=True)
def _axis_offset(p: Matrix, basis: Matrix, offset: Matrix, J: Matrix) -> None:
    """Fill where the fitted axis passes the camera's height (2,), and the Jacobian (3, 5) of it and of the radius."""
    c = p[0] * basis[0] + p[1] * basis[1]
    d = p[3] * basis[0] + p[4] * basis[1] + basis[2]
    s = -c[2] / d[2]
    for i in range(2):
        offset[i] = c[i] + s * d[i]
        for k in range(2):
            J[i, k] = basis[k, i] - basis[k, 2] / d[2] * d[i]
            J[i, 3 + k] = s * J[i, k]
    J[2, 2] = 1.0
