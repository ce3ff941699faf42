"""Compiled search of the depth image: rows are cut into runs of one surface, runs are linked into objects."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from services.detector.refine.model import Depth, Matrix

# columns of a run, float64
ROW, FIRST, LAST, LEFT_RAD, RIGHT_RAD, NEAR_M, LEFT_KIND, RIGHT_KIND, MIN_M, MAX_M, FIRST_H, LAST_H = range(12)
RUN_COLUMNS = 12

# what lies beside a run's end
BORDER, SILHOUETTE, OCCLUDED, HOLE, JOINED = 0.0, 1.0, 2.0, 3.0, 4.0

_LOOK_BESIDE_PX = 8
_MAX_GAP_PX = 3


@njit(cache=True, nogil=True, error_model="numpy")
def scan_rows(
    depth: Depth, ray_x: Depth, ray_y: Depth, M: Matrix, up_row: Matrix, camera_z_m: float,
    rows: NDArray[np.int64], u0: int, u1: int, limits: Matrix, noise: Matrix, runs: Matrix,
) -> int:  # fmt: skip
    """Fill ``runs`` (N, 12) with the surfaces seen in the given rows between columns u0 and u1; return their number.

    ``limits``: min and max depth, min and max height in map, min and max distance from the camera across the trunk.
    ``noise``: sigma per z^2, floor, ray spacing (1/f).
    """
    count = 0
    for v in rows:
        start, last, last_z = -1, -1, 0.0
        for u in range(u0, u1 + 1):
            z = depth[v, u]
            if not (z > limits[0] and z < limits[1]):
                continue
            x, y = ray_x[v, u], ray_y[v, u]
            if not _inside(z, x, y, M, up_row, camera_z_m, limits):
                continue
            if start >= 0 and (u - last > _MAX_GAP_PX or abs(z - last_z) > jump_m(last_z, u - last, noise)):
                count = _close(depth, ray_x, ray_y, M, v, start, last, limits, noise, runs, count)
                start = -1
            if start < 0:
                start = u
            last, last_z = u, z
        if start >= 0:
            count = _close(depth, ray_x, ray_y, M, v, start, last, limits, noise, runs, count)
    return count


@njit(cache=True, nogil=True, error_model="numpy")
def jump_m(z: float, apart_px: int, noise: Matrix) -> float:
    """Return the step of depth that parts two surfaces: more than noise and a cylinder's own slope.

    The last ``k`` pixels before the tangent of a cylinder of radius r rise by ``sqrt(2 r k z / f)``; r is 10 cm here.
    """
    sigma = noise[0] * z * z + noise[1]
    return 3.5 * sigma + math.sqrt(0.2 * z * noise[2] * apart_px)


@njit(cache=True, nogil=True, error_model="numpy")
def _inside(z: float, x: float, y: float, M: Matrix, up_row: Matrix, camera_z_m: float, limits: Matrix) -> bool:
    height = camera_z_m + z * (up_row[0] * x + up_row[1] * y + up_row[2])
    if height < limits[2] or height > limits[3]:
        return False
    a = z * (M[0, 0] * x + M[0, 1] * y + M[0, 2])
    b = z * (M[1, 0] * x + M[1, 1] * y + M[1, 2])
    square = a * a + b * b
    return limits[4] * limits[4] < square < limits[5] * limits[5]


@njit(cache=True, nogil=True, error_model="numpy")
def _ray(ray_x: Depth, ray_y: Depth, M: Matrix, v: int, u: int) -> tuple[float, float, float]:
    x, y = ray_x[v, u], ray_y[v, u]
    return (
        M[0, 0] * x + M[0, 1] * y + M[0, 2],
        M[1, 0] * x + M[1, 1] * y + M[1, 2],
        M[2, 0] * x + M[2, 1] * y + M[2, 2],
    )


@njit(cache=True, nogil=True, error_model="numpy")
def _beside(depth: Depth, v: int, u: int, step: int, noise: Matrix) -> float:
    """Say what lies beyond the run's end u: the first depth there, judged against the run's own."""
    z = depth[v, u]
    width = depth.shape[1]
    for k in range(1, _LOOK_BESIDE_PX + 1):
        w = u + step * k
        if w < 0 or w >= width:
            return BORDER
        other = depth[v, w]
        if not other > 0.0:
            continue
        if other > z + jump_m(z, k, noise):
            return SILHOUETTE
        if other < z - jump_m(z, k, noise):
            return OCCLUDED
        if k > _MAX_GAP_PX:
            return JOINED
    return HOLE


@njit(cache=True, nogil=True, error_model="numpy")
def _close(
    depth: Depth, ray_x: Depth, ray_y: Depth, M: Matrix, v: int, first: int, last: int, limits: Matrix,
    noise: Matrix, runs: Matrix, count: int,
) -> int:  # fmt: skip
    """Write one run and return the new count; a single pixel is none."""
    if last - first < 1 or count >= runs.shape[0]:
        return count
    third = (last - first) // 3
    near_sum, near_n, low, high = 0.0, 0, 1e9, 0.0
    for u in range(first, last + 1):
        z = depth[v, u]
        if not z > 0.0:
            continue
        a, b, _ = _ray(ray_x, ray_y, M, v, u)
        rho = z * math.sqrt(a * a + b * b)
        if not limits[4] < rho < limits[5]:
            continue
        low, high = min(low, rho), max(high, rho)
        if first + third <= u <= last - third:
            near_sum += rho
            near_n += 1
    if near_n == 0:
        return count
    a0, b0, h0 = _ray(ray_x, ray_y, M, v, first)
    a1, b1, h1 = _ray(ray_x, ray_y, M, v, last)
    run = runs[count]
    run[ROW], run[FIRST], run[LAST] = v, first, last
    # half a pixel outward: the run's pixels are on the object with their whole width
    half = 0.5 * (math.atan2(b0, a0) - math.atan2(b1, a1)) / (last - first)
    run[LEFT_RAD], run[RIGHT_RAD] = math.atan2(b0, a0) + half, math.atan2(b1, a1) - half
    run[NEAR_M], run[MIN_M], run[MAX_M] = near_sum / near_n, low, high
    run[LEFT_KIND], run[RIGHT_KIND] = _beside(depth, v, first, -1, noise), _beside(depth, v, last, 1, noise)
    run[FIRST_H], run[LAST_H] = h0 / math.hypot(a0, b0), h1 / math.hypot(a1, b1)
    return count + 1


@njit(cache=True, nogil=True, error_model="numpy")
def link_runs(runs: Matrix, count: int, row_step: int, noise: Matrix, label: NDArray[np.int64]) -> int:
    """Link runs of neighbouring rows into objects: they overlap across and agree in distance. Returns their number.

    ``label`` (N,) gets each run's object. Rows come in ascending order.
    """
    tails = np.empty(count, np.int64)
    objects = 0
    for k in range(count):
        best, best_overlap = -1, 0.5
        run = runs[k]
        width = run[LEFT_RAD] - run[RIGHT_RAD]
        reach = 0.04 + 3.0 * (noise[0] * run[NEAR_M] ** 2 + noise[1])
        for j in range(objects):
            tail = runs[tails[j]]
            if tail[ROW] == run[ROW] or run[ROW] - tail[ROW] > 4 * row_step or abs(tail[NEAR_M] - run[NEAR_M]) > reach:
                continue
            overlap = min(run[LEFT_RAD], tail[LEFT_RAD]) - max(run[RIGHT_RAD], tail[RIGHT_RAD])
            share = overlap / min(width, tail[LEFT_RAD] - tail[RIGHT_RAD])
            if share > best_overlap:
                best, best_overlap = j, share
        if best < 0:
            best = objects
            objects += 1
        tails[best] = k
        label[k] = best
    return objects
