"""A way around the mapped trunks to a place in front of the target. Pure.

A* (Hart, Nilsson and Raphael 1968) on an eight-connected grid; trunks are discs grown by the clearance. The
straight line is taken whenever it is free.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from services.common.geometry import Matrix

_CELL_M = 0.15
_MARGINS_M = (2.0, 6.0)
"""How far the search reaches beyond start and goal; further only when the near one finds no way."""
_MAX_CELLS = 40_000
_AZIMUTHS = 36
_UNKNOWN_COST, _CLOSE_COST = 3.0, 8.0
"""Price of a metre where nobody has looked, and of one inside a keep-out circle on the way out of it."""
_OUT_M, _YIELD_M = 0.5, 0.30
"""Length on which a circle is left, and how deep into one the aircraft may be without its body touching."""
_MUCH_UNKNOWN_M = 0.3
Unknown = Callable[[Matrix, Matrix], NDArray[np.bool_]]
"""For a grid of places, x (N, 1) and y (1, M): which of them nobody has seen (N, M)."""


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
    along_x, along_y = float(b[0] - a[0]), float(b[1] - a[1])
    length2 = along_x * along_x + along_y * along_y
    least = float("inf")
    for d in discs:
        x, y = d.x_m - float(a[0]), d.y_m - float(a[1])
        t = min(max((x * along_x + y * along_y) / length2, 0.0), 1.0) if length2 > 1e-12 else 0.0
        least = min(least, math.hypot(t * along_x - x, t * along_y - y) - d.keep_out_m)
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


def plan(
    start_m: Matrix, goal_m: Matrix, discs: Sequence[Disc], within: Disc | None = None, unknown: Unknown | None = None
) -> list[Matrix] | None:
    """Return the corner points (2,) after ``start_m`` to ``goal_m``, or None when there is no way.

    A circle that holds the goal shrinks until it does not. One that holds the start is left by the shortest way, and
    never entered deeper than the aircraft's body allows. No corner lies outside ``within``, the geofence's circle. A
    way through cells that nobody has seen costs ``_UNKNOWN_COST`` times its length: who takes one has to look first.
    """
    discs = [_shrunk(d, goal_m) for d in discs]
    free = _straight(start_m, goal_m, discs)
    if free and (unknown is None or _unseen_m(start_m, goal_m, unknown) < _MUCH_UNKNOWN_M):
        return [goal_m]
    for margin_m in _MARGINS_M:
        way = _detour(start_m, goal_m, discs, within, unknown, margin_m)
        if way is not None:
            return way
    return [goal_m] if free else None


def _straight(start_m: Matrix, goal_m: Matrix, discs: Sequence[Disc]) -> bool:
    """Whether the straight line is free; out of a circle that holds the start it has to lead outward."""
    if line_clearance_m(start_m, goal_m, discs) >= 0.0:
        return True
    way = goal_m - start_m
    length = float(np.linalg.norm(way))
    if length < 2.0 * _CELL_M:
        return clearance_m(goal_m, discs) >= 0.0
    near, out = start_m + way * (min(_OUT_M, length) / length), start_m + way * (min(0.5 * _OUT_M, length) / length)
    inside = [d for d in discs if math.hypot(start_m[0] - d.x_m, start_m[1] - d.y_m) < d.keep_out_m]
    outward = all(clearance_m(out, [d]) > clearance_m(start_m, [d]) + 0.2 * _OUT_M for d in inside)
    return bool(inside) and outward and line_clearance_m(near, goal_m, discs) >= 0.0


def _detour(
    start_m: Matrix, goal_m: Matrix, discs: Sequence[Disc], within: Disc | None, unknown: Unknown | None,
    margin_m: float,
) -> list[Matrix] | None:  # fmt: skip
    """Return the corners of the cheapest way on a grid that reaches ``margin_m`` beyond start and goal."""
    low = np.minimum(start_m, goal_m) - margin_m
    shape = tuple(int(n) for n in np.ceil((np.maximum(start_m, goal_m) + margin_m - low) / _CELL_M) + 1)
    if shape[0] * shape[1] > _MAX_CELLS:
        return None
    x = low[0] + np.arange(shape[0])[:, None] * _CELL_M
    y = low[1] + np.arange(shape[1])[None, :] * _CELL_M
    price = np.ones(shape) if unknown is None else np.where(unknown(x, y), _UNKNOWN_COST, 1.0)
    hard = [_hard(d, start_m) for d in discs]
    price = np.where(_blocked(x, y, discs, None), _CLOSE_COST, price)
    cells = _search(_blocked(x, y, hard, within), price, _cell(start_m, low), _cell(goal_m, low))
    if cells is None:
        return None
    points = [low + np.array(c) * _CELL_M for c in cells[1:-1]] + [goal_m]
    return _shortened(start_m, points, discs, unknown)


def _hard(d: Disc, start_m: Matrix) -> Disc:
    """Return the part of a circle that is never entered: all of it, unless the start lies in it."""
    room = math.hypot(start_m[0] - d.x_m, start_m[1] - d.y_m)
    if room >= d.keep_out_m:
        return d
    return Disc(d.x_m, d.y_m, max(min(d.keep_out_m - _YIELD_M, room - 0.5 * _CELL_M), 0.0))


def _unseen_m(a: Matrix, b: Matrix, unknown: Unknown) -> float:
    """Return how much of the segment nobody has seen."""
    length = float(np.linalg.norm(b - a))
    n = max(int(length / (0.5 * _CELL_M)), 1)
    places = a + np.linspace(0.0, 1.0, n + 1)[:, None] * (b - a)
    return float(np.mean([bool(unknown(p[:1, None], p[None, 1:])[0, 0]) for p in places])) * length


def _shrunk(d: Disc, goal_m: Matrix) -> Disc:
    room = math.hypot(goal_m[0] - d.x_m, goal_m[1] - d.y_m) - 0.5 * _CELL_M
    return d if room >= d.keep_out_m else Disc(d.x_m, d.y_m, max(room, 0.0))


def _cell(p: Matrix, low: Matrix) -> tuple[int, int]:
    i, j = np.rint((p - low) / _CELL_M).astype(int)
    return int(i), int(j)


def _blocked(x: Matrix, y: Matrix, discs: Sequence[Disc], within: Disc | None) -> Matrix:
    blocked = np.zeros((x.shape[0], y.shape[1]), dtype=bool)
    if within is not None:
        blocked |= np.hypot(x - within.x_m, y - within.y_m) > within.keep_out_m
    for d in discs:
        blocked |= np.hypot(x - d.x_m, y - d.y_m) < d.keep_out_m
    return blocked


def _search(
    blocked: Matrix, price: Matrix, start: tuple[int, int], goal: tuple[int, int]
) -> list[tuple[int, int]] | None:
    came: dict[tuple[int, int], tuple[int, int]] = {}
    cost = {start: 0.0}
    queue: list[tuple[float, tuple[int, int]]] = [(0.0, start)]
    shut, prices = blocked.tolist(), price.tolist()
    while queue:
        _, here = heapq.heappop(queue)
        if here == goal:
            way = [here]
            while way[-1] != start:
                way.append(came[way[-1]])
            return way[::-1]
        for di, dj, step in _STEPS:
            i, j = here[0] + di, here[1] + dj
            inside = 0 <= i < blocked.shape[0] and 0 <= j < blocked.shape[1]
            if not inside or (shut[i][j] and (i, j) != goal):
                continue
            c = cost[here] + step * prices[i][j]
            there = (i, j)
            if c < cost.get(there, _FAR) - 1e-12:
                cost[there], came[there] = c, here
                heapq.heappush(queue, (c + math.hypot(i - goal[0], j - goal[1]), there))
    return None


def _shortened(start: Matrix, points: list[Matrix], discs: Sequence[Disc], unknown: Unknown | None) -> list[Matrix]:
    """Drop corners that a free straight line makes needless, unless it leads through more that nobody has seen."""
    out: list[Matrix] = []
    here, i = start, 0
    while i < len(points):
        j = len(points) - 1
        while j > i and not _short_cut(here, points[i : j + 1], discs, unknown):
            j -= 1
        out.append(points[j])
        here, i = points[j], j + 1
    return out


def _short_cut(here: Matrix, points: list[Matrix], discs: Sequence[Disc], unknown: Unknown | None) -> bool:
    """Whether one may go straight to the last of ``points`` instead of along them: no nearer to anything."""
    along = min(clearance_m(p, discs) for p in (here, *points))
    if line_clearance_m(here, points[-1], discs) < min(along, 0.0) - 1e-9:
        return False
    if unknown is None or _unseen_m(here, points[-1], unknown) < 1e-9:
        return True
    unseen = sum(_unseen_m(a, b, unknown) for a, b in pairwise([here, *points]))
    return _unseen_m(here, points[-1], unknown) <= unseen + _MUCH_UNKNOWN_M


_ROOT2 = math.sqrt(2.0)
_STEPS = ((1, 0, 1.0), (-1, 0, 1.0), (0, 1, 1.0), (0, -1, 1.0), (1, 1, _ROOT2), (1, -1, _ROOT2), (-1, 1, _ROOT2),
          (-1, -1, _ROOT2))  # fmt: skip
_FAR = float("inf")
