"""The points that matter: those at trunk height, and those above it; one pass, each kind packed together."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np
from numba import njit
from numpy.typing import NDArray

from services.detector.ground import GroundedCloud
from services.detector.ground_surface import height_above
from services.detector.halves import both_halves, half_of
from services.detector.model import Floats, Views
from services.detector.upright import Upright

Floats32 = NDArray[np.float32]
Ints32 = NDArray[np.int32]
Rows = TypeVar("Rows", bound=NDArray[Any])

_NO_VIEWS = np.empty(0, dtype=np.int32)


@dataclass(frozen=True, slots=True)
class Band:
    """Points at trunk height, and the points above; upright frame."""

    xyz_m: Floats32 = field(repr=False)
    """(K, 3)."""
    view: Ints32 = field(repr=False)
    """(K,) row of the views' origins; empty where views are unknown."""
    span_m: tuple[float, float]
    """Lowest and highest of them above ground."""
    above_m: Floats32 = field(repr=False)
    """(L, 3) points above trunk height."""


@njit(cache=True, nogil=True)
def _crop(
    xyz: Floats32, cell_of: Ints32, view_of: Ints32, begin: int, end: int, x0: float, y0: float, cell: float, planes: Floats,
    low: float, high: float, top: float, out: Floats32, view: Ints32, above: Floats32, span: Floats,
) -> tuple[int, int]:  # fmt: skip
    n, m = begin, begin
    with_views = view_of.shape[0] > 0
    least, most = span[0], span[1]
    for i in range(begin, end):
        c = cell_of[i]
        if c < 0:
            continue
        h = height_above(xyz, i, c, x0, y0, cell, planes)
        if h < low or h > top:
            continue
        if h <= high:
            out[n, 0], out[n, 1], out[n, 2] = xyz[i, 0], xyz[i, 1], xyz[i, 2]
            if with_views:
                view[n] = view_of[i]
            least, most = min(least, h), max(most, h)
            n += 1
        else:
            above[m, 0], above[m, 1], above[m, 2] = xyz[i, 0], xyz[i, 1], xyz[i, 2]
            m += 1
    span[0], span[1] = least, most
    return n - begin, m - begin


def crop(
    frame: Upright, grounded: GroundedCloud, views: Views | None, low_m: float, high_m: float, top_m: float
) -> Band:
    """Return the points between ``low_m`` and ``high_m`` above ground, and those from there up to ``top_m``."""
    g, n = grounded.ground, len(frame.xyz_m)
    view_of = _NO_VIEWS if views is None else views.index
    xyz, above = np.empty((n, 3), dtype=np.float32), np.empty((n, 3), dtype=np.float32)
    view = np.empty(len(view_of), dtype=np.int32)
    span = np.tile([np.inf, -np.inf], (2, 1))
    kept = [(0, 0), (0, 0)]

    def work(half: int) -> None:
        begin, end = half_of(n, half)
        kept[half] = _crop(
            frame.xyz_m, grounded.cell_of, view_of, begin, end, g.x0_m, g.y0_m, g.cell_m, g.planes, low_m, high_m, top_m, xyz,
            view, above, span[half],
        )  # fmt: skip

    both_halves(work, n)
    (a, p), (b, q), middle = kept[0], kept[1], n // 2
    return Band(
        _closed_up(xyz, a, middle, b), _closed_up(view, a, middle, b) if len(view) else view,
        (float(span[:, 0].min()), float(span[:, 1].max())), _closed_up(above, p, middle, q),
    )  # fmt: skip


def _closed_up(rows: Rows, first: int, middle: int, more: int) -> Rows:
    """Move the rows that the second half wrote from ``middle`` on behind the first half's."""
    rows[first : first + more] = rows[middle : middle + more]
    packed: Rows = rows[: first + more]  # type: ignore[assignment]  # a slice of an array is such an array
    return packed
