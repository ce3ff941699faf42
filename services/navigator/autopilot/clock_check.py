"""The two clocks, measured: TIMESYNC there and back. Pure.

PX4 learns our clock from our answers and uses none that took 10 ms or more; what it learns we cannot see, but our own
question along the same way tells how long the way is and whether either clock jumped.
"""

from __future__ import annotations

from collections import deque
from typing import Any

from pymavlink.dialects.v20 import common as mav

_ASK_NS = 1_000_000_000
_SLOW_NS = 10_000_000
_JUMP_NS = 50_000_000
_SHARE = 0.1
_SLOW_IN_A_ROW = 5
_TOLD_NS = 30_000_000_000
_RATE_NS, _RATE_OFF = 5_000_000_000, 0.03
"""The two clocks' rates are compared over this long, and told when they differ by more than this share."""


class ClockCheck:
    """Asks once a second; ``offset_ns`` is the autopilot's clock minus ours."""

    def __init__(self) -> None:
        self.offset_ns: int | None = None
        self.round_trip_ns: int | None = None
        self.answers = 0
        self.jumps = 0
        self._slow = 0
        self._asked_ns = -1
        self._jumped_ns: int | None = None
        self._rates: deque[float] = deque(maxlen=2)
        """How fast the autopilot's clock ran against ours, over the last two stretches: one may hold a jump."""
        self._rate_from: tuple[int, int] | None = None

    def due(self, now_ns: int) -> list[Any]:
        """Return the question when it is time."""
        if self._asked_ns >= 0 and now_ns - self._asked_ns < _ASK_NS:
            return []
        self._asked_ns = now_ns
        return [mav.MAVLink_timesync_message(0, now_ns)]

    def take(self, message: mav.MAVLink_timesync_message, received_ns: int) -> None:
        """Take an answer: our own stamp came back with the autopilot's."""
        trip = received_ns - message.ts1
        if message.tc1 == 0 or not 0 <= trip < _ASK_NS:
            return
        offset = message.tc1 - (message.ts1 + trip // 2)
        self.answers += 1
        self.round_trip_ns = trip
        self._slow = self._slow + 1 if trip >= _SLOW_NS else 0
        if trip >= _SLOW_NS:
            return
        self._compare_rates(received_ns, offset)
        if self.offset_ns is not None and abs(offset - self.offset_ns) > _JUMP_NS:
            self.jumps += 1
            self._jumped_ns = received_ns
            self.offset_ns = offset
        elif self.offset_ns is None:
            self.offset_ns = offset
        else:
            self.offset_ns += round(_SHARE * (offset - self.offset_ns))

    def _compare_rates(self, received_ns: int, offset_ns: int) -> None:
        if self._rate_from is None:
            self._rate_from = received_ns, offset_ns
            return
        since_ns = received_ns - self._rate_from[0]
        if since_ns >= _RATE_NS:
            self._rates.append(1.0 + (offset_ns - self._rate_from[1]) / since_ns)
            self._rate_from = received_ns, offset_ns

    def word(self, now_ns: int) -> str:
        """Return what is wrong with the clocks, empty when nothing is."""
        if self._slow >= _SLOW_IN_A_ROW and self.round_trip_ns is not None:
            return f"TIMESYNC takes {self.round_trip_ns / 1e6:.0f} ms there and back: PX4 uses none above 10 ms"
        if len(self._rates) == 2 and all(abs(rate - 1.0) > _RATE_OFF for rate in self._rates):
            return (
                f"the autopilot's clock runs {self._rates[-1]:.2f} times as fast as ours: a simulated PX4 has to run in real "
                "time (PX4_SIM_SPEED_FACTOR 1, a machine that keeps up)"
            )
        if self._jumped_ns is not None and now_ns - self._jumped_ns < _TOLD_NS:
            return "the autopilot's clock jumped: vision stamps are wrong until it has learnt ours again"
        return ""
