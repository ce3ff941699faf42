"""What each flight mode wants: setpoints of Hold, Land, Takeoff, Return and the pilot; take-off ramp; land detector."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum

import numpy as np

from services.common.geometry import Matrix, wrap_angle
from services.simulator.px4.control import Setpoint
from services.simulator.px4.modes import NavState
from services.simulator.px4.params import Parameters

GRAVITY_M_S2 = 9.80665
_BRAKE_S = 0.8
_NEAR_M = 0.5
_AUTO_SPEED_M_S = 3.0
_CONTACT_S = 0.35
_LANDED_S = 0.7
_LOW_THRUST = 0.8
_STILL_M_S = 0.3
_WANTS_UP_M_S = 0.15
_LAND_SLOW_BELOW_M = 5.0


class Ground(Enum):
    """EXTENDED_SYS_STATE's landed states, with the inner steps of a take-off."""

    LANDED = "landed"
    SPOOLING = "spooling"
    CLIMBING = "climbing"
    FLYING = "flying"
    LANDING = "landing"


@dataclass(frozen=True, slots=True)
class Estimate:
    """What the modes know of the vehicle, local frame."""

    position_m: Matrix
    velocity_m_s: Matrix
    yaw_rad: float


@dataclass(frozen=True, slots=True)
class Sticks:
    """The pilot's sticks as velocities in the heading frame: forward, right, down (m/s) and yaw rate (rad/s)."""

    forward_m_s: float = 0.0
    right_m_s: float = 0.0
    down_m_s: float = 0.0
    yaw_rate_rad_s: float = 0.0


class LandDetector:
    """Tells flying from standing as PX4 must: by thrust, wanted and estimated vertical speed, never by the truth."""

    def __init__(self, params: Parameters) -> None:
        self._params = params
        self.state = Ground.LANDED
        self._armed_s = 0.0
        self._quiet_s = 0.0
        self.ramp = 0.0

    @property
    def landed(self) -> bool:
        """Standing on the ground, rotors idle or stopped."""
        return self.state in (Ground.LANDED, Ground.SPOOLING)

    @property
    def pressed_down(self) -> bool:
        """Ground contact is assumed: thrust is taken away."""
        return self.state is Ground.LANDING

    def update(self, armed: bool, wants_up: bool, sinking_wanted: bool, speed_m_s: float, thrust: float,
               dt_s: float) -> None:  # fmt: skip
        """Advance by ``dt_s``; ``speed_m_s`` is the estimated vertical speed, ``thrust`` the last command (m/s^2)."""
        if not armed:
            self.state, self._armed_s, self.ramp, self._quiet_s = Ground.LANDED, 0.0, 0.0, 0.0
            return
        self._armed_s += dt_s
        if self.landed:
            spooled = self._armed_s >= self._params["COM_SPOOLUP_TIME"]
            self.state = Ground.SPOOLING
            self.ramp, self._quiet_s = 0.0, 0.0
            if spooled and wants_up:
                self.state = Ground.CLIMBING
            return
        if self.state is Ground.CLIMBING:
            self.ramp += dt_s / max(0.3, 0.4 * self._params["MPC_TKO_RAMP_T"])
            if self.ramp >= 1.0:
                self.ramp, self.state = 1.0, Ground.FLYING
        quiet = sinking_wanted and abs(speed_m_s) < _STILL_M_S and thrust < _LOW_THRUST * GRAVITY_M_S2
        self._quiet_s = self._quiet_s + dt_s if quiet else 0.0
        if self._quiet_s >= _CONTACT_S + _LANDED_S:
            self.state = Ground.LANDED
        elif self._quiet_s >= _CONTACT_S:
            self.state = Ground.LANDING
        elif self.state is Ground.LANDING:
            self.state = Ground.FLYING


