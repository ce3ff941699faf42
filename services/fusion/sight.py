"""What slam told of one camera: its recent places. Pure."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field, replace

from services.common.geometry import exp_rotation, log_rotation, pose
from services.fusion.values import Located

_APART_NS = 150_000_000
"""Places farther apart than this are not interpolated between."""


@dataclass
class Sight:
    """The recent places of one camera."""

    _places: deque[Located] = field(default_factory=lambda: deque(maxlen=90))
    newest_ns: int = -1
    """Stamp of the last frame, located or not."""

    def take(self, stamp_ns: int, located: Located | None) -> None:
        """Take note of a frame."""
        self.newest_ns = max(self.newest_ns, stamp_ns)
        if located is not None and (not self._places or located.stamp_ns > self._places[-1].stamp_ns):
            self._places.append(located)

    def at(self, stamp_ns: int) -> Located | None:
        """Return the camera's place at a moment: told, or between two that were told."""
        after = next((p for p in self._places if p.stamp_ns >= stamp_ns), None)
        if after is None or after.stamp_ns == stamp_ns:
            return after
        before = next((p for p in reversed(self._places) if p.stamp_ns < stamp_ns), None)
        if before is None or before.epoch != after.epoch or after.stamp_ns - before.stamp_ns > _APART_NS:
            return None
        share = (stamp_ns - before.stamp_ns) / (after.stamp_ns - before.stamp_ns)
        R = before.T_map_camera[:3, :3]
        turn = share * log_rotation(R.T @ after.T_map_camera[:3, :3])
        t = (1.0 - share) * before.T_map_camera[:3, 3] + share * after.T_map_camera[:3, 3]
        return replace(after, stamp_ns=stamp_ns, T_map_camera=pose(R @ exp_rotation(turn), t))
