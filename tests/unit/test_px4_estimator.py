"""The simulated autopilot's filter: numeric Jacobians, consistency, gates."""

from __future__ import annotations

import math

import numpy as np
import pytest

from services.common.geometry import Matrix
from services.simulator.px4.estimator import Estimator
from services.simulator.px4.estimator_kernels import STATES, _transition, fuse, predict, propagate, replay, yaw_row
from services.simulator.px4.frames import rotation_from_wxyz, wxyz_from_yaw, yaw_from_wxyz
from services.simulator.px4.kernels import quaternion_times_exp
from services.simulator.px4.params import Parameters
from services.simulator.px4.vision import VisionSample

DT = 0.008
NAN3 = np.full(3, math.nan)


def state(rng: np.random.Generator) -> Matrix:
    x = np.zeros(16)
    x[:6] = rng.normal(size=6)
    x[6] = 1.0
    quaternion_times_exp(x[6:10], rng.normal(size=3) * 0.5, 1.0)
    x[10:13], x[13:16] = rng.normal(size=3) * 0.01, rng.normal(size=3) * 0.1
    return x


def plus(x: Matrix, dx: Matrix) -> Matrix:
    y = x.copy()
    y[:6] += dx[:6]
    quaternion_times_exp(y[6:10], dx[6:9], 1.0)
    y[10:16] += dx[9:15]
    return y


def minus(a: Matrix, b: Matrix) -> Matrix:
    """Return the error state that takes ``b`` to ``a``."""
    R = rotation_from_wxyz(b[6:10]).T @ rotation_from_wxyz(a[6:10])
    turn = 0.5 * np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    return np.concatenate([a[:6] - b[:6], turn, a[10:16] - b[10:16]])


def test_transition_matches_numeric_differences() -> None:
    rng = np.random.default_rng(1)
    for _ in range(5):
        x, gyro, accel = state(rng), rng.normal(size=3), rng.normal(size=3) * 3.0 + [0.0, 0.0, -9.8]
        F = _transition(x, gyro, accel, DT)
        base = x.copy()
        propagate(base, gyro, accel, DT)
        for j in range(STATES):
            dx = np.zeros(STATES)
            dx[j] = 1e-6
            moved = plus(x, dx)
            propagate(moved, gyro, accel, DT)
            assert np.allclose(minus(moved, base) / 1e-6, F[:, j], atol=2e-3), j


def test_yaw_row_matches_numeric_differences() -> None:
    rng = np.random.default_rng(2)
    for _ in range(5):
        x, row = state(rng), np.zeros(STATES)
        yaw_row(x[6:10], row)
        for j in range(STATES):
            dx = np.zeros(STATES)
            dx[j] = 1e-6
            change = math.remainder(yaw_from_wxyz(plus(x, dx)[6:10]) - yaw_from_wxyz(x[6:10]), 2 * math.pi)
            assert change / 1e-6 == pytest.approx(row[j], abs=1e-4)


def test_fusing_shrinks_the_variance_and_keeps_it_symmetric() -> None:
    rng = np.random.default_rng(3)
    x, P = state(rng), np.eye(STATES)
    for _ in range(20):
        predict(x, P, rng.normal(size=3) * 0.1, np.array([0.0, 0.0, -9.8]), DT, np.array([0.01, 0.3, 1e-5, 1e-3]))
    before = P[0, 0]
    H = np.zeros(STATES)
    H[0] = 1.0
    fuse(x, P, H, 0.5, 0.01)
    assert P[0, 0] < 0.011 < before
    assert np.array_equal(P, P.T)
    assert np.linalg.eigvalsh(P).min() > 0.0


def test_replay_equals_propagation() -> None:
    rng = np.random.default_rng(4)
    x, out = state(rng), np.zeros(16)
    samples = np.column_stack([np.full(9, DT), rng.normal(size=(9, 6))])
    replay(x, samples, 9, out)
    for row in samples:
        propagate(x, row[1:4], row[4:7], DT)
    assert np.array_equal(out, x)


