"""Compiled operations that keep a growing map small: fusing doubles, dropping what proves bad, measuring redundancy."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from services.slam.links import Keyframes, Points, describe, forget, merge, observe, remove_point
from services.slam.match import match_windows, project
from services.slam.observe import CHI2_DEPTH, CHI2_MONO

F64 = NDArray[np.float64]
I32 = NDArray[np.int32]

MATCH_STRICT = 50
"""Hamming distance below which two descriptors are taken for one corner."""


@njit(cache=True, nogil=True)
def cull_recent(points: Points, kf: Keyframes, recent: I32, now: int) -> I32:
    """Remove young points that prove bad: seldom found where they should be, or seen by one keyframe only.

    ``recent`` (M, 2) point, serial of birth; returns those that are still on probation.
    """
    out = np.empty_like(recent)
    count = 0
    for row in range(len(recent)):
        p, born = recent[row, 0], recent[row, 1]
        if points.n[p] == 0 or points.born[p] != born:
            continue
        if 4 * points.found[p] < points.visible[p] or (now - born >= 3 and points.n[p] < 2):
            remove_point(points, kf, p)
        elif now - born < 3:
            out[count] = recent[row]
            count += 1
    return out[:count].copy()


@njit(cache=True, nogil=True)
def describe_all(points: Points, kf: Keyframes, k: int, scales: F64) -> None:
    """Renew the description of all points that keyframe ``k`` sees."""
    for i in range(kf.n[k]):
        if kf.point[k, i] >= 0:
            describe(points, kf, kf.point[k, i], scales)


@njit(cache=True, nogil=True)
def fuse(
    points: Points, kf: Keyframes, k: int, ids: I32, camera: F64, variance: F64, scales: F64,
    cols: int, width: float, height: float,
) -> int:  # fmt: skip
    """Find points ``ids`` among the features of keyframe ``k``: new observations, or two points made one.

    Returns how many were joined. Only matches within the chi-square limit of the projection count.
    """
    candidates = np.empty(len(ids), np.int32)
    m = 0
    for p in ids:
        seen = points.n[p] == 0
        for j in range(points.n[p]):
            seen = seen or points.frame[p, j] == k
        if not seen:
            candidates[m] = p
            m += 1
    candidates = candidates[:m]
    place, octave, cosine = np.empty((m, 3)), np.zeros(m, np.int32), np.empty(m)
    project(candidates, points.pos, points.normal, points.near, points.far, kf.R[k], kf.t[k], camera, width, height,
            scales[1] / scales[0], len(scales), place, octave, cosine)  # fmt: skip
    n = kf.n[k]
    uv, disparity = kf.uv[k, :n].astype(np.float64), kf.disparity[k, :n].astype(np.float64)
    radius = 3.0 * scales[octave]
    match = match_windows(
        place, radius, octave - 1, octave + 1, points.desc[candidates], uv, disparity, kf.octave[k, :n].copy(),
        kf.desc[k, :n].copy(), kf.cell_start[k].copy(), kf.cell_items[k].copy(), cols, np.ones(n, np.bool_), MATCH_STRICT, 1.0,
    )  # fmt: skip
    joined = 0
    for c in range(m):
        i = match[c]
        if i < 0:
            continue
        e = ((uv[i, 0] - place[c, 0]) ** 2 + (uv[i, 1] - place[c, 1]) ** 2) / variance[kf.octave[k, i]]
        limit = CHI2_MONO
        if disparity[i] > 0.0:
            e += (disparity[i] - place[c, 2]) ** 2 * kf.info[k, i]
            limit = CHI2_DEPTH
        if e > limit:
            continue
        p, q = candidates[c], kf.point[k, i]
        if points.n[p] == 0:
            continue
        joined += 1
        if q < 0:
            observe(points, kf, p, k, i)
        elif points.n[q] >= points.n[p]:
            merge(points, kf, q, p, scales)
        else:
            merge(points, kf, p, q, scales)
    return joined


@njit(cache=True, nogil=True)
def drop_outliers(
    points: Points, kf: Keyframes, ids: I32, slots: I32, start: I32, frame: I32, use: NDArray[np.bool_]
) -> None:
    """Forget the observations of an adjustment that ended as outliers."""
    for m in range(len(ids)):
        for o in range(start[m], start[m + 1]):
            if not use[o]:
                forget(points, kf, ids[m], slots[frame[o]])


@njit(cache=True, nogil=True)
def redundancy(points: Points, kf: Keyframes, k: int) -> float:
    """Return the share of a keyframe's points that three others see at the same or a finer scale."""
    total, redundant = 0, 0
    for i in range(kf.n[k]):
        p = kf.point[k, i]
        if p < 0:
            continue
        total += 1
        others = 0
        for j in range(points.n[p]):
            other = points.frame[p, j]
            if other != k and kf.octave[other, points.feature[p, j]] <= kf.octave[k, i] + 1:
                others += 1
        redundant += others >= 3
    return redundant / max(total, 1)
