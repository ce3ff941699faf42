"""The ground under the cloud: the lowest points of 0.5 m cells, made one robust plane per cell.

The lowest point of a cell keeps its own x and y, so that on a slope it is a point of the ground and no bias. Cells
that show only a trunk or a bush hang above their neighbours by more than a slope can explain and are left out.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from services.detector.model import Floats, Ground
from services.detector.upright import Upright

_KEEP = 4
"""Lowest points kept per cell; the highest of them stands for the cell, so that three strays below do no harm."""
_REACH_M = 0.15
_BINS = 15
_MAX_CELLS = 2_000_000
_STEEP = 0.75
"""Steepest ground, metres per metre (37 degrees)."""


@njit(cache=True, nogil=True)
def _cell_lows(
    points: NDArray[np.floating],
    R: Floats,
    shift: Floats,
    x0: float,
    y0: float,
    cell: float,
    lows: Floats,
    counts: Floats,
) -> None:
    nx, ny = counts.shape
    for i in range(points.shape[0]):
        px = points[i, 0] - shift[0]
        py = points[i, 1] - shift[1]
        pz = points[i, 2] - shift[2]
        if not (abs(px) < 1e9 and abs(py) < 1e9 and abs(pz) < 1e9):
            continue
        x = R[0, 0] * px + R[0, 1] * py + R[0, 2] * pz
        y = R[1, 0] * px + R[1, 1] * py + R[1, 2] * pz
        z = R[2, 0] * px + R[2, 1] * py + R[2, 2] * pz
        a = min(int((x - x0) / cell), nx - 1)
        b = min(int((y - y0) / cell), ny - 1)
        counts[a, b] += 1
        k = _KEEP - 1
        if z >= lows[a, b, k, 2]:
            continue
        while k > 0 and lows[a, b, k - 1, 2] > z:
            for c in range(3):
                lows[a, b, k, c] = lows[a, b, k - 1, c]
            k -= 1
        lows[a, b, k, 0] = x
        lows[a, b, k, 1] = y
        lows[a, b, k, 2] = z


@njit(cache=True, nogil=True)
def _choose(lows: Floats, counts: Floats, cell_points: Floats, valid: NDArray[np.bool_]) -> None:
    """Take one low point per cell that has any; many points give more strays to pass over."""
    nx, ny = counts.shape
    for a in range(nx):
        for b in range(ny):
            n = int(counts[a, b])
            if n == 0:
                continue
            k = _KEEP - 1 if n >= 40 else (1 if n >= 10 else 0)
            for c in range(3):
                cell_points[a, b, c] = lows[a, b, k, c]
            valid[a, b] = True


@njit(cache=True, nogil=True)
def _is_pit(cell_points: Floats, valid: NDArray[np.bool_], a: int, b: int) -> bool:
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
def _drop_pits(cell_points: Floats, valid: NDArray[np.bool_]) -> None:
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
def _drop_hanging(cell_points: Floats, valid: NDArray[np.bool_], cell: float) -> None:
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
                    best = min(best, envelope[i, j] + _STEEP * reach)
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
def _plane_at(
    cell_points: Floats, valid: NDArray[np.bool_], a: int, b: int, half: int, xc: float, yc: float, out: Floats
) -> bool:
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
def _drop_above_wide_plane(cell_points: Floats, valid: NDArray[np.bool_], x0: float, y0: float, cell: float) -> None:
    """Drop cells well above the plane of their wider surroundings: a trunk or bush whose own ground was never seen."""
    nx, ny = valid.shape
    plane = np.zeros(3)
    drop = np.zeros((nx, ny), dtype=np.bool_)
    half = max(2, int(np.ceil(3.0 / cell)))
    for a in range(nx):
        for b in range(ny):
            if not valid[a, b]:
                continue
            xc, yc = x0 + (a + 0.5) * cell, y0 + (b + 0.5) * cell
            if _plane_at(cell_points, valid, a, b, half, xc, yc, plane):
                e = cell_points[a, b, 2] - plane[0] - plane[1] * (cell_points[a, b, 0] - xc)
                e -= plane[2] * (cell_points[a, b, 1] - yc)
                drop[a, b] = e > 0.25
    for a in range(nx):
        for b in range(ny):
            if drop[a, b]:
                valid[a, b] = False


@njit(cache=True, nogil=True)
def _planes(
    cell_points: Floats, valid: NDArray[np.bool_], counts: Floats, x0: float, y0: float, cell: float, planes: Floats
) -> None:
    nx, ny = valid.shape
    whole = np.zeros(3)
    lowest = 1e30
    for a in range(nx):
        for b in range(ny):
            if valid[a, b]:
                lowest = min(lowest, cell_points[a, b, 2])
    for a in range(nx):
        for b in range(ny):
            xc = x0 + (a + 0.5) * cell
            yc = y0 + (b + 0.5) * cell
            found = False
            near = counts[max(0, a - 1) : a + 2, max(0, b - 1) : b + 2].sum() > 0.0
            half = 2
            while near and not found and half <= 16:
                found = _plane_at(cell_points, valid, a, b, half, xc, yc, whole)
                half *= 2
            if found:
                for c in range(3):
                    planes[a, b, c] = whole[c]
            else:
                planes[a, b, 0] = lowest


@njit(cache=True, nogil=True)
def _settle(
    points: NDArray[np.floating], R: Floats, shift: Floats, x0: float, y0: float, cell: float, planes: Floats, step: int
) -> None:
    """Move each plane from the lowest points, which noise puts too low, to the median of the points near it.

    Histograms of 2 cm bins over +-0.15 m per cell, added up over the 3x3 neighbours.
    """
    nx, ny, _ = planes.shape
    bins = np.zeros((nx, ny, _BINS), dtype=np.int32)
    for n in range(0, points.shape[0], step):
        px = points[n, 0] - shift[0]
        py = points[n, 1] - shift[1]
        pz = points[n, 2] - shift[2]
        if not (abs(px) < 1e9 and abs(py) < 1e9 and abs(pz) < 1e9):
            continue
        x = R[0, 0] * px + R[0, 1] * py + R[0, 2] * pz - x0
        y = R[1, 0] * px + R[1, 1] * py + R[1, 2] * pz - y0
        a = min(int(x / cell), nx - 1)
        b = min(int(y / cell), ny - 1)
        h = R[2, 0] * px + R[2, 1] * py + R[2, 2] * pz - planes[a, b, 0]
        h -= planes[a, b, 1] * (x - (a + 0.5) * cell) + planes[a, b, 2] * (y - (b + 0.5) * cell)
        k = int(np.floor((h + _REACH_M) / (2.0 * _REACH_M) * _BINS))
        if 0 <= k < _BINS:
            bins[a, b, k] += 1
    total = np.zeros(_BINS, dtype=np.int64)
    for a in range(nx):
        for b in range(ny):
            total[:] = 0
            for i in range(max(0, a - 1), min(nx, a + 2)):
                for j in range(max(0, b - 1), min(ny, b + 2)):
                    total += bins[i, j]
            count = total.sum()
            if count < 30:
                continue
            seen, k = 0, 0
            while 2 * (seen + total[k]) < count:
                seen += total[k]
                k += 1
            inside = (0.5 * count - seen) / max(total[k], 1)
            planes[a, b, 0] += (k + inside) / _BINS * 2.0 * _REACH_M - _REACH_M


@njit(cache=True, nogil=True)
def _evidence(
    points: NDArray[np.floating], R: Floats, shift: Floats, x0: float, y0: float, cell: float, planes: Floats, step: int
) -> tuple[int, int]:
    """Count 0.1 m patches hit near the ground surface, and at 0.5..0.74 m above it."""
    nx, ny, _ = planes.shape
    hits = np.zeros((nx * 5, ny * 5), dtype=np.uint8)
    for n in range(0, points.shape[0], step):
        px = points[n, 0] - shift[0]
        py = points[n, 1] - shift[1]
        pz = points[n, 2] - shift[2]
        if not (abs(px) < 1e9 and abs(py) < 1e9 and abs(pz) < 1e9):
            continue
        x = R[0, 0] * px + R[0, 1] * py + R[0, 2] * pz - x0
        y = R[1, 0] * px + R[1, 1] * py + R[1, 2] * pz - y0
        z = R[2, 0] * px + R[2, 1] * py + R[2, 2] * pz
        a = min(int(x / cell), nx - 1)
        b = min(int(y / cell), ny - 1)
        h = z - planes[a, b, 0] - planes[a, b, 1] * (x - (a + 0.5) * cell) - planes[a, b, 2] * (y - (b + 0.5) * cell)
        i = min(int(x / cell * 5), nx * 5 - 1)
        j = min(int(y / cell * 5), ny * 5 - 1)
        if abs(h) < 0.12:
            hits[i, j] |= 1
        elif 0.5 < h < 0.74:
            hits[i, j] |= 2
    low, mid = 0, 0
    for i in range(nx * 5):
        for j in range(ny * 5):
            low += hits[i, j] & 1
            mid += (hits[i, j] >> 1) & 1
    return low, mid


def find_ground(points_m: NDArray[np.floating], frame: Upright, cell_m: float) -> Ground:
    """Return the ground under a cloud (N, 3) given its upright frame.

    Without anything ground-like (a cut-out trunk, heights already normalised) ``seen`` is false: heights are then
    above z = 0 where the cloud begins within 0..1.3 m of it, else above the lowest points.
    """
    x0, y0 = float(frame.low[0]), float(frame.low[1])
    size = frame.high[:2] - frame.low[:2]
    cell = cell_m
    while (size[0] / cell + 1) * (size[1] / cell + 1) > _MAX_CELLS:
        cell *= 2.0
    nx, ny = int(size[0] / cell) + 1, int(size[1] / cell) + 1
    lows = np.full((nx, ny, _KEEP, 3), 1e30)
    counts = np.zeros((nx, ny))
    _cell_lows(points_m, frame.R, frame.shift, x0, y0, cell, lows, counts)
    cell_points, valid = np.zeros((nx, ny, 3)), np.zeros((nx, ny), dtype=np.bool_)
    _choose(lows, counts, cell_points, valid)
    _drop_pits(cell_points, valid)
    _drop_hanging(cell_points, valid, cell)
    _drop_above_wide_plane(cell_points, valid, x0, y0, cell)
    planes = np.zeros((nx, ny, 3))
    _planes(cell_points, valid, counts, x0, y0, cell, planes)
    step = max(1, len(points_m) // 200_000)
    low, mid = _evidence(points_m, frame.R, frame.shift, x0, y0, cell, planes, step)
    if low > 1.5 * mid and low >= 50:
        _settle(points_m, frame.R, frame.shift, x0, y0, cell, planes, step)
        return Ground(x0, y0, cell, planes, seen=True, note="ground seen")
    return _without_ground(frame, Ground(x0, y0, cell, planes, seen=False, note=""))


def _without_ground(frame: Upright, lowest: Ground) -> Ground:
    zero = float((frame.R @ -frame.shift)[2])  # z of the input's origin in the upright frame
    planes, note = lowest.planes, "no ground in the cloud: heights are above the lowest points"
    if -0.2 <= frame.low[2] - zero <= 1.3:
        planes = np.zeros_like(planes)
        planes[..., 0] = zero
        note = "no ground in the cloud: heights are taken as above ground already"
    return Ground(lowest.x0_m, lowest.y0_m, lowest.cell_m, planes, seen=False, note=note)
