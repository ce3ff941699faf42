"""Keeps a live service's wall clock at the router's: asked at the start, before anything is stamped, and every two seconds."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Sequence
from typing import Protocol

import zenoh

from schemas.codec import Wire
from schemas.timekeeping import ClockReply, ClockRequest
from schemas.topics import CLOCK, Topic
from services.common.clock import WallClock
from services.common.timekeeping import OffsetFilter

LOG = logging.getLogger(__name__)

FAR_NS = 20_000_000
"""Clocks farther apart than this are told in health; PX4 drops vision whose clock is 10 ms off for long."""
_FIRST, _TIMEOUT_S = 5, 0.3
_PATIENCE_S, _PAUSE_S = 1.5, 0.1
"""So long a start waits for the first answer: on a busy machine it takes a moment, and where nobody answers READY must not wait."""
_PERIOD_S = 2.0
_UNTOLD_S = 30.0
"""So long the clock goes on by itself before that is worth a word: quartz drifts by 1 ms in it, an answer lost is soon made up."""
_YOUNG_S = 5.0
"""So soon after its start a service may still step: nobody rests on its stamps yet."""
_LATE_STEP_NS = 1_000_000_000
"""A first answer that comes later than that may not step by more: ages and holds are counted by this clock."""


class Asker(Protocol):
    """The bus, as far as it is needed here."""

    def ask(
        self, topic: Topic, request: Wire | None, kind: type[ClockReply], timeout_s: float, leaf: str | None = None, *,
        quiet: bool = False,
    ) -> Sequence[ClockReply]:  # fmt: skip
        """Query a key."""
        ...


class ClockSync:
    """Measures and corrects.

    A clock that is found to be off by more than a second only when the service has long been at work is kept as it is, and
    told in health. It is neither stepped (holds that are counted would not end, timers stand still) nor is the service
    ended for it: a navigator or a bridge that ends in flight lands the aircraft, and the flight got this far by the old clock.
    On the ground preflight refuses to start beside clocks half a second apart, until the service was started again.
    """

    def __init__(
        self, service: str, wall: WallClock, asker: Asker, monotonic_s: Callable[[], float] = time.monotonic
    ) -> None:
        self._request = ClockRequest(sender=service)
        self._wall, self._asker, self._monotonic_s = wall, asker, monotonic_s
        self._filter = OffsetFilter()
        self._begun_s = monotonic_s()
        self._measured = False
        self._answered_s = self._begun_s
        self._untold = False
        self.word = ""
        """What is wrong with the clock and what to do; empty while nothing is."""

    def begin(self) -> None:
        """Measure and correct at once; a router that does not answer in time (an older one) leaves the clock as it is."""
        if not self._first_exchange():
            return
        for _ in range(_FIRST - 1):
            if not self._exchange():
                break
        self._correct()

    def _first_exchange(self) -> bool:
        """Ask until an answer comes or patience ends, by real time; return whether one came."""
        until_s = time.monotonic() + _PATIENCE_S
        while not self._exchange():
            if time.monotonic() >= until_s:
                return False
            time.sleep(_PAUSE_S)
        return True

    def keep(self, stopped: Callable[[], bool]) -> None:
        """Measure and correct from a thread of its own until ``stopped()``."""
        threading.Thread(target=self._run, args=(stopped,), name="clock", daemon=True).start()

    def _run(self, stopped: Callable[[], bool]) -> None:
        while not stopped():
            time.sleep(_PERIOD_S)
            try:
                if not stopped():
                    self.once()
            except zenoh.ZError as error:
                if stopped():
                    return  # the session closed under the question
                LOG.warning("the router's clock could not be asked: %s", error)

    def once(self) -> None:
        """Measure and correct once; after half a minute without an answer, say so."""
        if self._exchange():
            if self._untold:
                LOG.info("the router tells the time again")
            self._untold = False
            self._correct()
        elif not self._untold and self._monotonic_s() - self._answered_s >= _UNTOLD_S:
            self._untold = True
            LOG.warning(
                "the router has not told the time for %.0f s, and this service's clock goes on by itself: is the machine too "
                "busy, the link to the router too weak, or the router of an older version?", _UNTOLD_S,
            )  # fmt: skip

    def _exchange(self) -> bool:
        """Ask once; return whether an answer came."""
        asked_ns = self._wall.machine_ns()
        replies = self._asker.ask(CLOCK, self._request, ClockReply, _TIMEOUT_S, quiet=True)
        if not replies:
            return False
        self._answered_s = self._monotonic_s()
        self._filter.add(asked_ns, replies[0].stamp_ns, self._wall.machine_ns())
        return True

    def _correct(self) -> None:
        offset_ns = self._filter.offset_ns
        if offset_ns is None:
            return
        change_ns = abs(offset_ns - self._wall.correction_ns)
        young = self._monotonic_s() - self._begun_s < _YOUNG_S
        if not self._measured and not young and change_ns > _LATE_STEP_NS:
            self._keep_old(offset_ns)
            return
        self.word = ""
        far = change_ns > FAR_NS
        at_once = not self._measured or (far and young)
        self._measured = True
        step_ns = self._wall.correct(offset_ns, at_once=at_once)
        if abs(step_ns) > FAR_NS:
            LOG.warning("this machine's clock is %+.0f ms off the router's: corrected", -offset_ns * 1e-6)

    def _keep_old(self, offset_ns: int) -> None:
        if not self.word:
            LOG.error(
                "this service's clock is %+.1f s off the router's, found too late to correct it", -offset_ns * 1e-9
            )
        self.word = (
            f"this service's clock is {-offset_ns * 1e-9:+.1f} s off the router's, found while it was at work, and is kept: "
            "start the service again, on the ground"
        )
