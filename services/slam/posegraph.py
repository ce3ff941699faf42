"""Pose graph: keyframes joined by measured relative poses, made consistent by Gauss-Newton.

An edge (i, j) measures ``T_i T_j^-1`` of two camera-from-map poses. Residual: (t - t_measured, log(R R_measured^T)) of that
product; perturbations on the left, order (v, w). Jacobians by Sola et al. (2018), equations 145 to 147.
"""

from __future__ import annotations

import math
from functools import cache
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from services.slam.linear import log_so3, matmul3, step_pose

F64 = NDArray[np.float64]
I32 = NDArray[np.int32]

_DENSE_NODES = 60
"""Above this the normal equations are solved sparse."""
_SIGMA_M = 0.01
_SIGMA_RAD = 0.004
"""Of one edge, before its weight."""
_SHARES = (1.0, 0.5, 0.125, 0.01)
"""Of a step, tried until one does not raise the cost: far from the optimum a whole step may lead anywhere."""
_CONVERGED = 1e-6
"""Share of the cost."""


class Edges(NamedTuple):
    """Measured relative poses (E first)."""

    i: I32
    j: I32
    R: F64
    t: F64
    weight: F64


@njit(cache=True, nogil=True)
def left_jacobian_inverse(e: F64) -> F64:
    """Return the (3, 3) matrix with ``log(exp(d) exp(e)) = e + M d`` to first order in d."""
    theta2 = e[0] ** 2 + e[1] ** 2 + e[2] ** 2
    theta = math.sqrt(theta2)
    c = 1.0 / 12.0 if theta < 1e-4 else 1.0 / theta2 - (1.0 + math.cos(theta)) / (2.0 * theta * math.sin(theta))
    K = np.array([[0.0, -e[2], e[1]], [e[2], 0.0, -e[0]], [-e[1], e[0], 0.0]])
    return np.eye(3) - 0.5 * K + c * matmul3(K, K)


@njit(cache=True, nogil=True)
def edge_terms(Ri: F64, ti: F64, Rj: F64, tj: F64, R: F64, t: F64, e: F64, Ji: F64, Jj: F64) -> None:
    """Write an edge's residual (6,) into ``e`` and its Jacobians (6, 6) by the poses i and j into ``Ji``, ``Jj``."""
    D = matmul3(Ri, np.ascontiguousarray(Rj.T))
    Ji[:] = 0.0
    Jj[:] = 0.0
    d = np.empty(3)
    for r in range(3):
        d[r] = ti[r] - D[r, 0] * tj[0] - D[r, 1] * tj[1] - D[r, 2] * tj[2]
        e[r] = d[r] - t[r]
    w = log_so3(matmul3(D, np.ascontiguousarray(R.T)))
    M = left_jacobian_inverse(w)
    MD = matmul3(M, D)
    for r in range(3):
        e[3 + r] = w[r]
        Ji[r, r] = 1.0
        for c in range(3):
            Jj[r, c] = -D[r, c]
            Ji[3 + r, 3 + c] = M[r, c]
            Jj[3 + r, 3 + c] = -MD[r, c]
    Ji[0, 4], Ji[0, 5], Ji[1, 3] = d[2], -d[1], -d[2]
    Ji[1, 5], Ji[2, 3], Ji[2, 4] = d[0], d[1], -d[0]


