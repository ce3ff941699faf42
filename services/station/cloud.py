"""The point cloud on its way to the 3D view: placed, thinned to a bound, packed. Pure.

Its key reaches the aircraft's network and not the radio, so the station asks for it only when it is told that it may
(``station.cloud``) and only while a page looks at it.
"""

from __future__ import annotations

import struct

import numpy as np
from numpy.typing import NDArray

from schemas.mapping import Submap

MAX_POINTS = 300_000
_HEAD = struct.Struct("<III")


class CloudView:
    """The newest submaps of one aircraft, each as a page's frame."""

    def __init__(self, uav: str, max_points: int = MAX_POINTS) -> None:
        self._uav = uav
        self._max_points = max_points
        self._counts: dict[int, int] = {}
        self.map_id = ""

    def take(self, submap: Submap) -> list[tuple[str, bytes]]:
        """Return frames with their keys: the submap, thinned when all together would be too many.

        The first of a new map also withdraws those of the old one.
        """
        frames = []
        if submap.map_id != self.map_id:
            frames = [self._frame(number, None) for number in self._counts]
            self._counts.clear()
            self.map_id = submap.map_id
        if submap.removed or not len(submap.points_m):
            self._counts.pop(submap.submap_id, None)
            return [*frames, self._frame(submap.submap_id, None)]
        share = max(1, len(self._counts.keys() | {submap.submap_id}))
        step = max(1, -(-len(submap.points_m) * share // self._max_points))
        others = sum(count for number, count in self._counts.items() if number != submap.submap_id)
        keep = slice(None, None, step)
        room = max(0, self._max_points - others)
        points = submap.points_m[keep][:room].astype(np.float64)
        placed = points @ submap.T_map_submap[:3, :3].T + submap.T_map_submap[:3, 3]
        colours = submap.colour[keep][:room] if len(submap.colour) else _by_height(placed)
        self._counts[submap.submap_id] = len(placed)
        body = placed.astype("<f4").tobytes() + np.ascontiguousarray(colours, dtype=np.uint8).tobytes()
        return [*frames, self._frame(submap.submap_id, (len(placed), body))]

    def _frame(self, number: int, body: tuple[int, bytes] | None) -> tuple[str, bytes]:
        name = self._uav.encode()
        count, points = body or (0, b"")
        head = b"C" + bytes([len(name)]) + name + _HEAD.pack(number % 2**32, int(body is None), count)
        return f"cloud/{self._uav}/{number}", head + points


def _by_height(points_m: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Return colours (N, 3) from brown at the ground to green at 3 m."""
    share = np.clip((points_m[:, 2:3] + 0.2) / 3.2, 0.0, 1.0)
    return np.asarray((1.0 - share) * [139, 106, 72] + share * [58, 158, 92], dtype=np.uint8)
