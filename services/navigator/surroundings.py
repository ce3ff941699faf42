"""What is around that no map tells: known and unknown space, things that stand, things that move. Pure."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from services.common.geometry import Matrix
from services.navigator.guard import View
from services.navigator.moving import Mover, Movers
from services.navigator.path import Disc
from services.navigator.space import Space, Thing
from services.navigator.track import Correction

_ANEW_NS = 250_000_000
_SAME_M = 0.6
_FEW_S = (0.0, 0.5, 1.0)
"""A moving thing is gone round where it is and where it will be."""
START_COLUMN_M = 0.8


class Surroundings:
    """Fed with views while they are of the present map; remembers."""

    def __init__(self) -> None:
        self.space = Space()
        self.movers = Movers()
        self._view_ns = -1
        self._things: list[Thing] = []
        self._things_ns = -1

    def take(self, view: View, map_key: tuple[str, int], known: Sequence[Disc]) -> None:
        """Take a view once, unless it was placed in another state of the map. ``known``: trunks with their margins."""
        if view.stamp_ns <= self._view_ns or view.map_key != map_key:
            return
        self._view_ns = view.stamp_ns
        points = self.space.take(view, known)
        self.movers.take(points, view.stamp_ns)
        if view.stamp_ns - self._things_ns >= _ANEW_NS:
            self._things_ns, self._things = view.stamp_ns, self.space.things()

    def correct(self, correction: Correction) -> None:
        """Follow a correction of the map."""
        self.space.correct(correction)
        self.movers.correct(correction)
        self._things_ns = -1

    def discs(self, keep_out_m: float, now_ns: int) -> list[Disc]:
        """Return what stands and what moves, grown by ``keep_out_m``."""
        moving = self.movers.moving(now_ns)
        standing = [t for t in self._things if not _is_one_of(t, moving, now_ns)]
        out = [Disc(t.x_m, t.y_m, t.radius_m + keep_out_m) for t in standing]
        for m in moving:
            for ahead_s in _FEW_S:
                place = m.at(now_ns + round(ahead_s * 1e9))
                out.append(Disc(float(place[0]), float(place[1]), m.radius_m + keep_out_m))
        return out

    def moving(self, now_ns: int) -> list[Mover]:
        """Return what moves."""
        return self.movers.moving(now_ns)


def _is_one_of(t: Thing, moving: Sequence[Mover], now_ns: int) -> bool:
    """Whether a standing thing is only where a moving one is seen, or its trail."""
    place: Matrix = np.array([t.x_m, t.y_m])
    return any(float(np.hypot(*(m.at(now_ns) - place))) < m.radius_m + t.radius_m + _SAME_M for m in moving)
