"""gtsam as the oracle: our bundle adjustment ends at gtsam's optimum of the same problem."""

from __future__ import annotations

import numpy as np
import pytest

from services.slam import bundle
from services.slam.linear import step_pose
from tests.unit.test_slam_kernels import CAMERA, scene

gtsam = pytest.importorskip("gtsam")


def gtsam_optimum(problem: bundle.Problem, free: int) -> tuple[list[np.ndarray], np.ndarray, float]:
    """Return camera-from-map poses, points and twice the error at gtsam's optimum; cameras from ``free`` on are fixed."""
    fx, fy, cx, cy, bf = CAMERA
    stereo = gtsam.Cal3_S2Stereo(fx, fy, 0.0, cx, cy, bf / fx)
    mono = gtsam.Cal3_S2(fx, fy, 0.0, cx, cy)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for k, (R, t) in enumerate(zip(problem.R, problem.t, strict=True)):
        T = gtsam.Pose3(gtsam.Rot3(R), t).inverse()
        values.insert(gtsam.symbol("c", k), T)
        if k >= free:
            graph.add(gtsam.NonlinearEqualityPose3(gtsam.symbol("c", k), T))
    for m, X in enumerate(problem.X):
        values.insert(gtsam.symbol("x", m), X)
        for o in range(problem.start[m], problem.start[m + 1]):
            u, v, d = problem.obs[o]
            i_uv, i_d = problem.info[o]
            keys = gtsam.symbol("c", int(problem.pose[o])), gtsam.symbol("x", m)
            if i_d > 0.0:  # gtsam's right coordinate u - d shares u's noise
                a, b = 1.0 / i_uv, 1.0 / i_d
                noise = gtsam.noiseModel.Gaussian.Covariance(np.array([[a, a, 0.0], [a, a + b, 0.0], [0.0, 0.0, a]]))
                graph.add(gtsam.GenericStereoFactor3D(gtsam.StereoPoint2(u, u - d, v), noise, *keys, stereo))
            else:
                noise = gtsam.noiseModel.Isotropic.Sigma(2, i_uv**-0.5)
                graph.add(gtsam.GenericProjectionFactorCal3_S2(np.array([u, v]), noise, *keys, mono))
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(1e-12)
    parameters.setAbsoluteErrorTol(1e-12)
    best = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize()
    poses = [best.atPose3(gtsam.symbol("c", k)).inverse().matrix() for k in range(len(problem.R))]
    points = np.array([best.atPoint3(gtsam.symbol("x", m)) for m in range(len(problem.X))])
    return poses, points, 2.0 * graph.error(best)


@pytest.mark.parametrize("solve", [bundle.adjust, bundle.adjust_large])
def test_bundle_adjustment_ends_where_gtsam_ends(solve: object) -> None:
    assert callable(solve)
    rng = np.random.default_rng(12)
    _, _, X, problem = scene(rng, 4, 40)
    problem.obs[:] += rng.normal(0.0, [1.0, 1.0, 0.5], problem.obs.shape)
    for k in range(3):
        step_pose(problem.R[k], problem.t[k], rng.normal(0.0, 0.02, 6))
    problem.X[:] += rng.normal(0.0, 0.05, X.shape)
    poses, points, cost = gtsam_optimum(problem, 3)
    mine = cost + 1.0
    for _ in range(4):  # each call ends at a relative gain of 1e-5
        mine = solve(problem, CAMERA, 3, 40, robust=False)
    assert mine == pytest.approx(cost, rel=1e-5)
    for k, T in enumerate(poses):
        np.testing.assert_allclose(problem.R[k], T[:3, :3], atol=3e-4)
        np.testing.assert_allclose(problem.t[k], T[:3, 3], atol=1e-3)
    assert float(np.median(np.linalg.norm(problem.X - points, axis=1))) < 1e-3
