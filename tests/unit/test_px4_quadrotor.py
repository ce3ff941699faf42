"""The simulated aircraft's dynamics and sensors."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from services.common.geometry import Matrix, pose, rotation_z
from services.simulator.px4.config import AirframeConfig, SensorConfig, WindConfig
from services.simulator.px4.frames import (
    FLIP,
    euler_from_wxyz,
    quaternion_ned_from_world,
    rotation_from_wxyz,
    wxyz_from_yaw,
    yaw_from_wxyz,
)
from services.simulator.px4.geodesy import to_global, to_local
from services.simulator.px4.kernels import quaternion_times_exp
from services.simulator.px4.quadrotor import GRAVITY_M_S2, Quadrotor

CALM = WindConfig(mean_m_s=0.0, gust_m_s=0.0)
EXACT = AirframeConfig(thrust_error=0.0)
PERFECT = SensorConfig(
    gyro_noise_rad_s=0.0, gyro_bias_rad_s=0.0, gyro_walk_rad_s=0.0, accel_noise_m_s2=0.0, accel_bias_m_s2=0.0,
    accel_walk_m_s2=0.0, baro_noise_m=0.0, baro_drift_m=0.0,
)  # fmt: skip
DT = 0.004


def body(height_m: float = 5.0, yaw_rad: float = 0.0, seed: int = 0, wind: WindConfig = CALM) -> Quadrotor:
    return Quadrotor(
        np.array([0.0, 0.0, -height_m]), wxyz_from_yaw(yaw_rad), lambda _x, _y: 0.0, EXACT, PERFECT, wind,
        np.random.default_rng(seed),
    )  # fmt: skip


def fly(q: Quadrotor, seconds: float, thrust: float, rates: Matrix | None = None) -> None:
    for _ in range(round(seconds / DT)):
        q.step(np.zeros(3) if rates is None else rates, thrust, DT)


def test_free_fall_is_felt_as_nothing() -> None:
    q = body()
    fly(q, 0.4, 0.0)
    assert q.state[5] == pytest.approx(GRAVITY_M_S2 * 0.4, rel=0.1)
    drag = EXACT.drag_n_s_m / EXACT.mass_kg * float(q.state[5])
    assert np.allclose(q.imu(DT).accel_m_s2, [0.0, 0.0, -drag], atol=0.05)


def test_standing_feels_gravity_upward_and_stays() -> None:
    q = body(0.1)
    fly(q, 1.0, 0.0)
    assert q.contact
    assert q.state[2] == pytest.approx(-0.1)
    assert np.allclose(q.imu(DT).accel_m_s2, [0.0, 0.0, -GRAVITY_M_S2], atol=1e-3)


def test_thrust_lags_by_its_time_constant() -> None:
    q = body()
    fly(q, 12 * DT, 10.0)
    assert q.state[13] == pytest.approx(10.0 * (1.0 - math.exp(-12 * DT / EXACT.thrust_lag_s)))


def test_yaw_rate_is_reached_but_for_its_gain() -> None:
    q = body()
    fly(q, 1.0, GRAVITY_M_S2, np.array([0.0, 0.0, 0.5]))
    assert q.state[12] == pytest.approx(0.5 * EXACT.yaw_rate_gain, abs=0.01)


def test_tilt_forward_accelerates_forward() -> None:
    q = body(50.0, yaw_rad=math.pi / 2)
    q._airframe[6:9] = 0.0
    fly(q, 0.3, GRAVITY_M_S2, np.array([0.0, -0.5, 0.0]))  # nose down
    fly(q, 0.7, GRAVITY_M_S2)
    assert q.state[4] > 0.5  # heading east
    assert abs(float(q.state[3])) < 0.05


def test_wind_carries_a_hovering_body_and_not_a_standing_one() -> None:
    breeze = WindConfig(mean_m_s=3.0, gust_m_s=0.0)
    flying, standing = body(10.0, wind=breeze), body(0.1, wind=breeze)
    fly(flying, 3.0, GRAVITY_M_S2)
    fly(standing, 3.0, 0.0)
    assert float(np.hypot(flying.state[3], flying.state[4])) > 0.5
    assert np.allclose(standing.state[:2], 0.0, atol=1e-3)


def test_same_seed_same_flight_other_seed_other_wind() -> None:
    a, b, c = (body(5.0, seed=s, wind=WindConfig()) for s in (4, 4, 5))
    for q in (a, b, c):
        fly(q, 1.0, GRAVITY_M_S2)
    assert a.state.tobytes() == b.state.tobytes()
    assert a.state.tobytes() != c.state.tobytes()


def test_relief_is_felt_under_the_legs() -> None:
    q = Quadrotor(
        np.array([2.0, 0.0, -3.0]), wxyz_from_yaw(0.0), lambda x, _y: 0.5 * x, EXACT, PERFECT, CALM,
        np.random.default_rng(0),
    )  # fmt: skip
    fly(q, 3.0, 0.0)
    assert q.contact
    assert -q.state[2] == pytest.approx(0.5 * q.state[0] + EXACT.leg_height_m, abs=1e-6)


@settings(max_examples=50, deadline=None)
@given(st.floats(-3.0, 3.0), st.floats(-1.4, 1.4), st.floats(-3.0, 3.0))
def test_frames_there_and_back(roll: float, pitch: float, yaw: float) -> None:
    q = np.array([1.0, 0.0, 0.0, 0.0])
    for axis, angle in ((2, yaw), (1, pitch), (0, roll)):
        rate = np.zeros(3)
        rate[axis] = angle
        quaternion_times_exp(q, rate, 1.0)
    told = euler_from_wxyz(q)
    assert np.allclose(told, (roll, pitch, yaw), atol=1e-6)
    R_world_body = FLIP @ rotation_from_wxyz(q) @ FLIP
    back = quaternion_ned_from_world(R_world_body)
    assert abs(abs(float(back @ q)) - 1.0) < 1e-9


def test_left_in_the_world_is_negative_yaw_in_ned() -> None:
    T = pose(rotation_z(0.4), [0.0, 0.0, 0.0])
    assert yaw_from_wxyz(quaternion_ned_from_world(T[:3, :3])) == pytest.approx(-0.4)


def test_geodesy_there_and_back() -> None:
    origin = (47.4, 8.5, 400.0)
    assert np.allclose(to_local(origin, to_global(origin, (12.0, -7.0, -3.0))), (12.0, -7.0, -3.0), atol=1e-6)
