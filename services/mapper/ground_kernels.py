"""Kernels of the ground model, over a window of cells of the map; cell (0, 0) of the window begins at (x0, y0)."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Floats32 = NDArray[np.float32]
Ints32 = NDArray[np.int32]

STRAYS = 5
"""So many points may lie below a cell's low: noise."""
REACH_M = 0.15
"""Points so near to the first plane are ground."""
BINS = 30
UNKNOWN = 1e9
_STEEP = 0.75
"""Steepest ground, metres per metre (37 degrees)."""


@njit(cache=True, nogil=True)
def gather_lows(points: Floats32, T: Floats, x0: float, y0: float, cell: float, lows: Floats, counts: Ints32) -> None:
    """Keep the lowest STRAYS + 1 heights per cell (nx, ny, STRAYS + 1), rising, and count the points."""
    nx, ny = counts.shape
    for i in range(points.shape[0]):
        px, py, pz = points[i, 0], points[i, 1], points[i, 2]
        x = T[0, 0] * px + T[0, 1] * py + T[0, 2] * pz + T[0, 3]
        y = T[1, 0] * px + T[1, 1] * py + T[1, 2] * pz + T[1, 3]
        a, b = int(np.floor((x - x0) / cell)), int(np.floor((y - y0) / cell))
        if not (0 <= a < nx and 0 <= b < ny):
            continue
        counts[a, b] += 1
        z = T[2, 0] * px + T[2, 1] * py + T[2, 2] * pz + T[2, 3]
        k = STRAYS
        if z >= lows[a, b, k]:
            continue
        while k > 0 and lows[a, b, k - 1] > z:
            lows[a, b, k] = lows[a, b, k - 1]
            k -= 1
        lows[a, b, k] = z


@njit(cache=True, nogil=True)
def drop_hanging(low: Floats, cell: float) -> None:
    """Make unknown the cells that hang above what any slope from their surroundings explains, by more than REACH_M."""
    nx, ny = low.shape
    envelope = low.copy()
    for sweep in range(4):  # two forward and two backward passes of a chamfer distance
        for step in range(nx * ny):
            at = step if sweep % 2 == 0 else nx * ny - 1 - step
            a, b = at // ny, at % ny
            for i in range(max(0, a - 1), min(nx, a + 2)):
                for j in range(max(0, b - 1), min(ny, b + 2)):
                    reach = cell * np.sqrt(float((i - a) ** 2 + (j - b) ** 2))
                    envelope[a, b] = min(envelope[a, b], envelope[i, j] + _STEEP * reach)
    for a in range(nx):
        for b in range(ny):
            if low[a, b] < UNKNOWN and low[a, b] > envelope[a, b] + REACH_M:
                low[a, b] = UNKNOWN


@njit(cache=True, nogil=True)
def _solve3(A: Floats, y: Floats, out: Floats) -> None:
    """Solve a symmetric positive 3x3 system by elimination without pivoting."""
    l10, l20 = A[1, 0] / A[0, 0], A[2, 0] / A[0, 0]
    d11 = A[1, 1] - l10 * A[0, 1]
    d12 = A[1, 2] - l10 * A[0, 2]
    y1 = y[1] - l10 * y[0]
    l21 = d12 / d11
    out[2] = (y[2] - l20 * y[0] - l21 * y1) / (A[2, 2] - l20 * A[0, 2] - l21 * d12)
    out[1] = (y1 - d12 * out[2]) / d11
    out[0] = (y[0] - A[0, 1] * out[1] - A[0, 2] * out[2]) / A[0, 0]


@njit(cache=True, nogil=True)
def first_planes(low: Floats, cell: float, planes: Floats) -> None:
    """Fit to each cell (height at its centre, slopes) the lows of its 5 x 5 neighbours, those above the plane weakly."""
    nx, ny = low.shape
    A, y, out, row = np.zeros((3, 3)), np.zeros(3), np.zeros(3), np.ones(3)
    for a in range(nx):
        for b in range(ny):
            planes[a, b, 0] = np.nan
            if low[a, b] >= UNKNOWN:
                continue
            out[:] = 0.0
            out[0] = low[a, b]
            for iteration in range(4):
                A[:] = 0.0
                y[:] = 0.0
                for i in range(max(0, a - 2), min(nx, a + 3)):
                    for j in range(max(0, b - 2), min(ny, b + 3)):
                        if low[i, j] >= UNKNOWN:
                            continue
                        row[1], row[2] = cell * (i - a), cell * (j - b)
                        e = low[i, j] - out[0] - out[1] * row[1] - out[2] * row[2]
                        scale = 0.06 if e > 0.0 else 0.15
                        weight = 1.0 if iteration == 0 else 1.0 / (1.0 + (e / scale) ** 2)
                        for r in range(3):
                            y[r] += weight * row[r] * low[i, j]
                            for c in range(3):
                                A[r, c] += weight * row[r] * row[c]
                A[1, 1] += 0.05
                A[2, 2] += 0.05
                _solve3(A, y, out)
            for c in range(3):
                planes[a, b, c] = out[c]


