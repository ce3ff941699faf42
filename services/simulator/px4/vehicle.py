"""The autopilot and its aircraft joined: one step is sensors, estimator, commander, controller, dynamics.

No bus, no socket, no wall clock: time is what :meth:`Vehicle.step` makes of it.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from services.common.geometry import Matrix, pose
from services.simulator.px4.config import Px4Config
from services.simulator.px4.control import (
    AttitudeSetpoint,
    PositionController,
    Setpoint,
    attitude_rates,
)
from services.simulator.px4.estimator import Estimator
from services.simulator.px4.flight import Estimate, FlightModes, LandDetector, wants_up
from services.simulator.px4.frames import (
    FLIP,
    ned_from_world,
    quaternion_ned_from_world,
    rotation_from_wxyz,
    yaw_from_wxyz,
)
from services.simulator.px4.gps import GpsReceiver
from services.simulator.px4.modes import Commander, NavState, Situation
from services.simulator.px4.params import Parameters
from services.simulator.px4.quadrotor import GroundHeight, Quadrotor

_CONTROL_EVERY = 5
_IMU_EVERY = 2
_BARO_EVERY = 12
_IDLE_SHARE = 0.12
GRAVITY_M_S2 = 9.80665


class Vehicle:
    """The simulated aircraft with PX4's brain.

    ``ground_height_m(x, y)`` and ``T_world_body`` (FLU) are in the world frame, z up. ``say(severity, text)`` receives
    status texts. Equal arguments and equal inputs at equal times give equal flights.
    """

    def __init__(
        self,
        ground_height_m: GroundHeight,
        T_world_body: Matrix,
        config: Px4Config,
        seed: int,
        say: Callable[[int, str], None],
    ) -> None:
        self.config = config
        self.params = Parameters(config.parameters)
        rng = np.random.default_rng(seed)
        quaternion = quaternion_ned_from_world(T_world_body[:3, :3])
        position = ned_from_world(T_world_body[:3, 3])
        self.body = Quadrotor(position, quaternion, ground_height_m, config.airframe, config.sensors, config.wind, rng)
        self.ticks = 0
        self.estimator = Estimator(self.params, self.now_s, quaternion)
        self.commander = Commander(self.params, say, self.now_s, remote_control=config.remote_control)
        self.modes = FlightModes(self.params)
        self.land = LandDetector(self.params)
        self.battery_share = config.battery_share
        self.origin: tuple[float, float, float] | None = None
        self.last_ground_station_s = -math.inf
        self.last_companion_s = -math.inf
        self.last_gyro_rad_s = np.zeros(3)
        self.last_accel_m_s2 = np.zeros(3)
        self.last_imu_s = -math.inf
        self.gps = GpsReceiver(config.gps, seed) if config.gps.present else None
        self.external = Setpoint()
        self._controller = PositionController(self.params)
        self._attitude_sp = AttitudeSetpoint(np.array([0.0, 0.0, -1.0]), 0.0, 0.0, 0.0)
        self._thrust_m_s2 = 0.0
        self._rates_sp = np.zeros(3)
        self._gyro, self._accel = np.zeros(3), np.zeros(3)

    # -- time and truth ------------------------------------------------------------------------------------------

    @property
    def now_s(self) -> float:
        """The autopilot's own clock since boot, seconds."""
        return self.config.boot_time_s + self.ticks * self.config.step_s

    def true_pose(self) -> Matrix:
        """Return the true ``T_world_body`` (4x4, FLU)."""
        R = FLIP @ rotation_from_wxyz(self.body.state[6:10]) @ FLIP
        return pose(R, FLIP @ self.body.state[:3])

    @property
    def yaw_rad(self) -> float:
        """Estimated yaw, clockwise from the local frame's north."""
        return yaw_from_wxyz(self.estimator.quaternion_wxyz)

    def put(self, T_world_body: Matrix) -> None:
        """Set the true pose of the standing body."""
        self.body.state[:] = 0.0
        self.body.state[:3] = ned_from_world(T_world_body[:3, 3])
        self.body.state[6:10] = quaternion_ned_from_world(T_world_body[:3, :3])

    # -- the companion's inputs ----------------------------------------------------------------------------------

    def set_external(self, setpoint: Setpoint) -> None:
        """Take a valid external setpoint; it flies only in OFFBOARD."""
        self.external = setpoint
        self.commander.stream.arrived(self.now_s)

    # -- the step ------------------------------------------------------------------------------------------------

    def step(self) -> None:
        """Advance by one ``config.step_s``."""
        dt_s = self.config.step_s
        self.body.step(self._rates_sp, self._thrust_m_s2, dt_s)
        self.ticks += 1
        imu = self.body.imu(dt_s)
        self._gyro += imu.gyro_rad_s / _IMU_EVERY
        self._accel += imu.accel_m_s2 / _IMU_EVERY
        if self.ticks % _BARO_EVERY == 0:
            self.estimator.add_barometer(self.body.barometer_m(dt_s * _BARO_EVERY))
        if self.ticks % _IMU_EVERY == 0:
            self.estimator.landed = self.land.landed
            self.estimator.add_imu(self.now_s, self._gyro, self._accel, dt_s * _IMU_EVERY)
            self.last_gyro_rad_s, self.last_accel_m_s2, self.last_imu_s = self._gyro, self._accel, self.now_s
            self._gyro, self._accel = np.zeros(3), np.zeros(3)
        if self.gps is not None:
            self.gps.update(self.ticks * dt_s, self.body.state[:3], self.body.state[3:6])
        if self.ticks % _CONTROL_EVERY == 0:
            self._control(dt_s * _CONTROL_EVERY)
        if self.ticks % _IMU_EVERY == 0:
            self._rates_sp = (
                attitude_rates(self._attitude_sp, self.estimator.quaternion_wxyz, self.params)
                if self._thrust_m_s2 > 0.0
                else np.zeros(3)
            )

    def spin_once(self) -> None:
        """Run the attitude loop once whatever the thrust (to compile it)."""
        attitude_rates(self._attitude_sp, self.estimator.quaternion_wxyz, self.params)

    def _situation(self) -> Situation:
        e = self.estimator
        return Situation(
            position_valid=e.horizontal_valid,
            global_valid=e.horizontal_valid and e.frame_is_ned and self.origin is not None,
            height_valid=e.height_valid,
            heading_valid=e.yaw_aligned,
            offboard_needs_position=self.external.has_position or self.external.has_velocity,
            landed=self.land.landed,
            battery_share=self.battery_share,
            ground_station=self.now_s - self.last_ground_station_s < 10.0,
        )

    def _control(self, dt_s: float) -> None:
        delta, delta_yaw = self.estimator.take_reset()
        if delta.any() or delta_yaw:
            self.modes.shift(delta, delta_yaw)
            self.external = self.external.shifted(delta, delta_yaw)
        self.commander.update(self.now_s, self._situation())
        estimate = Estimate(
            self.estimator.position_m.copy(),
            self.estimator.velocity_m_s.copy(),
            yaw_from_wxyz(self.estimator.quaternion_wxyz),
        )
        armed = self.commander.armed
        state = self.commander.state
        wanted = self.external if state is NavState.OFFBOARD else self.modes.setpoint(state, estimate, dt_s)
        if armed and self.land.landed and state is not NavState.RETURN:
            self.modes.home_m = estimate.position_m.copy()
        sinking = float(self._controller.velocity_sp_m_s[2]) > 0.1
        self.land.update(
            armed, wants_up(wanted, estimate), sinking, float(estimate.velocity_m_s[2]), self._thrust_m_s2, dt_s
        )
        self._steer(wanted, estimate, armed, dt_s)
        if state is NavState.TAKEOFF and self.modes.takeoff_done and not self.land.landed:
            self._end_takeoff()
        if armed:
            hover = self._thrust_m_s2 / GRAVITY_M_S2
            self.battery_share = max(0.0, self.battery_share - hover * dt_s / self.config.battery_endurance_s)

    def _steer(self, wanted: Setpoint, estimate: Estimate, armed: bool, dt_s: float) -> None:
        if not armed:
            self._controller.reset()
            self._controller.follow(estimate.velocity_m_s, dt_s)
            self._thrust_m_s2 = 0.0
            return
        if self.land.ramp < 1.0:
            self._controller.reset()  # thrust is held back: the integrator must not wind up
        self._attitude_sp = self._controller.update(
            wanted, estimate.position_m, estimate.velocity_m_s, estimate.yaw_rad, dt_s
        )
        idle = _IDLE_SHARE * GRAVITY_M_S2
        if self.land.landed or self.land.pressed_down:
            self._thrust_m_s2 = idle
            self._attitude_sp = AttitudeSetpoint(np.array([0.0, 0.0, -1.0]), idle, estimate.yaw_rad, 0.0)
        else:
            ramp = self.land.ramp
            self._thrust_m_s2 = min(self._attitude_sp.thrust_m_s2, idle + ramp * 2.0 * GRAVITY_M_S2)

    def _end_takeoff(self) -> None:
        """After take-off PX4 goes to Hold where it can; without a global position it stays and hovers."""
        if self.commander.intention is NavState.TAKEOFF and self.commander.can_run(NavState.HOLD):
            self.commander.request_mode(NavState.HOLD)