class Bench:
    """A vehicle that stands (or slides along a given path) before a filter, with chosen vision."""

    def __init__(self, **parameters: float) -> None:
        self.params = Parameters(parameters)
        self.estimator = Estimator(self.params, 0.0, wxyz_from_yaw(0.7))
        self.rng = np.random.default_rng(7)
        self.now_s = 0.0
        self.counter = 0
        self.offset = np.zeros(3)
        self.gyro_bias, self.accel_bias = np.array([0.004, -0.003, 0.005]), np.array([0.08, -0.06, 0.05])

    def run(self, seconds: float, every_s: float | None, delay_s: float = 0.0, speed: float = 0.0) -> None:
        pending: list[VisionSample] = []
        next_s = self.now_s
        for _ in range(round(seconds / DT)):
            self.now_s += DT
            gyro = self.gyro_bias + 0.004 * self.rng.standard_normal(3)
            accel = self.accel_bias + [0.0, 0.0, -9.80665] + 0.18 * self.rng.standard_normal(3)
            if every_s is not None and self.now_s >= next_s:
                next_s += every_s
                place = self.offset + [speed * self.now_s, 0.0, 0.0] + 0.01 * self.rng.standard_normal(3)
                pending.append(
                    VisionSample(
                        self.now_s,
                        place,
                        wxyz_from_yaw(0.7),
                        NAN3,
                        np.full(3, 1e-4),
                        1e-4,
                        NAN3,
                        frame_is_ned=True,
                        reset_counter=self.counter,
                    )
                )
            while pending and pending[0].stamp_s + delay_s <= self.now_s:
                self.estimator.add_vision(pending.pop(0), self.now_s)
            self.estimator.add_imu(self.now_s, gyro, accel, DT)


def test_yaw_is_unknown_until_vision_tells_it() -> None:
    b = Bench()
    b.run(2.0, None)
    assert not b.estimator.yaw_aligned
    b.run(2.0, 0.033)
    assert yaw_from_wxyz(b.estimator.quaternion_wxyz) == pytest.approx(0.7, abs=0.03)


def test_delayed_vision_meets_the_state_of_its_own_time() -> None:
    b = Bench()
    b.estimator.landed = False
    b.run(12.0, 0.033, delay_s=0.15, speed=1.0)
    assert b.estimator.position_m[0] == pytest.approx(b.now_s, abs=0.05)


def test_biases_are_learnt_and_the_error_stays_within_its_sigmas() -> None:
    b = Bench()
    b.estimator.landed = False
    b.run(40.0, 0.033)
    assert np.allclose(b.estimator.gyro_bias_rad_s, b.gyro_bias, atol=0.002)
    assert float(np.linalg.norm(b.estimator.position_m[:2])) < 4.0 * b.estimator.position_sigma_m + 0.01


def test_drift_without_vision_grows_faster_than_time() -> None:
    b = Bench()
    b.estimator.landed = False
    b.run(10.0, 0.033)
    errors = []
    for _ in range(4):
        b.run(1.2, None)
        errors.append(float(np.linalg.norm(b.estimator.position_m[:2])))
    assert errors[-1] > 0.03
    assert errors[-1] > errors[0]
    assert b.estimator.horizontal_valid is False


def test_announced_jump_resets_and_is_reported() -> None:
    b = Bench()
    b.run(3.0, 0.033)
    b.estimator.take_reset()
    b.offset, b.counter = np.array([1.0, -2.0, 0.5]), 1
    b.run(1.0, 0.033)
    assert np.allclose(b.estimator.position_m, b.offset, atol=0.06)
    delta, _ = b.estimator.take_reset()
    assert np.allclose(delta, b.offset, atol=0.1)
    assert not b.estimator.take_reset()[0].any()


def test_gate_holds_for_a_second_then_gives_in() -> None:
    b = Bench()
    b.estimator.landed = False
    b.run(3.0, 0.033)
    b.offset = np.array([1.0, 0.0, 0.0])
    b.run(0.9, 0.033)
    assert abs(float(b.estimator.position_m[0])) < 0.2
    b.run(1.0, 0.033)
    assert b.estimator.position_m[0] == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize(("interval_s", "used"), [(0.033, True), (0.1, True), (0.19, True), (0.25, False)])
def test_fusion_starts_only_on_a_quick_stream(interval_s: float, used: bool) -> None:
    b = Bench()
    b.run(6.0, interval_s)
    assert b.estimator.flags.position is used


def test_old_and_future_stamps_are_not_fused() -> None:
    for shift in (-2.0, 5.0):
        b = Bench()
        for _ in range(60):
            b.run(0.032, None)
            sample = VisionSample(
                b.now_s + shift, np.zeros(3), wxyz_from_yaw(0.0), NAN3, np.full(3, 1e-4), 1e-4, NAN3,
                frame_is_ned=True, reset_counter=0,
            )  # fmt: skip
            b.estimator.add_vision(sample, b.now_s)
        assert b.estimator.fused == 0
