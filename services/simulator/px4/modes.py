"""PX4's commander: arming checks, the wanted mode against the possible one, failsafes and their re-entry.

The wanted mode ("intention") stays what somebody asked for. Each cycle decides which mode may run; while a failsafe
holds, another mode flies, and when its cause clears the intention flies again by itself. That is the trap measured
on the real one: a setpoint stream that resumes takes the craft back.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum

from services.simulator.px4.params import Parameters

CYCLE_S = 0.1
"""The commander looks at the setpoint stream at 10 Hz."""
_LOSS_DELAY_S = 0.25
_STREAM_GAP_S = 0.5
"""A stream slower than 2 Hz is no stream."""
_STREAM_AGE_S = 1.0


class NavState(Enum):
    """Flight modes as (main mode, sub mode) of PX4's custom_mode."""

    MANUAL = (1, 0)
    ALTITUDE = (2, 0)
    POSITION = (3, 0)
    TAKEOFF = (4, 2)
    HOLD = (4, 3)
    RETURN = (4, 5)
    LAND = (4, 6)
    OFFBOARD = (6, 0)
    STABILIZED = (7, 0)
    DESCEND = (4, 6, 1)
    """Land without a position; the heartbeat shows it as Land."""

    @property
    def custom_mode(self) -> int:
        """The heartbeat's custom_mode field."""
        return self.value[0] << 16 | self.value[1] << 24


BY_MODE: dict[tuple[int, int], NavState] = {
    (state.value[0], state.value[1]): state for state in reversed(NavState) if state is not NavState.DESCEND
}

_NEEDS_POSITION = {NavState.POSITION, NavState.TAKEOFF, NavState.HOLD, NavState.RETURN, NavState.LAND}
_NEEDS_GLOBAL = {NavState.HOLD, NavState.RETURN}
_MANUAL = {NavState.ALTITUDE, NavState.MANUAL, NavState.STABILIZED, NavState.POSITION}
_BY_LOSS_ACTION = {0: NavState.POSITION, 1: NavState.ALTITUDE, 2: NavState.MANUAL, 3: NavState.RETURN,
                   4: NavState.LAND, 5: NavState.HOLD}  # fmt: skip
_ENDS_IN_HOLD = {NavState.LAND, NavState.TAKEOFF, NavState.RETURN}
"""Intentions that are done once the vehicle is disarmed; OFFBOARD is not one of them."""
_FALLBACKS = (NavState.HOLD, NavState.RETURN, NavState.LAND, NavState.DESCEND)


@dataclass(frozen=True, slots=True)
class Situation:
    """What the commander is told each tick."""

    position_valid: bool
    global_valid: bool
    height_valid: bool
    heading_valid: bool
    offboard_needs_position: bool
    landed: bool
    battery_share: float
    ground_station: bool


class SetpointStream:
    """Judges whether external setpoints flow: a second of unbroken stream to begin, COM_OF_LOSS_T to end."""

    def __init__(self) -> None:
        self.last_s = -math.inf
        self._since_s = math.inf

    def arrived(self, now_s: float) -> None:
        """Note a valid setpoint."""
        if now_s - self.last_s > _STREAM_GAP_S:
            self._since_s = now_s
        self.last_s = now_s

    def fresh(self, now_s: float, loss_s: float) -> bool:
        """Whether a setpoint came within the loss time."""
        return now_s - self.last_s <= loss_s

    def proven(self, now_s: float, loss_s: float) -> bool:
        """Whether the stream has also been steady for a second."""
        return self.fresh(now_s, loss_s) and now_s - self._since_s >= _STREAM_AGE_S


