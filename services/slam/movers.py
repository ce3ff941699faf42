"""What moves by itself: features that go another way between two frames than the camera's motion tells, all around alike.

One feature off its place is a wrong match. Neighbours at one depth that are off together are somebody walking: what he
wears is full of corners, near and therefore strong, and would take the map along if it ever became a part of it.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from services.slam.match import CELL_PX
from services.slam.observe import jacobian, pose_jacobian
from services.slam.tracking import Tracked, Tracking

F64 = NDArray[np.float64]
I32 = NDArray[np.int32]

_AROUND_PX = 60.0
_ALIKE_PX = 2.0
"""Neighbours are so near in the image, and in disparity."""
_LEAST = 8
"""Neighbours that have to agree."""
_OFF_PX = 1.5
_SURE = 5.0
"""Their mean has to be so many pixels off, and standard errors."""
_DOUBTS = 3.0
"""And so many standard deviations of what the pose itself may be off."""
_REMEMBERED_S = 1.5
"""What was seen to move is not trusted again before it has stood still for so long."""


def mark(tracking: Tracking, last: Tracked, frame: Tracked, dt_s: float) -> None:
    """Write into a located frame's features for how long they are not to be trusted; without them its pose is found anew.

    Judged from where points say the camera is that have been found again and again: somebody near who has just come is
    believed as well by a pose as it is by him, so a pose that he had a part in tells nothing of him.
    """
    judge = tracking.by_proven(frame) or frame
    match, off = tracking.off_their_places(last, judge)
    f, was = frame.features, last.features.moving_s
    queries = np.flatnonzero(match >= 0)
    before = np.zeros(len(f))
    before[match[queries]] = np.maximum(was[queries] - dt_s, 0.0)
    assert judge.information is not None
    covariance: F64 = np.asarray(np.linalg.inv(judge.information + 1e-6 * np.eye(6)), np.float64)
    doubt = doubts(f.uv, f.depth, covariance, tracking.camera.array)
    cols, usual_px = tracking.camera.cols, usual_off(off, before)
    f.moving_s = suspects(f.uv, f.disparity, f.cell_start, f.cell_items, cols, off, usual_px, doubt, before)
    taken = (f.moving_s > 0.0) & (frame.point >= 0)
    if taken.any():
        frame.point[taken] = -1
        frame.R, frame.t = judge.R, judge.t
        tracking.again(frame)


def usual_off(off: F64, before: F64) -> float:
    """Return how far (pixels, median) features are off that nobody suspects: in a smeared image all are, somehow."""
    seen = ~np.isnan(off[:, 0]) & (before == 0.0)
    return float(np.median(np.hypot(off[seen, 0], off[seen, 1]))) if seen.any() else 0.0


@njit(cache=True, nogil=True)
def doubts(uv: F64, depth: F64, covariance: F64, camera: F64) -> F64:
    """Return the variance (N,), pixels squared, of where features at ``depth`` are expected, for the pose's (6, 6)."""
    out = np.zeros(len(uv))
    J, JP = np.empty((3, 3)), np.empty((3, 6))
    for i in range(len(uv)):
        z = depth[i]
        if z <= 0.0:
            continue
        x, y = (uv[i, 0] - camera[2]) * z / camera[0], (uv[i, 1] - camera[3]) * z / camera[1]
        jacobian(x, y, z, camera, J)
        pose_jacobian(x, y, z, J, JP)
        for k in range(2):
            for m in range(6):
                for n in range(6):
                    out[i] += JP[k, m] * covariance[m, n] * JP[k, n]
    return out


@njit(cache=True, nogil=True)
def around(uv: F64, disparity: F64, off: F64, cell_start: I32, cell_items: I32, cols: int, i: int, out: I32) -> int:
    """Write into ``out`` the neighbours of feature ``i``, in the image and in depth, that the last frame saw too; return how many."""
    rows = (len(cell_start) - 1) // cols
    u, v = uv[i, 0], uv[i, 1]
    c0, c1 = max(int((u - _AROUND_PX) / CELL_PX), 0), min(max(int((u + _AROUND_PX) / CELL_PX), 0), cols - 1)
    r0, r1 = max(int((v - _AROUND_PX) / CELL_PX), 0), min(max(int((v + _AROUND_PX) / CELL_PX), 0), rows - 1)
    count = 0
    for row in range(r0, r1 + 1):
        for k in range(cell_start[row * cols + min(c0, c1)], cell_start[row * cols + c1 + 1]):
            j = cell_items[k]
            if abs(disparity[i] - disparity[j]) > _ALIKE_PX or np.isnan(off[j, 0]):
                continue
            if abs(uv[j, 0] - u) <= _AROUND_PX and abs(uv[j, 1] - v) <= _AROUND_PX:
                out[count] = j
                count += 1
    return count


@njit(cache=True, nogil=True)
def together(off: F64, which: I32, least2: float) -> bool:
    """Return whether features ``which`` are off their places together, by more than ``least2``, pixels squared."""
    count, x, y, squares = len(which), 0.0, 0.0, 0.0
    if count < _LEAST:
        return False
    for j in which:
        x, y = x + off[j, 0], y + off[j, 1]
        squares += off[j, 0] ** 2 + off[j, 1] ** 2
    mean2 = (x * x + y * y) / count**2
    return mean2 > least2 and mean2 * count > _SURE**2 * (squares / count - mean2)


@njit(cache=True, nogil=True)
def suspects(
    uv: F64, disparity: F64, cell_start: I32, cell_items: I32, cols: int, off: F64, usual_px: float, doubt: F64, before: F64
) -> F64:  # fmt: skip
    """Return for how long (N,), seconds, features are not to be trusted, 0 for most, and for all without depth: they do not pull.

    ``off`` (N, 2) pixels from where they should have come to lie since the last frame (NaN: not seen there), ``usual_px`` how
    far others are off, ``doubt`` (N,) the variance of it for the pose's, ``before`` (N,) how long they were not to be trusted
    yet: who is a suspect has to stand still to be trusted again, for him the doubt counts little. What is new is a suspect
    where most of its neighbours are, and nobody is one alone; the search grid finds the neighbours.
    """
    n = len(uv)
    own, out, found = before.copy(), np.zeros(n), np.empty(n, np.int32)
    least2 = max(_OFF_PX, usual_px) ** 2
    for i in range(n):
        if disparity[i] > 0.0:
            count = around(uv, disparity, off, cell_start, cell_items, cols, i, found)
            if together(off, found[:count], least2 + doubt[i] * (_DOUBTS**2 if before[i] == 0.0 else 1.0)):
                own[i] = _REMEMBERED_S
    if not own.any():
        return out
    for i in range(n):
        if disparity[i] > 0.0:
            count = around(uv, disparity, off, cell_start, cell_items, cols, i, found)
            suspected, total = 0, 0.0
            for j in found[:count]:
                suspected += own[j] > 0.0
                total += own[j]
            seen = not np.isnan(off[i, 0])
            if 2 * suspected > count:
                out[i] = total / suspected if not seen or 5 * suspected > 4 * count else own[i]
    return out
