"""A fixed-lag smoother of the body's motion (gtsam): states joined by IMU, cameras and GPS, the old ones marginalised.

The world W is level (z up), begins where the first state is put, and drifts as odometry does: it never jumps. With IMU a
state is pose, velocity and bias; without, a pose. Covariances are gtsam's: right perturbations (rotation, translation).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V, X

from services.common.geometry import Matrix, inverse
from services.fusion.config import FusionConfig
from services.fusion.inertial import Inertial
from services.fusion.values import Moved, adjoint

_HELD_M, _HELD_RAD = 1e-3, 1e-3
"""The first state's place and heading define the world."""
_SPEED_M_S = 1.0
_STEP_M, _STEP_RAD = 1e-4, 1e-5
"""Least standard deviations of a relative pose: what is singular cannot be solved."""
_HUBER = 1.345
_GPS_HUBER = 1.0


@dataclass(frozen=True, slots=True)
class State:
    """One moment of the body."""

    index: int
    stamp_ns: int
    T_W_body: Matrix
    velocity_m_s: Matrix


class Smoother:
    """The window. Call ``begin`` once, then ``step`` and ``join`` as it comes, ``solve`` after each."""

    def __init__(self, config: FusionConfig, inertial: Inertial | None) -> None:
        self._config, self._inertial = config, inertial
        params = gtsam.LevenbergMarquardtParams()
        params.setMaxIterations(6)
        self._lag = gtsam.BatchFixedLagSmoother(config.lag_s, params)
        self._new, self._values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        self._stamps: dict[Any, float] = {}
        self._origin_ns = 0
        self.states: list[State] = []
        """Those in the window, oldest first."""
        self._bias = gtsam.imuBias.ConstantBias()
        self._marginals: Any = None

    @property
    def inertial(self) -> bool:
        """Whether states are joined by the IMU."""
        return self._inertial is not None

    @property
    def last(self) -> State:
        """The newest state."""
        return self.states[-1]

    def begin(self, stamp_ns: int, T_W_body: Matrix, tilt_rad: float, velocity_m_s: Matrix | None = None) -> None:
        """Put the first state; ``tilt_rad`` is the standard deviation of its roll and pitch."""
        self._origin_ns = stamp_ns
        R = T_W_body[:3, :3]
        turn = R.T @ np.diag([tilt_rad**2, tilt_rad**2, _HELD_RAD**2]) @ R
        covariance = np.zeros((6, 6))
        covariance[:3, :3], covariance[3:, 3:] = turn, _HELD_M**2 * np.eye(3)
        self._new.add(gtsam.PriorFactorPose3(X(0), gtsam.Pose3(T_W_body), _gaussian(covariance)))
        velocity = np.zeros(3) if velocity_m_s is None else velocity_m_s
        if self.inertial:
            noise = self._config.imu_noise
            sigmas = np.repeat([noise.accel_bias_m_s2, noise.gyro_bias_rad_s], 3)
            self._new.add(gtsam.PriorFactorVector(V(0), velocity, gtsam.noiseModel.Isotropic.Sigma(3, _SPEED_M_S)))
            self._new.add(gtsam.PriorFactorConstantBias(B(0), self._bias, gtsam.noiseModel.Diagonal.Sigmas(sigmas)))
        self._insert(State(0, stamp_ns, T_W_body, velocity))

    def step(self, stamp_ns: int, guess: Moved | None = None) -> State:
        """Add a state, joined to the last by the IMU; without IMU at the pose that ``guess`` gives, to be joined next."""
        before = self.last
        index = before.index + 1
        T, velocity = before.T_W_body, before.velocity_m_s
        if self._inertial is not None:
            pim = self._inertial.between(before.stamp_ns, stamp_ns, self._bias)
            i = before.index
            self._new.add(gtsam.CombinedImuFactor(X(i), V(i), X(index), V(index), B(i), B(index), pim))
            nav = pim.predict(gtsam.NavState(gtsam.Pose3(T), velocity), self._bias)
            T, velocity = nav.pose().matrix(), nav.velocity()
        elif guess is not None:
            T = T @ guess.T
        state = State(index, stamp_ns, np.asarray(T), np.asarray(velocity))
        self._insert(state)
        return state

    def predict(self, stamp_ns: int) -> Matrix:
        """Return ``T_W_body`` at a moment after the last state, by the IMU alone; the last state's without one."""
        last = self.last
        if self._inertial is None or stamp_ns <= last.stamp_ns:
            return last.T_W_body
        pim = self._inertial.between(last.stamp_ns, stamp_ns, self._bias)
        nav = pim.predict(gtsam.NavState(gtsam.Pose3(last.T_W_body), last.velocity_m_s), self._bias)
        return np.asarray(nav.pose().matrix())

    def join(self, first: int, second: int, moved: Moved, *, robust: bool = False) -> None:
        """Join two states by a measured relative pose."""
        floor = np.repeat([_STEP_RAD**2, _STEP_M**2], 3)
        noise = _gaussian(moved.covariance + np.diag(floor))
        if robust:
            noise = gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.Huber.Create(_HUBER), noise)
        self._new.add(gtsam.BetweenFactorPose3(X(first), X(second), gtsam.Pose3(moved.T), noise))

    def place(self, index: int, position_W_m: Matrix, covariance: Matrix, antenna_m: Matrix) -> None:
        """Put a state's antenna at a place in W (a GPS fix)."""
        loss = gtsam.noiseModel.mEstimator.Huber.Create(_GPS_HUBER)
        noise = gtsam.noiseModel.Robust.Create(loss, _gaussian(covariance))
        self._new.add(gtsam.GPSFactorArm(X(index), position_W_m, antenna_m, noise))

    def keep(self, index: int) -> None:
        """Let a state's pose stay in the window as long as the newest does."""
        if self.holds(index):
            self._stamps[X(index)] = self._seconds(self.last.stamp_ns)

    def holds(self, index: int) -> bool:
        """Whether a state is in the window."""
        return any(state.index == index for state in self.states)

    def solve(self) -> None:
        """Take what was added into the window and solve it.

        Raises:
            RuntimeError: gtsam's, when the window cannot be solved.
        """
        self._lag.update(self._new, self._values, self._stamps)
        self._new, self._values, self._stamps = gtsam.NonlinearFactorGraph(), gtsam.Values(), {}
        self._marginals = None
        best = self._lag.calculateEstimate()
        self.states = [self._solved(best, s) for s in self.states if best.exists(X(s.index))]
        if self.inertial:
            self._bias = best.atConstantBias(B(self.last.index))

    @property
    def bias(self) -> tuple[Matrix, Matrix]:
        """The accelerometer's and the gyroscope's bias (3,), body."""
        return np.asarray(self._bias.accelerometer()), np.asarray(self._bias.gyroscope())

    def moved(self, first: int, second: int) -> Moved:
        """Return the pose of state ``second`` seen from ``first``, with its covariance: its joint marginal with it."""
        T = inverse(self.state(first).T_W_body) @ self.state(second).T_W_body
        if first == second:
            return Moved(np.eye(4), np.zeros((6, 6)))
        joint = self._joint().jointMarginalCovariance([X(first), X(second)])
        J = np.hstack([-adjoint(inverse(T)), np.eye(6)])
        a, b = X(first), X(second)
        P = np.block([[joint.at(a, a), joint.at(a, b)], [joint.at(b, a), joint.at(b, b)]])
        return Moved(T, J @ P @ J.T)

    def covariance(self, index: int) -> Matrix:
        """Return the (6, 6) marginal of a state's pose in W."""
        return np.asarray(self._joint().marginalCovariance(X(index)))

    def _joint(self) -> Any:  # noqa: ANN401
        if self._marginals is None:
            self._marginals = gtsam.Marginals(self._lag.getFactors(), self._lag.calculateEstimate())
        return self._marginals

    def state(self, index: int) -> State:
        """Return a state of the window."""
        return next(state for state in self.states if state.index == index)

    def _solved(self, best: Any, state: State) -> State:  # noqa: ANN401
        velocity = state.velocity_m_s
        if self.inertial and best.exists(V(state.index)):
            velocity = np.asarray(best.atVector(V(state.index)))
        return State(state.index, state.stamp_ns, np.asarray(best.atPose3(X(state.index)).matrix()), velocity)

    def _insert(self, state: State) -> None:
        keys = [X(state.index)]
        self._values.insert(X(state.index), gtsam.Pose3(state.T_W_body))
        if self.inertial:
            self._values.insert(V(state.index), state.velocity_m_s)
            self._values.insert(B(state.index), self._bias)
            keys += [V(state.index), B(state.index)]
        for key in keys:
            self._stamps[key] = self._seconds(state.stamp_ns)
        self.states.append(state)

    def _seconds(self, stamp_ns: int) -> float:
        return (stamp_ns - self._origin_ns) * 1e-9


def _gaussian(covariance: Matrix) -> Any:  # noqa: ANN401
    return gtsam.noiseModel.Gaussian.Covariance(0.5 * (covariance + covariance.T))
