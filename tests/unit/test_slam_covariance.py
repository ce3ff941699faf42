"""What slam tells of its doubt: a frame's information against drawn noise, and the covariance of the published pose."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from services.common.geometry import exp_rotation
from services.slam.linear import log_so3
from services.slam.refine import refine_pose
from services.slam.results import map_covariance

F64 = NDArray[np.float64]
CAMERA = np.array([500.0, 500.0, 320.0, 240.0, 40.0])
SIGMA_PX, SIGMA_D_PX = 1.0, 0.6
FRAMES, POINTS = 300, 120


def seen(X: F64, R: F64, t: F64) -> F64:
    """Return (N, 3) u, v, disparity of map points."""
    c = X @ R.T + t
    return np.column_stack([
        CAMERA[0] * c[:, 0] / c[:, 2] + CAMERA[2], CAMERA[1] * c[:, 1] / c[:, 2] + CAMERA[3], CAMERA[4] / c[:, 2],
    ])  # fmt: skip


def located(rng: np.random.Generator, R: F64, t: F64) -> tuple[F64, F64]:
    """Return the error (6,) of a pose refined from noisy matches, in the map's axes, and its information (6, 6)."""
    c = np.column_stack([rng.uniform(-1.0, 1.0, POINTS), rng.uniform(-0.8, 0.8, POINTS), rng.uniform(1.5, 6.0, POINTS)])
    c[:, :2] *= 0.5 * c[:, 2:]
    X = (c - t) @ R
    obs = seen(X, R, t) + rng.normal(size=(POINTS, 3)) * [SIGMA_PX, SIGMA_PX, SIGMA_D_PX]
    info = np.tile([SIGMA_PX**-2, SIGMA_D_PX**-2], (POINTS, 1))
    R_found, t_found, H = R.copy(), t.copy(), np.zeros((6, 6))
    refine_pose(R_found, t_found, X, obs, info, CAMERA, np.ones(POINTS, np.bool_), H, 4)
    moved = -R_found.T @ t_found + R.T @ t
    return np.concatenate([moved, log_so3(np.ascontiguousarray(R_found.T @ R))]), H


def ratios(errors: F64, covariances: F64) -> F64:
    """Return (6,) the mean squared error over the variance told."""
    return np.asarray(np.mean(errors**2 / np.diagonal(covariances, axis1=1, axis2=2), axis=0))


def test_a_frames_information_is_what_the_noise_of_its_matches_gives() -> None:
    rng = np.random.default_rng(5)
    R, t = exp_rotation([0.3, -0.8, 0.2]), np.array([0.4, -0.3, 0.7])
    drawn = [located(rng, R, t) for _ in range(FRAMES)]
    errors = np.stack([e for e, _ in drawn])
    turn = np.kron(np.eye(2), R.T)
    covariances = np.stack([turn @ np.linalg.inv(H) @ turn.T for _, H in drawn])
    found = ratios(errors, covariances)
    assert found.min() > 0.7
    assert found.max() < 1.5


def test_the_covariance_told_is_never_less_than_the_frames_own_and_grows_with_its_doubt() -> None:
    R = exp_rotation([0.3, -0.8, 0.2])
    turn = np.kron(np.eye(2), R.T)
    well, badly = np.diag([4e6, 4e6, 1e6, 9e7, 9e7, 9e7]), np.diag([4e2, 4e2, 1e2, 9e3, 9e3, 9e3])
    for information in (well, badly):
        told, own = map_covariance(R, information), turn @ np.linalg.inv(information) @ turn.T
        np.testing.assert_allclose(told, told.T)
        assert np.linalg.eigvalsh(told - own).min() > 0.0
    assert np.linalg.eigvalsh(map_covariance(R, badly) - map_covariance(R, well)).min() > 0.0
