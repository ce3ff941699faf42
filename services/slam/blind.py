"""A pose from matches alone, without any idea of where to begin: AP3P in RANSAC (Ke and Roumeliotis, 2017)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]
Bool = NDArray[np.bool_]

_OFF_PX, LEAST = 4.0, 10
"""An inlier is at most so far off, and so many make a pose."""


def ransac(world: F64, uv: F64, camera: F64) -> tuple[F64, F64, Bool] | None:
    """Return camera from map (3, 3), (3,) and which of points (N, 3) seen at ``uv`` (N, 2) agree with it; None when few do.

    OpenCV solves for all inliers at last, by EPnP, and does not look again: with points near and kilometres away among them its pose
    was up to 170 m off.
    """
    import cv2

    if len(world) < LEAST:
        return None
    K = np.array([[camera[0], 0.0, camera[2]], [0.0, camera[1], camera[3]], [0.0, 0.0, 1.0]])
    cv2.setRNGSeed(1)
    ok, r, t_column, inliers = cv2.solvePnPRansac(
        np.ascontiguousarray(world), np.ascontiguousarray(uv), K, None,
        iterationsCount=300, reprojectionError=_OFF_PX, confidence=0.9999, flags=cv2.SOLVEPNP_AP3P,
    )  # fmt: skip
    if not ok or len(inliers) < LEAST:
        return None
    R: F64 = np.ascontiguousarray(cv2.Rodrigues(r)[0], np.float64)
    t: F64 = np.ascontiguousarray(t_column[:, 0], np.float64)
    X = world @ R.T + t
    off = np.hypot(*(X[:, :2] / np.maximum(X[:, 2:], 1e-9) * camera[:2] + camera[2:4] - uv).T)
    agree = np.zeros(len(world), np.bool_)
    agree[inliers[:, 0]] = True
    agree &= (X[:, 2] > 0.0) & (off < 2.0 * _OFF_PX)
    return (R, t, agree) if np.count_nonzero(agree) >= LEAST else None
