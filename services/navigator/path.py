"""A way around the mapped trunks to a place in front of the target. Pure.

A* (Hart, Nilsson and Raphael 1968) on an eight-connected grid; trunks are discs grown by the clearance. The
straight line is taken whenever it is free.
"""

from __future__ import annotations

import heapq
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from services.common.geometry import Matrix

_CELL_M = 0.15
_MARGINS_M = (2.0, 6.0)
"""How far the search reaches beyond start and goal; further only when the near one finds no way."""
_MAX_CELLS = 40_000
_AZIMUTHS = 36


@dataclass(frozen=True, slots=True)
class Disc:
    """A trunk as an obstacle: centre x, y and the radius that the aircraft's centre keeps out of.

    The geofence is one that it keeps within.
    """

    x_m: float
    y_m: float
    keep_out_m: float


def clearance_m(p: Matrix, discs: Sequence[Disc]) -> float:
    """Return the distance from ``p`` (2,) to the nearest keep-out circle, negative inside; inf without discs."""
    return min((float(np.hypot(p[0] - d.x_m, p[1] - d.y_m)) - d.keep_out_m for d in discs), default=float("inf"))


def line_clearance_m(a: Matrix, b: Matrix, discs: Sequence[Disc]) -> float:
    """Return the least clearance on the segment from ``a`` to ``b``, each (2,)."""
    along = b - a
    length2 = float(along @ along)
    least = float("inf")
    for d in discs:
        c = np.array([d.x_m, d.y_m])
        t = float(np.clip((c - a) @ along / length2, 0.0, 1.0)) if length2 > 1e-12 else 0.0
        least = min(least, float(np.linalg.norm(a + t * along - c)) - d.keep_out_m)
    return least


def standoff(axis_m: Matrix, from_m: Matrix, distance_m: float, discs: Sequence[Disc]) -> Matrix:
    """Return the place (2,) at ``distance_m`` from the axis nearest to ``from_m`` that keeps clear of ``discs``.

    When no azimuth is clear, the clearest is returned.
    """
    offset = from_m - axis_m
    first = float(np.arctan2(offset[1], offset[0]))
    best: tuple[float, Matrix] | None = None
    for i in range(_AZIMUTHS):
        turn = ((i + 1) // 2) * (2.0 * np.pi / _AZIMUTHS) * (1 if i % 2 else -1)
        p = axis_m + distance_m * np.array([np.cos(first + turn), np.sin(first + turn)])
        clear = clearance_m(p, discs)
        if clear >= 0.0:
            return p
        if best is None or clear > best[0]:
            best = (clear, p)
    assert best is not None
    return best[1]


def plan(start_m: Matrix, goal_m: Matrix, discs: Sequence[Disc], within: Disc | None = None) -> list[Matrix] | None:
    """Return the corner points (2,) after ``start_m`` to ``goal_m``, or None when there is no way.

    A circle that holds the start or the goal shrinks until it does not: from there only outward, never deeper.
    No corner lies outside ``within``, the geofence's circle.
    """
    discs = [_shrunk(d, start_m, goal_m) for d in discs]
    if line_clearance_m(start_m, goal_m, discs) >= 0.0:
        return [goal_m]
    for margin_m in _MARGINS_M:
        way = _detour(start_m, goal_m, discs, within, margin_m)
        if way is not None:
            return way
    return None


def _detour(
    start_m: Matrix, goal_m: Matrix, discs: Sequence[Disc], within: Disc | None, margin_m: float
) -> list[Matrix] | None:
    """Return the corners of the shortest way on a grid that reaches ``margin_m`` beyond start and goal."""
    low = np.minimum(start_m, goal_m) - margin_m
    shape = tuple(int(n) for n in np.ceil((np.maximum(start_m, goal_m) + margin_m - low) / _CELL_M) + 1)
    if shape[0] * shape[1] > _MAX_CELLS:
        return None
    cells = _search(_blocked(low, shape, discs, within), _cell(start_m, low), _cell(goal_m, low))
    if cells is None:
        return None
    points = [low + np.array(c) * _CELL_M for c in cells[1:-1]] + [goal_m]
    return _shortened(start_m, points, discs)


def _shrunk(d: Disc, start_m: Matrix, goal_m: Matrix) -> Disc:
    room = min(float(np.hypot(p[0] - d.x_m, p[1] - d.y_m)) for p in (start_m, goal_m)) - 0.5 * _CELL_M
    return d if room >= d.keep_out_m else Disc(d.x_m, d.y_m, max(room, 0.0))


def _cell(p: Matrix, low: Matrix) -> tuple[int, int]:
    i, j = np.rint((p - low) / _CELL_M).astype(int)
    return int(i), int(j)


def _blocked(low: Matrix, shape: tuple[int, ...], discs: Sequence[Disc], within: Disc | None) -> Matrix:
    x = low[0] + np.arange(shape[0])[:, None] * _CELL_M
    y = low[1] + np.arange(shape[1])[None, :] * _CELL_M
    blocked = np.zeros(shape, dtype=bool)
    if within is not None:
        blocked |= np.hypot(x - within.x_m, y - within.y_m) > within.keep_out_m
    for d in discs:
        blocked |= np.hypot(x - d.x_m, y - d.y_m) < d.keep_out_m
    return blocked


def _search(blocked: Matrix, start: tuple[int, int], goal: tuple[int, int]) -> list[tuple[int, int]] | None:
    came: dict[tuple[int, int], tuple[int, int]] = {}
    cost = {start: 0.0}
    queue: list[tuple[float, tuple[int, int]]] = [(0.0, start)]
    while queue:
        _, here = heapq.heappop(queue)
        if here == goal:
            way = [here]
            while way[-1] != start:
                way.append(came[way[-1]])
            return way[::-1]
        for di, dj in ((1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (1, -1), (-1, 1), (-1, -1)):
            there = (here[0] + di, here[1] + dj)
            inside = 0 <= there[0] < blocked.shape[0] and 0 <= there[1] < blocked.shape[1]
            if not inside or (blocked[there] and there != goal):
                continue
            c = cost[here] + float(np.hypot(di, dj))
            if c < cost.get(there, float("inf")) - 1e-12:
                cost[there], came[there] = c, here
                heapq.heappush(queue, (c + float(np.hypot(there[0] - goal[0], there[1] - goal[1])), there))
    return None


def _shortened(start: Matrix, points: list[Matrix], discs: Sequence[Disc]) -> list[Matrix]:
    """Drop corners that a free straight line makes needless."""
    out: list[Matrix] = []
    here, i = start, 0
    while i < len(points):
        j = len(points) - 1
        while j > i and line_clearance_m(here, points[j], discs) < -1e-9:
            j -= 1
        out.append(points[j])
        here, i = points[j], j + 1
    return out
