"""PX4's own words: modes in ``custom_mode``, the commands we send, the streams we ask for. Pure."""

from __future__ import annotations

from pymavlink.dialects.v20 import common as mav

OFFBOARD = "offboard"
LAND = "land"
HOLD = "hold"

_MAIN = {
    1: "manual",
    2: "altitude",
    3: "position",
    4: "auto",
    5: "acro",
    6: "offboard",
    7: "stabilized",
    8: "rattitude",
}
_AUTO = {1: "ready", 2: "takeoff", 3: "hold", 4: "mission", 5: "rtl", 6: "land", 8: "follow", 9: "precland"}
_CODES = {OFFBOARD: (6, 0), LAND: (4, 6), HOLD: (4, 3)}

AUTOPILOT_COMPONENT = 1

STREAMS_HZ: dict[int, float] = {
    mav.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: 20.0,
    mav.MAVLINK_MSG_ID_LOCAL_POSITION_NED: 20.0,
    mav.MAVLINK_MSG_ID_EXTENDED_SYS_STATE: 5.0,
    mav.MAVLINK_MSG_ID_ESTIMATOR_STATUS: 5.0,
    mav.MAVLINK_MSG_ID_SYS_STATUS: 2.0,
    mav.MAVLINK_MSG_ID_POSITION_TARGET_LOCAL_NED: 5.0,
}
"""What we ask for with SET_MESSAGE_INTERVAL. Not the heartbeat: PX4 lets nobody change its rate of 1 Hz."""


def mode_name(custom_mode: int) -> str:
    """Return the mode in lower case: main mode in bits 16..23, auto's sub mode in bits 24..31."""
    main, sub = (custom_mode >> 16) & 0xFF, (custom_mode >> 24) & 0xFF
    if main == 4:
        return _AUTO.get(sub, f"auto{sub}")
    return _MAIN.get(main, f"mode{main}")


def set_mode(mode: str, system: int) -> mav.MAVLink_command_long_message:
    """Return DO_SET_MODE for a mode of ``_CODES``. PX4 acknowledges it twice: trust the heartbeat instead."""
    main, sub = _CODES[mode]
    flag = mav.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
    return command(mav.MAV_CMD_DO_SET_MODE, system, float(flag), float(main), float(sub))


def arm(system: int, *, on: bool) -> mav.MAVLink_command_long_message:
    """Return the order to arm or disarm, never forced."""
    return command(mav.MAV_CMD_COMPONENT_ARM_DISARM, system, 1.0 if on else 0.0)


def interval(message_id: int, rate_hz: float, system: int) -> mav.MAVLink_command_long_message:
    """Return the order to send a message at a rate."""
    return command(mav.MAV_CMD_SET_MESSAGE_INTERVAL, system, float(message_id), 1e6 / rate_hz)


def request(message_id: int, system: int) -> mav.MAVLink_command_long_message:
    """Return the order to send a message once, now; PX4 answers for its heartbeat, too."""
    return command(mav.MAV_CMD_REQUEST_MESSAGE, system, float(message_id))


def command(number: int, system: int, *parameters: float) -> mav.MAVLink_command_long_message:
    """Return COMMAND_LONG to the autopilot, parameters filled up with zeros."""
    filled = [*parameters, *([0.0] * (7 - len(parameters)))]
    return mav.MAVLink_command_long_message(system, AUTOPILOT_COMPONENT, number, 0, *filled)
