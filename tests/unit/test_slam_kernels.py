"""slam's kernels: rotations, Jacobians, pose refinement, bundle adjustment, pose graph."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from services.common.geometry import exp_rotation, log_rotation
from services.slam import bundle, observe, posegraph
from services.slam.linear import cholesky_solve, exp_so3, log_so3, step_pose
from services.slam.refine import accumulate, refine_pose

F64 = NDArray[np.float64]
CAMERA = np.array([500.0, 505.0, 320.0, 240.0, 40.0])
STEP = 1e-6


def random_rotation(rng: np.random.Generator, size: float = 1.0) -> F64:
    return exp_rotation(rng.normal(0.0, size, 3))


def observed(R: F64, t: F64, X: F64) -> F64:
    c = X @ R.T + t
    return np.column_stack([
        CAMERA[0] * c[:, 0] / c[:, 2] + CAMERA[2], CAMERA[1] * c[:, 1] / c[:, 2] + CAMERA[3], CAMERA[4] / c[:, 2]
    ])  # fmt: skip


def moved(R: F64, t: F64, delta: F64) -> tuple[F64, F64]:
    R, t = R.copy(), t.copy()
    step_pose(R, t, delta)
    return R, t


def test_exp_and_log_agree_with_the_geometry_module() -> None:
    rng = np.random.default_rng(1)
    for size in (1e-9, 1e-4, 0.1, 1.0, math.pi - 1e-3):
        w = rng.normal(size=3)
        w *= size / np.linalg.norm(w)
        R = exp_so3(w[0], w[1], w[2])
        np.testing.assert_allclose(R, exp_rotation(w), atol=1e-12)
        np.testing.assert_allclose(log_so3(R), w, atol=1e-7)
        np.testing.assert_allclose(log_so3(R), log_rotation(R), atol=1e-7)


def test_rotation_stays_orthonormal_over_100000_updates() -> None:
    rng = np.random.default_rng(2)
    R, t = np.eye(3), np.zeros(3)
    for delta in rng.normal(0.0, 0.02, (100_000, 6)):
        step_pose(R, t, delta)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) == pytest.approx(1.0, abs=1e-12)


def test_step_pose_follows_the_truth_over_many_steps() -> None:
    rng = np.random.default_rng(3)
    R, t = random_rotation(rng), rng.normal(size=3)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, t
    for delta in rng.normal(0.0, 0.1, (200, 6)):
        step_pose(R, t, delta)
        E = np.eye(4)
        E[:3, :3], E[:3, 3] = exp_rotation(delta[3:]), delta[:3]
        T = E @ T
    np.testing.assert_allclose(R, T[:3, :3], atol=1e-10)
    np.testing.assert_allclose(t, T[:3, 3], atol=1e-9)


def test_cholesky_solves_and_refuses() -> None:
    rng = np.random.default_rng(4)
    M = rng.normal(size=(12, 12))
    A = M @ M.T + np.eye(12)
    b = rng.normal(size=12)
    x = b.copy()
    assert cholesky_solve(A.copy(), x)
    np.testing.assert_allclose(A @ x, b, atol=1e-9)
    assert not cholesky_solve(-A, b.copy())


def test_projection_jacobians_match_differences() -> None:
    rng = np.random.default_rng(5)
    for _ in range(20):
        R, t = random_rotation(rng, 0.3), rng.normal(0.0, 0.3, 3)
        X = (np.array([rng.uniform(-1, 1), rng.uniform(-1, 1), rng.uniform(1.0, 6.0)]) - t) @ R
        x, y, z = R @ X + t
        J, JP = np.empty((3, 3)), np.empty((3, 6))
        observe.jacobian(x, y, z, CAMERA, J)
        observe.pose_jacobian(x, y, z, J, JP)
        for a in range(6):
            delta = np.zeros(6)
            delta[a] = STEP
            above, below = observed(*moved(R, t, delta), X[None]), observed(*moved(R, t, -delta), X[None])
            np.testing.assert_allclose(JP[:, a], (above - below)[0] / (2 * STEP), rtol=1e-5, atol=1e-4)
        for a in range(3):
            d = np.zeros(3)
            d[a] = STEP
            numeric = (observed(R, t, (X + d)[None]) - observed(R, t, (X - d)[None]))[0] / (2 * STEP)
            np.testing.assert_allclose(J @ R[:, a], numeric, rtol=1e-5, atol=1e-4)


def test_gradient_of_the_pose_cost_matches_differences() -> None:
    rng = np.random.default_rng(6)
    R, t = random_rotation(rng, 0.2), rng.normal(0.0, 0.2, 3)
    X = (np.column_stack([rng.uniform(-2, 2, 40), rng.uniform(-2, 2, 40), rng.uniform(1, 6, 40)]) - t) @ R
    obs = observed(R, t, X) + rng.normal(0.0, 3.0, (40, 3))
    info = np.column_stack([np.full(40, 0.7), np.where(np.arange(40) % 3 == 0, 0.0, 2.0)])
    use, chi2, H, b = np.ones(40, np.bool_), np.empty(40), np.empty((6, 6)), np.empty(6)
    for robust in (False, True):
        accumulate(R, t, X, obs, info, CAMERA, use, robust, chi2, H, b)
        gradient = -2.0 * b
        for a in range(6):
            delta = np.zeros(6)
            delta[a] = 1e-6
            scratch = (np.empty(40), np.empty((6, 6)), np.empty(6))
            above = accumulate(*moved(R, t, delta), X, obs, info, CAMERA, use, robust, *scratch)
            below = accumulate(*moved(R, t, -delta), X, obs, info, CAMERA, use, robust, *scratch)
            assert gradient[a] == pytest.approx((above - below) / 2e-6, rel=1e-4, abs=1e-2)


def test_pose_is_found_among_outliers_and_its_covariance_is_honest() -> None:
    rng = np.random.default_rng(7)
    X = np.column_stack([rng.uniform(-2, 2, 200), rng.uniform(-1.5, 1.5, 200), rng.uniform(1, 6, 200)])
    errors = []
    for _ in range(60):
        R, t = random_rotation(rng, 0.1), rng.normal(0.0, 0.1, 3)
        obs = observed(R, t, X) + rng.normal(0.0, [1.0, 1.0, 0.3], (200, 3))
        obs[:40] += rng.uniform(20.0, 60.0, (40, 3))
        info = np.tile([1.0, 1.0 / 0.09], (200, 1))
        use, H = np.ones(200, np.bool_), np.zeros((6, 6))
        found_R, found_t = moved(R, t, rng.normal(0.0, 0.03, 6))
        count, _ = refine_pose(found_R, found_t, X, obs, info, CAMERA, use, H, 4)
        assert 130 <= count <= 165
        assert not use[:40].any()
        w = log_rotation(found_R @ R.T)
        error = np.concatenate([found_t - exp_rotation(w) @ t, w])
        errors.append(error @ H @ error / 6.0)
    assert 0.7 < float(np.mean(errors)) < 1.5


def scene(rng: np.random.Generator, cameras: int, points: int) -> tuple[F64, F64, F64, bundle.Problem]:
    """Return true rotations, translations, points, and the noise-free problem."""
    R = np.stack([random_rotation(rng, 0.1) for _ in range(cameras)])
    t = rng.normal(0.0, 0.3, (cameras, 3))
    X = np.column_stack([rng.uniform(-2, 2, points), rng.uniform(-1.5, 1.5, points), rng.uniform(2, 6, points)])
    pose_of = np.tile(np.arange(cameras, dtype=np.int32), points)
    start = np.arange(0, cameras * points + 1, cameras, dtype=np.int32)
    obs = np.stack([observed(R[k], t[k], X) for k in range(cameras)], axis=1).reshape(-1, 3)
    info = np.tile([1.0, 4.0], (len(obs), 1))
    info[::4, 1] = 0.0
    problem = bundle.Problem(R.copy(), t.copy(), X.copy(), start, pose_of, obs, info, np.ones(len(obs), np.bool_))
    return R, t, X, problem


@pytest.mark.parametrize("solve", [bundle.adjust, bundle.adjust_large])
def test_bundle_adjustment_returns_to_the_truth(solve: object) -> None:
    assert callable(solve)
    rng = np.random.default_rng(8)
    R, t, X, problem = scene(rng, 5, 60)
    for k in range(4):
        step_pose(problem.R[k], problem.t[k], rng.normal(0.0, 0.03, 6))
    problem.X[:] += rng.normal(0.0, 0.1, X.shape)
    cost = solve(problem, CAMERA, 4, 30, robust=True)
    assert cost < 1e-6
    np.testing.assert_allclose(problem.t, t, atol=1e-5)
    np.testing.assert_allclose(problem.R, R, atol=1e-5)
    np.testing.assert_allclose(problem.X, X, atol=1e-4)


def test_reduced_system_is_the_schur_complement_of_the_numeric_hessian() -> None:
    rng = np.random.default_rng(9)
    _, _, _, problem = scene(rng, 3, 8)
    problem.obs[:] += rng.normal(0.0, 0.5, problem.obs.shape)
    free, points = 2, 8

    def residuals(delta: F64) -> F64:
        rows = []
        for o in range(len(problem.pose)):
            k, m = int(problem.pose[o]), o // 3
            R, t = problem.R[k], problem.t[k]
            if k < free:
                R, t = moved(R, t, delta[6 * k : 6 * k + 6])
            X = problem.X[m] + delta[6 * free + 3 * m : 6 * free + 3 * m + 3]
            weight = np.sqrt([problem.info[o, 0], problem.info[o, 0], problem.info[o, 1]])
            rows.append((problem.obs[o] - observed(R, t, X[None])[0]) * weight)
        return np.concatenate(rows)

    n = 6 * free + 3 * points
    J = np.stack([(residuals(d) - residuals(-d)) / (2 * STEP) for d in np.eye(n) * STEP], axis=1)
    H, g = J.T @ J, -J.T @ residuals(np.zeros(n))
    A, B, C = H[: 6 * free, : 6 * free], H[: 6 * free, 6 * free :], H[6 * free :, 6 * free :]
    work = bundle.workspace(problem, free)
    bundle.reduce_system(problem, CAMERA, free, False, 0.0, work)  # noqa: FBT003 - compiled: no keyword
    S = np.tril(work.S) + np.tril(work.S, -1).T
    np.testing.assert_allclose(S, A - B @ np.linalg.solve(C, B.T), rtol=1e-4, atol=2.0)
    np.testing.assert_allclose(work.dc, g[: 6 * free] - B @ np.linalg.solve(C, g[6 * free :]), rtol=1e-3, atol=1.0)


def test_pose_graph_jacobians_match_differences() -> None:
    rng = np.random.default_rng(10)
    for _ in range(10):
        poses = [(random_rotation(rng), rng.normal(size=3)) for _ in range(2)]
        R, t = random_rotation(rng), rng.normal(size=3)
        e, Ji, Jj = np.empty(6), np.empty((6, 6)), np.empty((6, 6))
        posegraph.edge_terms(*poses[0], *poses[1], R, t, e, Ji, Jj)
        for side, J in enumerate((Ji, Jj)):
            for a in range(6):
                values = []
                for sign in (1.0, -1.0):
                    delta = np.zeros(6)
                    delta[a] = sign * STEP
                    at = list(poses)
                    at[side] = moved(*poses[side], delta)
                    out = np.empty(6)
                    posegraph.edge_terms(*at[0], *at[1], R, t, out, np.empty((6, 6)), np.empty((6, 6)))
                    values.append(out)
                np.testing.assert_allclose(J[:, a], (values[0] - values[1]) / (2 * STEP), atol=1e-5)


@pytest.mark.parametrize("count", [20, 90])
def test_pose_graph_closes_a_drifting_circle(count: int) -> None:
    rng = np.random.default_rng(11)
    truth = []
    for a in np.linspace(0.0, 2.0 * math.pi, count, endpoint=False):
        R = exp_rotation([0.0, a, 0.0])
        truth.append((R, -R @ np.array([2.0 * math.sin(a), 0.0, 2.0 * math.cos(a)])))
    i, j = np.arange(count, dtype=np.int32), np.roll(np.arange(count, dtype=np.int32), -1)
    R_ij = np.stack([truth[a][0] @ truth[b][0].T for a, b in zip(i, j, strict=True)])
    t_ij = np.stack([truth[a][1] - r @ truth[b][1] for a, b, r in zip(i, j, R_ij, strict=True)])
    edges = posegraph.Edges(i, j, R_ij, t_ij, np.ones(count))
    R, t = np.stack([p[0] for p in truth]), np.stack([p[1] for p in truth])
    true_t = t.copy()
    for k in range(1, count):
        step_pose(R[k], t[k], rng.normal(0.0, 0.02, 6))
    free = np.arange(count) > 0
    posegraph.optimise(R, t, edges, free)
    np.testing.assert_allclose(t, true_t, atol=1e-5)
