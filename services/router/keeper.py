"""The router as keeper of the time: it answers with its clock, and takes up the others' when it was started again.

A router that dies comes back with its machine's clock as that is by now, which somebody may have set meanwhile; those that
outlived it still share the time of the one before. So it believes the first of them that it hears.
"""

from __future__ import annotations

import logging

from schemas.health import Health
from schemas.timekeeping import ClockReply, ClockRequest
from schemas.topics import CLOCK, HEALTH
from services.common.clock import WallClock
from services.common.clock_sync import FAR_NS
from services.common.context import Context

LOG = logging.getLogger(__name__)

_LISTEN_S = 3.0
"""So long after its start the router may take up another time."""
_OLDER_S = 1.0
"""A service that is so much older than the router has seen the one before it."""


class TimeKeeper:
    """Answers ``clock``; follows the elder services right after its own start."""

    def __init__(self, context: Context, wall: WallClock) -> None:
        self._wall = wall
        self._begun_ns = wall.machine_ns()
        self._taken_up = False
        context.answer(CLOCK, ClockRequest, lambda _: ClockReply(stamp_ns=wall.now_ns()))
        context.on(HEALTH, self.on_health)

    def on_health(self, health: Health) -> None:
        """Take up the time of a service that outlived the last router."""
        age_s = (self._wall.machine_ns() - self._begun_ns) * 1e-9
        if self._taken_up or age_s > _LISTEN_S or health.service == "router" or health.uptime_s < age_s + _OLDER_S:
            return
        self._taken_up = True
        off_ns = health.stamp_ns - self._wall.now_ns()
        if abs(off_ns) > FAR_NS:  # less is the way of the message
            self._wall.correct(self._wall.correction_ns + off_ns, at_once=True)
            LOG.warning("the clock of %s goes on: this machine's is %+.0f ms off it", health.service, -off_ns * 1e-6)
