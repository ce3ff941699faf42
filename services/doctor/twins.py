"""Notices a service that runs twice, on one machine or on two: both would fly the aircraft. Pure."""

from __future__ import annotations

from dataclasses import dataclass

from schemas.health import Health

SINGLE = frozenset({
    "camera", "second_camera", "slam", "second_slam", "fusion", "mapper", "detector", "refiner", "navigator", "autopilot",
})  # fmt: skip
"""Services that an aircraft flies by; of stations, recorders and previews there may be several."""
_MOST = 4
_FORGET_S = 2.5
"""A process not heard for so long is gone: health comes once a second."""


@dataclass
class _Process:
    pid: int
    uptime_s: float
    first_s: float
    last_s: float


class Twins:
    """The processes that lately spoke as each service."""

    def __init__(self) -> None:
        self._processes: dict[str, list[_Process]] = {}

    def hear(self, health: Health, now_s: float) -> bool:
        """Take a health in; return whether another process than this one's speaks as the same service, too.

        A service that was started again is none: the old process is not heard after the new one.

        Args:
            health: as it came.
            now_s: by a steady clock.
        """
        if health.service not in SINGLE:
            return False
        known = [p for p in self._processes.get(health.service, ()) if now_s - p.last_s < _FORGET_S]
        # numbers of processes may be alike on two machines; a process never grows younger
        alike = [p for p in known if p.pid == health.pid and p.uptime_s <= health.uptime_s]
        own = max(alike, key=lambda process: process.uptime_s, default=None)
        if own is None:
            own = _Process(health.pid, health.uptime_s, now_s, now_s)
            known.append(own)
        own.uptime_s, own.last_s = health.uptime_s, now_s
        known = known[-_MOST:]
        self._processes[health.service] = known
        return any(a.first_s < b.last_s and b.first_s < a.last_s for a in known for b in known if a is not b)
