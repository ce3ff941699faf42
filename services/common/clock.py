"""One notion of time for every service: the wall, or the simulator's clock."""

from __future__ import annotations

import threading
import time
from typing import Protocol


class Clock(Protocol):
    """Time as the services know it, nanoseconds."""

    def now_ns(self) -> int:
        """Return the present time, integer nanoseconds since the Unix epoch (simulated: since its own zero)."""
        ...

    @property
    def simulated(self) -> bool:
        """Whether time is the simulator's and may stand still."""
        ...


class WallClock:
    """The machine's clock, made monotonic: it starts at the wall time and never steps afterwards."""

    simulated = False

    def __init__(self) -> None:
        self._offset_ns = time.time_ns() - time.monotonic_ns()

    def now_ns(self) -> int:
        """Return the present time."""
        return time.monotonic_ns() + self._offset_ns


class SimulatedClock:
    """A clock that somebody sets: the subscriber of ``sim/clock``, a replay, or a test. It never runs back."""

    simulated = True

    def __init__(self, start_ns: int = 0) -> None:
        self._now_ns = start_ns
        self._lock = threading.Lock()

    def now_ns(self) -> int:
        """Return the time last set."""
        return self._now_ns

    def set_ns(self, stamp_ns: int) -> None:
        """Move on to ``stamp_ns``; an earlier time is ignored."""
        with self._lock:
            self._now_ns = max(self._now_ns, stamp_ns)
