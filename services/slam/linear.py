"""Small dense linear algebra and rotations for compiled kernels: plain loops, one thread, same result every time."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

F64 = NDArray[np.float64]


@njit(cache=True, nogil=True)
def exp_so3(wx: float, wy: float, wz: float) -> F64:
    """Return the rotation matrix of a rotation vector (Rodrigues; Sola et al. 2018, eq. 146)."""
    theta2 = wx * wx + wy * wy + wz * wz
    theta = math.sqrt(theta2)
    if theta < 1e-5:
        a, b = 1.0 - theta2 / 6.0, 0.5 - theta2 / 24.0
    else:
        a, b = math.sin(theta) / theta, (1.0 - math.cos(theta)) / theta2
    R = np.empty((3, 3))
    R[0, 0] = 1.0 - b * (wy * wy + wz * wz)
    R[0, 1] = -a * wz + b * wx * wy
    R[0, 2] = a * wy + b * wx * wz
    R[1, 0] = a * wz + b * wx * wy
    R[1, 1] = 1.0 - b * (wx * wx + wz * wz)
    R[1, 2] = -a * wx + b * wy * wz
    R[2, 0] = -a * wy + b * wx * wz
    R[2, 1] = a * wx + b * wy * wz
    R[2, 2] = 1.0 - b * (wx * wx + wy * wy)
    return R


@njit(cache=True, nogil=True)
def log_so3(R: F64) -> F64:
    """Return the rotation vector (3,) of a rotation matrix, through its unit quaternion (sound up to pi)."""
    w = np.zeros(3)
    trace = R[0, 0] + R[1, 1] + R[2, 2]
    if trace > -0.9:
        s = math.sqrt(max(1.0 + trace, 0.0)) * 2.0
        qw = 0.25 * s
        x, y, z = (R[2, 1] - R[1, 2]) / s, (R[0, 2] - R[2, 0]) / s, (R[1, 0] - R[0, 1]) / s
    else:
        i = 0
        if R[1, 1] > R[0, 0]:
            i = 1
        if R[2, 2] > R[i, i]:
            i = 2
        j, k = (i + 1) % 3, (i + 2) % 3
        s = math.sqrt(max(1.0 + R[i, i] - R[j, j] - R[k, k], 0.0)) * 2.0
        q = np.zeros(3)
        q[i] = 0.25 * s
        q[j] = (R[j, i] + R[i, j]) / s
        q[k] = (R[k, i] + R[i, k]) / s
        qw = (R[k, j] - R[j, k]) / s
        x, y, z = q[0], q[1], q[2]
    if qw < 0.0:
        qw, x, y, z = -qw, -x, -y, -z
    n = math.sqrt(x * x + y * y + z * z)
    factor = 2.0 / max(qw, 1e-12) if n < 1e-9 else 2.0 * math.atan2(n, qw) / n
    w[0], w[1], w[2] = factor * x, factor * y, factor * z
    return w


@njit(cache=True, nogil=True)
def orthonormalise(R: F64) -> None:
    """Make a nearly orthonormal matrix a rotation again, in place (Gram-Schmidt on its rows)."""
    n = math.sqrt(R[0, 0] ** 2 + R[0, 1] ** 2 + R[0, 2] ** 2)
    for c in range(3):
        R[0, c] /= n
    d = R[0, 0] * R[1, 0] + R[0, 1] * R[1, 1] + R[0, 2] * R[1, 2]
    for c in range(3):
        R[1, c] -= d * R[0, c]
    n = math.sqrt(R[1, 0] ** 2 + R[1, 1] ** 2 + R[1, 2] ** 2)
    for c in range(3):
        R[1, c] /= n
    R[2, 0] = R[0, 1] * R[1, 2] - R[0, 2] * R[1, 1]
    R[2, 1] = R[0, 2] * R[1, 0] - R[0, 0] * R[1, 2]
    R[2, 2] = R[0, 0] * R[1, 1] - R[0, 1] * R[1, 0]


@njit(cache=True, nogil=True)
def matmul3(A: F64, B: F64) -> F64:
    """Return the product of two 3x3 matrices."""
    C = np.empty((3, 3))
    for r in range(3):
        for c in range(3):
            C[r, c] = A[r, 0] * B[0, c] + A[r, 1] * B[1, c] + A[r, 2] * B[2, c]
    return C


@njit(cache=True, nogil=True)
def step_pose(R: F64, t: F64, delta: F64) -> None:
    """Move a pose in place by ``delta`` = (v, w) on the left: ``R <- exp(w) R``, ``t <- exp(w) t + v``."""
    E = exp_so3(delta[3], delta[4], delta[5])
    Rn = matmul3(E, R)
    orthonormalise(Rn)
    x, y, z = t[0], t[1], t[2]
    for r in range(3):
        t[r] = E[r, 0] * x + E[r, 1] * y + E[r, 2] * z + delta[r]
        for c in range(3):
            R[r, c] = Rn[r, c]


@njit(cache=True, nogil=True)
def cholesky_solve(A: F64, b: F64) -> bool:
    """Solve ``A x = b`` for symmetric positive definite A (lower triangle read); A and b are overwritten.

    Returns False, with b spoilt, when A is not positive definite.
    """
    n = len(b)
    for j in range(n):
        s = A[j, j]
        for k in range(j):
            s -= A[j, k] * A[j, k]
        if not s > 1e-300:
            return False
        d = math.sqrt(s)
        A[j, j] = d
        for i in range(j + 1, n):
            s = A[i, j]
            for k in range(j):
                s -= A[i, k] * A[j, k]
            A[i, j] = s / d
    for i in range(n):
        s = b[i]
        for k in range(i):
            s -= A[i, k] * b[k]
        b[i] = s / A[i, i]
    for i in range(n - 1, -1, -1):
        s = b[i]
        for k in range(i + 1, n):
            s -= A[k, i] * b[k]
        b[i] = s / A[i, i]
    return True
