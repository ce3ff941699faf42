"""Kernels of the ground: low points per cell, which cells to trust, a plane per cell."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from services.detector.model import Floats

Floats32 = NDArray[np.float32]
Ints32 = NDArray[np.int32]
Bools = NDArray[np.bool_]

KEEP = 4
"""Lowest points kept per cell; the highest of them stands for the cell, so that three strays below do no harm."""
STEEP = 0.75
"""Steepest ground, metres per metre (37 degrees)."""
_LATTICE = 3
"""Wide planes are fitted at every third cell."""


@njit(cache=True, nogil=True)
def cell_lows(
    xyz: Floats32, begin: int, end: int, x0: float, y0: float, cell: float, ny: int, cell_of: Ints32, lows: Floats32,
    at: Ints32, counts: Ints32,
) -> None:  # fmt: skip
    """Write each point's cell (-1: no point); keep per cell the lowest heights and whose they are; count points."""
    inverse = np.float32(1.0 / cell)
    xf, yf = np.float32(x0), np.float32(y0)
    nx = lows.shape[0] // ny
    for i in range(begin, end):
        x = xyz[i, 0]
        if np.isnan(x):
            cell_of[i] = -1
            continue
        a = min(int((x - xf) * inverse), nx - 1)
        b = min(int((xyz[i, 1] - yf) * inverse), ny - 1)
        c = a * ny + b
        cell_of[i] = c
        counts[c] += 1
        z = xyz[i, 2]
        k = lows.shape[1] - 1
        if z >= lows[c, k]:
            continue
        while k > 0 and lows[c, k - 1] > z:
            lows[c, k] = lows[c, k - 1]
            at[c, k] = at[c, k - 1]
            k -= 1
        lows[c, k] = z
        at[c, k] = i


@njit(cache=True, nogil=True)
def merge_lows(
    lows: Floats32, at: Ints32, counts: Ints32, more: Floats32, more_at: Ints32, more_counts: Ints32
) -> None:
    """Take the second half's lowest points and counts into the first's."""
    for c in range(lows.shape[0]):
        counts[c] += more_counts[c]
        for m in range(lows.shape[1]):
            z = more[c, m]
            k = lows.shape[1] - 1
            if z >= lows[c, k]:
                break
            while k > 0 and lows[c, k - 1] > z:
                lows[c, k] = lows[c, k - 1]
                at[c, k] = at[c, k - 1]
                k -= 1
            lows[c, k] = z
            at[c, k] = more_at[c, m]


@njit(cache=True, nogil=True)
def choose_lows(xyz: Floats32, at: Ints32, counts: Ints32, cell_points: Floats, valid: Bools) -> None:
    """Take one low point per cell that has any; many points give more strays to pass over."""
    nx, ny = valid.shape
    for a in range(nx):
        for b in range(ny):
            n = counts[a * ny + b]
            if n == 0:
                continue
            k = KEEP - 1 if n >= 40 else (1 if n >= 10 else 0)
            for c in range(3):
                cell_points[a, b, c] = xyz[at[a * ny + b, k], c]
            valid[a, b] = True


@njit(cache=True, nogil=True)
def _is_pit(cell_points: Floats, valid: Bools, a: int, b: int) -> bool:
    """Tell whether most neighbours lie higher than any slope explains."""
    nx, ny = valid.shape
    around, above = 0, 0
    for i in range(max(0, a - 2), min(nx, a + 3)):
        for j in range(max(0, b - 2), min(ny, b + 3)):
            if not valid[i, j] or (i == a and j == b):
                continue
            around += 1
            dx = cell_points[i, j, 0] - cell_points[a, b, 0]
            dy = cell_points[i, j, 1] - cell_points[a, b, 1]
            if cell_points[i, j, 2] - cell_points[a, b, 2] > np.sqrt(dx * dx + dy * dy) + 0.3:
                above += 1
    return around >= 4 and above > 0.7 * around


@njit(cache=True, nogil=True)
def drop_pits(cell_points: Floats, valid: Bools) -> None:
    """Drop cells far below most of their neighbours: reflections and strays."""
    nx, ny = valid.shape
    pits = np.zeros((nx, ny), dtype=np.bool_)
    for a in range(nx):
        for b in range(ny):
            pits[a, b] = valid[a, b] and _is_pit(cell_points, valid, a, b)
    for a in range(nx):
        for b in range(ny):
            if pits[a, b]:
                valid[a, b] = False


@njit(cache=True, nogil=True)
def drop_hanging(cell_points: Floats, valid: Bools, cell: float) -> None:
    """Drop cells higher than the slope-limited lower envelope of their surroundings by more than 0.15 m."""
    nx, ny = valid.shape
    envelope = np.full((nx, ny), 1e30)
    for a in range(nx):
        for b in range(ny):
            if valid[a, b]:
                envelope[a, b] = cell_points[a, b, 2]
    for sweep in range(4):  # two forward and two backward passes of a chamfer distance
        for step in range(nx * ny):
            at = step if sweep % 2 == 0 else nx * ny - 1 - step
            a, b = at // ny, at % ny
            best = envelope[a, b]
            for i in range(max(0, a - 1), min(nx, a + 2)):
                for j in range(max(0, b - 1), min(ny, b + 2)):
                    reach = cell * np.sqrt(float((i - a) ** 2 + (j - b) ** 2))
                    best = min(best, envelope[i, j] + STEEP * reach)
            envelope[a, b] = best
    for a in range(nx):
        for b in range(ny):
            if valid[a, b] and cell_points[a, b, 2] > envelope[a, b] + 0.15:
                valid[a, b] = False