class Commander:
    """Arming, modes and failsafes. ``say(severity, text)`` receives what PX4 would send as STATUSTEXT."""

    def __init__(
        self, params: Parameters, say: Callable[[int, str], None], now_s: float, *, remote_control: bool
    ) -> None:
        self._params, self._say = params, say
        self.intention = NavState.HOLD
        self.state = NavState.HOLD
        self.armed = False
        self.armed_since_s = -math.inf
        self.failsafe = ""
        self.remote_control = remote_control
        self.stream = SetpointStream()
        self.flown = False
        self._landed_since_s = now_s
        self._stream_ok = False
        self._lost_since_s = math.inf
        self._offboard_wish_s = math.inf
        self._next_cycle_s = now_s
        self._situation = Situation(False, False, False, False, False, True, 1.0, False)  # noqa: FBT003
        self._now_s = now_s

    # -- requests ------------------------------------------------------------------------------------------------

    def request_mode(self, wanted: NavState) -> bool:
        """Change the wanted mode: always while disarmed, only to a mode that can run while armed."""
        young = wanted is NavState.OFFBOARD and self.stream.fresh(self._now_s, _STREAM_GAP_S)
        if self.armed and young and not self._stream_ok:
            self._offboard_wish_s = self._now_s  # begun too late: offboard follows when the stream is a second old
            return True
        self._offboard_wish_s = math.inf
        if self.armed and not self.can_run(wanted):
            self._say(2, f"Switching to mode '{wanted.name.lower()}' is currently not available")
            return False
        self.intention = wanted
        self._decide()
        return True

    def request_arm(self) -> bool:
        """Arm if the checks pass; says why when they do not."""
        reason = self.arming_fault()
        if reason:
            self._say(2, f"Arming denied: {reason}")
            return False
        if not self.armed:
            self.armed, self.armed_since_s, self.flown = True, self._now_s, False
            self._decide()
            self._say(6, "Armed by external command")
        return True

    def request_disarm(self, *, forced: bool) -> bool:
        """Disarm; in the air only when forced."""
        if self.armed and not self._situation.landed and not forced:
            self._say(2, "Disarming denied: not landed")
            return False
        self._disarm("external command")
        return True

    def arming_fault(self) -> str:
        """Return why arming is refused, empty when it is not."""
        p, s = self._params, self._situation
        if not p.integer("SYS_HAS_GPS") and not p.integer("COM_ARM_WO_GPS"):
            return "no GPS (COM_ARM_WO_GPS 0)"
        if p.integer("NAV_DLL_ACT") and not s.ground_station:
            return "no connection to the ground control station (NAV_DLL_ACT)"
        if p.integer("COM_RC_IN_MODE") != 4 and not self.remote_control:
            return "no manual control input (COM_RC_IN_MODE)"
        if s.battery_share < p["BAT_CRIT_THR"]:
            return "low battery"
        if not s.heading_valid:
            return "heading estimate not available"
        if not self.can_run(self.intention):
            return f"mode '{self.intention.name.lower()}' cannot run"
        return ""

    def can_run(self, state: NavState) -> bool:
        """Whether the estimates and inputs that a mode needs are there."""
        s = self._situation
        if state is NavState.OFFBOARD:
            return self._stream_ok and (s.position_valid or not s.offboard_needs_position)
        if state in _NEEDS_POSITION and not s.position_valid:
            return False
        if state in _NEEDS_GLOBAL and not s.global_valid:
            return False
        if state in _MANUAL:
            # COM_RC_IN_MODE 4 asks for no sticks: a ground station may take the craft into these modes
            return self.remote_control or self._params.integer("COM_RC_IN_MODE") == 4
        return True

    # -- the cycle -----------------------------------------------------------------------------------------------

    def update(self, now_s: float, situation: Situation) -> None:
        """Look at the world; the mode is decided anew in each commander cycle."""
        self._now_s, self._situation = now_s, situation
        if not situation.landed:
            self._landed_since_s = math.inf
            self.flown = self.flown or self.armed
        elif self._landed_since_s == math.inf:
            self._landed_since_s = now_s
        if now_s + 1e-9 < self._next_cycle_s:
            return
        self._next_cycle_s = now_s + CYCLE_S
        self._watch_stream()
        self._late_offboard()
        self._auto_disarm()
        self._decide()

    def _watch_stream(self) -> None:
        loss_s = self._params["COM_OF_LOSS_T"]
        if not self._stream_ok:
            # at first a steady second is asked for; after a loss any resumed stream takes the craft back
            resumed = self.armed and self.intention is NavState.OFFBOARD and self.failsafe != ""
            fresh = self.stream.fresh(self._now_s, CYCLE_S * 2.0)
            self._stream_ok = fresh if resumed else self.stream.proven(self._now_s, loss_s)
            self._lost_since_s = math.inf
        elif self.stream.fresh(self._now_s, loss_s):
            self._lost_since_s = math.inf
        elif self._lost_since_s == math.inf:
            self._lost_since_s = self.stream.last_s + loss_s
        if self._now_s - self._lost_since_s >= _LOSS_DELAY_S:
            self._stream_ok = False

    def _late_offboard(self) -> None:
        if self._now_s - self._offboard_wish_s > _STREAM_AGE_S + 2.0 * CYCLE_S:
            self._offboard_wish_s = math.inf
        elif not math.isinf(self._offboard_wish_s) and self.can_run(NavState.OFFBOARD):
            self._offboard_wish_s = math.inf
            self.intention = NavState.OFFBOARD

    def _auto_disarm(self) -> None:
        if not self.armed or not self._situation.landed:
            return
        p = self._params
        if self.flown:
            if 0.0 < p["COM_DISARM_LAND"] <= self._now_s - self._landed_since_s:
                self._disarm("landing")
        elif 0.0 < p["COM_DISARM_PRFLT"] <= self._now_s - self.armed_since_s:
            self._disarm("no take-off")

    def _disarm(self, cause: str) -> None:
        if self.armed:
            self._say(6, f"Disarmed by {cause}")
        self.armed, self.flown, self.failsafe = False, False, ""
        if self.intention in _ENDS_IN_HOLD:
            self.intention = NavState.HOLD
        self.state = self.intention

    def _decide(self) -> None:
        if not self.armed:
            self.state, self.failsafe = self.intention, ""
            return
        wanted, cause = self._failsafe_wish()
        if wanted is None:
            if self.failsafe:
                self._say(5, "Failsafe cleared")
            self.state, self.failsafe = self.intention, ""
            return
        manned = wanted not in _MANUAL or self.remote_control
        chosen = wanted if manned and self.can_run(wanted) else next(f for f in _FALLBACKS if self.can_run(f))
        if cause != self.failsafe:
            self._say(2, f"Failsafe activated: {cause}, switching to {chosen.name.lower()}")
        self.state, self.failsafe = chosen, cause

    def _failsafe_wish(self) -> tuple[NavState | None, str]:
        s, p = self._situation, self._params
        if s.battery_share < p["BAT_CRIT_THR"] and p.integer("COM_LOW_BAT_ACT") >= 2:
            return NavState.LAND, "critical battery"
        if p.integer("NAV_DLL_ACT") and not s.ground_station:
            return NavState.HOLD, "ground station lost"
        if self.intention is NavState.OFFBOARD and not self._stream_ok:
            action = _BY_LOSS_ACTION.get(p.integer("COM_OBL_RC_ACT"), NavState.LAND)
            return action, "offboard signal lost"
        if not self.can_run(self.intention):
            if self.intention is NavState.POSITION:
                return NavState.ALTITUDE, "no position"
            return NavState.LAND, "no position" if not s.position_valid else "mode unavailable"
        return None, ""
