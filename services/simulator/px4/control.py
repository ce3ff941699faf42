"""PX4's multicopter cascade: P on position, PID on velocity, P on attitude, as its controller diagrams document them.

Frames NED and FRD. A NaN in a setpoint means "not controlled". Gains are PX4's parameters of the same meaning.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
from numba import njit

from services.common.geometry import Matrix
from services.simulator.px4.kernels import rotate_inverse, rotation_matrix
from services.simulator.px4.params import Parameters

GRAVITY_M_S2 = 9.80665
_VELOCITY_FILTER_S = 0.1
_MIN_VERTICAL_SHARE = 0.1
NAN3: tuple[float, float, float] = (math.nan, math.nan, math.nan)


def _nan3() -> Matrix:
    return np.array(NAN3)


def _zero_for_nan(values: Matrix) -> Matrix:
    return np.where(np.isnan(values), 0.0, values)


@dataclass(frozen=True, slots=True)
class Setpoint:
    """What is wanted, local frame. Every axis needs a finite position, velocity or acceleration."""

    position_m: Matrix = field(default_factory=_nan3)
    velocity_m_s: Matrix = field(default_factory=_nan3)
    acceleration_m_s2: Matrix = field(default_factory=_nan3)
    yaw_rad: float = math.nan
    yaw_rate_rad_s: float = math.nan

    def shifted(self, delta_m: Matrix, delta_yaw_rad: float) -> Setpoint:
        """Return the setpoint after the local frame jumped under the vehicle."""
        return replace(self, position_m=self.position_m + delta_m, yaw_rad=self.yaw_rad + delta_yaw_rad)

    @property
    def has_position(self) -> bool:
        """Position is controlled on some axis."""
        return bool(np.isfinite(self.position_m).any())

    @property
    def has_velocity(self) -> bool:
        """Velocity is given on some axis."""
        return bool(np.isfinite(self.velocity_m_s).any())

    @property
    def has_acceleration(self) -> bool:
        """Acceleration is given on some axis."""
        return bool(np.isfinite(self.acceleration_m_s2).any())


@dataclass(frozen=True, slots=True)
class AttitudeSetpoint:
    """Direction of thrust (unit vector, up out of the rotors, local frame), its size, and yaw."""

    thrust_axis: Matrix
    thrust_m_s2: float
    yaw_rad: float
    yaw_rate_rad_s: float


class PositionController:
    """Cascaded position and velocity control at a fixed rate; holds the integrator."""

    def __init__(self, params: Parameters) -> None:
        self._params = params
        self._integral = np.zeros(3)
        self._velocity = np.zeros(3)
        self._derivative = np.zeros(3)
        self.velocity_sp_m_s = np.zeros(3)

    def reset(self) -> None:
        """Forget the integrator (before take-off)."""
        self._integral[:] = 0.0
        self._derivative[:] = 0.0

    def follow(self, velocity_m_s: Matrix, dt_s: float) -> None:
        """Keep the filtered acceleration going."""
        raw = (velocity_m_s - self._velocity) / dt_s
        self._derivative += (raw - self._derivative) * (1.0 - math.exp(-dt_s / _VELOCITY_FILTER_S))
        self._velocity = velocity_m_s.copy()

    def update(
        self, setpoint: Setpoint, position_m: Matrix, velocity_m_s: Matrix, yaw_rad: float, dt_s: float
    ) -> AttitudeSetpoint:
        """Return the thrust vector and yaw for ``setpoint``."""
        self.follow(velocity_m_s, dt_s)
        velocity_sp = self._velocity_setpoint(setpoint, position_m)
        self.velocity_sp_m_s = _zero_for_nan(velocity_sp)
        error = velocity_sp - velocity_m_s
        controlled = np.isfinite(error)
        wanted = _zero_for_nan(setpoint.acceleration_m_s2)
        wanted = wanted + np.where(controlled, self._pid(_zero_for_nan(error)), 0.0)
        axis, thrust, saturated = self._thrust(wanted)
        gain = np.array([self._params["MPC_XY_VEL_I_ACC"]] * 2 + [self._params["MPC_Z_VEL_I_ACC"]])
        if not saturated:
            self._integral += np.where(controlled, _zero_for_nan(error) * gain * dt_s, 0.0)
            self._integral = np.clip(self._integral, -GRAVITY_M_S2, GRAVITY_M_S2)
        yaw = setpoint.yaw_rad if math.isfinite(setpoint.yaw_rad) else yaw_rad
        rate = setpoint.yaw_rate_rad_s if math.isfinite(setpoint.yaw_rate_rad_s) else 0.0
        return AttitudeSetpoint(axis, thrust, yaw, rate)

    def _velocity_setpoint(self, setpoint: Setpoint, position_m: Matrix) -> Matrix:
        p = self._params
        gains = np.array([p["MPC_XY_P"], p["MPC_XY_P"], p["MPC_Z_P"]])
        by_position = (setpoint.position_m - position_m) * gains
        feed = setpoint.velocity_m_s
        both_missing = np.isnan(by_position) & np.isnan(feed)
        total = _zero_for_nan(by_position) + _zero_for_nan(feed)
        speed, limit = float(np.hypot(total[0], total[1])), p["MPC_XY_VEL_MAX"]
        if speed > limit:
            total[:2] *= limit / speed
        total[2] = min(max(total[2], -p["MPC_Z_VEL_MAX_UP"]), p["MPC_Z_VEL_MAX_DN"])
        return np.where(both_missing, math.nan, total)

    def _pid(self, error: Matrix) -> Matrix:
        p = self._params
        proportional = np.array([p["MPC_XY_VEL_P_ACC"]] * 2 + [p["MPC_Z_VEL_P_ACC"]])
        damping = np.array([p["MPC_XY_VEL_D_ACC"]] * 2 + [0.0])
        return error * proportional + self._integral - self._derivative * damping

    def _thrust(self, wanted_m_s2: Matrix) -> tuple[Matrix, float, bool]:
        """Return thrust axis and size for an acceleration; vertical has priority, tilt is limited."""
        up = max(GRAVITY_M_S2 - float(wanted_m_s2[2]), _MIN_VERTICAL_SHARE * GRAVITY_M_S2)
        tilt_limit = math.tan(math.radians(self._params["MPC_TILTMAX_AIR"]))
        sideways = wanted_m_s2[:2].copy()
        size, most = float(np.hypot(sideways[0], sideways[1])), tilt_limit * GRAVITY_M_S2
        if size > most:
            sideways *= most / size
        # the tilt is planned for standard gravity, so that height control does not swing the attitude
        axis = np.array([sideways[0], sideways[1], -GRAVITY_M_S2])
        axis /= float(np.linalg.norm(axis))
        full = GRAVITY_M_S2 / self._params["MPC_THR_HOVER"]
        thrust = up / -float(axis[2])
        return axis, min(thrust, full), size > most or thrust > full


def attitude_rates(setpoint: AttitudeSetpoint, quaternion_wxyz: Matrix, params: Parameters) -> Matrix:
    """Return body rates (FRD, rad/s) that turn to the setpoint: tilt first, yaw apart (PX4's reduced attitude).

    The tilt error is the rotation between the thrust axes, taken as twice the sine of half the angle, as in
    Brescianini, Hehn, D'Andrea, "Nonlinear quadrocopter attitude control" (2013).
    """
    limit, limit_yaw = math.radians(params["MC_ROLLRATE_MAX"]), math.radians(params["MC_YAWRATE_MAX"])
    gains = (params["MC_ROLL_P"], params["MC_PITCH_P"], params["MC_YAW_P"])
    return _attitude_rates(
        quaternion_wxyz, setpoint.thrust_axis, setpoint.yaw_rad, setpoint.yaw_rate_rad_s, gains, limit, limit_yaw
    )


@njit(cache=True, nogil=True)
def _attitude_rates(
    q: Matrix,
    thrust_axis: Matrix,
    yaw_rad: float,
    yaw_rate_rad_s: float,
    gains: tuple[float, float, float],
    limit: float,
    limit_yaw: float,
) -> Matrix:
    R = rotation_matrix(q)
    up = rotate_inverse(q, thrust_axis)  # the wanted thrust axis seen from the body, whose own is (0, 0, -1)
    sine = math.sqrt(up[0] ** 2 + up[1] ** 2)
    angle = math.atan2(sine, -up[2])
    scale = 2.0 * math.sin(0.5 * angle) / sine if sine > 1e-9 else 0.0
    yaw = math.atan2(R[1, 0], R[0, 0])
    error = (yaw_rad - yaw + math.pi) % (2.0 * math.pi) - math.pi
    yaw_rate = gains[2] * 2.0 * math.sin(0.5 * error) + yaw_rate_rad_s
    yaw_rate = min(max(yaw_rate, -limit_yaw), limit_yaw)
    rates = np.empty(3)
    # (0, 0, -1) x up, and a yaw rate that is about the local vertical, the third body axis only when level
    rates[0] = gains[0] * scale * up[1] + R[2, 0] * yaw_rate
    rates[1] = -gains[1] * scale * up[0] + R[2, 1] * yaw_rate
    rates[2] = R[2, 2] * yaw_rate
    for i in range(3):
        rates[i] = min(max(rates[i], -limit), limit)
    return rates
