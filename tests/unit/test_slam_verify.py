"""What slam does not believe: impossible motion, views that depth contradicts; and the seeded faults of the bench."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from schemas.camera import Intrinsics
from services.common.geometry import exp_rotation, inverse, pose
from services.evaluate.slam_stress import FAULTS
from services.evaluate.slam_turns import Shot, mean_alignment, pose_errors
from services.slam.camera import camera_model
from services.slam.config import SlamConfig
from services.slam.features import Features
from services.slam.motion import Motion
from services.slam.tracking import Tracked
from services.slam.verify import Verifier, compare_depth

F64 = NDArray[np.float64]
CAMERA = Intrinsics(width=320, height=240, fx=250.0, fy=250.0, cx=159.5, cy=119.5)
PERIOD_NS = 66_666_667


def constant_velocity(seed: int) -> F64:
    rng = np.random.default_rng(seed)
    return pose(exp_rotation(rng.normal(0.0, 0.03, 3)), rng.normal(0.0, 0.02, 3))


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**31), missed=st.integers(0, 3))
def test_motion_goes_on_over_missing_frames(seed: int, missed: int) -> None:
    motion, step = Motion(), constant_velocity(seed)
    motion.update(0, None)
    motion.update(PERIOD_NS, step)
    stamp_ns = (2 + missed) * PERIOD_NS
    ahead = motion.predict(stamp_ns)
    np.testing.assert_allclose(ahead[:3, 3], (1 + missed) * step[:3, 3], atol=1e-9)
    np.testing.assert_allclose(ahead[:3, :3], np.linalg.matrix_power(step[:3, :3], 1 + missed), atol=1e-7)
    assert motion.plausible(stamp_ns, ahead)


def test_a_leap_is_not_plausible_and_time_makes_it_so() -> None:
    motion = Motion()
    motion.update(0, None)
    motion.update(PERIOD_NS, np.eye(4))
    leap = pose(np.eye(3), [0.5, 0.0, 0.0])
    assert not motion.plausible(2 * PERIOD_NS, leap)
    assert motion.plausible(10 * PERIOD_NS, leap)
    assert not motion.plausible(2 * PERIOD_NS, pose(exp_rotation([0.0, 1.0, 0.0]), np.zeros(3)))


def test_an_old_velocity_is_forgotten() -> None:
    motion = Motion()
    motion.update(0, None)
    motion.update(PERIOD_NS, constant_velocity(1))
    np.testing.assert_array_equal(motion.predict(20 * PERIOD_NS), np.eye(4))


@pytest.mark.parametrize(("depth", "index"), [(2.0, 0), (6.0, 1), (0.7, 2), (0.0, None)])
def test_depth_confirms_sees_through_or_is_in_front(depth: float, index: int | None) -> None:
    model = camera_model(CAMERA, SlamConfig())
    place = np.array([[100.0, 80.0, model.array[4] / 2.0], [np.nan, 0.0, 0.0], [500.0, 20.0, 1.0]])
    counts = np.zeros(3, np.int64)
    compare_depth(place, np.full((240, 320), depth, np.float32), model.array, np.zeros(5), counts)
    expected = np.zeros(3, np.int64)
    if index is not None:
        expected[index] = 1
    np.testing.assert_array_equal(counts, expected)


def tracked(inliers: int, expected: int, place: F64, close: int = 20) -> Tracked:
    """Return a frame with so many matches that have measured depth."""
    ones, none = np.ones(close), np.zeros(0, np.int32)
    features = Features(
        np.zeros((close, 2)), np.zeros(close, np.int32), 0.0 * ones, np.zeros((close, 4), np.uint64), 2.0 * ones, ones,
        np.zeros(close, bool), ones, none, none,
    )  # fmt: skip
    point = np.arange(close, dtype=np.int32)
    return Tracked(features, np.eye(3), np.zeros(3), point, inliers, None, 0.0, place, expected)


def test_a_view_that_depth_sees_through_is_not_believed() -> None:
    model = camera_model(CAMERA, SlamConfig())
    verifier = Verifier(CAMERA, model)
    rng = np.random.default_rng(2)
    place = np.column_stack([rng.uniform(20, 300, 80), rng.uniform(20, 220, 80), np.full(80, model.array[4] / 2.0)])
    depth_m = np.full((240, 320), 2.0, np.float32)
    assert verifier.believes(tracked(200, 300, place), depth_m, blind=True)
    assert not verifier.believes(tracked(200, 300, place), 3.0 * depth_m, blind=False)
    assert not verifier.believes(tracked(46, 900, place), depth_m, blind=True)
    assert not verifier.believes(tracked(200, 300, place, close=19), depth_m, blind=True)
    assert verifier.believes(tracked(200, 300, place, close=19), depth_m, blind=False)
    assert verifier.sure(tracked(200, 300, place))
    assert not verifier.sure(tracked(60, 100, place))


@pytest.mark.parametrize("name", FAULTS)
def test_faults_spoil_the_same_way_twice_and_leave_the_original(name: str) -> None:
    rng = np.random.default_rng(5)
    grey = rng.integers(0, 255, (480, 640), dtype=np.uint8)
    depth_m = rng.uniform(0.5, 8.0, (480, 640)).astype(np.float32)
    shot = Shot(0, grey.copy(), depth_m.copy(), None, np.eye(4))
    made = [FAULTS[name].spoil(shot, 4, np.random.default_rng(7)) for _ in range(2)]
    np.testing.assert_array_equal(shot.grey, grey)
    np.testing.assert_array_equal(shot.depth_m, depth_m)
    if made[0] is None or made[1] is None:
        assert made == [None, None]
        return
    for a, b in zip(*made, strict=True):
        np.testing.assert_array_equal(a, b)
    if name.startswith("30 %"):
        return
    assert not np.array_equal(made[0][0], grey)
    assert made[0][0].dtype == np.uint8


def test_alignment_by_mean_rotation_finds_a_known_transform() -> None:
    rng = np.random.default_rng(4)
    A = pose(exp_rotation([0.1, -0.3, 2.0]), [1.0, 2.0, 3.0])
    mine = [pose(exp_rotation(rng.normal(0.0, 1.0, 3)), rng.normal(0.0, 0.02, 3)) for _ in range(30)]
    true = [A @ m for m in mine]
    np.testing.assert_allclose(mean_alignment(mine, true), A, atol=1e-9)
    np.testing.assert_allclose(pose_errors(mine, true, A), 0.0, atol=1e-7)
    np.testing.assert_allclose(inverse(A) @ A, np.eye(4), atol=1e-12)
