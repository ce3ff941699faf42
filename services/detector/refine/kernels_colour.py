"""Compiled comparison of where the depth image and the colour image see a trunk's edges."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from services.detector.refine.model import Matrix

_STEP_PX = 2


@njit(cache=True, nogil=True)
def edge_profiles(colour: NDArray[np.uint8], edges: NDArray[np.int64], reach_px: int, profiles: Matrix) -> int:
    """Fill ``profiles`` (2, 2 * reach + 1): how strong colour edges are so far beside the left and right depth edges.

    ``colour`` (H, W, 3). Each row has one say: its gradients are divided by their sum. Returns the rows used.
    """
    width = colour.shape[1]
    size = 2 * reach_px + 1
    gradient = np.empty(size)
    profiles[:] = 0.0
    used = 0
    for k in range(len(edges)):
        v = edges[k, 0]
        for side in range(2):
            u = edges[k, 1 + side]
            if u < reach_px + _STEP_PX or u >= width - reach_px - _STEP_PX:
                continue
            total = 1e-9
            for j in range(size):
                w = u + j - reach_px
                gradient[j] = abs(float(colour[v, w + _STEP_PX, 1]) - float(colour[v, w - _STEP_PX, 1]))
                total += gradient[j]
            for j in range(size):
                profiles[side, j] += gradient[j] / total
            used += 1
    return used


@njit(cache=True, nogil=True)
def best_offset(profiles: Matrix, widest_px: int, out: Matrix) -> None:
    """Fill ``out`` (3,): the shift of colour against depth, the widening at it, and how it stands out.

    Mixed pixels make a trunk in the depth image a little wider or narrower than in colour, so both sides are moved
    together by the shift and apart by the widening. The last is the peak over the mean of all shifts.
    """
    size = profiles.shape[1]
    reach = (size - 1) // 2
    best, total, n = -1.0, 0.0, 0
    for shift in range(-reach + widest_px, reach - widest_px + 1):
        top, top_widening = -1.0, 0
        for widening in range(-widest_px, widest_px + 1):
            value = profiles[0, reach + shift - widening] + profiles[1, reach + shift + widening]
            if value > top:
                top, top_widening = value, widening
        total += top
        n += 1
        if top > best:
            best = top
            out[0], out[1] = shift, top_widening
    out[2] = best / (total / n) if total > 0.0 else 0.0
