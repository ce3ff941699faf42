"""What is believed of a camera's depth: its noise is learned, and wild pixels count for nothing."""

from __future__ import annotations

import numpy as np
import pytest

from services.slam.bundle import disparity_residuals
from services.slam.depth_noise import DepthNoise
from services.slam.features import sample_depth
from tests.unit.test_slam_kernels import CAMERA, scene

BF = 42.0
SIGMA_PX = 0.6


def taught(sigma_px: float, assumed_px: float = SIGMA_PX) -> DepthNoise:
    noise, rng = DepthNoise(assumed_px), np.random.default_rng(1)
    for _ in range(60):
        noise.learn(np.where(rng.random(1000) < 0.05, 5.0, rng.normal(0.0, sigma_px, 1000)))
    return noise


def test_the_noise_is_learned_and_taken_twice() -> None:
    assert taught(0.17).sigma_px == pytest.approx(0.36, abs=0.03)


def test_it_is_never_believed_to_be_more_than_assumed_nor_almost_none() -> None:
    assert taught(2.0).sigma_px == SIGMA_PX
    assert taught(0.01).sigma_px == 0.2
    assert taught(0.01, assumed_px=0.1).sigma_px == 0.1


def test_a_few_observations_teach_nothing() -> None:
    noise = DepthNoise(SIGMA_PX)
    noise.learn(np.zeros(50))
    assert noise.sigma_px == SIGMA_PX


def sampled(depth_m: np.ndarray, x: float = 20.0, y: float = 20.0) -> tuple[float, float]:
    z, info, _ = sample_depth(depth_m, np.array([[x, y]]), 0.3, 80.0, BF, SIGMA_PX)
    return float(z[0]), float(info[0])


def test_wild_pixels_beside_a_corner_do_not_make_its_depth_doubtful() -> None:
    depth_m = np.full((40, 40), 3.0, np.float32)
    calm = sampled(depth_m)
    depth_m[18, 22], depth_m[22, 19] = 0.6, 7.5
    assert sampled(depth_m) == calm
    assert calm == pytest.approx((3.0, 1.0 / SIGMA_PX**2))


def test_a_wild_pixel_under_a_corner_is_no_depth() -> None:
    depth_m = np.full((40, 40), 3.0, np.float32)
    depth_m[20, 20] = 0.7
    assert sampled(depth_m) == (0.0, 0.0)


def test_an_edge_beside_a_corner_makes_its_depth_doubtful() -> None:
    depth_m = np.full((40, 40), 3.0, np.float32)
    depth_m[:, 22:] = 6.0
    z, info = sampled(depth_m)
    assert z == 3.0
    assert info == pytest.approx(1.0 / (SIGMA_PX**2 + (0.5 * (BF / 3.0 - BF / 6.0)) ** 2), rel=1e-3)


def test_a_thin_branch_has_a_depth() -> None:
    depth_m = np.full((40, 40), 6.0, np.float32)
    depth_m[:, 19:22] = 2.0
    assert sampled(depth_m)[0] == 2.0


def test_what_is_believed_of_far_points_teaches_nothing_of_the_depths_noise() -> None:
    rng = np.random.default_rng(4)
    _, _, _, problem = scene(rng, 3, 40)
    problem.info[:, 1] = 4.0
    problem.obs[:, 2] += 0.1
    measured = np.arange(40) < 30
    problem.obs[90:, 2] += 5.0  # of the last ten points
    found = disparity_residuals(problem, CAMERA, 1.0, measured)
    assert len(found) == 90
    assert found == pytest.approx(np.full(90, 0.1), abs=1e-9)
    assert not len(disparity_residuals(problem, CAMERA, 5.0, measured))
