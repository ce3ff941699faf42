"""The points that matter: those at trunk height, and those above it; one pass, no copies of coordinates."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numba import njit
from numpy.typing import NDArray

from services.detector.ground import GroundedCloud
from services.detector.ground_surface import height_above
from services.detector.halves import both_halves, half_of
from services.detector.model import Floats
from services.detector.upright import Upright

Floats32 = NDArray[np.float32]
Ints32 = NDArray[np.int32]


@dataclass(frozen=True, slots=True)
class Band:
    """Points at trunk height, and the points above."""

    index: Ints32 = field(repr=False)
    """(K,) rows of the upright frame's points, rising."""
    height_m: Floats32 = field(repr=False)
    """(K,) above ground."""
    above_m: Floats32 = field(repr=False)
    """(L, 3) upright coordinates of the points above trunk height."""


@njit(cache=True, nogil=True)
def _crop(
    xyz: Floats32, cell_of: Ints32, begin: int, end: int, x0: float, y0: float, cell: float, planes: Floats, low: float,
    high: float, top: float, index: Ints32, height: Floats32, above: Floats32,
) -> tuple[int, int]:  # fmt: skip
    n, m = begin, begin
    for i in range(begin, end):
        c = cell_of[i]
        if c < 0:
            continue
        h = height_above(xyz, i, c, x0, y0, cell, planes)
        if h < low or h > top:
            continue
        if h <= high:
            index[n] = i
            height[n] = h
            n += 1
        else:
            above[m, 0], above[m, 1], above[m, 2] = xyz[i, 0], xyz[i, 1], xyz[i, 2]
            m += 1
    return n - begin, m - begin


def crop(frame: Upright, grounded: GroundedCloud, low_m: float, high_m: float, top_m: float) -> Band:
    """Return the points between ``low_m`` and ``high_m`` above ground, and those from there up to ``top_m``."""
    g, n = grounded.ground, len(frame.xyz_m)
    index, height = np.empty(n, dtype=np.int32), np.empty(n, dtype=np.float32)
    above = np.empty((n, 3), dtype=np.float32)
    kept = [(0, 0), (0, 0)]

    def work(half: int) -> None:
        begin, end = half_of(n, half)
        kept[half] = _crop(
            frame.xyz_m, grounded.cell_of, begin, end, g.x0_m, g.y0_m, g.cell_m, g.planes, low_m, high_m, top_m, index,
            height, above,
        )  # fmt: skip

    both_halves(work, n)
    (a, p), (b, q), middle = kept[0], kept[1], n // 2
    return Band(
        np.concatenate([index[:a], index[middle : middle + b]]),
        np.concatenate([height[:a], height[middle : middle + b]]),
        np.concatenate([above[:p], above[middle : middle + q]]),
    )