@njit(cache=True, nogil=True)
def _solve3(A: Floats, y: Floats, out: Floats) -> None:
    """Solve a symmetric positive 3x3 system by elimination without pivoting."""
    l10 = A[1, 0] / A[0, 0]
    l20 = A[2, 0] / A[0, 0]
    d11 = A[1, 1] - l10 * A[0, 1]
    d12 = A[1, 2] - l10 * A[0, 2]
    d22 = A[2, 2] - l20 * A[0, 2]
    y1 = y[1] - l10 * y[0]
    y2 = y[2] - l20 * y[0]
    l21 = d12 / d11
    out[2] = (y2 - l21 * y1) / (d22 - l21 * d12)
    out[1] = (y1 - d12 * out[2]) / d11
    out[0] = (y[0] - A[0, 1] * out[1] - A[0, 2] * out[2]) / A[0, 0]


@njit(cache=True, nogil=True)
def _plane_at(cell_points: Floats, valid: Bools, a: int, b: int, half: int, xc: float, yc: float, out: Floats) -> bool:
    """Fit a plane to the low points around a cell; those above it count less (they may be plants)."""
    nx, ny = valid.shape
    A, y = np.zeros((3, 3)), np.zeros(3)
    row = np.array([1.0, 0.0, 0.0])
    for iteration in range(4):
        A[:] = 0.0
        y[:] = 0.0
        n = 0
        for i in range(max(0, a - half), min(nx, a + half + 1)):
            for j in range(max(0, b - half), min(ny, b + half + 1)):
                if not valid[i, j]:
                    continue
                n += 1
                row[1] = cell_points[i, j, 0] - xc
                row[2] = cell_points[i, j, 1] - yc
                weight = 1.0
                if iteration > 0:
                    e = cell_points[i, j, 2] - (out[0] + out[1] * row[1] + out[2] * row[2])
                    scale = 0.06 if e > 0.0 else 0.15
                    weight = 1.0 / (1.0 + (e / scale) ** 2)
                weight /= 1.0 + (row[1] ** 2 + row[2] ** 2) / (0.36 * half * half)
                for r in range(3):
                    y[r] += weight * row[r] * cell_points[i, j, 2]
                    for c in range(3):
                        A[r, c] += weight * row[r] * row[c]
        if n < 5:
            return False
        A[1, 1] += 0.05
        A[2, 2] += 0.05
        _solve3(A, y, out)
    return True


@njit(cache=True, nogil=True)
def above_wide_plane(
    cell_points: Floats, valid: Bools, x0: float, y0: float, cell: float, half_of_rows: int, drop: Bools
) -> None:
    """Mark cells well above the plane of their wider surroundings: a trunk or bush whose own ground was never seen.

    Every second row of planes is one half's, the others the other's.
    """
    nx, ny = valid.shape
    plane = np.zeros(3)
    half = max(2, int(np.ceil(3.0 / cell)))
    for a in range(1 + half_of_rows * _LATTICE, nx + 1, 2 * _LATTICE):
        for b in range(1, ny + 1, _LATTICE):
            a0, b0 = min(a, nx - 1), min(b, ny - 1)
            xc, yc = x0 + (a0 + 0.5) * cell, y0 + (b0 + 0.5) * cell
            wanted = False
            for i in range(max(0, a - 1), min(nx, a + 2)):
                for j in range(max(0, b - 1), min(ny, b + 2)):
                    wanted = wanted or valid[i, j]
            if not wanted or not _plane_at(cell_points, valid, a0, b0, half, xc, yc, plane):
                continue
            for i in range(max(0, a - 1), min(nx, a + 2)):
                for j in range(max(0, b - 1), min(ny, b + 2)):
                    e = cell_points[i, j, 2] - plane[0] - plane[1] * (cell_points[i, j, 0] - xc)
                    e -= plane[2] * (cell_points[i, j, 1] - yc)
                    drop[i, j] = e > 0.25


@njit(cache=True, nogil=True)
def fit_planes(
    cell_points: Floats,
    valid: Bools,
    counts: Ints32,
    x0: float,
    y0: float,
    cell: float,
    half_of_rows: int,
    planes: Floats,
) -> None:
    """Write a plane per cell that has points near it, from the valid cells around; the lowest height elsewhere.

    Every second row is one half's, the others the other's.
    """
    nx, ny = valid.shape
    whole = np.zeros(3)
    lowest = 1e30
    for a in range(nx):
        for b in range(ny):
            if valid[a, b]:
                lowest = min(lowest, cell_points[a, b, 2])
    for a in range(half_of_rows, nx, 2):
        for b in range(ny):
            xc = x0 + (a + 0.5) * cell
            yc = y0 + (b + 0.5) * cell
            found = False
            near = False
            for i in range(max(0, a - 1), min(nx, a + 2)):
                for j in range(max(0, b - 1), min(ny, b + 2)):
                    near = near or counts[i * ny + j] > 0
            half = 2
            while near and not found and half <= 16:
                found = _plane_at(cell_points, valid, a, b, half, xc, yc, whole)
                half *= 2
            if found:
                for c in range(3):
                    planes[a, b, c] = whole[c]
            else:
                planes[a, b, 0] = lowest
