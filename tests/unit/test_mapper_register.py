"""Registration brings a cloud back onto the submap, and never makes things worse."""

from __future__ import annotations

import numpy as np
import pytest

from schemas.camera import Intrinsics
from services.common.geometry import exp_rotation, inverse, level_camera, log_rotation, pose
from services.mapper.cloud import KeyframeCloud, pixel_rays
from services.mapper.config import MapperConfig
from services.mapper.dense_map import DenseMap
from services.mapper.local_submap import LocalSubmap
from services.mapper.register import Placed, RangeView, Registration, range_view, register
from services.mapper.register_kernels import accumulate

K = Intrinsics(width=320, height=240, fx=250.0, fy=250.0, cx=159.5, cy=119.5)
RAYS = pixel_rays(K)
SLOPE = 0.002
SIGMA = np.array([0.02] * 3 + [0.01] * 3)


def view(T: np.ndarray, seed: int, trunks: bool = True) -> RangeView:
    """Return what a camera sees of a hummocky ground, a wall and trunks, with noise."""
    rays = np.dstack([RAYS.astype(float), np.ones(RAYS.shape[:2])]) @ T[:3, :3].T
    at = T[:3, 3]
    depth = np.full(RAYS.shape[:2], 20.0)
    depth = np.where(rays[..., 2] < -1e-3, np.minimum(depth, -at[2] / np.minimum(rays[..., 2], -1e-3)), depth)
    if trunks:
        for x, y, radius in ((3.0, 0.4, 0.15), (3.5, -1.0, 0.2), (4.5, 1.2, 0.15), (2.6, -0.3, 0.1)):
            away = np.array([x, y]) - at[:2]
            a = (rays[..., :2] ** 2).sum(axis=2)
            b = rays[..., :2] @ away
            inside = b * b - a * (away @ away - radius**2)
            hit = (b - np.sqrt(np.maximum(inside, 0.0))) / a
            depth = np.where((inside > 0) & (b > 0), np.minimum(depth, hit), depth)
    depth += np.random.default_rng(seed).normal(0.0, 1.0, depth.shape) * SLOPE * depth**2
    depth[depth > 6.0] = 0.0
    return range_view(depth.astype(np.float32), RAYS, (K.fx, K.fy, K.cx, K.cy), SLOPE)


def far(a: np.ndarray, b: np.ndarray) -> tuple[float, float]:
    d = inverse(a) @ b
    return float(np.linalg.norm(d[:3, 3])), float(np.linalg.norm(log_rotation(d[:3, :3])))


TRUE = level_camera([0.1, 0.0, 1.5], 0.05)


def from_wrong(error: np.ndarray, sigma: np.ndarray = SIGMA) -> tuple[Registration, np.ndarray]:
    references = [Placed(view(T, seed), T) for seed, T in enumerate((level_camera([0, 0, 1.5], 0.0), level_camera([0, 0.1, 1.5], 0.15)))]  # fmt: skip
    wrong = pose(exp_rotation(error[3:]) @ TRUE[:3, :3], TRUE[:3, 3] + error[:3])
    return register(view(TRUE, 9), wrong, references, sigma, SLOPE), wrong


@pytest.mark.parametrize("seed", range(4))
def test_a_wrong_pose_comes_closer(seed: int) -> None:
    error = np.random.default_rng(seed).normal(size=6) * SIGMA
    result, wrong = from_wrong(error)
    before, after = far(TRUE, wrong), far(TRUE, result.T_correction @ wrong)
    assert result.accepted
    assert result.cost_after < result.cost_before
    assert after[0] < 0.6 * before[0] + 0.004
    assert after[1] < 0.6 * before[1] + 0.001


def test_a_right_pose_stays() -> None:
    result, wrong = from_wrong(np.zeros(6))
    assert far(TRUE, result.T_correction @ wrong)[0] < 0.004
    assert far(TRUE, result.T_correction @ wrong)[1] < 0.002


def test_an_unlikely_correction_is_refused() -> None:
    result, _ = from_wrong(np.array([0.08, 0.06, 0.08, 0.0, 0.03, 0.0]), SIGMA / 40.0)
    assert far(np.eye(4), result.T_correction)[0] < 6.0 * float(SIGMA[0]) / 40.0, "never beyond what the pose allows"


def test_nothing_in_common_is_not_registered() -> None:
    there = level_camera([0, 0, 1.5], np.pi)
    result = register(view(TRUE, 1), TRUE, [Placed(view(there, 2), there)], SIGMA, SLOPE)
    assert not result.accepted
    assert (result.T_correction == np.eye(4)).all()


def test_the_gradient_is_that_of_the_cost() -> None:
    """Numeric check of the analytic Jacobian: half the gradient of the sum of squares, small residuals."""
    reference, T_ref = view(level_camera([0, 0, 1.5], 0.0), 1), level_camera([0, 0, 1.5], 0.0)
    source, wide = view(TRUE, 2), 1e4
    centre = TRUE[:3, 3].copy()

    def at(delta: np.ndarray) -> tuple[float, np.ndarray]:
        R = exp_rotation(delta[3:])
        T = pose(R, centre + delta[:3] - R @ centre) @ TRUE
        A, g = np.zeros((6, 6)), np.zeros(6)
        cost, n = accumulate(
            source.points_m, inverse(T_ref) @ T, np.ascontiguousarray(T_ref[:3, :3]), T_ref[:3, 3].copy(), centre,
            reference.points_m, reference.normals, *reference.focal_px, 0.0, 0.05, wide, 0, A, g,
        )  # fmt: skip
        return float(cost) * wide**2 / 3.0 / n, g / n

    zero = np.zeros(6)
    _, g = at(zero)
    step = 2e-6  # so small that hardly any pixel falls on another one of the reference
    for k in range(6):
        ahead, behind = zero.copy(), zero.copy()
        ahead[k], behind[k] = step, -step
        numeric = (at(ahead)[0] - at(behind)[0]) / (2 * step) / 2.0
        assert g[k] == pytest.approx(numeric, rel=0.1, abs=0.05 * float(np.abs(g).max())), k


def test_the_local_submap_keeps_a_bounded_number_of_different_views() -> None:
    config = MapperConfig(registration_views=12)
    local, dense = LocalSubmap(config), DenseMap(config)
    cloud = KeyframeCloud(np.ones((1, 3), dtype=np.float32), np.zeros((1, 3), dtype=np.uint8))
    one = view(TRUE, 0)
    for number in range(30):
        yaw = 0.0 if number % 2 else number * 0.2
        dense.add(number, number, cloud, level_camera([0, 0, 1.5], yaw))
        local.keep(number, one, dense.submaps)
    yaws = [0.0 if k % 2 else k * 0.2 for k in local._views]
    assert len(yaws) == 12
    assert sum(y == 0.0 for y in yaws) <= 5, "the redundant ones went first"
