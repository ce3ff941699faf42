"""Compiled first look at one object: could it be a trunk near here, and which circle is it about."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from services.detector.refine.kernels_scan import (
    FIRST,
    HOLE,
    LAST,
    LEFT_KIND,
    LEFT_RAD,
    MAX_M,
    MIN_M,
    NEAR_M,
    RIGHT_KIND,
    RIGHT_RAD,
    ROW,
    SILHOUETTE,
)
from services.detector.refine.model import Matrix

TREE_COLUMNS = 4
"""Of the trees an object may be: place in the frame along the trunk (2), radius, how much the radius may differ."""
_WIDE = 1.6


@njit(cache=True, nogil=True)
def object_start(
    runs: Matrix, label: NDArray[np.int64], wanted: int, trees: Matrix, reach_m: float, max_spread_m: float,
    radius_limits: Matrix, start: Matrix,
) -> bool:  # fmt: skip
    """Fill ``start`` (5,) with a first circle for the object ``wanted``; False when it cannot be any of ``trees``.

    ``radius_limits`` (2,): least and largest radius. Medians and tenths are used, as mixed pixels stretch single rows.
    """
    index = np.flatnonzero(label == wanted)
    n = len(index)
    near, deep, middle, half = np.empty(n), np.empty(n), np.empty(n), np.empty(n)
    whole = 0
    for j in range(n):
        run = runs[index[j]]
        near[j], deep[j] = run[NEAR_M], run[MAX_M] - run[MIN_M]
        whole += _whole(run)
    use_whole = whole * 3 >= n
    m = 0
    for j in range(n):
        run = runs[index[j]]
        if not use_whole or _whole(run):
            middle[m], half[m] = 0.5 * (run[LEFT_RAD] + run[RIGHT_RAD]), 0.5 * (run[LEFT_RAD] - run[RIGHT_RAD])
            m += 1
    near.sort()
    tenth = n // 10
    if max(near[n - 1 - tenth] - near[tenth], _median(deep)) > max_spread_m:
        return False
    bearing, sine = _median(middle[:m]), math.sin(min(max(_median(half[:m]), 0.0), 1.2))
    distance = near[n // 2]
    seen_radius = distance * sine / max(1.0 - sine, 0.1)
    best = reach_m
    for t in range(trees.shape[0]):
        if seen_radius > _WIDE * (trees[t, 2] + trees[t, 3]):
            continue
        radius = seen_radius if use_whole else trees[t, 2]
        radius = min(max(radius, radius_limits[0]), radius_limits[1])
        x, y = (distance + radius) * math.cos(bearing), (distance + radius) * math.sin(bearing)
        apart = math.hypot(x - trees[t, 0], y - trees[t, 1])
        if apart < best:
            best = apart
            start[0], start[1], start[2], start[3], start[4] = x, y, radius, 0.0, 0.0
    return best < reach_m


@njit(cache=True, nogil=True)
def _whole(run: Matrix) -> bool:
    """Tell whether both ends of a run are the object's own edges."""
    left, right = run[LEFT_KIND], run[RIGHT_KIND]
    return bool(left in (SILHOUETTE, HOLE) and right in (SILHOUETTE, HOLE))


@njit(cache=True, nogil=True)
def _median(values: Matrix) -> float:
    """Return the upper median."""
    return float(np.sort(values)[len(values) // 2])


@njit(cache=True, nogil=True)
def object_extent(runs: Matrix, label: NDArray[np.int64], wanted: int, extent: Matrix) -> None:
    """Fill ``extent`` (5,): median left and right column, first and last row, median angle seen from the camera."""
    index = np.flatnonzero(label == wanted)
    n = len(index)
    left, right, angle = np.empty(n), np.empty(n), np.empty(n)
    for j in range(n):
        run = runs[index[j]]
        left[j], right[j], angle[j] = run[FIRST], run[LAST], run[LEFT_RAD] - run[RIGHT_RAD]
    extent[0], extent[1], extent[4] = _median(left), _median(right), _median(angle)
    extent[2], extent[3] = runs[index[0], ROW], runs[index[n - 1], ROW]


@njit(cache=True, nogil=True)
def object_edges(runs: Matrix, label: NDArray[np.int64], wanted: int, edges: NDArray[np.int64]) -> int:
    """Fill ``edges`` (N, 3) with row, left and right column where background is seen beside them, else -1; how many."""
    n = 0
    for k in range(len(label)):
        run = runs[k]
        if label[k] != wanted or n >= edges.shape[0]:
            continue
        left = int(run[FIRST]) if run[LEFT_KIND] == SILHOUETTE else -1
        right = int(run[LAST]) if run[RIGHT_KIND] == SILHOUETTE else -1
        if left >= 0 or right >= 0:
            edges[n, 0], edges[n, 1], edges[n, 2] = int(run[ROW]), left, right
            n += 1
    return n
