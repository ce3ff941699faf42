"""Depth of another moment than the colour's: its geometry by numbers, and slam with lags of a Kinect's size."""

from __future__ import annotations

import numpy as np
import pytest

from services.common.geometry import inverse, level_camera
from services.slam.camera import camera_model
from services.slam.config import SlamConfig
from services.slam.depth_noise import DepthNoise
from services.slam.features import Extractor
from services.slam.lag import Lag, carried_back
from services.slam.motion import Velocity
from services.slam.slam import Slam
from tests.unit.slam_room import F64, INTRINSICS, look
from tests.unit.test_slam_shutter import CAMERA, V_M_S, W_RAD_S, moved_after, points, project, swing

FEW = SlamConfig(features=500)
RATE_HZ = 15.0


def test_depth_is_carried_back_to_the_moment_of_the_colour() -> None:
    X = points(100)
    after_s = np.linspace(-0.03, 0.03, 100)
    later = moved_after(X, after_s)[:, 2].copy()
    np.testing.assert_allclose(carried_back(project(X), later, after_s, CAMERA, V_M_S, W_RAD_S), X[:, 2], atol=0.003)
    assert np.abs(later - X[:, 2]).max() > 0.03
    assert carried_back(project(X), np.zeros(100), after_s, CAMERA, V_M_S, W_RAD_S).max() == 0.0


@pytest.mark.parametrize("after_s", [-0.019, 0.019])
def test_features_get_the_depth_that_they_had(after_s: float) -> None:
    at_s, step_s = 0.4, 1e-3
    grey, true_m = look(swing(at_s))
    late_m = look(swing(at_s + after_s))[1]
    step = inverse(swing(at_s)) @ swing(at_s + step_s)
    R = step[:3, :3]
    velocity = Velocity(step[:3, 3] / step_s, np.array([R[2, 1], R[0, 2], R[1, 0]]) / step_s)
    extractor, lag = Extractor(INTRINSICS, FEW), Lag(INTRINSICS, camera_model(INTRINSICS, FEW), FEW, DepthNoise(0.6))
    wanted, features = extractor.extract(grey, true_m).depth, extractor.extract(grey, late_m)
    untold = np.median(np.abs(features.depth - wanted))
    lag.begin(late_m, after_s)
    lag.look_up(features, velocity, 0.0)
    assert untold > 0.01
    assert np.median(np.abs(features.depth - wanted)) < 0.1 * untold
    np.testing.assert_allclose(features.disparity, INTRINSICS.fx * FEW.baseline_m / features.depth)


def keyframes_depth_error_m(after_s: float, told_s: float) -> float:
    """Return how far off the depth of keyframes' features is, median, of a swinging camera with depth ``after_s`` late."""
    slam, off = Slam(INTRINSICS, FEW), []
    for k in range(16):
        at_s = k / RATE_HZ
        grey, true_m = look(swing(at_s))
        late_m = look(swing(at_s + after_s))[1]
        result = slam.track(round(at_s * 1e9), grey, late_m, depth_after_s=told_s)
        assert result.T_map_camera is not None
        if result.new_keyframes and k:
            kf, slot = slam.atlas.keyframes, slam.atlas.slot_of(result.new_keyframes[0].keyframe_id)
            column, row = np.round(kf.uv[slot, : kf.n[slot]]).astype(int).T
            has = kf.depth[slot, : kf.n[slot]] > 0.0
            off.append(np.abs(kf.depth[slot, : kf.n[slot]] - true_m[row, column])[has])
    return float(np.median(np.concatenate(off)))


@pytest.mark.parametrize("after_s", [-0.019, 0.019])
def test_a_lag_that_is_told_is_compensated_while_tracking(after_s: float) -> None:
    told, untold = keyframes_depth_error_m(after_s, after_s), keyframes_depth_error_m(after_s, 0.0)
    assert told < 0.3 * untold  # 2.0 and 2.5 mm to 11


def test_a_keyframe_never_gets_the_depth_of_another_ones_image() -> None:
    """The first keyframe's velocity never got known: the second frame came too late. Its image was kept for the next keyframe."""
    slam, made = Slam(INTRINSICS, FEW), dict[int, float]()
    stamps_s = [0.0, 0.5, *(0.57 + 0.07 * k for k in range(14))]
    for at_s in stamps_s:
        grey, depth_m = look(turned(at_s))
        result = slam.track(round(at_s * 1e9), grey, depth_m, depth_after_s=0.005)
        assert result.T_map_camera is not None
        made |= {new.keyframe_id: at_s for new in result.new_keyframes}
    kf, off_m = slam.atlas.keyframes, []
    for k in slam.atlas.slots:
        has = kf.depth[k, : kf.n[k]] > 0.0
        column, row = np.round(kf.uv[k, : kf.n[k]]).astype(int).T
        true_m = look(turned(made[int(kf.serial[k])]))[1][row, column]
        off_m.append(float(np.median(np.abs(kf.depth[k, : kf.n[k]] - true_m)[has])))
    assert len(off_m) > 2
    assert max(off_m) < 0.01


def turned(at_s: float) -> F64:
    return level_camera([0.0, 0.0, 0.0], np.radians(30.0) * at_s)
