"""The MAVLink 2 endpoint: links in, handlers, streams out. All of PX4's habits on the wire are here.

Bad input never stops it: unreadable bytes, foreign targets and unknown messages are dropped and counted.
"""

from __future__ import annotations

import math
import struct
from collections import defaultdict

import numpy as np
from pymavlink.dialects.v20 import common as m

from services.simulator.px4.commands import ACCEPTED, FAILED, Command, execute, whole
from services.simulator.px4.external import setpoint_from_target, vision_from_odometry
from services.simulator.px4.links import Link
from services.simulator.px4.params import Parameter
from services.simulator.px4.telemetry import BUILDERS, RATES_HZ, Message
from services.simulator.px4.timesync import Timesync
from services.simulator.px4.vehicle import Vehicle

_AUTOPILOT = m.MAV_COMP_ID_AUTOPILOT1
_PARAM_BURST = 5
_TEXT_BYTES = 50
_SECOND_ACK_S = 0.02
_MAX_LATITUDE_DEG = 89.0
_MAX_ALTITUDE_MM = 50_000_000


class Port:
    """One link's state: its stream rates, its sequence numbers, its time synchronisation."""

    def __init__(self, link: Link, system_id: int, now_s: float, *, ground_station: bool) -> None:
        self.link = link
        self.ground_station = ground_station
        self.heard = not ground_station
        """A ground station's link carries only the heartbeat until somebody answers."""
        self.mav = m.MAVLink(None, srcSystem=system_id, srcComponent=_AUTOPILOT)
        self.mav.robust_parsing = True
        self.intervals_s = {ident: 1.0 / rate for ident, rate in RATES_HZ.items()}
        self.due_s = dict.fromkeys(self.intervals_s, now_s)
        self.timesync = Timesync()
        self.unpackable = 0
        self.parameters: list[Parameter] = []
        self.late_acks: list[tuple[float, Message]] = []
        self.origin_told: tuple[float, float, float] | None = None
        """An origin is told once, and when it is asked for."""

    def send(self, message: Message) -> None:
        """Pack with this link's sequence number and send; what does not fit its fields (1e9 m away) is dropped."""
        try:
            data = message.pack(self.mav)
        except (struct.error, OverflowError):
            self.unpackable += 1
            return
        self.link.send(data)
        self.mav.seq = (self.mav.seq + 1) % 256

    def set_interval(self, ident: int, interval_us: float, now_s: float) -> bool:
        """Set a stream's interval: -1 stops it, 0 restores its default; False for what has none of its own."""
        if ident not in BUILDERS or ident == m.MAVLINK_MSG_ID_HEARTBEAT:
            return False  # the heartbeat's rate is fixed
        default = RATES_HZ.get(ident)
        interval_s = interval_us * 1e-6 if interval_us > 0.0 else (1.0 / default if default else math.inf)
        if not interval_us >= 0.0 or not math.isfinite(interval_s):
            self.intervals_s.pop(ident, None)
            return True
        self.intervals_s[ident], self.due_s[ident] = interval_s, now_s
        return True


