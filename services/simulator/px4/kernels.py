"""Small compiled kernels on quaternions (w, x, y, z) shared by the dynamics and the estimator."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from services.common.geometry import Matrix


@njit(cache=True, nogil=True)
def rotation_matrix(q: Matrix) -> Matrix:
    """Return the rotation matrix of the unit quaternion ``q``."""
    w, x, y, z = q[0], q[1], q[2], q[3]
    R = np.empty((3, 3))
    R[0, 0] = 1.0 - 2.0 * (y * y + z * z)
    R[0, 1] = 2.0 * (x * y - z * w)
    R[0, 2] = 2.0 * (x * z + y * w)
    R[1, 0] = 2.0 * (x * y + z * w)
    R[1, 1] = 1.0 - 2.0 * (x * x + z * z)
    R[1, 2] = 2.0 * (y * z - x * w)
    R[2, 0] = 2.0 * (x * z - y * w)
    R[2, 1] = 2.0 * (y * z + x * w)
    R[2, 2] = 1.0 - 2.0 * (x * x + y * y)
    return R


@njit(cache=True, nogil=True)
def rotate(q: Matrix, v: Matrix) -> Matrix:
    """Return ``R(q) v``."""
    R = rotation_matrix(q)
    out = np.empty(3)
    for i in range(3):
        out[i] = R[i, 0] * v[0] + R[i, 1] * v[1] + R[i, 2] * v[2]
    return out


@njit(cache=True, nogil=True)
def rotate_inverse(q: Matrix, v: Matrix) -> Matrix:
    """Return ``R(q)^T v``."""
    R = rotation_matrix(q)
    out = np.empty(3)
    for i in range(3):
        out[i] = R[0, i] * v[0] + R[1, i] * v[1] + R[2, i] * v[2]
    return out


@njit(cache=True, nogil=True)
def quaternion_times_exp(q: Matrix, rate: Matrix, dt_s: float) -> None:
    """Multiply ``q`` in place, from the right, by the rotation ``rate * dt_s``, and normalise (Sola 2017, eq. 214)."""
    ax, ay, az = rate[0] * dt_s, rate[1] * dt_s, rate[2] * dt_s
    angle = math.sqrt(ax * ax + ay * ay + az * az)
    s = 0.5 if angle < 1e-9 else math.sin(0.5 * angle) / angle
    bw, bx, by, bz = math.cos(0.5 * angle), s * ax, s * ay, s * az
    w, x, y, z = q[0], q[1], q[2], q[3]
    q[0] = w * bw - x * bx - y * by - z * bz
    q[1] = w * bx + x * bw + y * bz - z * by
    q[2] = w * by - x * bz + y * bw + z * bx
    q[3] = w * bz + x * by - y * bx + z * bw
    norm = math.sqrt(q[0] ** 2 + q[1] ** 2 + q[2] ** 2 + q[3] ** 2)
    for i in range(4):
        q[i] /= norm
