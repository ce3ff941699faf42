"""Up from the ground, where no sensor tells it: the largest plane below the camera in its first depth image.

Fischler and Bolles, "Random sample consensus" (1981).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from schemas.camera import Intrinsics

F64 = NDArray[np.float64]

_STEP_PX = 12
_RANGE_M = (0.3, 6.0)
_TRIALS = 200
_WITHIN_M = 0.05
_STEEPEST = math.cos(math.radians(50.0))
"""Between the plane's normal and the image's top."""
_LEAST_HEIGHT_M = 0.05
_LEAST_POINTS = 60
_LEAST_SHARE = 0.35


def ground_up(depth_m: NDArray[np.float32], intrinsics: Intrinsics) -> F64 | None:
    """Return up (3,), unit, in the camera's frame, from a depth image (H, W), 0 = none; None where no ground is seen."""
    points = _below(depth_m, intrinsics)
    if len(points) < _LEAST_POINTS:
        return None
    rng = np.random.default_rng(1)
    best, most = None, 0
    for _ in range(_TRIALS):
        a, b, c = points[rng.choice(len(points), 3, replace=False)]
        normal = np.cross(b - a, c - a)
        length = float(np.linalg.norm(normal))
        if length < 1e-6:
            continue
        up = normal / length if normal[1] < 0.0 else -normal / length
        if not _is_ground(up, a):
            continue
        count = int(np.count_nonzero(np.abs((points - a) @ up) < _WITHIN_M))
        if count > most:
            best, most = (up, a), count
    if best is None or most < _LEAST_SHARE * len(points):
        return None
    inliers = points[np.abs((points - best[1]) @ best[0]) < _WITHIN_M]
    centre = inliers.mean(axis=0)
    up = np.linalg.svd(inliers - centre, full_matrices=False)[2][2]
    up = up if up[1] < 0.0 else -up
    return up if _is_ground(up, centre) else None


def _is_ground(up: F64, point: F64) -> bool:
    """Return whether a plane lies below the camera and is not too steep against the image's top."""
    return bool(-up[1] > _STEEPEST and -(point @ up) > _LEAST_HEIGHT_M)


def _below(depth_m: NDArray[np.float32], intrinsics: Intrinsics) -> F64:
    """Return points (N, 3), camera frame, of the image's lower three fifths."""
    i = intrinsics
    v, u = np.mgrid[int(0.4 * i.height) : i.height : _STEP_PX, 0 : i.width : _STEP_PX]
    z = depth_m[v, u].astype(float)
    good = (z >= _RANGE_M[0]) & (z <= _RANGE_M[1])
    u, v, z = u[good], v[good], z[good]
    return np.stack([(u - i.cx) * z / i.fx, (v - i.cy) * z / i.fy, z], axis=1)