@njit(cache=True, nogil=True)
def linearise(R: F64, t: F64, edges: Edges, blocks: F64, g: F64) -> float:
    """Fill each edge's normal blocks (E, 4, 6, 6: ii, ij, ji, jj) and the gradient g (nodes, 6); return the cost."""
    e, Ji, Jj = np.empty(6), np.empty((6, 6)), np.empty((6, 6))
    weight = np.empty(6)
    g[:] = 0.0
    cost = 0.0
    for k in range(len(edges.i)):
        i, j = edges.i[k], edges.j[k]
        edge_terms(R[i], t[i], R[j], t[j], edges.R[k], edges.t[k], e, Ji, Jj)
        weight[:3] = edges.weight[k] / _SIGMA_M**2
        weight[3:] = edges.weight[k] / _SIGMA_RAD**2
        for a in range(6):
            cost += weight[a] * e[a] * e[a]
            for b in range(6):
                g[i, a] -= Ji[b, a] * weight[b] * e[b]
                g[j, a] -= Jj[b, a] * weight[b] * e[b]
                ii = ij = jj = 0.0
                for c in range(6):
                    ii += Ji[c, a] * weight[c] * Ji[c, b]
                    ij += Ji[c, a] * weight[c] * Jj[c, b]
                    jj += Jj[c, a] * weight[c] * Jj[c, b]
                blocks[k, 0, a, b], blocks[k, 1, a, b], blocks[k, 2, b, a], blocks[k, 3, a, b] = ii, ij, ij, jj
    return cost


def solve_normal(edges: Edges, blocks: F64, g: F64, free: NDArray[np.bool_]) -> F64:
    """Return the step (nodes, 6) of the free nodes; the others' is zero."""
    n = len(g)
    position = np.cumsum(free) - 1
    rows = np.stack([edges.i, edges.i, edges.j, edges.j], axis=1).ravel()
    cols = np.stack([edges.i, edges.j, edges.i, edges.j], axis=1).ravel()
    keep = free[rows] & free[cols]
    a, b = position[rows[keep]], position[cols[keep]]
    six = np.arange(6)
    r = np.broadcast_to(6 * a[:, None, None] + six[None, :, None], (len(a), 6, 6)).ravel()
    c = np.broadcast_to(6 * b[:, None, None] + six[None, None, :], (len(a), 6, 6)).ravel()
    values = blocks.reshape(-1, 6, 6)[keep].ravel()
    size = 6 * int(free.sum())
    out = np.zeros((n, 6))
    rhs = g[free].ravel()
    if size <= 6 * _DENSE_NODES:
        A = np.zeros((size, size))
        np.add.at(A, (r, c), values)
        A[np.diag_indices(size)] += 1e-6
        out[free] = np.linalg.solve(A, rhs).reshape(-1, 6)
        return out
    solver = sparse_solver()
    sparse = solver.csc_matrix((values, (r, c)), shape=(size, size)) + 1e-6 * solver.eye(size, format="csc")
    out[free] = solver.splu(sparse).solve(rhs).reshape(-1, 6)
    return out


@cache
def sparse_solver() -> SimpleNamespace:
    """Load what solves large graphs: 0.2 s of Python that a loop must not wait for, nor the first frames."""
    from scipy.sparse import csc_matrix, eye
    from scipy.sparse.linalg import splu

    return SimpleNamespace(csc_matrix=csc_matrix, eye=eye, splu=splu)


def expect_nodes(nodes: int) -> None:
    """Be ready for a graph that grows: half way to where the sparse solver is needed it is loaded."""
    if nodes >= _DENSE_NODES // 2:
        sparse_solver()


def optimise(R: F64, t: F64, edges: Edges, free: NDArray[np.bool_], iterations: int = 10) -> float:
    """Move the free poses ``R`` (N, 3, 3), ``t`` (N, 3) in place to agree with the edges; return the final cost, never above the first."""
    blocks, g = np.zeros((len(edges.i), 4, 6, 6)), np.zeros((len(R), 6))
    cost = linearise(R, t, edges, blocks, g)
    for _ in range(iterations):
        step = solve_normal(edges, blocks, g, free)
        stood = R.copy(), t.copy()
        for share in _SHARES:
            R[:], t[:] = stood
            for k in np.flatnonzero(free):
                step_pose(R[k], t[k], share * step[k])
            new = linearise(R, t, edges, blocks, g)
            if new - cost <= _CONVERGED * max(cost, 1e-12):
                break
        else:
            R[:], t[:] = stood
            return cost
        if abs(cost - new) <= _CONVERGED * max(cost, 1e-12):
            return new
        cost = new
    return cost
