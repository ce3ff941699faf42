"""Somebody else at the controls: another companion with our ids, or setpoints that are not ours. Pure.

Two signs: what others say on the link (PX4 passes it on where forwarding is set), and what PX4 says it flies to
(POSITION_TARGET_LOCAL_NED) when that is none of what we sent.
"""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import common as mav

from services.common.geometry import Matrix

_SETPOINTS = frozenset({
    "SET_POSITION_TARGET_LOCAL_NED", "SET_POSITION_TARGET_GLOBAL_INT", "SET_ATTITUDE_TARGET", "SET_ACTUATOR_CONTROL_TARGET",
})  # fmt: skip
_KEEP_NS = 2_000_000_000
_HEARD_NS = 3_000_000_000
"""How long a word of somebody else counts."""
_OFF_M = 1.0
"""PX4 may shape a setpoint on its way; this far from all of ours of the last two seconds it is another's."""
_OFF_NS = 1_000_000_000
_IGNORES_POSITION = 7


class Foreign:
    """Watches for others. Times are of our clock."""

    def __init__(self, component: int) -> None:
        self._component = component
        self._heard_ns = -_HEARD_NS
        self._said = ""
        self._sent: deque[tuple[int, Matrix]] = deque()
        self._off_since_ns: int | None = None
        self._off_m = 0.0

    def hear(self, message: Any, system: int | None, now_ns: int) -> None:  # noqa: ANN401 - pymavlink has no typed base
        """Take a message that is not the autopilot's."""
        kind, source, component = message.get_type(), message.get_srcSystem(), message.get_srcComponent()
        if kind in _SETPOINTS:
            self._said = f"component {component} of system {source} sends setpoints too"
        elif kind == "HEARTBEAT" and source == system and component == self._component:
            self._said = f"another companion speaks as component {component} of system {source}"
        else:
            return
        self._heard_ns = now_ns

    def sent(self, position_ned_m: Matrix, now_ns: int) -> None:
        """Note a setpoint of ours."""
        self._sent.append((now_ns, position_ned_m))
        while now_ns - self._sent[0][0] > _KEEP_NS:
            self._sent.popleft()

    def moved(self) -> None:
        """Note that the map moved: what we sent before is in another frame."""
        self._sent.clear()
        self._off_since_ns = None

    def not_followed(self) -> None:
        """Note that the autopilot does not fly to our setpoints now, nor should."""
        self._off_since_ns = None

    def flown_to(self, message: mav.MAVLink_position_target_local_ned_message, now_ns: int) -> None:
        """Take what the autopilot says it flies to, while it flies to ours."""
        place = np.array([message.x, message.y, message.z])
        known = bool(self._sent) and not message.type_mask & _IGNORES_POSITION and bool(np.isfinite(place).all())
        off = min(float(np.linalg.norm(place - p)) for _, p in self._sent) if known else 0.0
        if off < _OFF_M:
            self._off_since_ns = None
        elif self._off_since_ns is None:
            self._off_since_ns = now_ns
        self._off_m = off

    def word(self, now_ns: int) -> str:
        """Return who else is there, empty when nobody is."""
        if now_ns - self._heard_ns < _HEARD_NS:
            return self._said
        if self._off_since_ns is not None and now_ns - self._off_since_ns > _OFF_NS:
            return f"the autopilot flies to a place {self._off_m:.1f} m from any setpoint of ours: another source?"
        return ""
