"""The pose graph against gtsam on a long circuit that closes."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from services.common.geometry import exp_rotation
from services.slam import posegraph
from services.slam.posegraph import Edges, optimise

F64 = NDArray[np.float64]

SIGMA_M, SIGMA_RAD = 0.01, 0.004


def circuit(nodes: int, seed: int) -> tuple[F64, F64, Edges]:
    """Return drifted camera-from-map poses of a circle, and edges to the next two nodes and round the gap."""
    rng = np.random.default_rng(seed)
    angle = np.linspace(0.0, 2.0 * np.pi, nodes, endpoint=False)
    R = np.stack([exp_rotation([0.05 * np.sin(a), a, 0.03 * np.cos(2 * a)]) for a in angle])
    centre = np.stack([6.0 * np.cos(angle), 0.2 * np.sin(3 * angle), 6.0 * np.sin(angle)], axis=1)
    t = -np.einsum("nab,nb->na", R, centre)
    i = np.concatenate([np.arange(nodes - 1), np.arange(nodes - 2), [nodes - 1, nodes - 2]])
    j = np.concatenate([np.arange(1, nodes), np.arange(2, nodes), [0, 0]])
    R_ij = np.einsum("nab,ncb->nac", R[i], R[j])
    t_ij = t[i] - np.einsum("nab,nb->na", R_ij, t[j])
    R_ij = np.stack([exp_rotation(rng.normal(0.0, 0.003, 3)) @ M for M in R_ij])
    t_ij = t_ij + rng.normal(0.0, 0.01, t_ij.shape)
    weight = rng.uniform(0.3, 2.0, len(i))
    for k in range(1, nodes):  # as odometry puts them together: the gap at the end is wide
        D, d = R_ij[k - 1].T, R_ij[k - 1].T @ -t_ij[k - 1]
        R[k], t[k] = D @ R[k - 1], D @ t[k - 1] + d
    return R, t, Edges(i.astype(np.int32), j.astype(np.int32), R_ij, t_ij, weight)


def by_gtsam(R: F64, t: F64, edges: Edges) -> tuple[F64, F64]:
    """Return the poses that gtsam's Levenberg-Marquardt finds, the first held."""
    gtsam = pytest.importorskip("gtsam")
    graph, start = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for k in range(len(R)):
        start.insert(k, gtsam.Pose3(gtsam.Rot3(R[k].T), -R[k].T @ t[k]))
    sigmas = np.array([SIGMA_RAD] * 3 + [SIGMA_M] * 3)
    for k in range(len(edges.i)):
        noise = gtsam.noiseModel.Diagonal.Sigmas(sigmas / np.sqrt(edges.weight[k]))
        measured = gtsam.Pose3(gtsam.Rot3(edges.R[k]), edges.t[k])
        graph.add(gtsam.BetweenFactorPose3(int(edges.i[k]), int(edges.j[k]), measured, noise))
    graph.add(gtsam.NonlinearEqualityPose3(0, start.atPose3(0)))
    found = gtsam.LevenbergMarquardtOptimizer(graph, start).optimize()
    poses = [found.atPose3(k) for k in range(len(R))]
    Rs = np.stack([p.rotation().matrix().T for p in poses])
    return Rs, np.stack([-M @ p.translation() for M, p in zip(Rs, poses, strict=True)])


@pytest.mark.parametrize("nodes", [20, 150])
def test_the_same_optimum_as_gtsam(nodes: int) -> None:
    R, t, edges = circuit(nodes, nodes)
    theirs_R, theirs_t = by_gtsam(R, t, edges)
    before_m = np.linalg.norm(np.einsum("nba,nb->na", R, t) - np.einsum("nba,nb->na", theirs_R, theirs_t), axis=1).max()
    free = np.ones(nodes, bool)
    free[0] = False
    cost = optimise(R, t, edges, free)
    assert before_m > 0.05, "nothing to correct"
    blocks, g = np.zeros((len(edges.i), 4, 6, 6)), np.zeros((nodes, 6))
    assert cost <= 1.002 * posegraph.linearise(theirs_R, theirs_t, edges, blocks, g)
    ours, theirs = np.einsum("nba,nb->na", R, t), np.einsum("nba,nb->na", theirs_R, theirs_t)
    assert np.linalg.norm(ours - theirs, axis=1).max() < 0.02 * before_m
    np.testing.assert_allclose(R @ R.transpose(0, 2, 1), np.broadcast_to(np.eye(3), R.shape), atol=1e-9)


def test_no_loop_waits_for_the_sparse_solver_to_load() -> None:
    posegraph.sparse_solver.cache_clear()
    posegraph.expect_nodes(posegraph._DENSE_NODES // 2 - 1)  # first frames do not wait for it either
    assert posegraph.sparse_solver.cache_info().currsize == 0
    posegraph.expect_nodes(posegraph._DENSE_NODES // 2)
    assert posegraph.sparse_solver.cache_info().currsize == 1
