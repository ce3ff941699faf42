"""The bus in memory: the same interface, one thread, first in first out, so that every run is the same.

This is product code: ``treedock process`` runs the services over it in lockstep, and tests inject it.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, TypeVar

from schemas.codec import Wire
from schemas.topics import Topic
from services.common.clock import SimulatedClock
from services.common.config import TreedockConfig
from services.common.context import HealthBook

M = TypeVar("M", bound=Wire)
Q = TypeVar("Q", bound=Wire)
A = TypeVar("A", bound=Wire)

Handler = Callable[[Any], None]

_FELT_NS = 300_000_000_000
"""Of a gap between two stamps, so much is lived through timer by timer."""


@dataclass
class _Timer:
    period_ns: int
    due_ns: int
    handler: Callable[[], None]


@dataclass
class Hub:
    """Joins the contexts of several services; messages pass as objects, in order, when ``run`` is called."""

    config: TreedockConfig
    clock: SimulatedClock = field(default_factory=SimulatedClock)
    uav: str = "uav1"
    _queue: deque[tuple[str, Wire]] = field(default_factory=deque)
    _handlers: dict[str, list[Handler]] = field(default_factory=dict)
    _answers: dict[str, Callable[[Any], Wire | None]] = field(default_factory=dict)
    _states: dict[str, Callable[[], list[Wire]]] = field(default_factory=dict)
    _chosen: dict[str, Callable[[Any], list[Wire]]] = field(default_factory=dict)
    _timers: list[_Timer] = field(default_factory=list)
    _at_stop: list[Callable[[], None]] = field(default_factory=list)
    live: set[str] = field(default_factory=set)
    """Services that have a context here; a test takes one out to have it dead."""

    def context(self, service: str) -> MemoryContext:
        """Return a context for one service."""
        self.live.add(service)
        return MemoryContext(self, service)

    def run(self) -> None:
        """Deliver everything that is queued, and what that causes, until nothing is left."""
        while self._queue:
            key, message = self._queue.popleft()
            for handler in self._handlers.get(key, ()):
                handler(message)

    def advance_to(self, stamp_ns: int) -> None:
        """Move time on to ``stamp_ns``, firing due timers in order of time and registration.

        A gap (a recording that paused, a clock that was set) is felt for its last minutes only: nothing happens in it, and
        there may be decades between two stamps.
        """
        self._leap(stamp_ns - _FELT_NS)
        while True:
            due = min(self._timers, key=lambda timer: timer.due_ns, default=None)
            if due is None or due.due_ns > stamp_ns:
                break
            self.clock.set_ns(due.due_ns)
            due.due_ns += due.period_ns
            due.handler()
            self.run()
        self.clock.set_ns(stamp_ns)

    def _leap(self, to_ns: int) -> None:
        """Let each timer miss what it would have done before ``to_ns``."""
        if to_ns <= self.clock.now_ns():
            return
        self.clock.set_ns(to_ns)
        for timer in self._timers:
            timer.due_ns += max(0, -((timer.due_ns - to_ns) // timer.period_ns)) * timer.period_ns

    def stop(self) -> None:
        """Call what the services registered with ``on_stop``."""
        while self._at_stop:
            self._at_stop.pop(0)()


class MemoryContext:
    """A service's context on a Hub."""

    lockstep = True

    def __init__(self, hub: Hub, service: str) -> None:
        self._hub = hub
        self.service = service
        self.uav = hub.uav
        self.config = hub.config
        self.clock = hub.clock
        self.health = HealthBook()

    def on(
        self, topic: Topic, handler: Callable[[M], None], leaf: str | None = None, *, ring: int | None = None
    ) -> None:
        """Register a handler; several on one key are called in order of registration."""
        del ring  # in memory nothing is dropped
        self._hub._handlers.setdefault(topic.key(self.uav, leaf), []).append(handler)  # noqa: SLF001 - one module

    def every(self, period_s: float, handler: Callable[[], None]) -> None:
        """Register a timer; it first fires one period from now."""
        period_ns = round(period_s * 1e9)
        self._hub._timers.append(_Timer(period_ns, self.clock.now_ns() + period_ns, handler))  # noqa: SLF001

    def every_wall(self, period_s: float, handler: Callable[[], None]) -> None:
        """As ``every``: in memory there is one time."""
        self.every(period_s, handler)

    def on_stop(self, handler: Callable[[], None]) -> None:
        """Register what ``Hub.stop`` calls."""
        self._hub._at_stop.append(handler)  # noqa: SLF001

    def listened(self, topic: Topic, leaf: str | None = None) -> bool:
        """Return whether a handler is registered for the key."""
        return topic.key(self.uav, leaf) in self._hub._handlers  # noqa: SLF001

    def alive(self, service: str) -> bool:
        """Return whether the service is among the hub's living."""
        return service in self._hub.live

    def publish(self, topic: Topic, message: Wire, leaf: str | None = None) -> None:
        """Queue a message for its handlers."""
        self._hub._queue.append((topic.key(self.uav, leaf), message))  # noqa: SLF001

    def answer(self, topic: Topic, kind: type[Q], handler: Callable[[Q], Wire | None], leaf: str | None = None) -> None:
        """Register the one that answers a query key; requests arrive as objects, so ``kind`` is not needed here."""
        del kind
        self._hub._answers[topic.key(self.uav, leaf)] = handler  # noqa: SLF001

    def answer_state(
        self, topic: Topic, handler: Callable[[], list[Wire]], kind: type[Q] | None = None,
        chosen: Callable[[Q], list[Wire]] | None = None,
    ) -> None:  # fmt: skip
        """Register the one that answers with a topic's whole state, or with a part of it."""
        del kind
        self._hub._states[topic.key(self.uav)] = handler  # noqa: SLF001
        if chosen is not None:
            self._hub._chosen[topic.key(self.uav)] = chosen  # noqa: SLF001

    def ask(
        self, topic: Topic, request: Wire | None, kind: type[A], timeout_s: float, leaf: str | None = None
    ) -> list[A]:
        """Ask at once: in memory nobody is late."""
        del timeout_s
        key = topic.key(self.uav, leaf)
        state, chosen = self._hub._states.get(key), self._hub._chosen.get(key)  # noqa: SLF001
        if state is not None:
            replies = state() if request is None or chosen is None else chosen(request)
            return [reply for reply in replies if isinstance(reply, kind)]
        if request is None:
            return []
        handler = self._hub._answers.get(key)  # noqa: SLF001
        reply = handler(request) if handler else None
        return [reply] if isinstance(reply, kind) else []

    def ask_later(
        self, topic: Topic, request: Wire, kind: type[A], timeout_s: float, then: Callable[[list[A]], None]
    ) -> None:
        """Ask and answer at once."""
        then(self.ask(topic, request, kind, timeout_s))

    def steady_ns(self) -> int:
        """Return the hub's time: there is no other."""
        return self.clock.now_ns()
