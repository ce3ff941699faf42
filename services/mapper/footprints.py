"""Where on the plan each submap lies, and which ones lie near a place: found by blocks, however large the map is."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

_BLOCK = 16
"""Cells."""


@dataclass(slots=True)
class Footprint:
    """What one submap covers of the map."""

    cells: NDArray[np.int64]
    """(n, 2) columns and rows."""
    T_map_submap: NDArray[np.float64]
    """Where it stood."""
    points: int

    @property
    def box(self) -> tuple[int, int, int, int]:
        """Least and greatest column, least and greatest row."""
        low, high = self.cells.min(axis=0).tolist(), self.cells.max(axis=0).tolist()
        return low[0], high[0], low[1], high[1]


class Footprints:
    """Footprints by submap."""

    def __init__(self) -> None:
        self._all: dict[int, Footprint] = {}
        self._boxes: dict[int, tuple[int, int, int, int]] = {}
        self._blocks: dict[tuple[int, int], set[int]] = {}

    def __iter__(self) -> Iterator[Footprint]:
        return iter(self._all.values())

    def get(self, submap_id: int) -> Footprint | None:
        """Return a submap's footprint, None when it has none."""
        return self._all.get(submap_id)

    def put(self, submap_id: int, footprint: Footprint) -> None:
        """Enter a submap's footprint in place of its last one."""
        self.drop(submap_id)
        self._all[submap_id], self._boxes[submap_id] = footprint, footprint.box
        for block in _blocks(footprint.box):
            self._blocks.setdefault(block, set()).add(submap_id)

    def drop(self, submap_id: int) -> None:
        """Forget a submap."""
        if self._all.pop(submap_id, None) is None:
            return
        for block in _blocks(self._boxes.pop(submap_id)):
            inside = self._blocks[block]
            inside.discard(submap_id)
            if not inside:
                del self._blocks[block]

    def near(self, box: tuple[int, int, int, int]) -> list[int]:
        """Return the submaps whose boxes meet a box of cells, in order of their number."""
        found = {k for block in _blocks(box) for k in self._blocks.get(block, ())}
        return sorted(k for k in found if _meet(self._boxes[k], box))


def _blocks(box: tuple[int, int, int, int]) -> Iterator[tuple[int, int]]:
    a, b, c, d = (edge // _BLOCK for edge in box)
    return product(range(a, b + 1), range(c, d + 1))


def _meet(p: tuple[int, int, int, int], q: tuple[int, int, int, int]) -> bool:
    return p[0] <= q[1] and p[1] >= q[0] and p[2] <= q[3] and p[3] >= q[2]
