"""One time for all machines: each service measures how far its clock is off the router's, and corrects it.

Four stamps as in NTP (RFC 5905, section 8): asked, answered, heard; the offset is the answer minus the middle of question and
arrival, and is wrong by half the round trip at most. The quickest of the last exchanges counts. On one machine that
bound is larger than the offset, and nothing is corrected.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass

from services.common.clock import WallClock
from services.common.context import HealthBook

_AHEAD, _BEHIND = "clock_ahead_us", "clock_behind_us"
KEPT = 8
"""Exchanges among which the quickest counts."""


@dataclass(frozen=True, slots=True)
class Exchange:
    """One question and its answer; ``offset_ns``: the router's clock minus this machine's."""

    offset_ns: int
    round_trip_ns: int


class OffsetFilter:
    """How far this machine's own clock is off the router's."""

    def __init__(self) -> None:
        self._exchanges: deque[Exchange] = deque(maxlen=KEPT)

    def add(self, asked_ns: int, answered_ns: int, heard_ns: int) -> None:
        """Take an exchange: ``asked_ns`` and ``heard_ns`` by this machine's clock, ``answered_ns`` by the router's."""
        middle_ns = (asked_ns + heard_ns) // 2
        self._exchanges.append(Exchange(answered_ns - middle_ns, heard_ns - asked_ns))

    def forget(self) -> None:
        """Begin anew: another router, or a clock that stepped."""
        self._exchanges.clear()

    @property
    def best(self) -> Exchange | None:
        """The quickest exchange, None before the first."""
        return min(self._exchanges, key=lambda e: e.round_trip_ns, default=None)

    @property
    def offset_ns(self) -> int | None:
        """What to add to this machine's clock; 0 where no more than the measurement's own error was found."""
        best = self.best
        if best is None:
            return None
        return 0 if abs(best.offset_ns) <= best.round_trip_ns // 2 else best.offset_ns


def tell(wall: WallClock, book: HealthBook) -> None:
    """Put the correction into health: microseconds by which the machine's clock is ahead of the router's, or behind."""
    microseconds = wall.correction_ns // 1000
    book.level(_BEHIND, microseconds)
    book.level(_AHEAD, -microseconds)


def told_ahead_s(counters: Mapping[str, int]) -> float | None:
    """Return by how much a service's machine is ahead of the router's, as its health tells; None: it does not (an older one)."""
    return 1e-6 * (counters[_AHEAD] - counters.get(_BEHIND, 0)) if _AHEAD in counters else None
