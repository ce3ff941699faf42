"""The rolling shutter: its geometry by numbers, and a readout time learned while tracking."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from services.common.geometry import exp_rotation, inverse, level_camera, log_rotation, pose
from services.slam.config import SlamConfig
from services.slam.linear import step_pose
from services.slam.motion import Motion
from services.slam.shutter import slopes, turn_slopes, unexplained
from services.slam.slam import Slam
from tests.unit.slam_room import INTRINSICS, look

F64 = NDArray[np.float64]
CAMERA = np.array([500.0, 505.0, 320.0, 240.0, 40.0])
V_M_S, W_RAD_S = np.array([0.3, -0.2, 0.4]), np.array([0.5, -0.7, 0.9])


def project(X: F64) -> F64:
    return np.column_stack([CAMERA[0] * X[:, 0] / X[:, 2] + CAMERA[2], CAMERA[1] * X[:, 1] / X[:, 2] + CAMERA[3]])


def moved_after(X: F64, s: F64) -> F64:
    """Still points after times ``s`` (N,), camera moving with constant velocity in its own axes."""
    return np.stack([exp_rotation(-W_RAD_S * t) @ (x - V_M_S * t) for x, t in zip(X, s, strict=True)])


def seen_after(X: F64, s: F64) -> F64:
    """Pixels of still points after times ``s`` (N,)."""
    return project(moved_after(X, s))


def points(count: int) -> F64:
    rng = np.random.default_rng(4)
    return rng.uniform([-1.0, -0.8, 1.2], [1.0, 0.8, 4.0], (count, 3))


def test_slopes_bring_features_back_to_the_middle_row() -> None:
    X, readout_s = points(200), 0.02
    row = (project(X)[:, 1] - CAMERA[3]) / 480.0
    read = seen_after(X, readout_s * row)
    slope = slopes(read, row, X[:, 2].copy(), CAMERA, V_M_S, W_RAD_S)
    off = np.linalg.norm(read - project(X), axis=1)
    left = np.linalg.norm(read + readout_s * slope - project(X), axis=1)
    assert off.max() > 3.0
    assert left.max() < 0.1


def test_turn_slopes_are_the_derivative_of_slopes() -> None:
    X = points(20)
    read, row, depth = project(X), np.linspace(-0.5, 0.5, 20), X[:, 2].copy()
    found = turn_slopes(read, row, CAMERA)
    for k in range(3):
        step = np.zeros(3)
        step[k] = 1e-4
        more, less = (slopes(read, row, depth, CAMERA, V_M_S, W_RAD_S + s) for s in (step, -step))
        np.testing.assert_allclose(found[:, :, k], (more - less) / 2e-4, atol=1e-6)


@pytest.mark.parametrize("readout_s", [0.0, 0.02])
def test_what_the_pose_cannot_explain_tells_the_readout(readout_s: float) -> None:
    X = points(300)
    row = (project(X)[:, 1] - CAMERA[3]) / 480.0
    read = seen_after(X, readout_s * row)
    R, t = np.eye(3), np.zeros(3)
    step_pose(R, t, np.array([0.002, -0.001, 0.001, 0.001, 0.002, -0.001]))  # a pose not yet right costs nothing
    obs = np.column_stack([read, CAMERA[4] / X[:, 2]])
    slope = slopes(read, row, X[:, 2].copy(), CAMERA, V_M_S, W_RAD_S)
    A, b = unexplained(R, t, X, obs, np.ones((300, 2)), np.ascontiguousarray(-slope[:, :, None]), CAMERA)
    assert b[0] / A[0, 0] == pytest.approx(readout_s, abs=0.0005)


def test_velocity_goes_on_changing_as_it_did() -> None:
    motion, step_ns = Motion(), 100_000_000
    motion.update(0, None)
    assert motion.measured is None
    motion.update(step_ns, pose(np.eye(3), [0.02, 0.0, 0.0]))
    velocity = motion.velocity(2 * step_ns, pose(np.eye(3), [0.04, 0.0, 0.0]))
    np.testing.assert_allclose(velocity.v_m_s, [0.5, 0.0, 0.0])  # 0.2 and 0.4 in the middles of two steps


def swing(at_s: float) -> F64:
    """A hand-held camera: up to 60 degrees and 0.3 m a second."""
    yaw, sway = 0.5 * np.sin(2.0 * at_s), 0.1 * np.sin(3.1 * at_s)
    T = level_camera([sway, 0.08 * np.sin(2.3 * at_s + 1.0), 0.05 * np.sin(1.7 * at_s)], yaw)
    return np.asarray(T @ pose(exp_rotation([0.15 * np.sin(2.6 * at_s), 0.0, 0.1 * np.sin(1.9 * at_s)]), np.zeros(3)))


def rolling(at_s: float, readout_s: float) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """A frame of the room read in bands of 15 rows."""
    grey, depth_m = look(swing(at_s))
    if readout_s:
        for top in range(0, INTRINSICS.height, 15):
            share = (top + 7.5) / INTRINSICS.height - 0.5
            band = look(swing(at_s + readout_s * share), slice(top, top + 15))
            grey[top : top + 15], depth_m[top : top + 15] = band
    return grey, depth_m


@pytest.mark.parametrize("readout_s", [0.0, 0.025])
def test_readout_is_learned_and_corrected_and_a_global_shutter_left_alone(readout_s: float) -> None:
    slam = Slam(INTRINSICS, SlamConfig(features=500))
    errors = []
    for k in range(60):
        at_s = k / 15.0
        result = slam.track(round(at_s * 1e9), *rolling(at_s, readout_s))
        assert result.T_map_camera is not None
        if k > 30:
            T = inverse(swing(0.0)) @ swing(at_s)
            mine = inverse(slam.mapping.keyframe_pose(0)) @ result.T_map_camera
            errors.append(np.linalg.norm(log_rotation(mine[:3, :3] @ T[:3, :3].T)))
    learned_s = slam.shutter.readout_s
    assert learned_s == (pytest.approx(readout_s, abs=0.008) if readout_s else 0.0)
    assert np.degrees(np.sqrt(np.mean(np.square(errors)))) < 1.2  # 2.5 degrees uncorrected
