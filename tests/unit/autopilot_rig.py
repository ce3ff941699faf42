"""A bridge on the bench: an autopilot that is all switches, poses and guidance on a fixed beat."""

from __future__ import annotations

from typing import Any

import numpy as np
from pymavlink.dialects.v20 import common as mav

from schemas.navigation import Guidance, Setpoint
from schemas.slam import Pose
from services.common.geometry import level_camera, to_transform
from services.common.mount import Mount
from services.navigator.autopilot.bridge import Bridge
from services.navigator.autopilot.config import AutopilotConfig
from services.navigator.autopilot.frames import quaternion_ned, to_ned

MS = 1_000_000
SECOND = 1_000 * MS
OFFBOARD_MODE, HOLD_MODE, LAND_MODE, POSITION_MODE = 6 << 16, (4 << 16) | (3 << 24), (4 << 16) | (6 << 24), 3 << 16


def _three(v: np.ndarray) -> tuple[float, float, float]:
    return float(v[0]), float(v[1]), float(v[2])


class Rig:
    """A bridge with an autopilot that is all switches; time in 10 ms ticks, a pose every 60 ms, guidance every 50."""

    def __init__(self, config: AutopilotConfig | None = None) -> None:
        self.bridge = Bridge(config or AutopilotConfig(check_parameters=False))
        self.now_ns = 1_700_000_000 * SECOND
        self.armed, self.mode = False, HOLD_MODE
        self.obedient = True
        self.telemetry = True
        self.T_map_camera: np.ndarray | None = level_camera((0.0, 0.0, 0.0), 0.0)
        self.velocity = np.zeros(3)
        self.reset_counter, self.map_id = 0, "m"
        self.believes: np.ndarray | None = None
        self.guidance: dict[str, Any] | None = {"engage": False, "mission_id": 0}
        self.setpoint = (np.array([0.0, 0.0, 1.0]), 0.0, np.zeros(3), 0.0)
        self.sent: list[tuple[int, Any]] = []
        self._ticks = 0

    def run(self, seconds: float) -> list[Any]:
        begin = len(self.sent)
        for _ in range(round(seconds * 100)):
            self.tick()
        return [m for _, m in self.sent[begin:]]

    def tick(self) -> None:
        self.now_ns += 10 * MS
        self._ticks += 1
        if self.T_map_camera is not None:
            self.T_map_camera = self.T_map_camera.copy()
            self.T_map_camera[:3, 3] += 0.01 * self.velocity
        if self.telemetry:
            self._telemetry()
        if self._ticks % 6 == 0:
            self.bridge.on_pose(self.pose_message(), self.now_ns)
        if self.guidance is not None and self._ticks % 5 == 0:
            self.bridge.on_guidance(self.guidance_message(), self.now_ns)
        for message in self.bridge.tick(self.now_ns):
            self.sent.append((self.now_ns, message))
            self._obey(message)

    def pose_message(self) -> Pose:
        T = self.T_map_camera
        return Pose(
            stamp_ns=self.now_ns - 100 * MS, seq=self._ticks, map_id=self.map_id,
            status="lost" if T is None else "tracking", T_map_camera=None if T is None else to_transform(T),
            covariance=None, reset_counter=self.reset_counter, graph_version=0, keyframe_id=None,
            T_keyframe_camera=None, inliers=0, up_sigma_rad=0.0, processing_ms=0.0,
        )  # fmt: skip

    def guidance_message(self) -> Guidance:
        position, yaw, velocity, rate = self.setpoint
        values: dict[str, Any] = {
            "stamp_ns": self.now_ns, "seq": self._ticks, "map_id": self.map_id, "command": "toward", "magnitude": 1.0,
            "unit": "m", "engage": True, "land": False, "mission_id": 1, "reset_counter": self.reset_counter,
            "setpoint": Setpoint(
                position_m=_three(position), yaw_rad=yaw, velocity_m_s=_three(velocity),
                yaw_rate_rad_s=rate,
            ),
        }  # fmt: skip
        return Guidance(**{**values, **(self.guidance or {})})

    def engage(self, mission_id: int = 1) -> None:
        self.guidance = {"engage": False, "mission_id": mission_id}
        self.run(1.5)
        self.guidance = {"engage": True, "mission_id": mission_id}
        self.run(3.0)
        assert self.bridge.engagement.phase == "engaged", self.bridge.engagement.note

    def setpoints(self, seconds: float) -> list[Any]:
        return [m for m in self.run(seconds) if m.get_type() == "SET_POSITION_TARGET_LOCAL_NED"]

    def _telemetry(self) -> None:
        T = self.believes if self.believes is not None else self.T_map_camera
        if self._ticks % 10 == 0:
            flag = mav.MAV_MODE_FLAG_SAFETY_ARMED if self.armed else 0
            self._hear(mav.MAVLink_heartbeat_message(2, mav.MAV_AUTOPILOT_PX4, flag | 1, self.mode, 4, 3))
        if self._ticks % 5 == 0 and T is not None:
            p = to_ned(T[:3, 3])
            self._hear(mav.MAVLink_local_position_ned_message(0, *map(float, p), 0.0, 0.0, 0.0))
            R = T[:3, :3] @ Mount.level((0.0, 0.0, 0.0)).T_body_camera[:3, :3].T
            self._hear(mav.MAVLink_attitude_quaternion_message(0, *quaternion_ned(R), 0.0, 0.0, 0.0))

    def _hear(self, message: Any) -> None:
        message._header.srcSystem, message._header.srcComponent = 1, 1
        self.bridge.handle(message, self.now_ns)

    def _obey(self, message: Any) -> None:
        if not self.obedient or message.get_type() != "COMMAND_LONG":
            return
        if message.command == mav.MAV_CMD_DO_SET_MODE:
            self.mode = (int(message.param2) << 16) | (int(message.param3) << 24)
        elif message.command == mav.MAV_CMD_COMPONENT_ARM_DISARM:
            self.armed = message.param1 == 1.0
