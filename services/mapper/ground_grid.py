"""Lowest heights per cell of the map: coarse, quick, enough to tell the ground from what stands on it."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

_HALF = 512
"""Cells to each side of the map's origin; beyond it (256 m at 0.5 m cells) the rim's cells serve."""
_UNKNOWN = 1e9
_STRAYS = 5
"""So many points may lie below a cell's height: noise."""


@njit(cache=True, nogil=True)
def _lower(points: NDArray[np.float32], T: NDArray[np.float64], cell: float, lows: NDArray[np.float32]) -> None:
    """Lower the cells to the sixth-lowest point that one keyframe shows there."""
    side = lows.shape[0]
    half = side // 2
    kept = np.full((side, side), -1, dtype=np.int32)
    stack = np.full((4096, _STRAYS + 1), _UNKNOWN)
    cells = np.empty((4096, 2), dtype=np.int64)
    used = 0
    for i in range(points.shape[0]):
        px, py, pz = points[i, 0], points[i, 1], points[i, 2]
        x = T[0, 0] * px + T[0, 1] * py + T[0, 2] * pz + T[0, 3]
        y = T[1, 0] * px + T[1, 1] * py + T[1, 2] * pz + T[1, 3]
        z = T[2, 0] * px + T[2, 1] * py + T[2, 2] * pz + T[2, 3]
        a = min(max(int(np.floor(x / cell)) + half, 0), side - 1)
        b = min(max(int(np.floor(y / cell)) + half, 0), side - 1)
        at = kept[a, b]
        if at < 0:
            if used >= 4096:
                continue
            at = used
            kept[a, b] = at
            cells[at, 0] = a
            cells[at, 1] = b
            used += 1
        k = _STRAYS
        if z >= stack[at, k]:
            continue
        while k > 0 and stack[at, k - 1] > z:
            stack[at, k] = stack[at, k - 1]
            k -= 1
        stack[at, k] = z
    for at in range(used):
        a, b = cells[at, 0], cells[at, 1]
        if stack[at, _STRAYS] < lows[a, b]:
            lows[a, b] = stack[at, _STRAYS]


class GroundGrid:
    """Lowest seen height per cell, map frame."""

    def __init__(self, cell_m: float) -> None:
        self.cell_m = cell_m
        self.lows_m: NDArray[np.float32] = np.full((2 * _HALF, 2 * _HALF), _UNKNOWN, dtype=np.float32)

    def take(self, points_m: NDArray[np.float32], T_map_camera: NDArray[np.float64]) -> None:
        """Take up a keyframe's points (N, 3), camera frame."""
        _lower(points_m, T_map_camera, self.cell_m, self.lows_m)
