"""What is believed of the distance of things beyond the sensor's range, of which depth tells nothing."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from services.slam.links import Keyframes, Points

F64 = NDArray[np.float64]

_KNOWN_SIGMA_INVERSE_M = 0.012
"""Parallax has told a distance when its inverse is known this well."""
_LEAST_KNOWN = 60
_SIGMA_RANGE_INVERSE_M = (0.02, 0.5)
_SPAN_M, _SIGMA_PER_SPAN = 2.0, 0.1
"""Keyframes that stand farther apart than a start and its rise doubt the belief more, by so much (1/m) for each metre beyond: where the
camera turns on the spot it keeps far points from taking the camera along, where it goes parallax tells more, and a common error
of the belief would make the way longer or shorter (a walk of 9 m: 24 cm too long without this)."""


class FarPrior:
    """Mean and spread of their inverse distance: wide at first, then learned from those that parallax has shown.

    Far points err together (a forest's edge is as far in all directions): a belief too narrow is not evened out by their
    number, it bends the map.
    """

    def __init__(self, far_m: float, sigma_inverse_m: float) -> None:
        self.distance_m = far_m
        self.sigma_inverse_m = sigma_inverse_m

    def disparity(self, bf: float, span_m: float) -> F64:
        """Return (2,) the disparity and its inverse variance, for ``bf`` focal length times virtual baseline.

        ``span_m``: how far apart the keyframes stand of whose adjustment it is part.
        """
        sigma_inverse_m = math.hypot(self.sigma_inverse_m, _SIGMA_PER_SPAN * max(span_m - _SPAN_M, 0.0))
        return np.array([bf / self.distance_m, 1.0 / (bf * sigma_inverse_m) ** 2])

    def learn(self, points: Points, kf: Keyframes, focal: float) -> None:
        """Take mean and spread from the far points whose distance is known by now, when they are enough."""
        inverse_m = known_distances(points, kf, focal, _KNOWN_SIGMA_INVERSE_M)
        if len(inverse_m) < _LEAST_KNOWN:
            return
        middle = float(np.median(inverse_m))
        spread = 1.4826 * float(np.median(np.abs(inverse_m - middle)))
        self.distance_m = 1.0 / max(middle, 0.01)
        self.sigma_inverse_m = min(max(spread, _SIGMA_RANGE_INVERSE_M[0]), _SIGMA_RANGE_INVERSE_M[1])


@njit(cache=True, nogil=True)
def known_distances(points: Points, kf: Keyframes, focal: float, sigma: float) -> F64:
    """Return the inverse distances (M,) from their first keyframe of far points known to ``sigma``, 1/m."""
    out = np.empty(len(points.n))
    count = 0
    for p in range(len(points.n)):
        if points.n[p] < 2 or focal * focal * points.parallax[p] * sigma * sigma < 1.0:
            continue
        k = points.frame[p, 0]
        z = kf.t[k, 2]
        for c in range(3):
            z += kf.R[k, 2, c] * points.pos[p, c]
        if z > 0.1:
            out[count] = 1.0 / z
            count += 1
    return out[:count].copy()
