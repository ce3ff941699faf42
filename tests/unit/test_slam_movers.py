"""What moves by itself is noticed, remembered, and takes no part in the map."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from services.common.geometry import inverse, level_camera
from services.slam.config import SlamConfig
from services.slam.features import grid_of
from services.slam.movers import doubts, suspects, usual_off
from services.slam.slam import Slam
from tests.unit.slam_room import INTRINSICS, look

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
U8 = NDArray[np.uint8]

SOMEBODY = slice(0, 60)


def crowd(seed: int = 1) -> tuple[F64, F64]:
    """Places (200, 2) and disparities (200,) of features: the first 60 near and in one part of the image."""
    rng = np.random.default_rng(seed)
    uv = rng.uniform([0.0, 0.0], [640.0, 480.0], (200, 2))
    uv[SOMEBODY] = rng.uniform([200.0, 100.0], [300.0, 400.0], (60, 2))
    disparity = rng.uniform(8.0, 12.0, 200)
    disparity[SOMEBODY] = 28.0
    return uv, disparity


def still(seed: int = 2) -> F64:
    return np.random.default_rng(seed).normal(0.0, 1.5, (200, 2))


def judged(uv: F64, disparity: F64, off: F64, before: F64) -> F64:
    return suspected(uv, disparity, off, np.full(200, 0.05), before)


def suspected(uv: F64, disparity: F64, off: F64, doubt: F64, before: F64) -> F64:
    return suspects(uv, disparity, *grid_of(uv, 32, 24), 32, off, usual_off(off, before), doubt, before)


def test_neighbours_that_are_off_together_are_suspects_and_nothing_else_is() -> None:
    uv, disparity = crowd()
    off = still()
    off[SOMEBODY] += [4.0, -1.0]
    found = judged(uv, disparity, off, np.zeros(200))
    assert (found[SOMEBODY] > 0.0).all()
    assert not found[60:].any()


def test_noise_and_wrong_matches_make_no_suspects() -> None:
    uv, disparity = crowd()
    off = still()
    wrong = np.random.default_rng(3).random(200) < 0.2
    off[wrong] = np.random.default_rng(4).uniform(-15.0, 15.0, (200, 2))[wrong]
    assert not judged(uv, disparity, off, np.zeros(200)).any()


def test_who_moved_a_moment_ago_stays_a_suspect_and_so_do_his_new_features() -> None:
    uv, disparity = crowd()
    off, before = still(), np.zeros(200)
    before[SOMEBODY] = 0.7
    before[:15] = 0.0
    off[:15] = np.nan  # new: not seen in the last frame
    found = judged(uv, disparity, off, before)
    assert (found[SOMEBODY] > 0.6).all()
    assert found.max() < 0.71
    assert not found[60:].any()


def test_what_has_no_depth_is_no_suspect() -> None:
    uv, disparity = crowd()
    disparity[SOMEBODY] = 0.0
    off = still()
    off[SOMEBODY] += [4.0, -1.0]
    assert not judged(uv, disparity, off, np.zeros(200)).any()


def test_in_a_smeared_image_where_all_is_off_nobody_is_a_suspect() -> None:
    uv, disparity = crowd()
    off = 4.0 * still()
    off[SOMEBODY] += [4.0, -1.0]
    assert not judged(uv, disparity, off, np.zeros(200)).any()


def test_a_pose_in_doubt_suspects_nobody_new_but_frees_nobody_either() -> None:
    uv, disparity = crowd()
    off, before = still(), np.zeros(200)
    off[SOMEBODY] += [4.0, -1.0]
    doubt = np.full(200, 4.0)
    assert not suspected(uv, disparity, off, doubt, before).any()
    before[SOMEBODY] = 0.1
    assert (suspected(uv, disparity, off, doubt, before)[SOMEBODY] > 1.0).all()


def test_the_doubt_of_a_place_is_what_the_poses_error_moves_it_by() -> None:
    camera = np.array([500.0, 500.0, 320.0, 240.0, 40.0])
    sideways = np.diag([0.01**2, 0.0, 0.0, 0.0, 0.0, 0.0])
    found = doubts(
        np.array([[320.0, 240.0], [400.0, 100.0], [10.0, 10.0]]), np.array([1.0, 2.0, 0.0]), sideways, camera
    )
    assert found == pytest.approx([5.0**2, 2.5**2, 0.0])


def with_somebody(grey: U8, depth_m: F32, left: int) -> tuple[U8, F32]:
    """Somebody in patterned clothes before the camera, 85 pixels wide from column ``left`` on."""
    cloth = np.kron(np.random.default_rng(17).integers(30, 226, (48, 17)), np.ones((5, 5))).astype(np.uint8)
    grey, depth_m = grey.copy(), depth_m.copy()
    a, b = max(left, 0), min(left + 85, grey.shape[1])
    if a < b:
        grey[20:, a:b] = cloth[: grey.shape[0] - 20, a - left : b - left]
        depth_m[20:, a:b] = 1.0
    return grey, depth_m


def test_somebody_who_walks_by_does_not_take_the_map_along() -> None:
    slam = Slam(INTRINSICS, SlamConfig(features=400, disparity_sigma_px=0.15))
    poses = [level_camera([0.0, 0.0, 0.0], np.radians(0.8 * k)) for k in range(55)]
    off_m = []
    for k, T in enumerate(poses):
        seen = with_somebody(*look(T), -85 + 9 * (k - 10))
        result = slam.track(k * 66_666_667, *seen, np.array([0.0, -9.81, 0.0]))
        assert result.T_map_camera is not None
        here = inverse(slam.mapping.keyframe_pose(0)) @ result.T_map_camera
        off_m.append(float(np.linalg.norm((here @ inverse(inverse(poses[0]) @ T))[:3, 3])))
    assert max(off_m) < 0.1  # until he is noticed; 1.04 m when he was not
    assert max(off_m[20:]) < 0.04
