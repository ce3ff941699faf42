"""A service's context over Zenoh: timers by two clocks, and the work loop's one step."""

from __future__ import annotations

import heapq
import logging
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TypeVar

import zenoh

from schemas.codec import Wire
from schemas.envelope import DecodeError
from schemas.simulation import SimClock
from schemas.topics import SIM_CLOCK, Topic
from services.common.asking import Asking
from services.common.bus import Bus
from services.common.clock import Clock, SimulatedClock, WallClock
from services.common.config import TreedockConfig
from services.common.context import HealthBook
from services.common.errors import InputError
from services.common.inbox import Inbox
from services.common.logging import Throttle

LOG = logging.getLogger(__name__)

M = TypeVar("M", bound=Wire)
Q = TypeVar("Q", bound=Wire)
A = TypeVar("A", bound=Wire)

_LONGEST_WAIT_S = 0.5


@dataclass(order=True)
class _Timer:
    due_ns: int
    order: int
    period_ns: int = field(compare=False)
    handler: Callable[[], None] = field(compare=False)

    def advance(self, now_ns: int) -> None:
        """Set the next due time; periods that were missed altogether are skipped, not made up for."""
        self.due_ns += self.period_ns
        if self.due_ns <= now_ns:
            self.due_ns = now_ns + self.period_ns


class LiveContext:
    """A service's context over Zenoh; see ``services.common.context.Context`` for what each operation promises."""

    lockstep = False

    def __init__(
        self, service: str, config: TreedockConfig, session: zenoh.Session, clock: Clock | None = None
    ) -> None:
        self.service = service
        self.config = config
        self.uav = config.uav
        self.health = HealthBook()
        self.inbox = Inbox()
        self.bus = Bus(session, config.uav, self.health, self.inbox)
        self.wall = WallClock(config.clock_ahead_s)
        self.clock: Clock = clock or self.wall
        self.topics_in: list[Topic] = []
        self.at_stop: list[Callable[[], None]] = []
        self._timers: list[_Timer] = []
        self._wall_timers: list[_Timer] = []
        self._throttle = Throttle()
        self._asking: Asking | None = None

    def on(
        self, topic: Topic, handler: Callable[[M], None], leaf: str | None = None, *, ring: int | None = None
    ) -> None:
        """Call ``handler(message)`` for each sample."""
        self.topics_in.append(topic)
        self.bus.subscribe(topic, self.guarded(topic.name, handler), leaf, ring=ring)

    def every(self, period_s: float, handler: Callable[[], None]) -> None:
        """Call ``handler()`` each ``period_s`` of the clock's time; first after one period."""
        _add_timer(self._timers, self._timer_ns(), period_s, handler)

    def every_wall(self, period_s: float, handler: Callable[[], None]) -> None:
        """Call ``handler()`` each ``period_s`` of real time."""
        _add_timer(self._wall_timers, time.monotonic_ns(), period_s, handler)

    def _timer_ns(self) -> int:
        """Return what timers count by: never the wall clock, which is corrected in steps."""
        return self.clock.now_ns() if self.clock.simulated else time.monotonic_ns()

    def on_stop(self, handler: Callable[[], None]) -> None:
        """Call ``handler()`` before the bus closes."""
        self.at_stop.append(handler)

    def publish(self, topic: Topic, message: Wire, leaf: str | None = None) -> None:
        """Send a message."""
        self.bus.publish(topic, message, leaf)

    def listened(self, topic: Topic, leaf: str | None = None) -> bool:
        """Return whether anybody subscribes now."""
        return self.bus.listened(topic, leaf)

    def alive(self, service: str) -> bool:
        """Return whether the service's token stands."""
        return self.bus.alive(service)

    def answer(self, topic: Topic, kind: type[Q], handler: Callable[[Q], Wire | None], leaf: str | None = None) -> None:
        """Answer queries that carry a ``kind``."""
        self.bus.answer(topic, kind, handler, leaf)

    def answer_state(
        self, topic: Topic, handler: Callable[[], list[Wire]], kind: type[Q] | None = None,
        chosen: Callable[[Q], list[Wire]] | None = None,
    ) -> None:  # fmt: skip
        """Answer payload-less queries with the whole state, others with the part they name."""
        self.bus.answer_state(topic, handler, kind, chosen)

    def ask(
        self, topic: Topic, request: Wire | None, kind: type[A], timeout_s: float, leaf: str | None = None
    ) -> list[A]:
        """Query a key."""
        return self.bus.ask(topic, request, kind, timeout_s, leaf)

    def ask_later(
        self, topic: Topic, request: Wire, kind: type[A], timeout_s: float, then: Callable[[list[A]], None]
    ) -> None:
        """Query a key on a thread of its own; ``then`` is called by the work loop."""
        if self._asking is None:
            self._asking = Asking(self.bus, self.inbox)
            self.at_stop.append(self._asking.close)
        self._asking.ask(topic, request, kind, timeout_s, then)

    def steady_ns(self) -> int:
        """Return the time since the machine started, its sleep included."""
        return time.clock_gettime_ns(time.CLOCK_BOOTTIME) if hasattr(time, "CLOCK_BOOTTIME") else time.monotonic_ns()

    def guarded(self, about: str, handler: Callable[[M], None]) -> Callable[[M], None]:
        """Return ``handler`` so that bad data is counted and told; any other exception is a bug and passes."""

        def call(message: M) -> None:
            try:
                handler(message)
            except (InputError, DecodeError) as error:
                self.health.count(f"refused.{about}")
                self._throttle.log(LOG, logging.WARNING, about, f"refused a message of {about}: {error}")

        return call

    # -- the work loop

    def turn(self) -> None:
        """Fire what is due, handle the item that waited longest, or wait for the next thing to do."""
        fired = _fire(self._wall_timers, time.monotonic_ns()) + _fire(self._timers, self._timer_ns())
        taken = self.inbox.take()
        if taken is not None:
            box, item = taken
            box.handler(item)
        elif not fired:
            self.inbox.wait(self._wait_s())

    def _wait_s(self) -> float:
        waits = [_LONGEST_WAIT_S]
        if self._wall_timers:
            waits.append((self._wall_timers[0].due_ns - time.monotonic_ns()) * 1e-9)
        if self._timers and not self.clock.simulated:
            waits.append((self._timers[0].due_ns - time.monotonic_ns()) * 1e-9)
        return max(0.0, min(waits))

    def follow_simulated_clock(self) -> None:
        """Let ``sim/clock`` set the clock, on Zenoh's thread: time also moves while a handler works."""
        clock = self.clock
        if not isinstance(clock, SimulatedClock):
            return

        def moved(_: str, message: SimClock) -> None:
            clock.set_ns(message.stamp_ns)
            if self._timers and self._timers[0].due_ns <= message.stamp_ns:
                self.inbox.wake()

        self.bus.subscribe_keys(SIM_CLOCK, moved, at_once=True)


def _add_timer(timers: list[_Timer], now_ns: int, period_s: float, handler: Callable[[], None]) -> None:
    period_ns = round(period_s * 1e9)
    heapq.heappush(timers, _Timer(now_ns + period_ns, len(timers), period_ns, handler))


def _fire(timers: list[_Timer], now_ns: int) -> int:
    """Fire each due timer at most once, so that samples get their turn in between."""
    fired = 0
    while timers and timers[0].due_ns <= now_ns:
        timer = timers[0]
        timer.advance(now_ns)
        heapq.heapreplace(timers, timer)
        timer.handler()
        fired += 1
    return fired
