"""How a point is seen: projection with a virtual stereo disparity, its residual, weight and Jacobians.

An observation is (u, v, d): undistorted pixels and the disparity ``d = bf / z`` of a virtual baseline, after Mur-Artal
and Tardos, "ORB-SLAM2" (2017), section III-A, except that d stands alone instead of in a right-eye coordinate: its
noise is then independent of u's. ``camera`` is the array (fx, fy, cx, cy, bf).
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

F64 = NDArray[np.float64]

CHI2_MONO = 5.991
"""95 % of chi-square with two degrees of freedom."""
CHI2_DEPTH = 7.815
"""95 % with three."""
MIN_Z_M = 0.02


@njit(cache=True, nogil=True)
def jacobian(x: float, y: float, z: float, camera: F64, J: F64) -> None:
    """Write d(u, v, d)/d(camera point) (3, 3) into ``J``."""
    iz = 1.0 / z
    iz2 = iz * iz
    J[0, 0], J[0, 1], J[0, 2] = camera[0] * iz, 0.0, -camera[0] * x * iz2
    J[1, 0], J[1, 1], J[1, 2] = 0.0, camera[1] * iz, -camera[1] * y * iz2
    J[2, 0], J[2, 1], J[2, 2] = 0.0, 0.0, -camera[4] * iz2


@njit(cache=True, nogil=True)
def pose_jacobian(x: float, y: float, z: float, J: F64, JP: F64) -> None:
    """Write d(u, v, d)/d(pose) (3, 6) into ``JP``: J times [I, -hat(point)], order (v, w), left perturbation."""
    for r in range(3):
        a, b, c = J[r, 0], J[r, 1], J[r, 2]
        JP[r, 0], JP[r, 1], JP[r, 2] = a, b, c
        JP[r, 3] = -b * z + c * y
        JP[r, 4] = a * z - c * x
        JP[r, 5] = -a * y + b * x


@njit(cache=True, nogil=True)
def residual(x: float, y: float, z: float, u: float, v: float, d: float, camera: F64, r: F64) -> None:
    """Write observed minus predicted (3,) into ``r``; the third is zero when ``d`` is not above zero."""
    iz = 1.0 / z
    r[0] = u - (camera[0] * x * iz + camera[2])
    r[1] = v - (camera[1] * y * iz + camera[3])
    r[2] = d - camera[4] * iz if d > 0.0 else 0.0


@njit(cache=True, nogil=True)
def huber_weight(chi2: float, limit2: float) -> float:
    """Return the weight of Huber's kernel for a squared error; 1 up to ``limit2``."""
    return 1.0 if chi2 <= limit2 else math.sqrt(limit2 / chi2)


@njit(cache=True, nogil=True)
def huber_cost(chi2: float, limit2: float) -> float:
    """Return Huber's cost for a squared error."""
    return chi2 if chi2 <= limit2 else 2.0 * math.sqrt(chi2 * limit2) - limit2


@njit(cache=True, nogil=True)
def distort(u: float, v: float, camera: F64, distortion: F64, out: F64) -> None:
    """Write where an undistorted pixel is in the image as taken into ``out`` (2,); ``distortion`` k1, k2, p1, p2, k3 of OpenCV's model."""
    k1, k2, p1, p2, k3 = distortion[0], distortion[1], distortion[2], distortion[3], distortion[4]
    x, y = (u - camera[2]) / camera[0], (v - camera[3]) / camera[1]
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    out[0] = camera[0] * (x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)) + camera[2]
    out[1] = camera[1] * (y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y) + camera[3]
