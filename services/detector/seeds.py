"""RANSAC seeds for circles: three near points each, scored by a truncated quadratic (MSAC)."""

from __future__ import annotations

import numpy as np
from numba import njit

from services.detector.model import Floats, Ints

_GOOD = 0.7
"""A circle with this share of all points (truncated quadratic count) needs no rival."""


@njit(cache=True, nogil=True)
def _uniform(state: Ints) -> float:
    """Return the next number in [0, 1) of a 63-bit linear congruential generator."""
    state[0] = (state[0] * np.int64(2862933555777941757) + np.int64(3037000493)) & np.int64(0x7FFFFFFFFFFFFFFF)
    return (state[0] >> 11) / 4503599627370496.0


@njit(cache=True, nogil=True)
def _circumcircle(P: Floats, i: int, j: int, k: int, out: Floats) -> bool:
    ax, ay = P[j, 0] - P[i, 0], P[j, 1] - P[i, 1]
    bx, by = P[k, 0] - P[i, 0], P[k, 1] - P[i, 1]
    cross = 2.0 * (ax * by - ay * bx)
    if abs(cross) < 1e-9:
        return False
    a2, b2 = ax * ax + ay * ay, bx * bx + by * by
    ux, uy = (by * a2 - ay * b2) / cross, (ax * b2 - bx * a2) / cross
    out[0], out[1] = P[i, 0] + ux, P[i, 1] + uy
    out[2] = np.sqrt(ux * ux + uy * uy)
    return True


@njit(cache=True, nogil=True)
def _score(P: Floats, U: Floats, S: Floats, left: Ints, n: int, c: Floats) -> float:
    """Return a truncated quadratic count of the points on the visible side, less half of those inside the circle."""
    score = 0.0
    step = max(1, n // 100)
    for q in range(0, n, step):
        i = left[q]
        dx, dy = P[i, 0] - c[0], P[i, 1] - c[1]
        d = np.sqrt(dx * dx + dy * dy)
        tol = S[i] + 0.08 * min(c[2], 0.15)
        e = (d - c[2]) / tol
        if abs(e) < 1.0:
            facing = dx * U[i, 0] + dy * U[i, 1]
            if facing <= 0.25 * c[2] + tol:
                score += 1.0 - e * e
        elif e < 0.0:
            score -= 0.5
    return score * step


@njit(cache=True, nogil=True)
def best_seed(
    P: Floats,
    U: Floats,
    S: Floats,
    left: Ints,
    n: int,
    state: Ints,
    trials: int,
    r_min: float,
    r_max: float,
    best: Floats,
) -> float:
    """Return the best score of circles through three near points; writes the circle to ``best``."""
    top = 0.0
    c = np.empty(3)
    for trial in range(trials):
        i = left[min(n - 1, int(_uniform(state) * n))]
        j, k = -1, -1
        for _ in range(10):
            q = left[min(n - 1, int(_uniform(state) * n))]
            d2 = (P[q, 0] - P[i, 0]) ** 2 + (P[q, 1] - P[i, 1]) ** 2
            if q in (i, j) or d2 > 4.0 * r_max * r_max:
                continue
            if j < 0:
                j = q
            else:
                k = q
                break
        if k < 0 or not _circumcircle(P, i, j, k, c) or not r_min <= c[2] <= r_max:
            continue
        score = _score(P, U, S, left, n, c)
        if score > top:
            top = score
            best[0], best[1], best[2] = c[0], c[1], c[2]
            if trial > 8 and top > _GOOD * n:
                break
    return top
