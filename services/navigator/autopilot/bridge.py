"""The bridge between the bus and PX4: messages and time in, MAVLink messages out. Pure: no socket, no clock.

Order within a tick matters: a pose with a correction is taken (``on_pose``) before the next setpoint is made, and the
setpoint is expressed in the map as the pose has it, so both move in the same tick.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from pymavlink.dialects.v20 import common as mav

from schemas.navigation import Guidance
from schemas.slam import Pose
from schemas.vehicle import VehicleState
from services.common.geometry import Matrix, wrap_angle
from services.common.mount import Mount
from services.navigator.autopilot import px4
from services.navigator.autopilot.clock_check import ClockCheck
from services.navigator.autopilot.config import AutopilotConfig
from services.navigator.autopilot.engagement import Engagement, Order, Vehicle
from services.navigator.autopilot.foreign import Foreign
from services.navigator.autopilot.frames import to_ned
from services.navigator.autopilot.parameters import ParameterReader, refusals
from services.navigator.autopilot.sensors import Sensors
from services.navigator.autopilot.telemetry import Telemetry
from services.navigator.autopilot.vision import Vision
from services.navigator.track import Correction, Step

_HEARTBEAT_NS = 1_000_000_000
_ASK_AGAIN_NS = 2_000_000_000
_AGREE_NS = 50_000_000
_MODE_NS = 100_000_000
"""In flight the heartbeat is asked for this often, so that a pilot who takes over is noticed in 0.1 s instead of 1 s."""
_ORIGINS, _ORIGIN_QUESTIONS = 30, 2
_SET_THEM = "Set them, or start with --set autopilot.set_parameters=true; then start the autopilot again"
_SAY_VEHICLE = (
    "parameters: autopilot.vehicle is not said, and the camera is a real one. Set it to 'real' (the sticks must win), or to "
    "'simulation' for hardware in the loop"
)
_AHEAD_S = 0.15
"""A setpoint is carried on along its velocity for at most this long after its guidance was made."""
_USE_POSITION_VELOCITY_YAW_RATE = 448
"""Type mask: only the three accelerations are ignored."""


class Bridge:
    """All the bridge knows. ``handle`` takes the autopilot's messages, ``tick`` gives ours."""

    def __init__(
        self, config: AutopilotConfig, sensors: Sensors | None = None, *, vehicle_guessed: bool = False
    ) -> None:
        self.config = config
        self._vehicle_guessed = vehicle_guessed
        self.sensors = sensors or Sensors()
        self.mount = Mount.level(config.camera_offset_m, config.camera_pitch_rad, config.camera_yaw_rad)
        self.telemetry = Telemetry(config.component_id)
        self.vision = Vision(config, self.mount)
        self.engagement = Engagement(config)
        self.parameters = ParameterReader(config.vehicle, change=config.set_parameters)
        self.clocks = ClockCheck()
        self.foreign = Foreign(config.component_id)
        self._origins_sent = self._origins_asked = 0
        self.setpoints_sent = 0
        self.setpoints_refused = 0
        self._far = ""
        self._wrong = refusals({}, config.vehicle)
        self._corrections: dict[tuple[str, int], Correction] = {}
        """From the map as it was under (map_id, reset_counter) to the present one."""
        self._moved_ns = -1
        """Guidance made before this is in a map that cannot be related to the present one."""
        self._held: tuple[Matrix, float] | None = None
        self._sent: tuple[Matrix, float] | None = None
        self._due = {"heartbeat": 0, "setpoint": 0, "ask": 0, "agree": 0, "mode": 0}
        self._outages = 0
        self._seq = 0

    # -- in -----------------------------------------------------------------------------------------------------
    def on_pose(self, pose: Pose, now_ns: int) -> None:
        """Take slam's pose."""
        last = self.vision.track.latest
        step = self.vision.add(pose, now_ns)
        if step is Step.CORRECTION and last is not None and self.vision.track.correction is not None:
            new = self.vision.track.correction
            self._corrections = {key: new.after(old) for key, old in self._corrections.items()}
            self._corrections[last.map_id, last.reset_counter] = new
            self._corrections.pop((pose.map_id, pose.reset_counter), None)
            self._shift_held(new)
        elif step in (Step.RELOCATED, Step.JUMP):
            self._corrections.clear()
            self._moved_ns, self._held, self._sent = now_ns, None, None
        if step in (Step.CORRECTION, Step.RELOCATED, Step.JUMP):
            self.foreign.moved()

    def on_guidance(self, guidance: Guidance, now_ns: int) -> None:
        """Take the navigator's guidance."""
        self.engagement.on_guidance(guidance, self.vehicle(now_ns), now_ns)

    def handle(self, message: Any, received_ns: int) -> None:  # noqa: ANN401 - pymavlink's classes share no typed base
        """Take a message of the autopilot. Of what others say on the link it is only noted that they are there."""
        if not self.telemetry.take(message, received_ns):
            self.foreign.hear(message, self.telemetry.system, received_ns)
            return
        if self.telemetry.outages != self._outages:
            self._outages = self.telemetry.outages
            self._begin_anew()
        self.sensors.take(message, received_ns, self.clocks.offset_ns)
        kind = message.get_type()
        if kind == "PARAM_VALUE":
            self.parameters.take(message.param_id, message.param_value, message.param_type)
            self._wrong = refusals(self.parameters.found, self.config.vehicle)
        elif kind == "TIMESYNC":
            self.clocks.take(message, received_ns)
        elif kind == "POSITION_TARGET_LOCAL_NED" and self.engagement.phase == "engaged":
            self.foreign.flown_to(message, received_ns)

    def _begin_anew(self) -> None:
        """Ask the autopilot everything again: it was silent for so long that it may have been started again."""
        self.parameters = ParameterReader(self.config.vehicle, change=self.config.set_parameters)
        self._wrong = refusals({}, self.config.vehicle)
        self.clocks = ClockCheck()
        self._origins_sent = self._origins_asked = 0

    # -- out ----------------------------------------------------------------------------------------------------
    def tick(self, now_ns: int) -> list[Any]:
        """Return the messages to send at ``now_ns``; call it every 10 ms or so, and right after a pose."""
        system = self.telemetry.system
        out: list[Any] = []
        if self._is_due("heartbeat", now_ns, _HEARTBEAT_NS):
            out.append(_heartbeat())
        if system is None:
            return out
        if self._is_due("ask", now_ns, _ASK_AGAIN_NS):
            out.extend(self._requests(system, now_ns))
        flying = self.engagement.phase not in ("quiet", "released")
        if flying and self._is_due("mode", now_ns, _MODE_NS):
            out.append(px4.request(mav.MAVLINK_MSG_ID_HEARTBEAT, system))
        out.extend(self.clocks.due(now_ns))
        if self.config.check_parameters:
            may_set = not (self.telemetry.armed or flying or self._vehicle_guessed)
            out.extend(self.parameters.due(system, now_ns, may_set=may_set))
        odometry = self.vision.message(now_ns)
        if odometry is not None:
            out.append(odometry)
        if self._is_due("agree", now_ns, _AGREE_NS):
            self.telemetry.agree(self.vision.body(now_ns), now_ns)
        orders = self.engagement.update(self.vehicle(now_ns), now_ns)
        if self.engagement.phase != "engaged":
            self.foreign.not_followed()
        if self.engagement.streams:
            if self._is_due("setpoint", now_ns, round(1e9 / self.config.setpoint_hz)):
                out.extend(self._setpoint(system, now_ns))
        else:
            self._held = self._sent = None
        out.extend(_order(order, system) for order in orders)
        return out

    def vehicle(self, now_ns: int) -> Vehicle:
        """Return what the engagement looks at."""
        t = self.telemetry
        heard = t.age_s(now_ns) <= self.config.link_lost_s
        return Vehicle(heard, t.armed, t.mode, t.landed == "on_ground", t.fused(now_ns), self.refusal(),
                       self.foreign.word(now_ns), t.arming_word, t.failsafe, t.mode_ns)  # fmt: skip

    def refusal(self) -> str:
        """Return why the vehicle must not be flown, in words; empty when nothing speaks against it."""
        if self._vehicle_guessed:
            return _SAY_VEHICLE
        if not self.config.check_parameters:
            return ""
        if not self.parameters.complete:
            return "parameters are still being read"
        return f"parameters: {'; '.join(self._wrong)}. {_SET_THEM}" if self._wrong else ""

    def state(self, now_ns: int) -> VehicleState:
        """Return the vehicle state for the bus."""
        self._seq += 1
        e = self.engagement
        return self.telemetry.state(
            now_ns, self._seq, connected=self.vehicle(now_ns).heard, override=e.override, mission_id=e.mission_id,
            note=self._far or e.note or self.refusal() or self.clocks.word(now_ns),
        )  # fmt: skip

    def _is_due(self, what: str, now_ns: int, period_ns: int) -> bool:
        due = self._due[what]
        if now_ns < due:
            return False
        self._due[what] = due + period_ns if due and now_ns - due < period_ns else now_ns + period_ns
        return True

    def _requests(self, system: int, now_ns: int) -> list[Any]:
        """Ask for the streams that do not come, and for the origin until PX4 has told it."""
        out: list[Any] = []
        for message_id, rate_hz in (px4.STREAMS_HZ | self.sensors.streams_hz).items():
            came = self.telemetry.came_ns.get(message_id)
            asked = self.telemetry.acks.get(mav.MAV_CMD_SET_MESSAGE_INTERVAL) is not None
            if not asked or came is None or (now_ns - came) / 1e9 > max(3.0 / rate_hz, 0.5):
                out.append(px4.interval(message_id, rate_hz, system))
        # never in flight: a new origin may move PX4's estimate
        on_ground = not self.telemetry.armed and self.telemetry.landed != "in_air"
        if not self.telemetry.origin_known and on_ground and self._origins_sent < _ORIGINS:
            # it tells an origin it has only when asked, or once; it is not given another one
            out.append(px4.request(mav.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN, system))
            self._origins_asked += 1
            if self._origins_asked <= _ORIGIN_QUESTIONS:
                return out
            self._origins_sent += 1
            c = self.config
            lat, lon, alt = round(c.origin_lat_deg * 1e7), round(c.origin_lon_deg * 1e7), round(c.origin_alt_m * 1e3)
            out.append(mav.MAVLink_set_gps_global_origin_message(system, lat, lon, alt, time_usec=now_ns // 1000))
        return out

    # -- setpoints ----------------------------------------------------------------------------------------------
    def _setpoint(self, system: int, now_ns: int) -> list[Any]:
        guided = self._guided(now_ns)
        if guided is not None:
            self._held = None
            position, yaw, velocity, rate = guided
        else:
            held = self._hold(now_ns)
            if held is None:
                return []
            position, yaw, velocity, rate = held[0], held[1], np.zeros(3), 0.0
        self._sent = (position, yaw)
        self.setpoints_sent += 1
        p, v = to_ned(position), to_ned(velocity)
        self.foreign.sent(p, now_ns)
        message = mav.MAVLink_set_position_target_local_ned_message(
            (now_ns // 1_000_000) & 0xFFFFFFFF, system, px4.AUTOPILOT_COMPONENT, mav.MAV_FRAME_LOCAL_NED,
            _USE_POSITION_VELOCITY_YAW_RATE, float(p[0]), float(p[1]), float(p[2]), float(v[0]), float(v[1]),
            float(v[2]), 0.0, 0.0, 0.0, -yaw, -rate,
        )  # fmt: skip
        return [message]

    def _guided(self, now_ns: int) -> tuple[Matrix, float, Matrix, float] | None:
        """Return position, yaw, velocity (body, map) and yaw rate of the guidance in the present map, or None."""
        self._far = ""
        g = self.engagement.usable(now_ns)
        last = self.vision.track.latest
        if g is None or g.setpoint is None or last is None or g.stamp_ns <= self._moved_ns or self.engagement.holds:
            return None
        correction = None
        if (g.map_id, g.reset_counter) != (last.map_id, last.reset_counter):
            correction = self._corrections.get((g.map_id, g.reset_counter))
            if correction is None:
                return None
        s = g.setpoint
        ahead = float(np.clip((now_ns - g.stamp_ns) / 1e9, 0.0, _AHEAD_S))
        velocity = np.array(s.velocity_m_s)
        position = np.array(s.position_m) + velocity * ahead
        yaw = s.yaw_rad + s.yaw_rate_rad_s * ahead
        if correction is not None:
            position, velocity = correction.point(position), correction.vector(velocity)
            yaw += correction.yaw_rad
        body, body_yaw, body_velocity = self.mount.body_setpoint(position, yaw, velocity, s.yaw_rate_rad_s)
        if self._out_of_reach(body, now_ns):
            return None
        return body, body_yaw, body_velocity, s.yaw_rate_rad_s

    def _out_of_reach(self, body: Matrix, now_ns: int) -> bool:
        """Whether a setpoint is too far away to be meant; counted, and told in the vehicle state."""
        T = self.vision.body(now_ns)
        away_m = 0.0 if T is None else float(np.linalg.norm(body - T[:3, 3]))
        if away_m > self.config.setpoint_reach_m:
            self.setpoints_refused += 1
            self._far = f"holding: the navigator asks for a place {away_m:.1f} m away"
        return bool(self._far)

    def _hold(self, now_ns: int) -> tuple[Matrix, float] | None:
        """Return where to stand: where the aircraft is when the hold begins, else the last setpoint sent."""
        if self._held is None:
            T = self.vision.body(now_ns)
            if T is not None:
                self._held = (T[:3, 3].copy(), float(np.arctan2(T[1, 0], T[0, 0])))
            else:
                self._held = self._sent
        return self._held

    def _shift_held(self, correction: Correction) -> None:
        def moved(place: tuple[Matrix, float] | None) -> tuple[Matrix, float] | None:
            if place is None:
                return None
            return correction.point(place[0]), wrap_angle(place[1] + correction.yaw_rad)

        self._held, self._sent = moved(self._held), moved(self._sent)


def timesync_answer(message: Any, now_ns: int) -> mav.MAVLink_timesync_message | None:  # noqa: ANN401
    """Return the answer to a TIMESYNC request, with our clock now; None when it is itself an answer."""
    return mav.MAVLink_timesync_message(now_ns, message.ts1) if message.tc1 == 0 else None


def _heartbeat() -> mav.MAVLink_heartbeat_message:
    return mav.MAVLink_heartbeat_message(
        mav.MAV_TYPE_ONBOARD_CONTROLLER, mav.MAV_AUTOPILOT_INVALID, 0, 0, mav.MAV_STATE_ACTIVE, 3
    )


def _order(order: Order, system: int) -> mav.MAVLink_command_long_message:
    if order == "offboard":
        return px4.set_mode(px4.OFFBOARD, system)
    if order == "land":
        return px4.set_mode(px4.LAND, system)
    return px4.arm(system, on=order == "arm")
