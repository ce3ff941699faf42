"""Pose of one frame from matches with known map points: robust Gauss-Newton over (u, v, disparity)."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from services.slam.linear import cholesky_solve, step_pose
from services.slam.observe import (
    CHI2_DEPTH,
    CHI2_MONO,
    MIN_Z_M,
    huber_cost,
    huber_weight,
    jacobian,
    pose_jacobian,
    residual,
)

EXACT = False
"""For ``robust``: plain squares."""

F64 = NDArray[np.float64]
Bool = NDArray[np.bool_]


@njit(cache=True, nogil=True)
def accumulate(
    R: F64, t: F64, points: F64, obs: F64, info: F64, camera: F64, use: Bool, robust: bool, chi2: F64, H: F64, b: F64
) -> float:
    """Fill the normal equations ``H delta = b`` of a pose and each match's chi-square; return the robust cost."""
    J, JP, r = np.empty((3, 3)), np.empty((3, 6)), np.empty(3)
    H[:] = 0.0
    b[:] = 0.0
    cost = 0.0
    for i in range(len(points)):
        X = points[i]
        x = R[0, 0] * X[0] + R[0, 1] * X[1] + R[0, 2] * X[2] + t[0]
        y = R[1, 0] * X[0] + R[1, 1] * X[1] + R[1, 2] * X[2] + t[1]
        z = R[2, 0] * X[0] + R[2, 1] * X[1] + R[2, 2] * X[2] + t[2]
        if z < MIN_Z_M:
            chi2[i] = 1e12
            continue
        residual(x, y, z, obs[i, 0], obs[i, 1], obs[i, 2], camera, r)
        e = info[i, 0] * (r[0] * r[0] + r[1] * r[1]) + info[i, 1] * r[2] * r[2]
        chi2[i] = e
        if not use[i]:
            continue
        limit = CHI2_DEPTH if info[i, 1] > 0.0 else CHI2_MONO
        w = huber_weight(e, limit) if robust else 1.0
        cost += huber_cost(e, limit) if robust else e
        jacobian(x, y, z, camera, J)
        pose_jacobian(x, y, z, J, JP)
        for k in range(3):
            wk = w * (info[i, 0] if k < 2 else info[i, 1])
            if wk == 0.0:
                continue
            for m in range(6):
                jm = wk * JP[k, m]
                b[m] += jm * r[k]
                for n in range(m + 1):
                    H[m, n] += jm * JP[k, n]
    return cost


@njit(cache=True, nogil=True)
def gate(chi2: F64, info: F64, slack: float, use: Bool) -> int:
    """Mark in ``use`` the matches within the 95 % chi-square limit times ``slack``; return how many."""
    count = 0
    for i in range(len(chi2)):
        use[i] = chi2[i] <= slack * (CHI2_DEPTH if info[i, 1] > 0.0 else CHI2_MONO)
        count += use[i]
    return count


@njit(cache=True, nogil=True)
def refine_pose(
    R: F64, t: F64, points: F64, obs: F64, info: F64, camera: F64, use: Bool, H: F64, rounds: int
) -> tuple[int, float]:
    """Refine ``R``, ``t`` (camera from map) in place; ``use`` becomes the inliers, ``H`` the information (6, 6).

    ``points`` (N, 3) map, ``obs`` (N, 3) u, v, d with d = 0 for none, ``info`` (N, 2) inverse variances of u and v, and of
    d (0 for none). Each round is some Gauss-Newton steps, then a chi-square gate that may also bring matches back, the
    last rounds without the robust kernel. Returns the number of inliers and the sum of their chi-square.
    """
    n = len(points)
    chi2, A, b, g = np.empty(n), np.empty((6, 6)), np.empty(6), np.empty(6)
    count = 0
    for cycle in range(rounds):
        robust = cycle < 2
        for _ in range(8):
            accumulate(R, t, points, obs, info, camera, use, robust, chi2, A, b)
            for m in range(6):
                A[m, m] += 1e-9 * A[m, m] + 1e-9
            if not cholesky_solve(A, b):
                return 0, 0.0
            step_pose(R, t, b)
            if b[0] ** 2 + b[1] ** 2 + b[2] ** 2 + b[3] ** 2 + b[4] ** 2 + b[5] ** 2 < 1e-14:
                break
        accumulate(R, t, points, obs, info, camera, use, EXACT, chi2, H, g)
        count = gate(chi2, info, 1.0, use)
        if count < 6:
            return count, 0.0
    accumulate(R, t, points, obs, info, camera, use, EXACT, chi2, H, g)
    total = 0.0
    for i in range(n):
        if use[i]:
            total += chi2[i]
    for m in range(6):
        for k in range(m):
            H[k, m] = H[m, k]
    return count, total
