"""The vertical: gravity and the sensor's bias told apart by turning, and when the map is turned for it."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from schemas.camera import Intrinsics
from services.common.geometry import exp_rotation, level_camera, pose, rotation_z
from services.slam import gravity
from services.slam.ground import ground_up

F64 = NDArray[np.float64]
RATE_HZ = 15.0


def here(_: int) -> F64:
    """Where the only keyframe stands."""
    return np.eye(4)


def lean_deg(up: F64, truth: F64) -> float:
    return float(np.degrees(np.arccos(min(float(up @ truth), 1.0))))


def fly(
    level: gravity.Level, seconds: float, turn_rad: float, bias: F64, lean: F64, seed: int = 1
) -> gravity.Vertical | None:
    """Sway and turn with a biased accelerometer in a map that leans by ``lean``; poses err by 5 mm."""
    rng = np.random.default_rng(seed)
    map_from_level = exp_rotation(lean)
    for k in range(int(seconds * RATE_HZ)):
        t = k / RATE_HZ
        amplitude, rate = np.array([0.05, 0.04, 0.03]), np.array([2.0, 3.1, 1.3])
        position = amplitude * np.sin(rate * t)
        acceleration = -amplitude * rate**2 * np.sin(rate * t)
        T = level_camera(position, turn_rad * t / seconds)
        force = T[:3, :3].T @ (acceleration + np.array([0.0, 0.0, gravity.STANDARD_M_S2])) + bias
        T = pose(map_from_level, [0.0, 0.0, 0.0]) @ T
        T[:3, 3] += rng.normal(0.0, 0.005, 3)
        level.add(round(t * 1e9), 0, T, force + rng.normal(0.0, 0.03, 3), here)
    return level.vertical(here)


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 2**31), lean_x=st.floats(-0.05, 0.05), lean_y=st.floats(-0.05, 0.05))
def test_after_a_turn_the_lean_is_known_whatever_the_bias(seed: int, lean_x: float, lean_y: float) -> None:
    bias = np.random.default_rng(seed).normal(0.0, 0.2, 3)
    lean = np.array([lean_x, lean_y, 0.0])
    found = fly(gravity.Level(), 16.0, 2.0 * np.pi, bias, lean, seed)
    assert found is not None
    assert lean_deg(found.up, exp_rotation(lean) @ np.array([0.0, 0.0, 1.0])) < 0.15
    assert np.degrees(found.sigma_rad) < 0.2
    np.testing.assert_allclose(found.bias_m_s2, bias, atol=0.06)


def test_without_a_turn_the_bias_stays_unknown_and_that_is_told() -> None:
    bias = np.array([0.25, 0.0, -0.1])
    found = fly(gravity.Level(), 16.0, 0.0, bias, np.zeros(3))
    assert found is not None
    error = lean_deg(found.up, np.array([0.0, 0.0, 1.0]))
    assert error > 0.8
    assert error < 2.0 * np.degrees(found.sigma_rad)


def test_windows_follow_their_keyframe_when_the_map_is_bent() -> None:
    level = gravity.Level()
    fly(level, 16.0, 2.0 * np.pi, np.zeros(3), np.zeros(3))
    bend = pose(exp_rotation([0.1, -0.2, 0.4]), [1.0, 2.0, 3.0])
    found = level.vertical(lambda _: bend)
    assert found is not None
    assert lean_deg(found.up, bend[:3, 2]) < 0.15


def test_a_keyframe_that_is_gone_takes_its_windows_along() -> None:
    level = gravity.Level()

    def gone(serial: int) -> F64:
        raise KeyError(serial)

    fly(level, 5.0, 1.0, np.zeros(3), np.zeros(3))
    assert level.vertical(gone) is None
    for k in range(60):
        assert not level.add(round((10.0 + k / RATE_HZ) * 1e9), 7, np.eye(4), np.array([0.0, -9.8, 0.0]), gone)


def test_no_window_spans_a_gap() -> None:
    level = gravity.Level()
    made = [
        level.add(
            round((k / RATE_HZ + (2.0 if k >= 25 else 0.0)) * 1e9), 0, np.eye(4), np.array([0.0, -9.8, 0.0]), here
        )
        for k in range(50)
    ]
    assert not any(made)


def test_an_attitude_tells_gravity_without_the_cameras_motion() -> None:
    upright = gravity.Upright()
    up = np.array([0.0, -1.0, 0.0])
    upright.begin(None, up, lambda: None)
    assert upright.sigma_rad == gravity.SIGMA_ATTITUDE_RAD
    asked = []
    lean = exp_rotation([0.02, 0.0, 0.0])
    for k in range(300):
        R = lean @ rotation_z(0.03 * k) @ level_camera([0.0, 0.0, 0.0], 0.0)[:3, :3]
        T = pose(R, [np.sin(0.3 * k), 0.0, 0.0])
        asked.append(upright.feel(round(k / RATE_HZ * 1e9), 0, T, None, up, here))
    found = [a for a in asked if a is not None]
    assert found
    assert lean_deg(found[-1], lean @ np.array([0.0, 0.0, 1.0])) < 0.3


def test_an_upright_map_is_left_alone_and_becomes_sure() -> None:
    upright = gravity.Upright()
    upright.begin(np.array([0.0, -9.8, 0.0]), None, lambda: None)
    for k in range(300):
        T = level_camera([0.0, 0.0, 0.0], 0.03 * k)
        accel = T[:3, :3].T @ np.array([0.0, 0.0, 9.8])
        assert upright.feel(round(k / RATE_HZ * 1e9), 0, T, accel, None, here) is None
    assert np.degrees(upright.sigma_rad) == pytest.approx(0.15, abs=0.1)


CAMERA = Intrinsics(width=320, height=240, fx=250.0, fy=250.0, cx=159.5, cy=119.5)


def test_a_map_without_its_first_keyframe_is_not_turned_about_the_vertical() -> None:
    """Its x is the first keyframe's heading; that of another is not along x."""
    up, forward = exp_rotation([0.02, 0.01, 0.0])[2], np.array([0.0, 1.0, 0.0])
    assert abs(np.arctan2(*gravity.levelling(up, forward)[[1, 0], 0])) > 1.5
    R = gravity.levelling(up, None)
    np.testing.assert_allclose(R @ up, [0.0, 0.0, 1.0], atol=1e-9)
    assert abs(np.arctan2(R[1, 0], R[0, 0])) < 1e-3


