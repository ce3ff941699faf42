"""The ground per cell of the map: height, slope, relief. Only cells that a changed submap touches are looked at again."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.mapper.dense_map import MapSubmap, shift_m
from services.mapper.footprints import Footprint, Footprints
from services.mapper.ground_kernels import (
    BINS,
    STRAYS,
    UNKNOWN,
    drop_hanging,
    first_planes,
    gather_lows,
    gather_near,
    settle,
)

Floats = NDArray[np.float64]
CellIndex = tuple[int, int]

_MARGIN = 6
"""Cells around the changed ones whose points are needed to judge them."""
_LEAST = 30
"""Points that make a cell."""
_FEW_LEFT = 3
"""A submap's far points, seen by chance, need not be followed: cells with fewer of its points are not touched by it."""
_MOVE_M = 0.01
_HEIGHT_M, _SLOPE, _RELIEF_M = 0.005, 0.01, 0.005
"""Smaller changes are not told."""


@dataclass(frozen=True, slots=True)
class GroundPlane:
    """The ground in one cell: height at the centre, slopes along x and y, relief, number of points."""

    height_m: float
    slope_x: float
    slope_y: float
    relief_m: float
    points: int

    def differs(self, other: GroundPlane) -> bool:
        """Return whether the other says something else of the cell."""
        return (
            abs(self.height_m - other.height_m) > _HEIGHT_M
            or abs(self.slope_x - other.slope_x) > _SLOPE
            or abs(self.slope_y - other.slope_y) > _SLOPE
            or abs(self.relief_m - other.relief_m) > _RELIEF_M
        )


@dataclass(frozen=True, slots=True)
class GroundChange:
    """Cells (column, row) that changed, and those without ground now."""

    cells: dict[CellIndex, GroundPlane]
    gone: list[CellIndex]


class GroundModel:
    """Cells by (column, row), multiples of ``cell_m`` in the map."""

    def __init__(self, cell_m: float) -> None:
        self.cell_m = cell_m
        self.cells: dict[CellIndex, GroundPlane] = {}
        self._prints = Footprints()
        self._dirty: list[NDArray[np.int64]] = []

    @property
    def dirty(self) -> bool:
        """Whether some cells have to be looked at again."""
        return bool(self._dirty)

    @property
    def covered(self) -> set[CellIndex]:
        """The cells that hold points of the map, ground or not."""
        return {(int(a), int(b)) for p in self._prints for a, b in p.cells}

    def clear(self) -> None:
        """Begin a new map."""
        self.cells, self._prints, self._dirty = {}, Footprints(), []

    def touch(self, submaps: Iterable[MapSubmap]) -> None:
        """Note that these submaps are new, moved or have lost points: where they were and where they are is to be redone.

        A centimetre is not worth it: local corrections move a dozen submaps with each keyframe.
        """
        for submap in submaps:
            old = self._prints.get(submap.submap_id)
            same = old is not None and old.points == len(submap.points_m)
            if same and old is not None and shift_m(old.T_map_submap, submap.T_map_submap) < _MOVE_M:
                continue
            self._prints.drop(submap.submap_id)
            if old is not None:
                self._dirty.append(old.cells)
            if len(submap.points_m) == 0:
                continue
            new = self._footprint(submap)
            self._prints.put(submap.submap_id, new)
            self._dirty.append(new.cells)

    def refresh(self, submaps: dict[int, MapSubmap]) -> GroundChange:
        """Do the touched cells again from the points of the submaps around them; return what changed."""
        if not self._dirty:
            return GroundChange({}, [])
        dirty = np.unique(np.concatenate(self._dirty), axis=0)
        self._dirty = []
        low, high = dirty.min(axis=0) - _MARGIN, dirty.max(axis=0) + _MARGIN
        box = (int(low[0]), int(high[0]), int(low[1]), int(high[1]))
        near = [submaps[k] for k in self._prints.near(box) if k in submaps]
        fresh = self._fit(near, low, high - low + 1)
        cells: dict[CellIndex, GroundPlane] = {}
        gone: list[CellIndex] = []
        for column, row in dirty.tolist():
            height, slope_x, slope_y, relief, n = fresh[column - low[0], row - low[1]].tolist()
            old = self.cells.get((column, row))
            if n != n:  # NaN: no ground
                if old is not None:
                    gone.append((column, row))
                    del self.cells[column, row]
                continue
            new = GroundPlane(height, slope_x, slope_y, relief, int(n))
            if old is None or new.differs(old):
                self.cells[column, row] = cells[column, row] = new
        return GroundChange(cells, gone)

    def height_m(self, x_m: float, y_m: float) -> float | None:
        """Return the ground's z at a place of the map, None where it was not seen."""
        column, row = int(np.floor(x_m / self.cell_m)), int(np.floor(y_m / self.cell_m))
        plane = self.cells.get((column, row))
        if plane is None:
            return None
        dx, dy = x_m - (column + 0.5) * self.cell_m, y_m - (row + 0.5) * self.cell_m
        return plane.height_m + plane.slope_x * dx + plane.slope_y * dy

    def _footprint(self, submap: MapSubmap) -> Footprint:
        T = submap.T_map_submap
        plan = submap.points_m @ T[:2, :3].T.astype(np.float32) + T[:2, 3].astype(np.float32)
        at = np.floor(plan / self.cell_m).astype(np.int64)
        keys, counts = np.unique((at[:, 0] << 32) + (at[:, 1] + (1 << 31)), return_counts=True)
        keys = keys[counts >= min(_FEW_LEFT, int(counts.max()))]
        cells = np.stack([keys >> 32, (keys & 0xFFFFFFFF) - (1 << 31)], axis=1)
        return Footprint(cells, T, len(submap.points_m))

    def _fit(self, submaps: list[MapSubmap], low: NDArray[np.int64], size: NDArray[np.int64]) -> Floats:
        shape, cell = (int(size[0]), int(size[1])), self.cell_m
        x0, y0 = float(low[0] * cell), float(low[1] * cell)
        lows, counts = np.full((*shape, STRAYS + 1), UNKNOWN), np.zeros(shape, dtype=np.int32)
        for s in submaps:
            gather_lows(s.points_m, s.T_map_submap, x0, y0, cell, lows, counts)
        lowest = np.ascontiguousarray(lows[:, :, STRAYS])
        lowest[counts < _LEAST] = UNKNOWN
        drop_hanging(lowest, cell)
        planes = np.zeros((*shape, 3))
        first_planes(lowest, cell, planes)
        bins, sums = np.zeros((*shape, BINS), dtype=np.int32), np.zeros((*shape, 9))
        for s in submaps:
            gather_near(s.points_m, s.T_map_submap, x0, y0, cell, planes, bins, sums)
        out = np.empty((*shape, 5))
        settle(planes, bins, sums, _LEAST, out)
        return out
