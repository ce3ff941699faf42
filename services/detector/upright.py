"""The upright frame: the input turned so that up is +z and moved so that numbers are small."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from services.common.geometry import rotation_aligning
from services.detector.model import Floats

LIMIT_M = 1e9
"""Coordinates beyond this are no coordinates."""


@dataclass(frozen=True, slots=True)
class Upright:
    """``p_upright = R (p - shift)``."""

    R: Floats
    shift: Floats
    low: Floats
    """Smallest upright coordinates of the finite points, (3,)."""
    high: Floats
    finite: int

    def to_input(self, p: Floats) -> Floats:
        """Return points (..., 3) of the upright frame in the input frame."""
        return p @ self.R + self.shift

    def from_input(self, p: Floats) -> Floats:
        """Return points (..., 3) of the input frame in the upright frame."""
        return (p - self.shift) @ self.R.T


@njit(cache=True, nogil=True)
def _bounds(points: NDArray[np.floating], R: Floats, shift: Floats, low: Floats, high: Floats) -> int:
    finite = 0
    for i in range(points.shape[0]):
        px = points[i, 0] - shift[0]
        py = points[i, 1] - shift[1]
        pz = points[i, 2] - shift[2]
        if not (abs(px) < 1e9 and abs(py) < 1e9 and abs(pz) < 1e9):
            continue
        finite += 1
        for k in range(3):
            v = R[k, 0] * px + R[k, 1] * py + R[k, 2] * pz
            if v < low[k]:
                low[k] = v
            if v > high[k]:
                high[k] = v
    return finite


def upright_frame(points_m: NDArray[np.floating], up: tuple[float, float, float]) -> Upright:
    """Return the upright frame of a cloud (N, 3); ``up`` need not be of unit length."""
    R = rotation_aligning(np.asarray(up, dtype=float), (0.0, 0.0, 1.0))
    shift = np.zeros(3)
    for p in points_m[:: max(1, len(points_m) // 64)]:
        if np.all(np.abs(p) < LIMIT_M):
            shift = np.floor(np.asarray(p, dtype=np.float64))
            break
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    finite = int(_bounds(points_m, R, shift, low, high))
    return Upright(R, shift, low, high, finite)
