"""The event log: what happened, and who commanded what. Bounded, numbered, kept by the inventory as well. Pure."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any, Literal

EventKind = Literal["mission", "command", "operator", "link", "service", "inventory", "claim"]
EventLevel = Literal["info", "good", "warn", "bad"]

_KEPT = 400
_MAX_TEXT = 400


@dataclass(frozen=True, slots=True)
class Event:
    """One line of the log. ``time_ns`` is the station's wall clock: for people, never for decisions."""

    number: int
    time_ns: int
    uav: str
    kind: EventKind
    level: EventLevel
    text: str
    who: str = ""
    """The operator that an order came from."""

    def as_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return asdict(self)


class EventLog:
    """The newest events; ``listeners`` hear of each one as it comes."""

    def __init__(self, wall_ns: Callable[[], int]) -> None:
        self._wall_ns = wall_ns
        self._events: deque[Event] = deque(maxlen=_KEPT)
        self._next = 1
        self.listeners: list[Callable[[Event], None]] = []

    def add(self, uav: str, kind: EventKind, level: EventLevel, text: str, who: str = "") -> Event:
        """Write one line."""
        event = Event(self._next, self._wall_ns(), uav, kind, level, text[:_MAX_TEXT], who)
        self._next += 1
        self._events.append(event)
        for listener in self.listeners:
            listener(event)
        return event

    def latest(self, most: int = _KEPT) -> list[Event]:
        """Return the newest events, the oldest of them first."""
        return list(self._events)[-most:]
