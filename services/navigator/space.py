"""The space around as far as it was seen: free, occupied, or unknown, in a flat grid at the aircraft's height. Pure.

A cell is free when a direction of a view was free beyond it, or when the aircraft was there. Surfaces that the map
does not explain are evidence of things; evidence grows with each look and is taken back where one looks through it
(occupancy counting, after Moravec and Elfes 1985). The grid keeps its own frame, which follows corrections of the map.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.common.geometry import Matrix, rotation_z
from services.navigator.guard import BAND_M, View
from services.navigator.path import Disc
from services.navigator.track import Correction

Cells = NDArray[np.int64]
Mask = NDArray[np.bool_]

CELL_M = 0.15
_HALF_M = 15.0
_CELLS = int(2.0 * _HALF_M / CELL_M)
_RAY_STEP_M = 0.10
_BEFORE_SURFACE_M = 0.15
_HIT, _MISS, _FULL, _OCCUPIED = 2, 1, 12, 5
"""Evidence: per look, per look through, at most, and from when on a cell counts as occupied."""
_NOTED_M = 4.5
"""Surfaces farther away are too vague to be kept."""
_BODY_M = 0.45
_LEAST_HALF_M, _VIEW_SLOPE = 0.20, 0.6
_LEAST_CELLS, _SURE = 2, 9
"""Cells that make a thing; a single one, as of a sapling or a post, must have been seen more often."""
_SKIN_M = 0.08


@dataclass(frozen=True, slots=True)
class Thing:
    """Something unmapped that stands there: centre in map and the radius of what was seen of it."""

    x_m: float
    y_m: float
    radius_m: float


class Space:
    """What is known of the space around. All places are x, y in map."""

    def __init__(self) -> None:
        self._free = np.zeros((_CELLS, _CELLS), dtype=bool)
        self._hits = np.zeros((_CELLS, _CELLS), dtype=np.int16)
        self._yaw_rad = 0.0
        self._shift_m: Matrix = np.zeros(3)
        """From the grid's frame to map."""
        self.fed = False
        """Whether any view was ever taken: without eyes nothing can be said."""

    def correct(self, correction: Correction) -> None:
        """Follow a correction of the map."""
        self._yaw_rad += correction.yaw_rad
        self._shift_m = correction.point(self._shift_m)

    # -- in -----------------------------------------------------------------------------------------------------
    def visit(self, p_m: Matrix, radius_m: float = _BODY_M) -> None:
        """Take it that the aircraft is at ``p_m`` (2,): what it fills is free."""
        n = int(radius_m / CELL_M) + 1
        steps = np.arange(-n, n + 1) * CELL_M
        x, y = np.meshgrid(steps, steps, indexing="ij")
        near = np.hypot(x, y) <= radius_m
        self._mark_free(np.stack([p_m[0] + x[near], p_m[1] + y[near]], axis=1))

    def take(self, view: View, known: Sequence[Disc]) -> Matrix:
        """Take a view; return the points (N, 2) in map, at the aircraft's height, that ``known`` does not explain."""
        self.fed = True
        at = view.position_m[:2]
        if view.fan is not None:
            self._look_along(at, view.fan.azimuth_rad, view.fan.free_m)
        p = view.points_m if view.solid is None else view.points_m[view.solid]
        near = (np.abs(p[:, 2]) < BAND_M) & (np.hypot(p[:, 0], p[:, 1]) < _NOTED_M)
        places = p[near][:, :2] + at
        for d in known:
            places = places[np.hypot(places[:, 0] - d.x_m, places[:, 1] - d.y_m) > d.keep_out_m]
        here = self._marked(places)
        self._hits[here] = np.minimum(self._hits[here] + _HIT, _FULL)
        return places

    def _look_along(self, at: Matrix, azimuth_rad: Matrix, free_m: Matrix) -> None:
        steps = np.arange(0.0, float(free_m.max(initial=0.0)) + _RAY_STEP_M, _RAY_STEP_M)
        along, azimuth = np.meshgrid(steps, azimuth_rad, indexing="xy")
        inside = along <= free_m[:, None]
        r, a = along[inside], azimuth[inside]
        places = np.stack([at[0] + r * np.cos(a), at[1] + r * np.sin(a)], axis=1)
        self._mark_free(places)
        through = (along <= free_m[:, None] - _BEFORE_SURFACE_M)[inside]
        seen_through = self._marked(places[through])
        self._hits[seen_through] = np.maximum(self._hits[seen_through] - _MISS, 0)

    def _marked(self, places_m: Matrix) -> Mask:
        """Return the grid with the cells of these places set: each once."""
        cells = self._cells(places_m)
        out = np.zeros(self._hits.shape, dtype=bool)
        out[cells[:, 0], cells[:, 1]] = True
        return out

    def _mark_free(self, places_m: Matrix) -> None:
        cells = self._cells(places_m)
        self._free[cells[:, 0], cells[:, 1]] = True

    # -- out ----------------------------------------------------------------------------------------------------
    def is_free(self, places_m: Matrix) -> Mask:
        """Return whether each of the places (N, 2) is known to be free."""
        cells, inside = self._indices(places_m)
        out = np.zeros(len(places_m), dtype=bool)
        i, j = cells[inside, 0], cells[inside, 1]
        out[inside] = self._free[i, j] & (self._hits[i, j] < _OCCUPIED)
        return out

    def known_ahead_m(self, from_m: Matrix, to_m: Matrix, half_width_m: float) -> float:
        """Return how far the way from one place (2,) to another is known, over its width; its length when all of it is."""
        way = to_m - from_m
        length = float(np.linalg.norm(way))
        if length < 1e-6:
            return 0.0
        ahead = way / length
        steps = np.arange(0.0, length + 1e-9, 0.5 * CELL_M)
        # near the camera no wider than its view: beside it nothing can be seen from where it stands
        width = np.minimum(half_width_m, np.maximum(_LEAST_HALF_M, _VIEW_SLOPE * steps))
        sides = width[:, None] * np.linspace(-1.0, 1.0, 5)
        aside = np.array([-ahead[1], ahead[0]])
        places = from_m + steps[:, None, None] * ahead + sides[..., None] * aside
        known = self._known(places.reshape(-1, 2)).reshape(sides.shape).all(axis=1)
        return length if known.all() else float(steps[int(np.argmin(known))])

    def _known(self, places_m: Matrix) -> Mask:
        """Return whether each place was ever seen, free or not: what stands there is the obstacles' business."""
        cells, inside = self._indices(places_m)
        out = np.zeros(len(places_m), dtype=bool)
        i, j = cells[inside, 0], cells[inside, 1]
        out[inside] = self._free[i, j] | (self._hits[i, j] >= _OCCUPIED)
        return out

    def unknown_cells(self, x_m: Matrix, y_m: Matrix) -> Mask:
        """Return for a grid of places, x (N, 1) and y (1, M), which were never seen (N, M)."""
        x, y = np.broadcast_arrays(x_m, y_m)
        return np.logical_not(self._known(np.stack([x.ravel(), y.ravel()], axis=1))).reshape(x.shape)

    def things(self) -> list[Thing]:
        """Return what stands there and no map knows, in a fixed order."""
        open_cells = {(int(i), int(j)) for i, j in np.argwhere(self._hits >= _OCCUPIED)}
        found = []
        for cell in sorted(open_cells):
            if cell not in open_cells:
                continue
            group = _connected(cell, open_cells)
            if len(group) >= _LEAST_CELLS or self._hits[group[0]] >= _SURE:
                found.append(self._thing(np.array(group, dtype=float)))
        return found

    def _thing(self, cells: Matrix) -> Thing:
        middle = cells.mean(axis=0)
        radius = float(np.hypot(*(cells - middle).T).max()) * CELL_M + 0.5 * CELL_M + _SKIN_M
        grid = (middle + 0.5) * CELL_M - _HALF_M
        place = rotation_z(self._yaw_rad) @ np.array([grid[0], grid[1], 0.0]) + self._shift_m
        return Thing(float(place[0]), float(place[1]), radius)

    def _cells(self, places_m: Matrix) -> Cells:
        cells, inside = self._indices(places_m)
        return cells[inside]

    def _indices(self, places_m: Matrix) -> tuple[Cells, Mask]:
        c, s = np.cos(self._yaw_rad), np.sin(self._yaw_rad)
        offset = places_m - self._shift_m[:2]
        grid = np.stack([c * offset[:, 0] + s * offset[:, 1], -s * offset[:, 0] + c * offset[:, 1]], axis=1)
        cells = np.floor((grid + _HALF_M) / CELL_M).astype(np.int64)
        return cells, np.all((cells >= 0) & (cells < _CELLS), axis=1)


def _connected(first: tuple[int, int], open_cells: set[tuple[int, int]]) -> list[tuple[int, int]]:
    """Return the group that ``first`` belongs to, taken out of ``open_cells``."""
    open_cells.discard(first)
    group, queue = [first], deque([first])
    while queue:
        i, j = queue.popleft()
        for di in (-1, 0, 1):
            for dj in (-1, 0, 1):
                there = (i + di, j + dj)
                if there in open_cells:
                    open_cells.discard(there)
                    group.append(there)
                    queue.append(there)
    return group
