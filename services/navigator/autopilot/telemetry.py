"""What the autopilot says, message by message, put together to one vehicle state in our frames. Pure."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import common as mav

from schemas.vehicle import LandedState, VehicleState
from services.common.geometry import Matrix, quaternion_from_rotation, wrap_angle
from services.navigator.autopilot.frames import rotation_map_body, to_ned
from services.navigator.autopilot.px4 import AUTOPILOT_COMPONENT, mode_name

_LANDED: dict[int, LandedState] = {
    mav.MAV_LANDED_STATE_ON_GROUND: "on_ground", mav.MAV_LANDED_STATE_IN_AIR: "in_air",
    mav.MAV_LANDED_STATE_TAKEOFF: "taking_off", mav.MAV_LANDED_STATE_LANDING: "landing",
}  # fmt: skip
_RESULTS = {
    mav.MAV_RESULT_TEMPORARILY_REJECTED: "temporarily rejected", mav.MAV_RESULT_DENIED: "denied",
    mav.MAV_RESULT_UNSUPPORTED: "unsupported", mav.MAV_RESULT_FAILED: "failed",
}  # fmt: skip
_FUSED_FLAGS = mav.ESTIMATOR_POS_HORIZ_REL | mav.ESTIMATOR_POS_HORIZ_ABS
_AGREE_M, _AGREE_RAD, _AGREE_S = 0.4, math.radians(20.0), 0.5
_FRESH_S = 1.0
_BATTERY_FRESH_S = 5.0
_STARTED_AGAIN_NS = 2_000_000_000


class Telemetry:
    """The latest of each message of the autopilot; ``*_ns`` are times of arrival on our clock.

    ``component`` is ours: acknowledgements for others are not noted.
    """

    def __init__(self, component: int) -> None:
        self._component = component
        self.system: int | None = None
        self.outages = 0
        """How often the autopilot came back after a silence long enough for it to have been started again."""
        self.heard_ns: int | None = None
        self.armed = False
        self.mode = "unknown"
        self.mode_ns = 0
        """When the mode was last told."""
        self.landed: LandedState = "unknown"
        self._shares: dict[int, tuple[float | None, int]] = {}
        """The battery's share by each message that tells it, None where it does not know it, and when it came."""
        self.R_map_body: Matrix | None = None
        self.position_m: Matrix | None = None
        self.velocity_m_s: Matrix | None = None
        self.position_ns = 0
        self.estimator_flags: int | None = None
        self.origin_known = False
        self.failsafe = False
        self.may_arm: bool | None = None
        """The autopilot's own verdict on arming, where it tells one."""
        self.said = ""
        """The last warning it sent; PX4 sends them on a ground station's links only."""
        self.came_ns: dict[int, int] = {}
        """Last arrival of each message id."""
        self.acks: dict[int, int] = {}
        """Last result of each command."""
        self._agrees_since_ns: int | None = None

    def take(self, message: Any, received_ns: int) -> bool:  # noqa: ANN401 - pymavlink's classes share no typed base
        """Take a message; False when it is not of the autopilot we talk to."""
        system, component = message.get_srcSystem(), message.get_srcComponent()
        gone = self.heard_ns is not None and received_ns - self.heard_ns > _STARTED_AGAIN_NS
        if component != AUTOPILOT_COMPONENT or (self.system is not None and system != self.system and not gone):
            return False
        kind = message.get_type()
        if kind == "HEARTBEAT":
            if message.autopilot == mav.MAV_AUTOPILOT_INVALID:
                return False
            self.system = system
            self.armed = bool(message.base_mode & mav.MAV_MODE_FLAG_SAFETY_ARMED)
            self.mode, self.mode_ns = mode_name(message.custom_mode), received_ns
            self.failsafe = message.system_status in (mav.MAV_STATE_CRITICAL, mav.MAV_STATE_EMERGENCY)
        if self.system is None or system != self.system:
            return False
        if gone:
            self._begin_anew()
        self.heard_ns = received_ns
        self.came_ns[message.get_msgId()] = received_ns
        reader = getattr(self, f"_on_{kind.lower()}", None)
        if reader is not None:
            reader(message, received_ns)
        return True

    def _begin_anew(self) -> None:
        """Forget what another start of the autopilot may have changed: streams, origin, acknowledgements."""
        self.outages += 1
        self.origin_known, self.estimator_flags, self.may_arm = False, None, None
        self._shares.clear()
        self.acks.clear()
        self.came_ns.clear()
        self._agrees_since_ns = None

    def age_s(self, now_ns: int) -> float:
        """Return the seconds since the autopilot spoke, inf before."""
        return math.inf if self.heard_ns is None else (now_ns - self.heard_ns) / 1e9

    def battery_share(self, now_ns: int) -> float | None:
        """Return what is left in the battery; None when nobody has known it for a while: it is no full one."""
        for message_id in (mav.MAVLINK_MSG_ID_SYS_STATUS, mav.MAVLINK_MSG_ID_BATTERY_STATUS):
            share, came_ns = self._shares.get(message_id, (None, 0))
            if share is not None and now_ns - came_ns <= _BATTERY_FRESH_S * 1e9:
                return share
        return None

    def agree(self, T_map_body: Matrix | None, now_ns: int) -> None:
        """Compare the autopilot's estimate with vision: fused is what follows it for a while."""
        near = False
        if T_map_body is not None and self.position_m is not None and self.R_map_body is not None:
            apart = float(np.linalg.norm(self.position_m - T_map_body[:3, 3]))
            turned = abs(wrap_angle(_yaw(self.R_map_body) - _yaw(T_map_body[:3, :3])))
            near = apart < _AGREE_M and turned < _AGREE_RAD and now_ns - self.position_ns < _FRESH_S * 1e9
        if not near:
            self._agrees_since_ns = None
        elif self._agrees_since_ns is None:
            self._agrees_since_ns = now_ns

    def fused(self, now_ns: int) -> bool:
        """Whether the estimator uses the vision pose: its flags where it sends them, and agreement."""
        if self._agrees_since_ns is None or (now_ns - self._agrees_since_ns) / 1e9 < _AGREE_S:
            return False
        return self.estimator_flags is None or bool(self.estimator_flags & _FUSED_FLAGS)

    @property
    def arming_word(self) -> str:
        """What the autopilot answered when asked to arm, and what it says of its checks; empty when it is content."""
        result = self.acks.get(mav.MAV_CMD_COMPONENT_ARM_DISARM, mav.MAV_RESULT_ACCEPTED)
        content = result in (mav.MAV_RESULT_ACCEPTED, mav.MAV_RESULT_IN_PROGRESS)
        words = [] if content else [_RESULTS.get(result, f"result {result}")]
        if self.may_arm is False:
            words.append("its pre-arm checks fail (its ground station, or `commander check` in its shell, shows why)")
        if words and self.said:
            words.append(f"it says: {self.said}")
        return ", ".join(words)

    def state(
        self, now_ns: int, seq: int, *, connected: bool, override: bool, mission_id: int, note: str
    ) -> VehicleState:
        """Return the message for the bus."""
        age = self.age_s(now_ns)
        return VehicleState(
            stamp_ns=now_ns, seq=seq, connected=connected, armed=self.armed, mode=self.mode, landed=self.landed,
            quaternion_map_body=_quaternion(self.R_map_body), position_map_m=_tuple(self.position_m),
            velocity_map_m_s=_tuple(self.velocity_m_s), battery_share=self.battery_share(now_ns),
            vision_fused=self.fused(now_ns), operator_override=override, engaged_mission_id=mission_id,
            link_age_s=min(max(age, 0.0), 1e6), note=note[:500],
        )  # fmt: skip

    def _on_current_mode(self, message: Any, received_ns: int) -> None:  # noqa: ANN401
        self.mode, self.mode_ns = mode_name(message.custom_mode), received_ns

    def _on_attitude_quaternion(self, message: Any, _: int) -> None:  # noqa: ANN401
        q = (message.q1, message.q2, message.q3, message.q4)
        if all(math.isfinite(v) for v in q) and sum(v * v for v in q) > 0.5:
            self.R_map_body = rotation_map_body(q)

    def _on_local_position_ned(self, message: Any, received_ns: int) -> None:  # noqa: ANN401
        values = np.array([message.x, message.y, message.z, message.vx, message.vy, message.vz])
        if np.isfinite(values).all():
            self.position_m, self.velocity_m_s = to_ned(values[:3]), to_ned(values[3:])
            self.position_ns = received_ns

    def _on_extended_sys_state(self, message: Any, _: int) -> None:  # noqa: ANN401
        self.landed = _LANDED.get(message.landed_state, "unknown")

    def _on_sys_status(self, message: Any, received_ns: int) -> None:  # noqa: ANN401
        self._battery(message, received_ns)
        check = mav.MAV_SYS_STATUS_PREARM_CHECK
        if message.onboard_control_sensors_enabled & check:
            self.may_arm = bool(message.onboard_control_sensors_health & check)

    def _on_battery_status(self, message: Any, received_ns: int) -> None:  # noqa: ANN401
        self._battery(message, received_ns)

    def _battery(self, message: Any, received_ns: int) -> None:  # noqa: ANN401
        percent = message.battery_remaining
        share = percent / 100.0 if 0 <= percent <= 100 else None
        self._shares[message.get_msgId()] = (share, received_ns)

    def _on_estimator_status(self, message: Any, _: int) -> None:  # noqa: ANN401
        self.estimator_flags = int(message.flags)

    def _on_gps_global_origin(self, message: Any, _: int) -> None:  # noqa: ANN401
        del message
        self.origin_known = True

    def _on_statustext(self, message: Any, _: int) -> None:  # noqa: ANN401
        if message.severity <= mav.MAV_SEVERITY_WARNING:
            self.said = str(message.text).rstrip("\0")[:100]

    def _on_command_ack(self, message: Any, _: int) -> None:  # noqa: ANN401
        for_us = message.target_system in (0, self.system) and message.target_component in (0, self._component)
        if for_us:
            self.acks[int(message.command)] = int(message.result)


def _yaw(R_map_body: Matrix) -> float:
    return float(np.arctan2(R_map_body[1, 0], R_map_body[0, 0]))


def _tuple(v: Matrix | None) -> tuple[float, float, float] | None:
    return None if v is None else (float(v[0]), float(v[1]), float(v[2]))


def _quaternion(R: Matrix | None) -> tuple[float, float, float, float] | None:
    if R is None:
        return None
    x, y, z, w = (float(c) for c in quaternion_from_rotation(R))
    return x, y, z, w
