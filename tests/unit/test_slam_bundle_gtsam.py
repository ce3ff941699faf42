"""Bundle adjustment against gtsam: the same observations, the same optimum."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from services.slam import bundle
from services.slam.linear import step_pose
from tests.unit.test_slam_kernels import CAMERA, scene

F64 = NDArray[np.float64]

FREE = 4


def by_gtsam(problem: bundle.Problem) -> tuple[F64, F64, F64]:
    """Return gtsam's rotations, translations and points; (u, v, d) become left, right and row with their joint covariance."""
    gtsam = pytest.importorskip("gtsam")
    fx, fy, cx, cy, bf = (float(c) for c in CAMERA)
    K = gtsam.Cal3_S2Stereo(fx, fy, 0.0, cx, cy, bf / fx)
    to_stereo = np.array([[1.0, 0.0, 0.0], [1.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    graph, start = gtsam.NonlinearFactorGraph(), gtsam.Values()
    pose_key, point_key = gtsam.symbol_shorthand.X, gtsam.symbol_shorthand.L
    for k in range(len(problem.R)):
        start.insert(pose_key(k), gtsam.Pose3(gtsam.Rot3(problem.R[k].T), -problem.R[k].T @ problem.t[k]))
    for k in range(FREE, len(problem.R)):
        graph.add(gtsam.NonlinearEqualityPose3(pose_key(k), start.atPose3(pose_key(k))))
    for m, X in enumerate(problem.X):
        start.insert(point_key(m), X)
        for o in range(problem.start[m], problem.start[m + 1]):
            weight = problem.info[o]
            covariance = to_stereo @ np.diag([1.0 / weight[0], 1.0 / weight[0], 1.0 / weight[1]]) @ to_stereo.T
            left, right, row = to_stereo @ problem.obs[o]
            noise = gtsam.noiseModel.Gaussian.Covariance(covariance)
            graph.add(gtsam.GenericStereoFactor3D(
                gtsam.StereoPoint2(left, right, row), noise, pose_key(int(problem.pose[o])), point_key(m), K
            ))  # fmt: skip
    found = gtsam.LevenbergMarquardtOptimizer(graph, start).optimize()
    poses = [found.atPose3(pose_key(k)) for k in range(len(problem.R))]
    R = np.stack([p.rotation().matrix().T for p in poses])
    t = np.stack([-M @ p.translation() for M, p in zip(R, poses, strict=True)])
    return R, t, np.stack([found.atPoint3(point_key(m)) for m in range(len(problem.X))])


@pytest.mark.parametrize("solve", [bundle.adjust, bundle.adjust_large])
def test_the_same_optimum_as_gtsam(solve: object) -> None:
    assert callable(solve)
    rng = np.random.default_rng(21)
    R, t, X, problem = scene(rng, 5, 40)
    problem.info[:, 1] = 4.0
    problem.obs[:] += rng.normal(0.0, [1.0, 1.0, 0.5], problem.obs.shape)
    for k in range(FREE):
        step_pose(problem.R[k], problem.t[k], rng.normal(0.0, 0.02, 6))
    problem.X[:] += rng.normal(0.0, 0.05, X.shape)
    theirs = by_gtsam(problem)
    cost = solve(problem, CAMERA, FREE, 30, robust=False)
    best = problem._replace(R=theirs[0], t=theirs[1], X=theirs[2])
    assert cost == pytest.approx(bundle.chi_squares(best, CAMERA).sum(), rel=1e-4)
    np.testing.assert_allclose(problem.t, theirs[1], atol=2e-4)
    np.testing.assert_allclose(problem.R, theirs[0], atol=2e-4)
    np.testing.assert_allclose(problem.X, theirs[2], atol=2e-3)
    assert np.abs(problem.t - t).max() > 1e-3, "noise has moved the optimum off the truth"
    assert np.abs(R - problem.R).max() < 0.05