class FlightModes:
    """Setpoints of the modes that PX4 flies by itself. One instance per vehicle; remembers where a mode began."""

    def __init__(self, params: Parameters) -> None:
        self._params = params
        self._state: NavState | None = None
        self._anchor = np.zeros(3)
        self._yaw_rad = 0.0
        self._start = np.zeros(3)
        self._returning = 0
        self.home_m = np.zeros(3)
        self.takeoff_height_m = math.nan
        self.takeoff_done = False
        self.sticks = Sticks()

    def shift(self, delta_m: Matrix, delta_yaw_rad: float) -> None:
        """Keep the remembered places where they truly are after the local frame jumped under the vehicle."""
        self._anchor = self._anchor + delta_m
        self._start = self._start + delta_m
        self.home_m = self.home_m + delta_m
        self._yaw_rad = wrap_angle(self._yaw_rad + delta_yaw_rad)

    def setpoint(self, state: NavState, estimate: Estimate, dt_s: float) -> Setpoint:
        """Return what ``state`` wants now; entering a mode brakes to a stop ahead."""
        if state is not self._state:
            self._enter(state, estimate)
        if state is NavState.TAKEOFF:
            return self._takeoff(estimate)
        if state is NavState.LAND:
            return self._sink(estimate)
        if state is NavState.RETURN:
            return self._return(estimate)
        if state is NavState.DESCEND:
            return self._blind(self._params["MPC_LAND_SPEED"])
        if state in (NavState.ALTITUDE, NavState.MANUAL, NavState.STABILIZED):
            return self._blind(self.sticks.down_m_s)
        return self._hold(estimate, dt_s)

    def _enter(self, state: NavState, estimate: Estimate) -> None:
        self._state = state
        self._start = estimate.position_m.copy()
        self._anchor = estimate.position_m + _BRAKE_S * estimate.velocity_m_s
        self._yaw_rad = estimate.yaw_rad
        self._returning = 0
        self.takeoff_done = False

    def _hold(self, estimate: Estimate, dt_s: float) -> Setpoint:
        s = self.sticks if self._state is NavState.POSITION else Sticks()
        c, n = math.cos(estimate.yaw_rad), math.sin(estimate.yaw_rad)
        wish = np.array([c * s.forward_m_s - n * s.right_m_s, n * s.forward_m_s + c * s.right_m_s, s.down_m_s])
        self._yaw_rad = wrap_angle(self._yaw_rad + s.yaw_rate_rad_s * dt_s)
        self._anchor = self._anchor + wish * dt_s
        return Setpoint(self._anchor.copy(), wish, yaw_rad=self._yaw_rad, yaw_rate_rad_s=s.yaw_rate_rad_s)

    def _takeoff(self, estimate: Estimate) -> Setpoint:
        height = self.takeoff_height_m
        rise = height if math.isfinite(height) else self._params["MIS_TAKEOFF_ALT"]
        top = self._start[2] - rise
        self.takeoff_done = float(estimate.position_m[2]) - top < 0.15
        return self._towards(np.array([self._start[0], self._start[1], top]), estimate, self._params["MPC_TKO_SPEED"])

    def _sink(self, estimate: Estimate) -> Setpoint:
        height = self.home_m[2] - float(estimate.position_m[2])
        fast = height > _LAND_SLOW_BELOW_M
        speed = self._params["MPC_Z_VEL_MAX_DN"] if fast else self._params["MPC_LAND_SPEED"]
        place = np.array([self._anchor[0], self._anchor[1], math.nan])
        return Setpoint(place, np.array([0.0, 0.0, speed]), yaw_rad=self._yaw_rad)

    def _return(self, estimate: Estimate) -> Setpoint:
        top = min(self._start[2], self.home_m[2] - self._params["RTL_RETURN_ALT"])
        away = float(np.linalg.norm(estimate.position_m[:2] - self.home_m[:2]))
        if self._returning == 0:
            goal = np.array([self._start[0], self._start[1], top])
            self._returning += abs(float(estimate.position_m[2]) - top) < _NEAR_M
        elif self._returning == 1:
            goal = np.array([self.home_m[0], self.home_m[1], top])
            self._returning += away < _NEAR_M
        else:
            self._anchor = self.home_m.copy()
            return self._sink(estimate)
        return self._towards(goal, estimate, _AUTO_SPEED_M_S)

    def _towards(self, goal_m: Matrix, estimate: Estimate, speed_m_s: float) -> Setpoint:
        """Return a setpoint that lies at most a little ahead, so that the P gain never asks for more speed."""
        way = goal_m - estimate.position_m
        reach = speed_m_s / min(self._params["MPC_XY_P"], self._params["MPC_Z_P"])
        far = float(np.linalg.norm(way))
        place = goal_m if far <= reach else estimate.position_m + way * (reach / far)
        return Setpoint(place, np.zeros(3), yaw_rad=self._yaw_rad)

    def _blind(self, down_m_s: float) -> Setpoint:
        """Level attitude with a vertical speed: no position is needed."""
        return Setpoint(
            velocity_m_s=np.array([math.nan, math.nan, down_m_s]),
            acceleration_m_s2=np.zeros(3),
            yaw_rad=self._yaw_rad,
        )


def wants_up(setpoint: Setpoint, estimate: Estimate) -> bool:
    """Whether a setpoint asks a standing vehicle to leave the ground."""
    by_place = float(estimate.position_m[2] - setpoint.position_m[2])
    by_speed = -float(setpoint.velocity_m_s[2])
    return by_place > _WANTS_UP_M_S or by_speed > _WANTS_UP_M_S or float(setpoint.acceleration_m_s2[2]) < -1.0