@njit(cache=True, nogil=True)
def gather_near(
    points: Floats32, T: Floats, x0: float, y0: float, cell: float, planes: Floats, bins: Ints32, sums: Floats
) -> None:
    """Count the points near each cell's first plane by height above it, and sum what a plane through them needs.

    ``bins`` (nx, ny, BINS) over -REACH_M..REACH_M; ``sums`` (nx, ny, 9): 1, dx, dy, h, dx dx, dx dy, dy dy, dx h, dy h.
    """
    nx, ny, _ = planes.shape
    for n in range(points.shape[0]):
        px, py, pz = points[n, 0], points[n, 1], points[n, 2]
        x = T[0, 0] * px + T[0, 1] * py + T[0, 2] * pz + T[0, 3] - x0
        y = T[1, 0] * px + T[1, 1] * py + T[1, 2] * pz + T[1, 3] - y0
        a, b = int(np.floor(x / cell)), int(np.floor(y / cell))
        if not (0 <= a < nx and 0 <= b < ny) or np.isnan(planes[a, b, 0]):
            continue
        z = T[2, 0] * px + T[2, 1] * py + T[2, 2] * pz + T[2, 3]
        dx, dy = x - (a + 0.5) * cell, y - (b + 0.5) * cell
        h = z - planes[a, b, 0] - planes[a, b, 1] * dx - planes[a, b, 2] * dy
        k = int(np.floor((h + REACH_M) / (2.0 * REACH_M) * BINS))
        if not 0 <= k < BINS:
            continue
        bins[a, b, k] += 1
        s = sums[a, b]
        s[0] += 1.0
        s[1] += dx
        s[2] += dy
        s[3] += h
        s[4] += dx * dx
        s[5] += dx * dy
        s[6] += dy * dy
        s[7] += dx * h
        s[8] += dy * h


@njit(cache=True, nogil=True)
def _quantile(bins: Ints32, count: int, share: float) -> float:
    seen, k = 0.0, 0
    while k < BINS - 1 and seen + bins[k] < share * count:
        seen += bins[k]
        k += 1
    return (k + (share * count - seen) / max(bins[k], 1)) / BINS * 2.0 * REACH_M - REACH_M


@njit(cache=True, nogil=True)
def settle(planes: Floats, bins: Ints32, sums: Floats, least: int, out: Floats) -> None:
    """Fill ``out`` (nx, ny, 5) with height, slopes, relief and count: the median of the points, the slope of their plane.

    Cells with fewer than ``least`` points near their plane stay NaN.
    """
    nx, ny, _ = planes.shape
    A, y, tilt = np.zeros((3, 3)), np.zeros(3), np.zeros(3)
    for a in range(nx):
        for b in range(ny):
            out[a, b, :] = np.nan
            s = sums[a, b]
            n = int(s[0])
            if n < least:
                continue
            A[0, 0], A[0, 1], A[0, 2] = s[0], s[1], s[2]
            A[1, 0], A[1, 1], A[1, 2] = s[1], s[4], s[5]
            A[2, 0], A[2, 1], A[2, 2] = s[2], s[5], s[6]
            # held to the neighbours' slope by as much as 50 points at 10 cm say
            A[1, 1] += 0.5
            A[2, 2] += 0.5
            y[0], y[1], y[2] = s[3], s[7], s[8]
            _solve3(A, y, tilt)
            middle = _quantile(bins[a, b], n, 0.5)
            out[a, b, 0] = planes[a, b, 0] + middle - tilt[1] * s[1] / n - tilt[2] * s[2] / n
            out[a, b, 1] = planes[a, b, 1] + tilt[1]
            out[a, b, 2] = planes[a, b, 2] + tilt[2]
            out[a, b, 3] = 0.5 * (_quantile(bins[a, b], n, 0.84) - _quantile(bins[a, b], n, 0.16))
            out[a, b, 4] = n
