"""Flown motion for the fusion's benchmark: the simulated aircraft's own dynamics, wind, IMU and GPS along a given way.

The position controller sees the truth, so that all that is judged is fusion; the gusts are real to the IMU. World frame:
x north, y west, z up (the simulated PX4's); the earth's plane is (east, north, up).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from services.common.geometry import Matrix, pose, rotation_z
from services.fusion.values import GpsReading, ImuReading
from services.simulator.px4.config import AirframeConfig, GpsConfig, SensorConfig, WindConfig
from services.simulator.px4.control import AttitudeSetpoint, PositionController, Setpoint, attitude_rates
from services.simulator.px4.frames import (
    FLIP,
    ned_from_world,
    quaternion_ned_from_world,
    rotation_from_wxyz,
    yaw_from_wxyz,
)
from services.simulator.px4.gps import GpsReceiver
from services.simulator.px4.params import Parameters
from services.simulator.px4.quadrotor import ImuSample, Quadrotor

STEP_S = 0.004
_IMU_EVERY, _CONTROL_EVERY = 2, 5
FRAME_HZ = 15.0
_SETTLE_S = 3.0
"""Flown before the clock starts: the integrators of the controller have learnt the wind."""
EARTH_FROM_WORLD: Matrix = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])

Way = Callable[[float], tuple[Matrix, float]]
"""Seconds since the start -> the place to be at (3,), world, and the heading."""


@dataclass(frozen=True, slots=True)
class Frame:
    """A moment at which the cameras look."""

    stamp_ns: int
    T_world_body: Matrix


@dataclass(frozen=True, slots=True)
class FlownWay:
    """All that was measured, in the order of stamps, and the truth at the frames."""

    frames: tuple[Frame, ...]
    imu: tuple[ImuReading, ...]
    fixes: tuple[GpsReading, ...]


def fly(
    way: Way, seconds: float, seed: int, wind: WindConfig, gps: GpsConfig, sensors: SensorConfig | None = None
) -> FlownWay:
    """Fly along a way; the same arguments give the same flight."""
    flyer = _Flyer(way, seed, wind, sensors or SensorConfig())
    receiver = GpsReceiver(gps, seed)
    gyro, accel = np.zeros(3), np.zeros(3)
    frames: list[Frame] = []
    imu: list[ImuReading] = []
    fixes: list[GpsReading] = []
    settle = round(_SETTLE_S / STEP_S)
    for tick in range(1, settle + round(seconds / STEP_S) + 1):
        t_s = (tick - settle) * STEP_S
        sample = flyer.step(t_s)
        gyro += FLIP @ sample.gyro_rad_s / _IMU_EVERY
        accel += FLIP @ sample.accel_m_s2 / _IMU_EVERY
        stamp_ns = _stamp_ns(t_s)
        if tick % _IMU_EVERY == 0:
            imu.append(ImuReading(stamp_ns, gyro, accel))
            gyro, accel = np.zeros(3), np.zeros(3)
        if t_s < 0.0:
            continue
        if t_s + 1e-9 >= len(frames) / FRAME_HZ:
            frames.append(Frame(stamp_ns, flyer.T_world_body))
        if receiver.update(t_s, flyer.body.state[:3], flyer.body.state[3:6]):
            fix = receiver.latest
            assert fix is not None
            measured_ns = _stamp_ns(fix.given_s - gps.delay_s)
            fixes.append(GpsReading(measured_ns, EARTH_FROM_WORLD @ (FLIP @ fix.position_ned_m), fix.sigma_m))
    return FlownWay(tuple(frames), tuple(imu), tuple(fixes))


def _stamp_ns(t_s: float) -> int:
    return 10_000_000_000 + round(t_s * 1e9)


class _Flyer:
    """The aircraft under a controller that knows the truth."""

    def __init__(self, way: Way, seed: int, wind: WindConfig, sensors: SensorConfig) -> None:
        position, yaw = way(0.0)
        T = pose(rotation_z(yaw), position)
        quaternion = quaternion_ned_from_world(T[:3, :3])
        rng = np.random.default_rng([seed, 505])
        self.body = Quadrotor(
            ned_from_world(position), quaternion, lambda _x, _y: -100.0, AirframeConfig(), sensors, wind, rng
        )
        self._way = way
        self._params = Parameters({})
        self._control = PositionController(self._params)
        self._ticks = 0
        self._wanted = self._attitude(0.0)

    @property
    def T_world_body(self) -> Matrix:
        """The truth (4, 4)."""
        return pose(FLIP @ rotation_from_wxyz(self.body.state[6:10]) @ FLIP, FLIP @ self.body.state[:3])

    def step(self, t_s: float) -> ImuSample:
        """Let one step pass and return the IMU's sample."""
        if self._ticks % _CONTROL_EVERY == 0:
            self._wanted = self._attitude(t_s)
        rates = attitude_rates(self._wanted, self.body.state[6:10], self._params)
        self.body.step(rates, self._wanted.thrust_m_s2, STEP_S)
        self._ticks += 1
        return self.body.imu(STEP_S)

    def _attitude(self, t_s: float) -> AttitudeSetpoint:
        t_s = max(t_s, 0.0)
        (p, yaw), (ahead, yaw_ahead) = self._way(t_s), self._way(t_s + 0.1)
        velocity = (ahead - p) / 0.1
        setpoint = Setpoint(
            ned_from_world(p), ned_from_world(velocity), yaw_rad=-yaw, yaw_rate_rad_s=-(yaw_ahead - yaw) / 0.1
        )
        s = self.body.state
        return self._control.update(setpoint, s[:3], s[3:6], yaw_from_wxyz(s[6:10]), STEP_S * _CONTROL_EVERY)
