"""COMMAND_LONG and COMMAND_INT: what each command does and the result that is acknowledged."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from pymavlink.dialects.v20 import common as m

from services.simulator.px4.geodesy import to_local
from services.simulator.px4.modes import BY_MODE, NavState
from services.simulator.px4.vehicle import Vehicle

ACCEPTED, TEMPORARILY_REJECTED, DENIED, UNSUPPORTED, FAILED = 0, 1, 2, 3, 4
_FORCE_DISARM = 21196.0


@dataclass(frozen=True, slots=True)
class Command:
    """A command with its seven parameters; positions of COMMAND_INT already in degrees."""

    command: int
    params: tuple[float, float, float, float, float, float, float]


def whole(value: float) -> int:
    """Return a parameter that stands for an integer; -1 for what cannot be one."""
    return int(value) if math.isfinite(value) and abs(value) < 2**31 else -1


def _result(accepted: bool) -> int:
    return ACCEPTED if accepted else TEMPORARILY_REJECTED


def _arm_disarm(v: Vehicle, c: Command) -> int:
    if c.params[0] == 1.0:
        return _result(v.commander.request_arm())
    if c.params[0] == 0.0:
        return _result(v.commander.request_disarm(forced=c.params[1] == _FORCE_DISARM))
    return UNSUPPORTED


def _set_mode(v: Vehicle, c: Command) -> int:
    base, main, sub = (whole(v) for v in c.params[:3])
    if base < 0 or not base & m.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED:
        return DENIED
    state = BY_MODE.get((main, sub if main == NavState.HOLD.value[0] else 0))
    return _result(v.commander.request_mode(state)) if state is not None else DENIED


def _takeoff(v: Vehicle, c: Command) -> int:
    height = c.params[6]
    above_home = math.nan
    if math.isfinite(height) and v.origin is not None:
        above_home = float(v.estimator.position_m[2]) - to_local(v.origin, (v.origin[0], v.origin[1], height))[2]
    v.modes.takeoff_height_m = above_home
    return _result(v.commander.request_mode(NavState.TAKEOFF))


def _land(v: Vehicle, _c: Command) -> int:
    return _result(v.commander.request_mode(NavState.LAND))


def _return(v: Vehicle, _c: Command) -> int:
    return _result(v.commander.request_mode(NavState.RETURN))


def _hold(v: Vehicle, _c: Command) -> int:
    return _result(v.commander.request_mode(NavState.HOLD))


def _prearm(v: Vehicle, _c: Command) -> int:
    return _result(not v.commander.arming_fault())


def _accept(_v: Vehicle, _c: Command) -> int:
    return ACCEPTED


HANDLERS: dict[int, Callable[[Vehicle, Command], int]] = {
    m.MAV_CMD_COMPONENT_ARM_DISARM: _arm_disarm,
    m.MAV_CMD_DO_SET_MODE: _set_mode,
    m.MAV_CMD_NAV_TAKEOFF: _takeoff,
    m.MAV_CMD_NAV_LAND: _land,
    m.MAV_CMD_NAV_RETURN_TO_LAUNCH: _return,
    m.MAV_CMD_NAV_LOITER_UNLIM: _hold,
    m.MAV_CMD_RUN_PREARM_CHECKS: _prearm,
    m.MAV_CMD_DO_SET_HOME: _accept,
    m.MAV_CMD_DO_CHANGE_SPEED: _accept,
}
"""Commands of the vehicle; those about messages are the link's own (mavlink_server.py)."""


def execute(vehicle: Vehicle, command: Command) -> int:
    """Carry out a command and return its MAV_RESULT."""
    handler = HANDLERS.get(command.command)
    return UNSUPPORTED if handler is None else handler(vehicle, command)
