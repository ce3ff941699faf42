"""The point cloud on its way to the 3D view: which submaps a page holds, how many points of each. Pure.

It comes as ``map/sketch``, asked for only while a page looks at it. The points of a sketch are in an order in which
every first part is an even sample, so thinning is taking fewer.
"""

from __future__ import annotations

import struct

import numpy as np

from schemas.sketch import SubmapSketch

MAX_POINTS = 300_000
"""About so many points of one aircraft go to a page (4.5 MB)."""
_HEAD = struct.Struct("<III12f")
_POINTS, _REMOVED, _MOVED = 0, 1, 2


class CloudView:
    """The submaps of one aircraft, each as a frame for the page."""

    def __init__(self, uav: str, max_points: int = MAX_POINTS) -> None:
        self._uav = uav
        self._max_points = max_points
        self._held: set[int] = set()
        self.map_id = ""

    @property
    def empty(self) -> bool:
        """Whether nothing has come yet."""
        return not self._held

    def take(self, sketch: SubmapSketch) -> list[tuple[str, bytes]]:
        """Return frames with their keys, of which a later one replaces an earlier that still waits.

        The first of a new map also withdraws the submaps of the old one. A place for points that were never seen is
        passed over: they come with the answer of the whole, which has the place too.
        """
        frames = []
        if sketch.map_id != self.map_id:
            frames = [self._frame(number, _REMOVED, b"") for number in sorted(self._held)]
            self._held.clear()
            self.map_id = sketch.map_id
        number = sketch.submap_id
        if sketch.removed:
            known = number in self._held
            self._held.discard(number)
            return [*frames, self._frame(number, _REMOVED, b"")] if known else frames
        if sketch.moved:
            return [*frames, self._frame(number, _MOVED, b"", sketch)] if number in self._held else frames
        self._held.add(number)
        room = max(1, self._max_points // len(self._held))
        points = np.ascontiguousarray(sketch.points_cm[:room], dtype="<i2").tobytes()
        return [*frames, self._frame(number, _POINTS, points + sketch.colour[:room].tobytes(), sketch)]

    def _frame(self, number: int, kind: int, body: bytes, sketch: SubmapSketch | None = None) -> tuple[str, bytes]:
        name = self._uav.encode()
        T = np.eye(4) if sketch is None else sketch.T_map_submap
        head = b"C" + bytes([len(name)]) + name + _HEAD.pack(number % 2**32, kind, len(body) // 9, *T[:3].ravel())
        # a new place must not take the place of points that still wait
        return f"cloud/{self._uav}/{number}" + ("/at" if kind == _MOVED else ""), head + body
