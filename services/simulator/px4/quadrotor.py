"""Rigid-body quadrotor: attitude kinematics, lagging rates and thrust, drag, wind, ground contact. NED and FRD.

The inner rate loop and the motors appear as first-order lags from commanded body rates and collective thrust, the
usual model above the rate loop (Mahony, Kumar, Corke, "Multirotor aerial vehicles", 2012, section on dynamics).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numba import njit

from services.common.geometry import Matrix
from services.simulator.px4.config import AirframeConfig, SensorConfig, WindConfig
from services.simulator.px4.kernels import quaternion_times_exp, rotate, rotate_inverse

GRAVITY_M_S2 = 9.80665

GroundHeight = Callable[[float, float], float]
"""World x, y (metres) to the height of the ground there."""

_REST_TILT_S = 0.08
_FRICTION_S = 0.06
_WIND_FULL_HEIGHT_M = 2.0
_MAX_RATE_RAD_S2 = 60.0
_BARO_TIME_S = 60.0


@njit(cache=True, nogil=True)
def advance(
    state: Matrix,
    force: Matrix,
    rates_sp: Matrix,
    thrust_sp_m_s2: float,
    wind: Matrix,
    down_limit_m: float,
    airframe: Matrix,
    dt_s: float,
) -> bool:
    """Advance ``state`` (position 3, velocity 3, quaternion wxyz 4, body rates 3, thrust 1) by one step, in place.

    ``force`` (3,) receives the mean specific force of the step in FRD, m/s^2: what an accelerometer feels.
    ``down_limit_m`` is the NED z at which the legs touch. ``airframe``: rate lag, yaw rate lag, yaw rate gain,
    thrust lag, drag over mass, thrust scale, constant rate disturbance (3). Returns whether the legs touch.
    """
    rate_lag, yaw_lag, yaw_gain, thrust_lag = airframe[0], airframe[1], airframe[2], airframe[3]
    state[13] += (thrust_sp_m_s2 - state[13]) * (1.0 - math.exp(-dt_s / thrust_lag))
    for i in range(3):
        lag = rate_lag if i < 2 else yaw_lag
        target = rates_sp[i] + airframe[6 + i] if i < 2 else yaw_gain * rates_sp[2] + airframe[8]
        change = (target - state[10 + i]) * (1.0 - math.exp(-dt_s / lag))
        limit = _MAX_RATE_RAD_S2 * dt_s
        state[10 + i] += min(max(change, -limit), limit)
    q = state[6:10]
    thrust = np.array([0.0, 0.0, -state[13] * airframe[5]])
    acceleration = rotate(q, thrust)
    velocity_before = state[3:6].copy()
    for i in range(3):
        acceleration[i] += airframe[4] * (wind[i] - state[3 + i])
    acceleration[2] += GRAVITY_M_S2
    for i in range(3):
        state[3 + i] += acceleration[i] * dt_s
        state[i] += state[3 + i] * dt_s
    quaternion_times_exp(q, state[10:13], dt_s)
    contact = state[2] >= down_limit_m
    if contact:
        _stand(state, down_limit_m, dt_s)
    for i in range(3):
        acceleration[i] = (state[3 + i] - velocity_before[i]) / dt_s
    acceleration[2] -= GRAVITY_M_S2
    force[:] = rotate_inverse(q, acceleration)
    return contact


@njit(cache=True, nogil=True)
def _stand(state: Matrix, down_limit_m: float, dt_s: float) -> None:
    """Let the ground act: no sinking, friction, and the legs level the body (the ground counts as level)."""
    state[2] = down_limit_m
    state[5] = min(state[5], 0.0)
    slide = math.exp(-dt_s / _FRICTION_S)
    state[3] *= slide
    state[4] *= slide
    state[10:13] = 0.0
    level = math.exp(-dt_s / _REST_TILT_S)
    state[7] *= level
    state[8] *= level
    norm = math.sqrt(state[6] ** 2 + state[7] ** 2 + state[8] ** 2 + state[9] ** 2)
    state[6:10] /= norm


@dataclass(frozen=True, slots=True)
class ImuSample:
    """One inertial sample in FRD: rad/s and m/s^2, with bias and noise."""

    gyro_rad_s: Matrix
    accel_m_s2: Matrix


class Quadrotor:
    """The true aircraft: steps the dynamics, draws the wind, and feels through imperfect sensors.

    ``T_ned_frd`` is implied by the start position (NED) and yaw; the craft starts at rest on its legs when the
    start is at or below leg height, else in free air. All randomness comes from ``rng``.
    """

    def __init__(
        self,
        position_ned_m: Matrix,
        quaternion_wxyz: Matrix,
        ground_height_m: GroundHeight,
        airframe: AirframeConfig,
        sensors: SensorConfig,
        wind: WindConfig,
        rng: np.random.Generator,
    ) -> None:
        self._ground_height_m = ground_height_m
        self._config, self._sensors, self._wind = airframe, sensors, wind
        self._rng = rng
        self.state = np.zeros(14)
        self.state[:3], self.state[6:10] = position_ned_m, quaternion_wxyz
        self.force = np.array([0.0, 0.0, -GRAVITY_M_S2])
        self.contact = True
        self.touchdowns = 0
        self._airframe = self._draw_airframe()
        heading = rng.uniform(-np.pi, np.pi)
        self._wind_mean = wind.mean_m_s * np.array([math.cos(heading), math.sin(heading), 0.0])
        self._gust = wind.gust_m_s * rng.standard_normal(3)
        self._gyro_bias = sensors.gyro_bias_rad_s * rng.standard_normal(3)
        self._accel_bias = sensors.accel_bias_m_s2 * rng.standard_normal(3)
        self._baro_error_m = sensors.baro_drift_m * float(rng.standard_normal())

    def _draw_airframe(self) -> Matrix:
        c = self._config
        trim = 0.01 * self._rng.standard_normal(3)  # centre of gravity off the middle, motors unequal
        scale = 1.0 + c.thrust_error * float(self._rng.uniform(-1.0, 1.0))
        lags = [c.rate_lag_s, c.yaw_rate_lag_s, c.yaw_rate_gain, c.thrust_lag_s, c.drag_n_s_m / c.mass_kg, scale]
        return np.array([*lags, trim[0], trim[1], 0.2 * trim[2]])

    @property
    def down_limit_m(self) -> float:
        """NED z of the body origin when the legs touch the ground below."""
        return -(self._ground_height_m(float(self.state[0]), -float(self.state[1])) + self._config.leg_height_m)

    def step(self, rates_sp: Matrix, thrust_sp_m_s2: float, dt_s: float) -> None:
        """Advance by ``dt_s`` under commanded body rates (FRD, rad/s) and collective thrust (m/s^2)."""
        c = self._wind
        keep = math.exp(-dt_s / c.gust_time_s)
        self._gust = keep * self._gust + c.gust_m_s * math.sqrt(1.0 - keep * keep) * self._rng.standard_normal(3)
        limit = self.down_limit_m
        share = min(1.0, max(0.0, (limit - float(self.state[2])) / _WIND_FULL_HEIGHT_M))
        wind = share * (self._wind_mean + self._gust * np.array([1.0, 1.0, 0.4]))
        before = self.contact
        self.contact = bool(
            advance(self.state, self.force, rates_sp, thrust_sp_m_s2, wind, limit, self._airframe, dt_s)
        )
        self.touchdowns += int(self.contact and not before)

    def imu(self, dt_s: float) -> ImuSample:
        """Return the sample of the last step; biases walk on."""
        c, noise = self._sensors, self._rng.standard_normal((4, 3))
        self._gyro_bias = self._gyro_bias + c.gyro_walk_rad_s * math.sqrt(dt_s) * noise[2]
        self._accel_bias = self._accel_bias + c.accel_walk_m_s2 * math.sqrt(dt_s) * noise[3]
        gyro = self.state[10:13] + self._gyro_bias + c.gyro_noise_rad_s * noise[0]
        accel = self.force + self._accel_bias + c.accel_noise_m_s2 * noise[1]
        return ImuSample(gyro, np.clip(accel, -156.0, 156.0))

    def barometer_m(self, dt_s: float) -> float:
        """Return the barometric height (up), ``dt_s`` after the last reading: slow error and noise."""
        c = self._sensors
        keep = math.exp(-dt_s / _BARO_TIME_S)
        draw = self._rng.standard_normal(2)
        self._baro_error_m = keep * self._baro_error_m + c.baro_drift_m * math.sqrt(1.0 - keep * keep) * float(draw[0])
        return -float(self.state[2]) + self._baro_error_m + c.baro_noise_m * float(draw[1])
