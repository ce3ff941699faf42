"""What a service is given: the bus, the clock, its configuration, its health book. Nothing else is global.

A service is a function ``build(context)`` in ``services/<name>/service.py`` that makes its core, warms it and
registers handlers. The runtime (live, over Zenoh) or the lockstep hub (in memory, for ``process`` and tests) then
calls the handlers one after the other from a single work loop: a core needs no locks.
"""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Protocol, TypeVar

from schemas.codec import Wire
from schemas.topics import Topic
from services.common.clock import Clock

if TYPE_CHECKING:
    from services.common.config import TreedockConfig

M = TypeVar("M", bound=Wire)
Q = TypeVar("Q", bound=Wire)
A = TypeVar("A", bound=Wire)


class HealthBook:
    """Counters, stage timings and the present fault note of one service; the runtime publishes it at 1 Hz."""

    def __init__(self) -> None:
        self.counters: dict[str, int] = defaultdict(int)
        self.stage_ms: dict[str, list[float]] = defaultdict(list)
        self.notes: dict[str, str] = {}

    def count(self, name: str, by: int = 1) -> None:
        """Add to a counter (``frames``, ``decode_errors``, ``dropped_bad_depth``...)."""
        self.counters[name] += by

    def level(self, name: str, value: int) -> None:
        """Set a counter to what is there now (megabytes free, minutes left); less than nothing is nothing."""
        self.counters[name] = max(0, value)

    def note(self, topic: str, text: str) -> None:
        """Say what is wrong with ``topic`` and what to do; an empty text withdraws it. Any note means degraded."""
        if text:
            self.notes[topic] = text
        else:
            self.notes.pop(topic, None)

    @contextmanager
    def timed(self, stage: str) -> Iterator[None]:
        """Measure a stage's duration."""
        begin = time.perf_counter()
        try:
            yield
        finally:
            self.stage_ms[stage].append((time.perf_counter() - begin) * 1e3)


class Context(Protocol):
    """The service's view of the system."""

    uav: str
    service: str
    config: TreedockConfig
    health: HealthBook

    @property
    def lockstep(self) -> bool:
        """Whether every message waits for all that the last one caused (in memory), instead of coming in real time."""
        ...

    @property
    def clock(self) -> Clock:
        """The one clock of the service."""
        ...

    def on(
        self, topic: Topic, handler: Callable[[M], None], leaf: str | None = None, *, ring: int | None = None
    ) -> None:
        """Call ``handler(message)`` for each sample of ``topic`` (LATEST: only the newest), from the work loop."""
        ...

    def every(self, period_s: float, handler: Callable[[], None]) -> None:
        """Call ``handler()`` each ``period_s`` of the clock's time, from the work loop."""
        ...

    def every_wall(self, period_s: float, handler: Callable[[], None]) -> None:
        """Call ``handler()`` each ``period_s`` of real time, even while simulated time stands still (in memory: as every)."""
        ...

    def on_stop(self, handler: Callable[[], None]) -> None:
        """Call ``handler()`` once when the service stops, before the bus closes: flush a file, and be quick (< 0.5 s)."""
        ...

    def publish(self, topic: Topic, message: Wire, leaf: str | None = None) -> None:
        """Send a message; ``leaf`` names the chunk in place of a trailing ``*``."""
        ...

    def listened(self, topic: Topic, leaf: str | None = None) -> bool:
        """Return whether anybody subscribes to the topic now: for what is only made when somebody wants it."""
        ...

    def alive(self, service: str) -> bool:
        """Return whether the service's liveliness token stands: gone within milliseconds of its death, hung or not."""
        ...

    def answer(self, topic: Topic, kind: type[Q], handler: Callable[[Q], Wire | None], leaf: str | None = None) -> None:
        """Answer queries on ``topic``'s key: the request is decoded as ``kind``; None gives no reply."""
        ...

    def answer_state(
        self, topic: Topic, handler: Callable[[], list[Wire]], kind: type[Q] | None = None,
        chosen: Callable[[Q], list[Wire]] | None = None,
    ) -> None:  # fmt: skip
        """Answer payload-less queries on a published topic's key with its whole present state.

        A query that carries a ``kind`` is answered with what ``chosen`` returns for it: a part of the state.
        """
        ...

    def ask(
        self, topic: Topic, request: Wire | None, kind: type[A], timeout_s: float, leaf: str | None = None
    ) -> list[A]:
        """Query a key and return the decoded replies; empty when nobody answered in time."""
        ...

    def ask_later(
        self, topic: Topic, request: Wire, kind: type[A], timeout_s: float, then: Callable[[list[A]], None]
    ) -> None:
        """Query a key without waiting: the work loop calls ``then`` with the replies, or with none after ``timeout_s``."""
        ...

    def steady_ns(self) -> int:
        """Return a time that nobody sets and that goes on while the machine sleeps: for durations that others rely on."""
        ...
