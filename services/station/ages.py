"""How old is what we know: per topic the last arrival, the rate, and whether that is late. Pure.

Ages are counted on the station's own monotonic clock from the moment of arrival, so nobody's clock is trusted and a
stamp in the future makes nothing young. Late is never shown as good.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from schemas.topics import Topic

Level = Literal["none", "good", "late", "lost"]

LINK_LATE_S = 1.0
LINK_LOST_S = 1.5
"""Within 2 s of the last message the operator must know: 1.5 s here, and the page is told five times a second."""
LINK_TOPICS = ("slam/pose", "mission/state", "vehicle/state", "trees/target")
"""What only comes from aboard: mapper, detector and routers may run on the ground, and say nothing of the link."""
_RATE_OVER_S = 4.0


@dataclass(slots=True)
class Arrivals:
    """The arrivals of one topic of one aircraft."""

    timeout_s: float | None
    expected_hz: float
    last_s: float | None = None
    count: int = 0
    missed: int = 0
    """Gaps in the sequence numbers: lost on the way, or thinned on purpose."""
    _last_seq: int | None = None
    _marks: list[tuple[float, int]] = field(default_factory=list)

    def note(self, now_s: float, seq: int | None) -> None:
        """Take note of one message."""
        self.last_s = now_s
        self.count += 1
        if seq is not None:
            if self._last_seq is not None and seq > self._last_seq + 1:
                self.missed += seq - self._last_seq - 1
            self._last_seq = seq
        if not self._marks or now_s - self._marks[-1][0] >= 1.0:
            self._marks = [mark for mark in self._marks if now_s - mark[0] <= _RATE_OVER_S]
            self._marks.append((now_s, self.count))

    def age_s(self, now_s: float) -> float | None:
        """Return the seconds since the last message, None when none came."""
        return None if self.last_s is None else max(0.0, now_s - self.last_s)

    def rate_hz(self, now_s: float) -> float:
        """Return the messages per second over the last few seconds."""
        marks = [mark for mark in self._marks if now_s - mark[0] <= _RATE_OVER_S + 1.0]
        if not marks or self.last_s is None or now_s - self.last_s > _RATE_OVER_S:
            return 0.0
        since_s, count = marks[0]
        return (self.count - count) / max(now_s - since_s, 0.2)

    def level(self, now_s: float) -> Level:
        """Return ``late`` once the topic's own timeout has passed; topics on change are never late by themselves."""
        age = self.age_s(now_s)
        if age is None:
            return "none"
        return "late" if self.timeout_s is not None and age > self.timeout_s else "good"


class LinkAges:
    """All arrivals of one aircraft, and the link as a whole."""

    def __init__(self) -> None:
        self.arrivals: dict[str, Arrivals] = {}

    def note(self, topic: Topic, name: str, now_s: float, seq: int | None) -> None:
        """Take note of a message of ``topic`` under ``name``: the topic's own, or with the service's for health."""
        entry = self.arrivals.get(name)
        if entry is None:
            entry = self.arrivals[name] = Arrivals(topic.timeout_s, topic.rate_hz)
        entry.note(now_s, seq)

    def age_s(self, name: str, now_s: float) -> float | None:
        """Return the age of one topic."""
        entry = self.arrivals.get(name)
        return None if entry is None else entry.age_s(now_s)

    def link_age_s(self, now_s: float) -> float | None:
        """Return the seconds since anything that is sent from aboard all the time came."""
        ages = [self.age_s(name, now_s) for name in LINK_TOPICS]
        return min((age for age in ages if age is not None), default=None)

    def link(self, now_s: float) -> Level:
        """Return the link as a whole: lost when nothing came for ``LINK_LOST_S``."""
        age = self.link_age_s(now_s)
        if age is None:
            return "none"
        if age > LINK_LOST_S:
            return "lost"
        return "late" if age > LINK_LATE_S or any(e.level(now_s) == "late" for e in self.arrivals.values()) else "good"
