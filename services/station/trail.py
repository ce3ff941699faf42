"""Where an aircraft has been, as the page draws it. Pure."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

TrailPoint = tuple[float, float, float, float]
"""x and y in map, metres, the heading, radians, and the height, metres."""

_MOST = 3_000


class Trail:
    """The newest points of the way, in single precision (0.1 mm at a kilometre); its memory is taken at once."""

    def __init__(self, most: int = _MOST) -> None:
        self._rows = np.zeros((most, 4), np.float32)
        self._added = 0

    def append(self, point: TrailPoint) -> None:
        """Add a point; the oldest makes room."""
        self._rows[self._added % len(self._rows)] = point
        self._added += 1

    def clear(self) -> None:
        """Begin anew."""
        self._added = 0

    def __len__(self) -> int:
        return min(self._added, len(self._rows))

    def __iter__(self) -> Iterator[TrailPoint]:
        """Go through the points, the oldest first."""
        for index in range(self._added - len(self), self._added):
            yield self._point(index)

    @property
    def newest(self) -> TrailPoint | None:
        """The point added last."""
        return self._point(self._added - 1) if self._added else None

    def _point(self, index: int) -> TrailPoint:
        x, y, yaw, z = self._rows[index % len(self._rows)].tolist()
        return x, y, yaw, z
