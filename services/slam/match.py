"""Matching by projection: each query looks into a window of the image and takes the nearest descriptor."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from services.slam.binary import hamming

F64 = NDArray[np.float64]
I32 = NDArray[np.int32]

CELL_PX = 20.0
_ANGLE_BINS = 30


@njit(cache=True, nogil=True)
def match_windows(  # noqa: C901 - one loop over one window
    place: F64,
    radius: F64,
    low: I32,
    high: I32,
    query: NDArray[np.uint64],
    uv: F64,
    disparity: F64,
    octave: I32,
    desc: NDArray[np.uint64],
    cell_start: I32,
    cell_items: I32,
    cols: int,
    free: NDArray[np.bool_],
    max_distance: int,
    ratio: float,
) -> I32:
    """Return for each query the feature (index or -1) that fits best; one feature serves one query, the nearest.

    ``place`` (M, 3) predicted u, v, disparity (0: unknown, u NaN: skip), ``radius`` (M,) pixels, ``low`` and ``high`` (M,)
    octaves allowed. A match needs ``max_distance``, and a second best of the same octave must be farther by ``ratio``.
    """
    rows = (len(cell_start) - 1) // cols
    m = len(place)
    match = np.full(m, -1, np.int32)
    owner = np.full(len(uv), -1, np.int32)
    owner_distance = np.full(len(uv), 1000, np.int32)
    for i in range(m):
        u, v, r = place[i, 0], place[i, 1], radius[i]
        if math.isnan(u):
            continue
        c0, c1 = max(int((u - r) / CELL_PX), 0), min(int((u + r) / CELL_PX), cols - 1)
        r0, r1 = max(int((v - r) / CELL_PX), 0), min(int((v + r) / CELL_PX), rows - 1)
        c0, r0 = min(c0, cols - 1), min(r0, rows - 1)
        best, second, best_octave, second_octave, index = 1000, 1000, -1, -1, -1
        for row in range(r0, r1 + 1):
            for k in range(cell_start[row * cols + c0], cell_start[row * cols + max(c1, c0) + 1]):
                j = cell_items[k]
                if not free[j] or octave[j] < low[i] or octave[j] > high[i]:
                    continue
                if abs(uv[j, 0] - u) > r or abs(uv[j, 1] - v) > r:
                    continue
                if place[i, 2] > 0.0 and disparity[j] > 0.0 and abs(disparity[j] - place[i, 2]) > r:
                    continue
                distance = hamming(query[i], desc[j])
                if distance < best:
                    second, second_octave = best, best_octave
                    best, best_octave, index = distance, octave[j], j
                elif distance < second:
                    second, second_octave = distance, octave[j]
        if index < 0 or best > max_distance:
            continue
        if best_octave == second_octave and best > ratio * second:
            continue
        if best < owner_distance[index]:
            if owner[index] >= 0:
                match[owner[index]] = -1
            owner[index], owner_distance[index] = i, best
            match[i] = index
    return match


@njit(cache=True, nogil=True)
def keep_common_turn(match: I32, query_angle: F64, angle: F64) -> int:
    """Drop the matches (in place) whose turn of the feature differs from the three commonest; return how many stay."""
    bins = np.zeros(_ANGLE_BINS, np.int64)
    which = np.full(len(match), -1, np.int32)
    for i in range(len(match)):
        if match[i] >= 0:
            turn = (query_angle[i] - angle[match[i]]) / (2.0 * math.pi)
            which[i] = int((turn - math.floor(turn)) * _ANGLE_BINS + 0.5) % _ANGLE_BINS
            bins[which[i]] += 1
    first = np.argmax(bins)
    top = bins[first]
    good = np.zeros(_ANGLE_BINS, np.bool_)
    for b in range(_ANGLE_BINS):
        apart = min((b - first) % _ANGLE_BINS, (first - b) % _ANGLE_BINS)
        good[b] = apart <= 1 or bins[b] > 0.5 * top
    kept = 0
    for i in range(len(match)):
        if match[i] >= 0:
            if good[which[i]]:
                kept += 1
            else:
                match[i] = -1
    return kept


@njit(cache=True, nogil=True)
def project(
    ids: I32, pos: F64, normal: F64, near: F64, far: F64, R: F64, t: F64, camera: F64, width: float, height: float,
    scale: float, levels: int, place: F64, octave: I32, cosine: F64,
) -> int:  # fmt: skip
    """Predict where map points ``ids`` are seen: fills ``place`` (M, 3; u NaN when not), ``octave`` and ``cosine`` (M,).

    Not seen: behind, outside of the image, at a distance that its octaves do not cover, or from over 60 degrees aside.
    Returns how many are seen. ``R``, ``t`` is camera from map; octave prediction after Mur-Artal et al. (2015).
    """
    log_scale = math.log(scale)
    ox = -(R[0, 0] * t[0] + R[1, 0] * t[1] + R[2, 0] * t[2])
    oy = -(R[0, 1] * t[0] + R[1, 1] * t[1] + R[2, 1] * t[2])
    oz = -(R[0, 2] * t[0] + R[1, 2] * t[1] + R[2, 2] * t[2])
    seen = 0
    for i in range(len(ids)):
        p = ids[i]
        place[i, 0] = np.nan
        X, Y, Z = pos[p, 0], pos[p, 1], pos[p, 2]
        z = R[2, 0] * X + R[2, 1] * Y + R[2, 2] * Z + t[2]
        if z < 0.05:
            continue
        x = R[0, 0] * X + R[0, 1] * Y + R[0, 2] * Z + t[0]
        y = R[1, 0] * X + R[1, 1] * Y + R[1, 2] * Z + t[1]
        u, v = camera[0] * x / z + camera[2], camera[1] * y / z + camera[3]
        if not (0.0 <= u < width and 0.0 <= v < height):
            continue
        dx, dy, dz = X - ox, Y - oy, Z - oz
        distance = math.sqrt(dx * dx + dy * dy + dz * dz)
        if distance < 0.8 * near[p] or distance > 1.2 * far[p]:
            continue
        c = (dx * normal[p, 0] + dy * normal[p, 1] + dz * normal[p, 2]) / distance
        if c < 0.5:
            continue
        place[i, 0], place[i, 1], place[i, 2] = u, v, camera[4] / z
        level = math.ceil(math.log(far[p] / distance) / log_scale)
        octave[i] = min(max(level, 0), levels - 1)
        cosine[i] = c
        seen += 1
    return seen
