"""RANSAC seeds for circles: three near points each, scored by a truncated quadratic (MSAC)."""

from __future__ import annotations

import numpy as np
from numba import njit

from services.detector.model import Floats, Ints

GOOD = 0.7
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
def _part_score(P: Floats, U: Floats, S: Floats, left: Ints, first: int, n: int, step: int, c: Floats) -> float:
    """Sum the score over every ``step``-th point from ``first`` on."""
    score = 0.0
    wide = 0.08 * min(c[2], 0.15)
    for q in range(first, n, step):
        i = left[q]
        dx, dy = P[i, 0] - c[0], P[i, 1] - c[1]
        tol = S[i] + wide
        d2 = dx * dx + dy * dy
        if d2 > (c[2] + tol) ** 2:
            continue
        e = (np.sqrt(d2) - c[2]) / tol
        if e > -1.0:
            if dx * U[i, 0] + dy * U[i, 1] <= 0.25 * c[2] + tol:
                score += 1.0 - e * e
        else:
            score -= 0.5
    return score


@njit(cache=True, nogil=True)
def circle_score(P: Floats, U: Floats, S: Floats, left: Ints, n: int, c: Floats, top: float) -> float:
    """Return a truncated quadratic count of the points on the visible side, less half of those inside the circle.

    About 100 points are looked at; only a quarter of them where that quarter shows no hope of passing ``top``.
    """
    step = max(1, n // 100)
    part = _part_score(P, U, S, left, 0, n, 4 * step, c)
    if 4.0 * part * step < 0.5 * top:
        return 4.0 * part * step
    for first in range(1, 4):
        part += _part_score(P, U, S, left, first * step, n, 4 * step, c)
    return part * step


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
        score = circle_score(P, U, S, left, n, c, top)
        if score > top:
            top = score
            best[0], best[1], best[2] = c[0], c[1], c[2]
            if trial > 8 and top > GOOD * n:
                break
    return top
