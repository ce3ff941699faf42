"""Kernels of the ground's surface: heights above the planes, where they really lie, and whether there is a ground at all."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from services.detector.model import Floats

Floats32 = NDArray[np.float32]
Ints32 = NDArray[np.int32]

REACH_M = 0.15
BINS = 15


@njit(cache=True, nogil=True)
def height_above(xyz: Floats32, i: int, c: int, x0: float, y0: float, cell: float, planes: Floats) -> float:
    """Return the height of point ``i`` above the plane of its cell ``c``."""
    ny = planes.shape[1]
    a, b = c // ny, c % ny
    h = xyz[i, 2] - planes[a, b, 0] - planes[a, b, 1] * (xyz[i, 0] - x0 - (a + 0.5) * cell)
    return h - planes[a, b, 2] * (xyz[i, 1] - y0 - (b + 0.5) * cell)


@njit(cache=True, nogil=True)
def near_surface(
    xyz: Floats32, cell_of: Ints32, begin: int, end: int, step: int, x0: float, y0: float, cell: float, planes: Floats,
    bins: Ints32, hits: NDArray[np.uint8],
) -> None:  # fmt: skip
    """Count points in bins of 2 cm around each cell's plane; mark 0.1 m patches hit near it, and 0.5..0.74 m above it."""
    ny = planes.shape[1]
    scale = BINS / (2.0 * REACH_M)
    patch = 5.0 / cell
    for i in range(begin, end, step):
        c = cell_of[i]
        if c < 0:
            continue
        h = height_above(xyz, i, c, x0, y0, cell, planes)
        k = int(np.floor((h + REACH_M) * scale))
        if 0 <= k < BINS:
            bins[c // ny, c % ny, k] += 1
        mark = 1 if abs(h) < 0.12 else (2 if 0.5 < h < 0.74 else 0)
        if mark > 0:
            u = min(int((xyz[i, 0] - x0) * patch), hits.shape[0] - 1)
            v = min(int((xyz[i, 1] - y0) * patch), hits.shape[1] - 1)
            hits[u, v] |= mark


@njit(cache=True, nogil=True)
def count_patches(hits: NDArray[np.uint8], more: NDArray[np.uint8]) -> tuple[int, int]:
    """Return the number of patches hit near the ground, and of those hit above it, in either half."""
    low, mid = 0, 0
    for i in range(hits.shape[0]):
        for j in range(hits.shape[1]):
            both = hits[i, j] | more[i, j]
            low += both & 1
            mid += (both >> 1) & 1
    return low, mid


@njit(cache=True, nogil=True)
def settle(bins: Ints32, planes: Floats) -> None:
    """Move each plane from the lowest points, which noise puts too low, to the median of the points near it.

    The bins of the 3x3 neighbours are added up.
    """
    nx, ny, _ = planes.shape
    total = np.zeros(BINS, dtype=np.int64)
    for a in range(nx):
        for b in range(ny):
            total[:] = 0
            for i in range(max(0, a - 1), min(nx, a + 2)):
                for j in range(max(0, b - 1), min(ny, b + 2)):
                    for k in range(BINS):
                        total[k] += bins[i, j, k]
            count = total.sum()
            if count < 30:
                continue
            seen, k = 0, 0
            while 2 * (seen + total[k]) < count:
                seen += total[k]
                k += 1
            inside = (0.5 * count - seen) / max(total[k], 1)
            planes[a, b, 0] += (k + inside) / BINS * 2.0 * REACH_M - REACH_M
