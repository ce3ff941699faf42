"""A companion computer for the contract tests: the simplest client that flies the simulated PX4 over a loopback."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import common as m

from services.common.geometry import Matrix, pose
from services.simulator.px4.config import Px4Config, SensorConfig, WindConfig
from services.simulator.px4.frames import ned_from_world, quaternion_ned_from_world, rotation_from_wxyz
from services.simulator.px4.links import LoopbackLink
from services.simulator.px4.modes import NavState
from services.simulator.px4.simulated import SimulatedPx4

TICK_S = 0.004
POSITION_AND_YAW = 0b101111111000  # velocity, acceleration and yaw rate ignored
POSITION_YAW_RATE = 0b000111111000
VELOCITY_ONLY = 0b110111000111
CUSTOM = m.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
CALM = WindConfig(mean_m_s=0.0, gust_m_s=0.0)
ORIGIN = (473977420, 85455940, 488000)

Place = Callable[[float], tuple[float, float, float]]


@dataclass
class Vision:
    """How the external vision is sent."""

    rate_hz: float = 30.0
    on: bool = True
    bias_world_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    delay_s: float = 0.0
    frame: int = m.MAV_FRAME_LOCAL_NED
    child: int = m.MAV_FRAME_BODY_FRD
    estimator: int = m.MAV_ESTIMATOR_TYPE_VIO
    norm: float = 1.0
    reset_counter: int = 0
    sigma_m: float = 0.005
    stamp_offset_s: float = 0.0


@dataclass
class Setpoints:
    """How setpoints are sent: ``place(t)`` in the local frame, yaw and yaw rate at will."""

    rate_hz: float = 20.0
    on: bool = False
    place: Place = lambda _t: (0.0, 0.0, -1.5)
    yaw: Callable[[float], float] = lambda _t: 0.0
    yaw_rate: float = math.nan
    velocity: tuple[float, float, float] | None = None
    frame: int = m.MAV_FRAME_LOCAL_NED


@dataclass
class Companion:
    """Runs a simulated PX4 and talks to it in simulated time."""

    config: Px4Config = field(default_factory=Px4Config)
    seed: int = 1
    yaw_world_rad: float = 0.0
    clock_offset_s: float = 5000.0
    answer_timesync: bool = True
    timesync_delay_s: float = 0.0

    def __post_init__(self) -> None:
        c, s = math.cos(self.yaw_world_rad), math.sin(self.yaw_world_rad)
        T = pose(np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]), [0.0, 0.0, 0.1])
        self.px4 = SimulatedPx4(lambda _x, _y: 0.0, T, self.config, self.seed)
        ours, theirs = LoopbackLink.pair()
        self.link = ours
        self.port = self.px4.attach(theirs)
        self.mav = m.MAVLink(None, srcSystem=1, srcComponent=191)
        self.vision, self.setpoints = Vision(), Setpoints()
        self.got: dict[str, list[tuple[float, Any]]] = defaultdict(list)
        self.rng = np.random.default_rng(self.seed + 100)
        self._late: list[tuple[float, Any]] = []
        self._next = {"beat": 0.0, "vision": 0.0, "setpoint": 0.0}

    @property
    def now_s(self) -> float:
        return self.px4.elapsed_s

    def send(self, message: Any) -> None:
        self.link.send(message.pack(self.mav))
        self.mav.seq = (self.mav.seq + 1) % 256

    def run(self, seconds: float, each_tick: Callable[[], None] | None = None) -> None:
        for _ in range(round(seconds / TICK_S)):
            self._periodic()
            self.px4.step(TICK_S)
            self._listen()
            if each_tick is not None:
                each_tick()

    def _due(self, name: str, rate_hz: float) -> bool:
        if self.now_s + 1e-9 < self._next[name]:
            return False
        self._next[name] = max(self._next[name] + 1.0 / rate_hz, self.now_s)
        return True

    def _periodic(self) -> None:
        if self._due("beat", 1.0):
            self.send(m.MAVLink_heartbeat_message(m.MAV_TYPE_ONBOARD_CONTROLLER, 8, 0, 0, 4, 3))
        if self.vision.on and self._due("vision", self.vision.rate_hz):
            self._late.append((self.now_s + self.vision.delay_s, self._odometry()))
        if self.setpoints.on and self._due("setpoint", self.setpoints.rate_hz):
            self.send(self._setpoint())
        while self._late and self._late[0][0] <= self.now_s + 1e-9:
            self.send(self._late.pop(0)[1])

    def _odometry(self) -> Any:
        v, T = self.vision, self.px4.true_pose()
        noise = v.sigma_m * self.rng.standard_normal(3)
        p = ned_from_world(T[:3, 3] + np.array(v.bias_world_m) + noise)
        q = quaternion_ned_from_world(T[:3, :3]) * v.norm
        covariance = [0.0] * 21
        covariance[0] = covariance[6] = covariance[11] = max(v.sigma_m, 0.01) ** 2
        covariance[15] = covariance[18] = covariance[20] = 0.01**2
        stamp = int((self.now_s + self.clock_offset_s + v.stamp_offset_s) * 1e6)
        nan = math.nan
        return m.MAVLink_odometry_message(
            stamp, v.frame, v.child, *(float(c) for c in p), [float(c) for c in q], nan, nan, nan, nan, nan, nan,
            covariance, [nan] * 21, v.reset_counter, v.estimator, 0,
        )  # fmt: skip

    def _setpoint(self) -> Any:
        s = self.setpoints
        mask = POSITION_YAW_RATE if math.isfinite(s.yaw_rate) else POSITION_AND_YAW
        rate = s.yaw_rate if math.isfinite(s.yaw_rate) else 0.0
        velocity = (0.0, 0.0, 0.0)
        if s.velocity is not None:
            mask, velocity = VELOCITY_ONLY, s.velocity
        return m.MAVLink_set_position_target_local_ned_message(
            0, 1, 1, s.frame, mask, *s.place(self.now_s), *velocity, 0.0, 0.0, 0.0, s.yaw(self.now_s), rate
        )

    def _listen(self) -> None:
        while (data := self.link.receive()) is not None:
            for message in self.mav.parse_buffer(data) or []:
                self.got[message.get_type()].append((self.now_s, message))
                if message.get_type() == "TIMESYNC" and message.tc1 == 0 and self.answer_timesync:
                    mine = int((self.now_s + self.clock_offset_s) * 1e9)
                    answer = m.MAVLink_timesync_message(mine, message.ts1)
                    self._late.append((self.now_s + self.timesync_delay_s, answer))
        self._late.sort(key=lambda entry: entry[0])

    # -- commands ------------------------------------------------------------------------------------------------

    def command(self, ident: int, *params: float) -> list[int]:
        """Send a command, wait 0.1 s, and return the results of its acknowledgements in order."""
        before = len(self.got["COMMAND_ACK"])
        values = [*params, *[0.0] * (7 - len(params))]
        self.send(m.MAVLink_command_long_message(1, 1, ident, 0, *values))
        self.run(0.1)
        acks = [a for _, a in self.got["COMMAND_ACK"][before:] if a.command == ident]
        return [a.result for a in acks]

    def set_mode(self, state: NavState) -> list[int]:
        return self.command(m.MAV_CMD_DO_SET_MODE, CUSTOM, state.value[0], state.value[1])

    def arm(self) -> list[int]:
        return self.command(m.MAV_CMD_COMPONENT_ARM_DISARM, 1.0)

    def set_origin(self) -> None:
        self.send(m.MAVLink_set_gps_global_origin_message(1, *ORIGIN, 0))
        self.run(0.1)

    def set_integer(self, name: str, value: int) -> None:
        self.px4.vehicle.params.set(name, value)

    # -- what is seen --------------------------------------------------------------------------------------------

    def heartbeat_mode(self) -> tuple[int, int]:
        """Main and sub mode of the newest heartbeat."""
        mode = self.got["HEARTBEAT"][-1][1].custom_mode
        return mode >> 16 & 0xFF, mode >> 24 & 0xFF

    def flies(self) -> NavState:
        """The mode that truly flies; a method, so that the type checker forgets it between calls."""
        return self.px4.mode

    def synced(self) -> bool:
        return self.port.timesync.converged

    def true_ned(self) -> Matrix:
        return ned_from_world(self.px4.true_pose()[:3, 3])

    def hover(self, height_m: float = 1.5) -> None:
        """Fly to a hover in OFFBOARD at the start place."""
        self.setpoints.on = True
        self.setpoints.place = lambda _t: (0.0, 0.0, -height_m)
        self.run(2.0)
        assert self.set_mode(NavState.OFFBOARD) == [0, 0]
        assert self.arm() == [0]
        self.run(9.0)
        assert abs(-float(self.true_ned()[2]) - height_m) < 0.4


def quiet(**changes: Any) -> Px4Config:
    """Return a configuration without wind."""
    return Px4Config(wind=CALM, **changes)


__all__ = ["CALM", "Companion", "SensorConfig", "Setpoints", "Vision", "quiet", "rotation_from_wxyz"]
