"""The refiner's measurements correct the map's trees: by view, by covariance, never twice."""

from __future__ import annotations

import numpy as np
import pytest

from schemas.slam import Pose
from schemas.trees import Target, Tree
from services.common.geometry import Matrix, inverse, level_camera, pose, rotation_z, to_transform
from services.detector.config import FusionConfig
from services.detector.fusion import Fusion
from services.detector.refine.correction import Correction
from services.detector.refine.model import ExpectedTree

CONFIG = FusionConfig()
TREE = Tree(
    id=4, x_m=2.0, y_m=0.0, z_m=0.0, axis=(0.0, 0.0, 1.0), radius_m=0.10, radius_height_m=1.3, height_seen_m=2.0,
    sigma_xy_m=0.02, sigma_radius_m=0.01, arc_rad=2.0, confidence=0.9, observations=5, suitable=True,
)  # fmt: skip
TRUE = np.array([2.03, -0.02])
KEYFRAMES = {k: level_camera((0.1 * k, 0.2 * k, 1.5), 0.1 * k) for k in range(6)}


def _pose(stamp_ns: int, keyframe: int, T: Matrix | None = None, map_id: str = "m") -> Pose:
    T = KEYFRAMES[keyframe] if T is None else T
    return Pose(
        stamp_ns=stamp_ns, seq=1, map_id=map_id, status="tracking", T_map_camera=to_transform(T), covariance=None,
        reset_counter=0, graph_version=1, keyframe_id=keyframe,
        T_keyframe_camera=to_transform(inverse(KEYFRAMES[keyframe]) @ T), inliers=99, up_sigma_rad=0.01, processing_ms=1.0,
    )  # fmt: skip


def _target(stamp_ns: int, place: np.ndarray, *, sigma_m: float = 0.01, map_id: str = "m", seen: bool = True) -> Target:
    return Target(
        stamp_ns=stamp_ns, seq=1, map_id=map_id, status="tracking", tree_id=4, measured=seen, bearing_rad=0.0, range_m=2.0,
        radius_m=0.11, image_x_px=320.0, sigma_bearing_rad=0.002, sigma_range_m=0.01, sigma_radius_m=0.004,
        raw_image_x_px=320.0, raw_range_m=2.0, raw_radius_m=0.11, position_map_m=(float(place[0]), float(place[1])),
        covariance_map_m2=(sigma_m**2, 0.0, sigma_m**2),
    )  # fmt: skip


def _fed(keyframes: range, frames: int, place: np.ndarray = TRUE) -> Fusion:
    fusion = Fusion(CONFIG)
    fusion.clear("m")
    for keyframe in keyframes:
        for k in range(frames):
            stamp = 1000 * keyframe + k + 1
            fusion.on_pose(_pose(stamp, keyframe))
            assert fusion.on_target(_target(stamp, place))
    return fusion


def _error(tree: Tree) -> float:
    return float(np.hypot(tree.x_m - TRUE[0], tree.y_m - TRUE[1]))


def test_a_tree_moves_towards_what_was_measured_and_is_surer_of_it() -> None:
    after = _fed(range(1), 5).corrected(TREE, KEYFRAMES)
    assert _error(after) < 0.5 * _error(TREE)
    assert after.sigma_xy_m < TREE.sigma_xy_m
    assert 0.10 < after.radius_m < 0.11
    assert after.sigma_radius_m < TREE.sigma_radius_m
    assert after.z_m == TREE.z_m


def test_frames_of_one_view_count_once_and_views_add_up_to_the_floor() -> None:
    one, many = (_fed(range(1), n).corrected(TREE, KEYFRAMES).sigma_xy_m for n in (3, 300))
    assert many == pytest.approx(one)
    six = _fed(range(6), 5).corrected(TREE, KEYFRAMES).sigma_xy_m
    assert CONFIG.common_xy_m <= six < one


def test_what_all_views_share_is_the_floor() -> None:
    sure = TREE.model_copy(update={"sigma_xy_m": 0.010, "sigma_radius_m": 0.001})
    after = _fed(range(6), 50).corrected(sure, KEYFRAMES)
    assert after.sigma_xy_m == pytest.approx(CONFIG.common_xy_m)
    assert after.sigma_radius_m == 0.001, "never less sure than the cloud was"


def test_few_frames_say_nothing() -> None:
    assert _fed(range(1), CONFIG.min_frames - 1).corrected(TREE, KEYFRAMES) == TREE


def test_the_place_follows_the_keyframe() -> None:
    move = pose(rotation_z(0.2), [0.5, -0.3, 0.1])
    fusion = _fed(range(2), 5)
    moved = {k: move @ T for k, T in KEYFRAMES.items()}
    x, y, z = (move @ np.array([TREE.x_m, TREE.y_m, TREE.z_m, 1.0]))[:3]
    before, after = (
        fusion.corrected(TREE, KEYFRAMES),
        fusion.corrected(TREE.model_copy(update={"x_m": x, "y_m": y, "z_m": z}), moved),
    )
    there = move @ np.array([before.x_m, before.y_m, before.z_m, 1.0])
    assert (after.x_m, after.y_m) == pytest.approx((there[0], there[1]), abs=1e-9)


def test_without_its_keyframe_a_view_says_nothing() -> None:
    assert _fed(range(1), 5).corrected(TREE, {7: KEYFRAMES[1]}) == TREE


def test_what_does_not_belong_is_refused() -> None:
    fusion = Fusion(CONFIG)
    fusion.clear("m")
    fusion.on_pose(_pose(1, 0))
    assert not fusion.on_target(_target(2, TRUE))
    assert not fusion.on_target(_target(1, TRUE, seen=False))
    assert not fusion.on_target(_target(1, TRUE, map_id="other"))
    assert not fusion.on_target(_target(1, TRUE, sigma_m=0.0))
    fusion.on_pose(_pose(3, 0, map_id="other"))
    assert not fusion.on_target(_target(3, TRUE))
    assert fusion.corrected(TREE, KEYFRAMES) == TREE


def test_a_view_of_something_else_moves_nothing() -> None:
    far = np.array([2.0 + CONFIG.max_shift_m + 0.05, 0.0])
    assert _fed(range(2), 5, far).corrected(TREE, KEYFRAMES) == TREE


def test_a_new_map_forgets() -> None:
    fusion = _fed(range(1), 5)
    fusion.clear("n")
    assert fusion.corrected(TREE, KEYFRAMES) == TREE


def test_a_correction_that_the_list_took_over_is_not_added_again() -> None:
    old = ExpectedTree(4, 2.0, 0.0, 0.0, (0.0, 0.0, 1.0), 0.10, 0.02, 0.01)
    new = ExpectedTree(4, 2.02, -0.01, 0.0, (0.0, 0.0, 1.0), 0.105, 0.01, 0.005)
    correction = Correction(np.array([0.03, -0.02]), np.eye(2) * 1e-4, 0.008, 1e-5)
    before, after = correction.applied(old), correction.rebased(old, new).applied(new)
    assert (after.x_m, after.y_m, after.radius_m) == pytest.approx((before.x_m, before.y_m, before.radius_m))