class MavlinkServer:
    """Speaks for one vehicle on any number of links. ``poll`` before each step, ``stream`` after it."""

    def __init__(self, system_id: int) -> None:
        self.system_id = system_id
        self.ports: list[Port] = []
        self.counters: dict[str, int] = defaultdict(int)
        self._vehicle: Vehicle | None = None
        self._handlers = {
            "HEARTBEAT": self._on_heartbeat,
            "ODOMETRY": self._on_odometry,
            "SET_POSITION_TARGET_LOCAL_NED": self._on_setpoint,
            "COMMAND_LONG": self._on_command_long,
            "COMMAND_INT": self._on_command_int,
            "SET_MODE": self._on_set_mode,
            "TIMESYNC": self._on_timesync,
            "PARAM_REQUEST_READ": self._on_param_read,
            "PARAM_REQUEST_LIST": self._on_param_list,
            "PARAM_SET": self._on_param_set,
            "SET_GPS_GLOBAL_ORIGIN": self._on_origin,
            "MISSION_REQUEST_LIST": self._on_mission_list,
            "MISSION_CLEAR_ALL": self._on_mission_clear,
        }

    def serve(self, vehicle: Vehicle) -> None:
        """Name the vehicle that is served."""
        self._vehicle = vehicle

    @property
    def vehicle(self) -> Vehicle:
        """The vehicle that is served."""
        assert self._vehicle is not None
        return self._vehicle

    def attach(self, link: Link, *, ground_station: bool) -> Port:
        """Open a link; ``ground_station`` links carry STATUSTEXT."""
        port = Port(link, self.system_id, self.vehicle.now_s, ground_station=ground_station)
        self.ports.append(port)
        return port

    def say(self, severity: int, text: str) -> None:
        """Send a STATUSTEXT: to ground stations only."""
        message = m.MAVLink_statustext_message(severity, text.encode()[:_TEXT_BYTES])
        for port in self.ports:
            if port.ground_station:
                port.send(message)

    def poll(self) -> None:
        """Handle everything that has arrived."""
        for port in self.ports:
            while (data := port.link.receive()) is not None:
                port.heard = True
                for message in self._parse(port, data):
                    self._dispatch(port, message)

    def _parse(self, port: Port, data: bytes) -> list[Message]:
        try:
            return port.mav.parse_buffer(data) or []
        except m.MAVError:
            self.counters["unreadable"] += 1
            return []

    def _dispatch(self, port: Port, message: Message) -> None:
        kind = message.get_type()
        handler = self._handlers.get(kind)
        if handler is None:
            self.counters["unreadable" if kind == "BAD_DATA" else "not_handled"] += 1
        elif self._is_for_us(message):
            handler(port, message)
        else:
            self.counters["for_others"] += 1

    def _is_for_us(self, message: Message) -> bool:
        system = getattr(message, "target_system", 0)
        component = getattr(message, "target_component", 0)
        return system in (0, self.system_id) and component in (0, _AUTOPILOT)

    def stream(self) -> None:
        """Send what is due."""
        now_s = self.vehicle.now_s
        for port in self.ports:
            for ident, interval_s in list(port.intervals_s.items()):
                if now_s + 1e-9 >= port.due_s[ident] and (port.heard or ident == m.MAVLINK_MSG_ID_HEARTBEAT):
                    port.due_s[ident] = max(port.due_s[ident] + interval_s, now_s)
                    if ident == m.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN and port.origin_told == self.vehicle.origin:
                        continue
                    self._tell(port, ident)
            for parameter in port.parameters[:_PARAM_BURST]:
                self._send_parameter(port, parameter)
            del port.parameters[:_PARAM_BURST]
            while port.late_acks and port.late_acks[0][0] <= now_s:
                port.send(port.late_acks.pop(0)[1])

    def _tell(self, port: Port, ident: int) -> bool:
        message = BUILDERS[ident](self.vehicle)
        if message is None:
            return False
        port.send(message)
        if ident == m.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN:
            port.origin_told = self.vehicle.origin
        return True

    # -- handlers ------------------------------------------------------------------------------------------------

    def _on_heartbeat(self, _port: Port, message: Message) -> None:
        if message.type == m.MAV_TYPE_GCS:
            self.vehicle.last_ground_station_s = self.vehicle.now_s
        elif message.type == m.MAV_TYPE_ONBOARD_CONTROLLER and message.get_srcSystem() == self.system_id:
            self.vehicle.last_companion_s = self.vehicle.now_s

    def _on_odometry(self, port: Port, message: Message) -> None:
        now_s = self.vehicle.now_s
        stamp_s = port.timesync.to_autopilot_s(message.time_usec * 1e-6, now_s)
        sample, refusal = vision_from_odometry(message, stamp_s)
        if sample is not None:
            self.counters["odometry"] += 1
            self.vehicle.estimator.add_vision(sample, now_s)
            return
        self.counters["odometry_refused"] += 1
        if refusal:
            self.say(m.MAV_SEVERITY_CRITICAL, refusal)

    def _on_setpoint(self, _port: Port, message: Message) -> None:
        yaw = self.vehicle.yaw_rad
        setpoint, refusal = setpoint_from_target(message, yaw)
        if setpoint is not None:
            self.vehicle.set_external(setpoint)
            return
        self.counters["setpoints_refused"] += 1
        self.say(m.MAV_SEVERITY_CRITICAL, refusal)

    def _on_command_long(self, port: Port, message: Message) -> None:
        values = tuple(float(getattr(message, f"param{i}")) for i in range(1, 8))
        self._command(port, message, Command(message.command, values))  # type: ignore[arg-type]

    def _on_command_int(self, port: Port, message: Message) -> None:
        first = tuple(float(getattr(message, f"param{i}")) for i in range(1, 5))
        place = (message.x * 1e-7, message.y * 1e-7, float(message.z))
        self._command(port, message, Command(message.command, first + place))

    def _command(self, port: Port, message: Message, command: Command) -> None:
        ident, result = command.command, ACCEPTED
        if ident == m.MAV_CMD_SET_MESSAGE_INTERVAL:
            good = port.set_interval(whole(command.params[0]), command.params[1], self.vehicle.now_s)
            result = ACCEPTED if good else FAILED
        elif ident in (m.MAV_CMD_REQUEST_MESSAGE, m.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES):
            wanted = m.MAVLINK_MSG_ID_AUTOPILOT_VERSION
            if ident == m.MAV_CMD_REQUEST_MESSAGE:
                wanted = whole(command.params[0])
            result = ACCEPTED if wanted in BUILDERS and self._tell(port, wanted) else FAILED
        elif ident == m.MAV_CMD_DO_SET_MODE:
            # the first acknowledgement says nothing: it is always "accepted" and comes before the decision
            self._acknowledge(port, message, ACCEPTED)
            late = self._ack(message, execute(self.vehicle, command))
            port.late_acks.append((self.vehicle.now_s + _SECOND_ACK_S, late))
            return
        else:
            result = execute(self.vehicle, command)
        self._acknowledge(port, message, result)

    def _acknowledge(self, port: Port, message: Message, result: int) -> None:
        port.send(self._ack(message, result))

    def _ack(self, message: Message, result: int) -> Message:
        return m.MAVLink_command_ack_message(
            message.command, result, 0, 0, message.get_srcSystem(), message.get_srcComponent()
        )

    def _on_set_mode(self, port: Port, message: Message) -> None:
        main, sub = message.custom_mode >> 16 & 0xFF, message.custom_mode >> 24 & 0xFF
        values = (float(message.base_mode), float(main), float(sub), 0.0, 0.0, 0.0, 0.0)
        execute(self.vehicle, Command(m.MAV_CMD_DO_SET_MODE, values))
        self.counters["set_mode"] += 1
        del port

    def _on_timesync(self, port: Port, message: Message) -> None:
        now_s = self.vehicle.now_s
        if message.tc1 == 0:
            port.send(m.MAVLink_timesync_message(int(now_s * 1e9), message.ts1))
        else:
            port.timesync.update(now_s, message.ts1 * 1e-9, message.tc1 * 1e-9)

    def _on_origin(self, _port: Port, message: Message) -> None:
        latitude, longitude = message.latitude * 1e-7, message.longitude * 1e-7
        if abs(latitude) > _MAX_LATITUDE_DEG or abs(longitude) > 180.0 or abs(message.altitude) > _MAX_ALTITUDE_MM:
            self.counters["origins_refused"] += 1
            return
        self.vehicle.origin = (latitude, longitude, message.altitude * 1e-3)

    def _on_mission_list(self, port: Port, message: Message) -> None:
        port.send(
            m.MAVLink_mission_count_message(
                message.get_srcSystem(), message.get_srcComponent(), 0, getattr(message, "mission_type", 0)
            )
        )

    def _on_mission_clear(self, port: Port, message: Message) -> None:
        port.send(
            m.MAVLink_mission_ack_message(
                message.get_srcSystem(), message.get_srcComponent(), 0, getattr(message, "mission_type", 0)
            )
        )

    # -- parameters ----------------------------------------------------------------------------------------------

    def _on_param_read(self, port: Port, message: Message) -> None:
        params = self.vehicle.params
        found = params.at(message.param_index) if message.param_index >= 0 else params.get(message.param_id)
        if found is not None:
            self._send_parameter(port, found)

    def _on_param_list(self, port: Port, message: Message) -> None:
        del message
        params = self.vehicle.params
        port.parameters = [p for p in (params.at(i) for i in range(len(params))) if p is not None]

    def _on_param_set(self, port: Port, message: Message) -> None:
        stored = self.vehicle.params.set_from_wire(message.param_id, message.param_type, message.param_value)
        if stored is None:
            self.counters["params_refused"] += 1
            # PX4 answers a refused set with the value as it stands, where there is one
            stored = self.vehicle.params.get(message.param_id)
        if stored is not None:
            self._send_parameter(port, stored)

    def _send_parameter(self, port: Port, parameter: Parameter) -> None:
        value = np.float32(parameter.wire_value)
        port.send(
            m.MAVLink_param_value_message(
                parameter.name.encode(), float(value), parameter.type, len(self.vehicle.params), parameter.index
            )
        )