def plane_seen(up: F64, height_m: float) -> NDArray[np.float32]:
    """Depth (240, 320) of a plane ``height_m`` below a camera for which up is ``up``; 1 cm of noise."""
    u, v = np.meshgrid(np.arange(320), np.arange(240))
    rays = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones(u.shape)], axis=-1)
    with np.errstate(divide="ignore"):
        z = -height_m / (rays @ up)
    z += np.random.default_rng(3).normal(0.0, 0.01, z.shape)
    return np.where((z > 0.3) & (z < 8.0), z, 0.0).astype(np.float32)


@settings(max_examples=15, deadline=None)
@given(pitch=st.floats(-0.5, 0.2), roll=st.floats(-0.3, 0.3), height_m=st.floats(0.4, 2.0))
def test_the_ground_tells_up_where_no_sensor_does(pitch: float, roll: float, height_m: float) -> None:
    up = exp_rotation([pitch, 0.0, roll]) @ np.array([0.0, -1.0, 0.0])
    depth_m = plane_seen(up, height_m)
    depth_m[100:, 40:90] = np.where(depth_m[100:, 40:90] > 0.0, 1.0, 0.0)  # something stands on it
    found = ground_up(depth_m, CAMERA)
    if found is not None:
        assert lean_deg(found, up) < 2.0
    else:
        assert np.count_nonzero(depth_m[96:]) < 0.3 * depth_m[96:].size


def test_a_wall_ahead_is_no_ground() -> None:
    assert ground_up(np.full((240, 320), 2.0, np.float32), CAMERA) is None
    assert ground_up(np.zeros((240, 320), np.float32), CAMERA) is None
    upright = gravity.Upright()
    assert upright.begin(None, None, lambda: None) is None
    assert upright.sigma_rad == gravity.SIGMA_UNKNOWN_RAD
    assert upright.begin(None, None, lambda: np.array([0.0, -1.0, 0.0])) is not None
    assert upright.sigma_rad == gravity.SIGMA_GROUND_RAD
