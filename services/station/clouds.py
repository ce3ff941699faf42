"""The point clouds that pages look at: asked of the aircraft on threads of their own, followed while somebody looks.

The work loop alone touches what is held here; a thread only asks, once, and brings back what came.
"""

from __future__ import annotations

import functools
import logging
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field

import zenoh

from schemas.sketch import SubmapSketch
from schemas.topics import MAP_SKETCH
from services.common.bus import Bus
from services.station.cloud import CloudView

LOG = logging.getLogger(__name__)

_AT_ONCE = 2
_ROUNDS, _TIMEOUT_S, _AGAIN_S = 12, 5.0, 5.0


@dataclass(slots=True)
class _Look:
    """An aircraft that somebody looks at."""

    bus: Bus
    view: CloudView
    asked_s: float = 0.0
    rounds: int = 0
    held: set[int] = field(default_factory=set)
    """Submaps that came since a page last began to look."""


class Clouds:
    """The clouds of all aircraft: one question to each at a time, however many pages look."""

    def __init__(
        self, watchers: Callable[[str], list[int]], send: Callable[[int, bytes, str], None],
        call: Callable[[Callable[[], None]], None],
    ) -> None:  # fmt: skip
        """``watchers`` returns the pages that look; ``send`` gives one a frame with its key; ``call`` has the work loop do something."""
        self._watchers, self._send, self._call = watchers, send, call
        self._looks: dict[str, _Look] = {}
        self._asked: dict[str, Future[list[SubmapSketch]]] = {}
        self._pool = ThreadPoolExecutor(_AT_ONCE, thread_name_prefix="cloud")

    def wish(self, uav: str, bus: Bus) -> None:
        """Ask for the whole map; follow its changes from then on."""
        look = self._looks.get(uav)
        if look is None:
            look = self._looks[uav] = _Look(bus, CloudView(uav))
            bus.subscribe(MAP_SKETCH, functools.partial(self._on_sketch, uav))
        look.rounds = 0
        look.held.clear()  # who begins to look has nothing yet: what comes next is new, also of a question under way
        self._ask(uav, look)

    def each_second(self) -> None:
        """Stop listening to what no page looks at (the radio has better to carry); ask again where nothing came yet.

        A page may look before there is a mapper, or a map.
        """
        for uav in [uav for uav in self._looks if not self._watchers(uav)]:
            self._looks.pop(uav).bus.unsubscribe(MAP_SKETCH)
            self._asked[uav].cancel()
        for uav, look in self._looks.items():
            if look.view.empty and time.monotonic() - look.asked_s > _AGAIN_S:
                self.wish(uav, look.bus)

    def close(self) -> None:
        """Ask for nothing more."""
        self._pool.shutdown(wait=False, cancel_futures=True)

    def _ask(self, uav: str, look: _Look) -> None:
        look.asked_s = time.monotonic()
        before = self._asked.get(uav)
        if before is None or before.done():
            look.rounds += 1
            asked = self._asked[uav] = self._pool.submit(_sketches_of, look.bus)
            asked.add_done_callback(lambda _: self._call(functools.partial(self._on_round, uav, asked)))

    def _on_round(self, uav: str, asked: Future[list[SubmapSketch]]) -> None:
        """Take what came; big answers are dropped where the network is full: asked for until none is new."""
        look = self._looks.get(uav)
        if look is None or asked.cancelled():
            return
        fresh = [sketch for sketch in asked.result() if sketch.submap_id not in look.held]
        for sketch in fresh:
            self._on_sketch(uav, sketch)
        look.held |= {sketch.submap_id for sketch in fresh}
        if fresh and look.rounds < _ROUNDS and self._watchers(uav):
            self._ask(uav, look)

    def _on_sketch(self, uav: str, sketch: SubmapSketch) -> None:
        pages = self._watchers(uav)
        if pages and uav in self._looks:
            for key, frame in self._looks[uav].view.take(sketch):
                for page in pages:
                    self._send(page, frame, key)


def _sketches_of(bus: Bus) -> list[SubmapSketch]:
    try:
        return bus.ask(MAP_SKETCH, None, SubmapSketch, _TIMEOUT_S)
    except zenoh.ZError as error:  # the session is closing or the router away
        LOG.debug("the map of %s could not be asked for: %s", bus.uav, error)
        return []
