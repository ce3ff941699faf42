"""One notion of time for every service: the wall, or the simulator's clock."""

from __future__ import annotations

import threading
import time
from typing import Protocol

SLEW = 1e-3
"""Seconds per second by which a running clock is brought to the router's: PX4's own filter follows that."""


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
    """The machine's clock, made monotonic: it starts at the wall time and never steps by itself afterwards.

    ``correct`` brings it to the router's: a first time at once, then slowly, so that nobody sees time run back or jump.
    """

    simulated = False

    def __init__(self, ahead_s: float = 0.0) -> None:
        """Start at the machine's time; ``ahead_s`` is added, for tests of machines whose clocks differ."""
        self._offset_ns = time.time_ns() - time.monotonic_ns() + round(ahead_s * 1e9)
        self._goal_ns = self._corrected_ns = 0
        self._slewed_ns = time.monotonic_ns()
        self._lock = threading.Lock()

    def now_ns(self) -> int:
        """Return the present time."""
        with self._lock:
            now_ns = time.monotonic_ns()
            most_ns = int((now_ns - self._slewed_ns) * SLEW)
            if most_ns:  # else the little that is due would be forgotten
                left_ns = self._goal_ns - self._corrected_ns
                self._corrected_ns += max(-most_ns, min(most_ns, left_ns))
                self._slewed_ns = now_ns
            return now_ns + self._offset_ns + self._corrected_ns

    def machine_ns(self) -> int:
        """Return the time without any correction."""
        return time.monotonic_ns() + self._offset_ns

    @property
    def correction_ns(self) -> int:
        """What is added at present."""
        return self._corrected_ns

    def correct(self, correction_ns: int, *, at_once: bool = False) -> int:
        """Aim at another correction; ``at_once`` steps there. Return by how much the time stepped, ns."""
        with self._lock:
            self._goal_ns = correction_ns
            if not at_once:
                return 0
            step_ns, self._corrected_ns = correction_ns - self._corrected_ns, correction_ns
            return step_ns


def on_clock_ns(clock: Clock, machine_stamp_ns: int) -> int:
    """Return a stamp of this machine's clock as ``clock`` counts: another zero, or the machine's clock was set since."""
    return machine_stamp_ns + clock.now_ns() - time.time_ns()


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
