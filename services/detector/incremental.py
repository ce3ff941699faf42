"""Detection again only where the map changed: the trunks elsewhere are kept as they were found.

The map's plan is cut into cells of 1 m. A submap that comes, goes or moves touches the cells that its points were or are
in. Points are taken from those cells and two around (ground and neighbours want them); of what is found, and of what was
known, that part is exchanged whose base stands in the touched cells and one around.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from services.detector.config import DetectorConfig
from services.detector.detect import detect_trees
from services.detector.model import DetectionResult, Rejection, Trunk, Views

CELL_M = 1.0
_FEED, _SWAP = 2, 1
"""Cells around the touched ones from which points are taken, and in which results are exchanged."""
MOST = 0.6
"""Share of the map beyond which all of it is looked at."""
_UP = (0.0, 0.0, 1.0)
_HALF = 1 << 20

Cells = frozenset[int]


def cells_of(points_m: NDArray[np.floating]) -> Cells:
    """Return the cells of the plan that points (N, 3) of the map frame are in."""
    return frozenset(int(c) for c in np.unique(_codes(points_m)))


def _codes(points_m: NDArray[np.floating]) -> NDArray[np.int64]:
    at = np.floor(points_m[:, :2] / CELL_M).astype(np.int64) + _HALF
    return np.asarray(at[:, 0] * (2 * _HALF) + at[:, 1])


def around(cells: Cells, reach: int) -> Cells:
    """Return cells and those within ``reach`` of them."""
    steps = range(-reach, reach + 1)
    return frozenset(c + dx * 2 * _HALF + dy for c in cells for dx in steps for dy in steps)


class Incremental:
    """Holds the result of the whole map and mends it part by part."""

    def __init__(self, config: DetectorConfig) -> None:
        self._config = config
        self.result: DetectionResult | None = None
        self.partial = False
        """Whether parts of the result are older than the whole: ground and neighbours may say otherwise now."""

    def clear(self) -> None:
        """Begin a new map."""
        self.result, self.partial = None, False

    def whole(self, points_m: NDArray[np.float32], views: Views) -> DetectionResult:
        """Look at all of the map."""
        self.result, self.partial = detect_trees(points_m, _UP, views, self._config), False
        return self.result

    def update(self, points_m: NDArray[np.float32], views: Views, touched: Cells) -> DetectionResult:
        """Look again at the touched cells of the map, or at all of it where that is most of it."""
        if self.result is None or len(points_m) == 0:
            return self.whole(points_m, views)
        feed = np.array(sorted(around(touched, _FEED)), dtype=np.int64)
        codes = _codes(points_m)
        place = np.minimum(np.searchsorted(feed, codes), max(len(feed) - 1, 0))
        chosen = np.flatnonzero(feed[place] == codes) if len(feed) else np.zeros(0, dtype=np.int64)
        if len(chosen) > MOST * len(points_m):
            return self.whole(points_m, views)
        part = detect_trees(points_m[chosen], _UP, replace(views, index=views.index[chosen]), self._config)
        swapped = around(touched, _SWAP)
        self.result, self.partial = _mended(self.result, part, swapped, len(points_m)), True
        return self.result


def _mended(old: DetectionResult, part: DetectionResult, swapped: Cells, points: int) -> DetectionResult:
    def within(things: Iterable[Trunk | Rejection], *, inside: bool) -> list[Trunk | Rejection]:
        places = list(things)
        xy = np.array([_place(t) for t in places]).reshape(-1, 2)
        codes = _codes(xy)
        return [t for t, code in zip(places, codes, strict=True) if (int(code) in swapped) == inside]

    trunks = [*within(old.trunks, inside=False), *within(part.trunks, inside=True)]
    rejections = [*within(old.rejections, inside=False), *within(part.rejections, inside=True)]
    kept = sorted((t for t in trunks if isinstance(t, Trunk)), key=lambda t: (np.hypot(*t.base_m[:2]), t.base_m))
    return DetectionResult(
        tuple(kept), tuple(r for r in rejections if isinstance(r, Rejection)), part.ground, part.up, points,
        old.refused_points, part.stages_ms,
    )  # fmt: skip


def _place(thing: Trunk | Rejection) -> tuple[float, float]:
    return thing.base_m[:2] if isinstance(thing, Trunk) else (thing.x_m, thing.y_m)
