"""Kernels that judge one fitted trunk: its surface, what lies around it, its girth."""

from __future__ import annotations

import numpy as np
from numba import njit

from services.detector.arcs import BINS
from services.detector.model import Floats, Ints
from services.detector.ray import point_sigma, residual


@njit(cache=True, nogil=True)
def assess(
    P: Floats, U: Floats, G: Floats, x: Floats, scale: float, k_range: float, surface: float, on: Ints, counts: Floats,
    bands: Ints, z_low: float,
) -> None:  # fmt: skip
    """Fill counts: on, inside, around, arc, noise, mean range, core, skin. Mark the points on the surface; count them per band."""
    bins = np.zeros(BINS)
    J = np.empty(3)
    counts[:] = 0.0
    for i in range(P.shape[0]):
        z = P[i, 2]
        cx, cy, r = x[0] + x[2] * z, x[1] + x[3] * z, max(x[4] + x[5] * z, 0.005)
        dx, dy = P[i, 0] - cx, P[i, 1] - cy
        ray = U[i, 0] != 0.0 or U[i, 1] != 0.0
        s = (dy * U[i, 0] - dx * U[i, 1]) / r
        sigma = scale * point_sigma(s, G[i], ray, k_range, surface)
        e = residual(P[i, 0], P[i, 1], U[i, 0], U[i, 1], cx, cy, r, J)
        d = np.sqrt(dx * dx + dy * dy)
        if d < 0.6 * r:
            counts[6] += 1
        elif 0.8 * r < d < 1.2 * r:
            counts[7] += 1
        on[i] = 0
        if abs(e) < 3.0 * sigma:
            on[i] = 1
            counts[0] += 1
            counts[4] += e * e
            counts[5] += G[i]
            bins[min(BINS - 1, int((np.arctan2(dy, dx) + np.pi) / (2.0 * np.pi) * BINS))] += 1.0
            band = int((z - z_low) / 0.1)
            if 0 <= band < bands.shape[0]:
                bands[band] += 1
        elif d < r:
            counts[1] += 1
        elif d < r + 0.1:
            counts[2] += 1
    few = 0.02 * counts[0] / 10.0
    for b in range(BINS):
        if bins[b] > few:
            counts[3] += 2.0 * np.pi / BINS
    if counts[0] > 0:
        counts[4] = np.sqrt(counts[4] / counts[0])
        counts[5] /= counts[0]


@njit(cache=True, nogil=True)
def girth_correction(P: Floats, x: Floats) -> float:
    """Return what to add to the radius so that every direction counts alike, not every point.

    Trunks are not round and scans are denser on one side; a tape goes round all sides. Mean over 36 sectors of the
    median residual; sectors with fewer than 8 points count as the fitted circle.
    """
    n = P.shape[0]
    e, sector = np.empty(n), np.full(n, -1)
    for i in range(n):
        z = P[i, 2]
        dx, dy = P[i, 0] - x[0] - x[2] * z, P[i, 1] - x[1] - x[3] * z
        e[i] = np.sqrt(dx * dx + dy * dy) - (x[4] + x[5] * z)
        if abs(e[i]) < min(0.08, 0.5 * x[4]):
            sector[i] = min(BINS - 1, int((np.arctan2(dy, dx) + np.pi) / (2.0 * np.pi) * BINS))
    total, own = 0.0, np.empty(n)
    for b in range(BINS):
        m = 0
        for i in range(n):
            if sector[i] == b:
                own[m] = e[i]
                m += 1
        total += np.median(own[:m]) if m >= 8 else 0.0
    return total / BINS
