"""Bundle adjustment: Levenberg-Marquardt over keyframes and points with the Schur complement, dense in the cameras.

Triggs, McLauchlan, Hartley and Fitzgibbon, "Bundle adjustment: a modern synthesis" (2000), section 6.1.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from services.slam.linear import cholesky_solve, step_pose
from services.slam.links import Keyframes, Points
from services.slam.observe import (
    CHI2_DEPTH,
    CHI2_MONO,
    MIN_Z_M,
    huber_cost,
    huber_weight,
    jacobian,
    pose_jacobian,
    residual,
)

F64 = NDArray[np.float64]
I32 = NDArray[np.int32]


class Problem(NamedTuple):
    """One adjustment: the first ``free`` poses move, the others hold still. Observations are sorted by point."""

    R: F64
    """(C, 3, 3) camera from map."""
    t: F64
    X: F64
    """(M, 3) points, map."""
    start: I32
    """(M + 1,) first observation of each point."""
    pose: I32
    """(O,)"""
    obs: F64
    """(O, 3) u, v, disparity (0 = none)."""
    info: F64
    """(O, 2) inverse variances."""
    use: NDArray[np.bool_]
    """(O,)"""


@njit(cache=True, nogil=True)
def camera_point(R: F64, t: F64, X: F64, out: F64) -> None:
    """Write the point in the camera's frame into ``out``."""
    for r in range(3):
        out[r] = R[r, 0] * X[0] + R[r, 1] * X[1] + R[r, 2] * X[2] + t[r]


@njit(cache=True, nogil=True)
def chi_squares(problem: Problem, camera: F64) -> F64:
    """Return each observation's chi-square (O,); behind the camera 1e12."""
    out = np.empty(len(problem.pose))
    c, r = np.empty(3), np.empty(3)
    for m in range(len(problem.X)):
        for o in range(problem.start[m], problem.start[m + 1]):
            k = problem.pose[o]
            camera_point(problem.R[k], problem.t[k], problem.X[m], c)
            if c[2] < MIN_Z_M:
                out[o] = 1e12
                continue
            residual(c[0], c[1], c[2], problem.obs[o, 0], problem.obs[o, 1], problem.obs[o, 2], camera, r)
            out[o] = problem.info[o, 0] * (r[0] * r[0] + r[1] * r[1]) + problem.info[o, 1] * r[2] * r[2]
    return out


@njit(cache=True, nogil=True)
def disparity_residuals(problem: Problem, camera: F64, least_info: float, measured: NDArray[np.bool_]) -> F64:
    """Return observed minus predicted disparity of the observations in use whose inverse variance is ``least_info`` or more.

    Only of points that are ``measured`` (M,): a far one's disparity is believed, not seen.
    """
    out = np.empty(len(problem.pose))
    c, count = np.empty(3), 0
    for m in range(len(problem.X)):
        if not measured[m]:
            continue
        for o in range(problem.start[m], problem.start[m + 1]):
            if problem.use[o] and problem.info[o, 1] >= least_info:
                k = problem.pose[o]
                camera_point(problem.R[k], problem.t[k], problem.X[m], c)
                if c[2] >= MIN_Z_M:
                    out[count] = problem.obs[o, 2] - camera[4] / c[2]
                    count += 1
    return out[:count].copy()


@njit(cache=True, nogil=True)
def total_cost(problem: Problem, camera: F64, robust: bool) -> float:
    """Return the sum of (robust) costs of the observations in use."""
    chi2 = chi_squares(problem, camera)
    cost = 0.0
    for o in range(len(chi2)):
        if problem.use[o]:
            limit = CHI2_DEPTH if problem.info[o, 1] > 0.0 else CHI2_MONO
            cost += huber_cost(chi2[o], limit) if robust else chi2[o]
    return cost


@njit(cache=True, nogil=True)
def invert3(A: F64, damping: float, out: F64) -> None:
    """Write the inverse of symmetric A (3, 3), its diagonal raised by ``damping`` times itself, into ``out``."""
    a, d, f = A[0, 0] * (1 + damping) + 1e-9, A[1, 1] * (1 + damping) + 1e-9, A[2, 2] * (1 + damping) + 1e-9
    b, c, e = A[1, 0], A[2, 0], A[2, 1]
    i00, i01, i02 = d * f - e * e, c * e - b * f, b * e - c * d
    det = a * i00 + b * i01 + c * i02
    s = 1.0 / det
    out[0, 0], out[0, 1], out[0, 2] = i00 * s, i01 * s, i02 * s
    out[1, 0], out[1, 1], out[1, 2] = i01 * s, (a * f - c * c) * s, (b * c - a * e) * s
    out[2, 0], out[2, 1], out[2, 2] = i02 * s, out[1, 2], (a * d - b * b) * s


@njit(cache=True, nogil=True)
def linearise_point(  # noqa: C901 - the unrolled products of small matrices
    problem: Problem, camera: F64, m: int, robust: bool, free: int, S: F64, g: F64, W: F64, Hp: F64, bp: F64
) -> None:
    """Add one point's observations to the cameras' blocks of ``S`` and ``g``; fill its own ``Hp``, ``bp`` and ``W``."""
    J, JP, JX, r, c = np.empty((3, 3)), np.empty((3, 6)), np.empty((3, 3)), np.empty(3), np.empty(3)
    Hp[:] = 0.0
    bp[:] = 0.0
    for o in range(problem.start[m], problem.start[m + 1]):
        W[o, :, :] = 0.0
        if not problem.use[o]:
            continue
        k = problem.pose[o]
        R = problem.R[k]
        camera_point(R, problem.t[k], problem.X[m], c)
        if c[2] < MIN_Z_M:
            continue
        residual(c[0], c[1], c[2], problem.obs[o, 0], problem.obs[o, 1], problem.obs[o, 2], camera, r)
        wu, wd = problem.info[o, 0], problem.info[o, 1]
        e = wu * (r[0] * r[0] + r[1] * r[1]) + wd * r[2] * r[2]
        if robust:
            h = huber_weight(e, CHI2_DEPTH if wd > 0.0 else CHI2_MONO)
            wu, wd = wu * h, wd * h
        jacobian(c[0], c[1], c[2], camera, J)
        rows = 3 if wd > 0.0 else 2
        for a in range(rows):
            for b in range(3):
                JX[a, b] = J[a, 0] * R[0, b] + J[a, 1] * R[1, b] + J[a, 2] * R[2, b]
        for a in range(rows):
            w = wd if a == 2 else wu
            for b in range(3):
                bp[b] += w * JX[a, b] * r[a]
                for d in range(3):
                    Hp[b, d] += w * JX[a, b] * JX[a, d]
        if k >= free:
            continue
        pose_jacobian(c[0], c[1], c[2], J, JP)
        base = 6 * k
        for a in range(rows):
            w = wd if a == 2 else wu
            for b in range(6):
                wj = w * JP[a, b]
                g[base + b] += wj * r[a]
                for d in range(b + 1):
                    S[base + b, base + d] += wj * JP[a, d]
                for d in range(3):
                    W[o, b, d] += wj * JX[a, d]


@njit(cache=True, nogil=True)
def eliminate_point(problem: Problem, m: int, free: int, S: F64, g: F64, W: F64, Hi: F64, bp: F64) -> None:
    """Subtract one point's part from the reduced camera system."""
    Y = np.empty((6, 3))
    for o in range(problem.start[m], problem.start[m + 1]):
        k = problem.pose[o]
        if k >= free or not problem.use[o]:
            continue
        for a in range(6):
            w0, w1, w2 = W[o, a, 0], W[o, a, 1], W[o, a, 2]
            Y[a, 0] = w0 * Hi[0, 0] + w1 * Hi[1, 0] + w2 * Hi[2, 0]
            Y[a, 1] = w0 * Hi[0, 1] + w1 * Hi[1, 1] + w2 * Hi[2, 1]
            Y[a, 2] = w0 * Hi[0, 2] + w1 * Hi[1, 2] + w2 * Hi[2, 2]
            g[6 * k + a] -= Y[a, 0] * bp[0] + Y[a, 1] * bp[1] + Y[a, 2] * bp[2]
        for q in range(problem.start[m], problem.start[m + 1]):
            j = problem.pose[q]
            if j > k or not problem.use[q]:
                continue
            for a in range(6):
                for b in range(6):
                    S[6 * k + a, 6 * j + b] -= Y[a, 0] * W[q, b, 0] + Y[a, 1] * W[q, b, 1] + Y[a, 2] * W[q, b, 2]


class Workspace(NamedTuple):
    """What one linearisation leaves for the back substitution."""

    S: F64
    """(6 free, 6 free) reduced camera system, lower triangle."""
    W: F64
    """(O, 6, 3) camera-point blocks."""
    Hi: F64
    """(M, 3, 3) inverse point blocks."""
    bp: F64
    dc: F64
    """(6 free,) right hand side, then the cameras' step."""
    dX: F64


@njit(cache=True, nogil=True)
def workspace(problem: Problem, free: int) -> Workspace:
    """Return the arrays an adjustment needs."""
    n, M = 6 * free, len(problem.X)
    return Workspace(
        np.zeros((n, n)), np.zeros((len(problem.pose), 6, 3)), np.zeros((M, 3, 3)), np.zeros((M, 3)), np.zeros(n),
        np.zeros((M, 3)),
    )  # fmt: skip


@njit(cache=True, nogil=True)
def reduce_system(problem: Problem, camera: F64, free: int, robust: bool, damping: float, work: Workspace) -> None:
    """Fill the damped reduced camera system: ``S`` and, as its right hand side, ``dc``."""
    S, dc = work.S, work.dc
    S[:] = 0.0
    dc[:] = 0.0
    Hp = np.empty((3, 3))
    D = np.empty(len(dc))
    for m in range(len(problem.X)):
        linearise_point(problem, camera, m, robust, free, S, dc, work.W, Hp, work.bp[m])
        invert3(Hp, damping, work.Hi[m])
    for a in range(len(dc)):
        D[a] = damping * S[a, a] + 1e-9
    for m in range(len(problem.X)):
        eliminate_point(problem, m, free, S, dc, work.W, work.Hi[m], work.bp[m])
    for a in range(len(dc)):
        S[a, a] += D[a]


@njit(cache=True, nogil=True)
def move(problem: Problem, free: int, work: Workspace) -> None:
    """Back-substitute the points' step from the cameras' ``dc`` and move both."""
    for m in range(len(problem.X)):
        b0, b1, b2 = work.bp[m, 0], work.bp[m, 1], work.bp[m, 2]
        for o in range(problem.start[m], problem.start[m + 1]):
            k = problem.pose[o]
            if k < free and problem.use[o]:
                for a in range(6):
                    b0 -= work.W[o, a, 0] * work.dc[6 * k + a]
                    b1 -= work.W[o, a, 1] * work.dc[6 * k + a]
                    b2 -= work.W[o, a, 2] * work.dc[6 * k + a]
        H = work.Hi[m]
        for a in range(3):
            problem.X[m, a] += H[a, 0] * b0 + H[a, 1] * b1 + H[a, 2] * b2
    for k in range(free):
        step_pose(problem.R[k], problem.t[k], work.dc[6 * k : 6 * k + 6])


@njit(cache=True, nogil=True)
def adjust(problem: Problem, camera: F64, free: int, iterations: int, robust: bool) -> float:
    """Minimise over the free poses and all points, in place; return the final cost."""
    work = workspace(problem, free)
    cost = total_cost(problem, camera, robust)
    damping = 1e-5
    for _ in range(iterations):
        reduce_system(problem, camera, free, robust, damping, work)
        if not cholesky_solve(work.S, work.dc):
            damping *= 100.0
            continue
        R, t, X = problem.R[:free].copy(), problem.t[:free].copy(), problem.X.copy()
        move(problem, free, work)
        new = total_cost(problem, camera, robust)
        gain = (cost - new) / max(cost, 1e-300)
        if gain > 0.0:
            cost = new
            damping = max(damping * 0.1, 1e-9)
            if gain < 1e-5:
                break
        else:
            problem.R[:free], problem.t[:free] = R, t
            problem.X[:] = X
            damping *= 10.0
            if damping > 1e6:
                break
    return cost


def adjust_large(
    problem: Problem, camera: F64, free: int, iterations: int, robust: bool, hurried: Callable[[], bool] | None = None
) -> float:
    """Do the same as ``adjust`` with the cameras' system solved by LAPACK: for a map of many keyframes.

    Between two iterations it stops when ``hurried()``.
    """
    work = workspace(problem, free)
    cost = total_cost(problem, camera, robust)
    damping = 1e-5
    for _ in range(iterations):
        if hurried is not None and hurried():
            break
        reduce_system(problem, camera, free, robust, damping, work)
        lower = np.tril(work.S)
        try:
            work.dc[:] = np.linalg.solve(lower + np.tril(lower, -1).T, work.dc)
        except np.linalg.LinAlgError:
            damping *= 100.0
            continue
        R, t, X = problem.R[:free].copy(), problem.t[:free].copy(), problem.X.copy()
        move(problem, free, work)
        new = total_cost(problem, camera, robust)
        gain = (cost - new) / max(cost, 1e-300)
        if gain > 0.0:
            cost, damping = new, max(damping * 0.1, 1e-9)
            if gain < 1e-5:
                break
        else:
            problem.R[:free], problem.t[:free], problem.X[:] = R, t, X
            damping *= 10.0
    return cost


@njit(cache=True, nogil=True)
def build(points: Points, kf: Keyframes, ids: I32, slots: I32, index: I32, variance: F64, far: F64) -> Problem:
    """Gather points ``ids`` and keyframes ``slots`` (``index`` (K,): place in ``slots``, -1: not in) into a Problem.

    ``variance`` (levels,) of u and v by octave, pixels squared; ``far`` (2,) disparity and its inverse variance that stand in
    for the unknown depth in the first observation of a far point.
    """
    total = 0
    for p in ids:
        for j in range(points.n[p]):
            total += index[points.frame[p, j]] >= 0
    C = len(slots)
    R, t = np.empty((C, 3, 3)), np.empty((C, 3))
    for c in range(C):
        R[c], t[c] = kf.R[slots[c]], kf.t[slots[c]]
    X, start = np.empty((len(ids), 3)), np.zeros(len(ids) + 1, np.int32)
    pose, obs, info = np.empty(total, np.int32), np.empty((total, 3)), np.empty((total, 2))
    o = 0
    for m in range(len(ids)):
        p = ids[m]
        X[m] = points.pos[p]
        for j in range(points.n[p]):
            k, i = points.frame[p, j], points.feature[p, j]
            if index[k] < 0:
                continue
            pose[o] = index[k]
            obs[o, 0], obs[o, 1], obs[o, 2] = kf.uv[k, i, 0], kf.uv[k, i, 1], kf.disparity[k, i]
            info[o, 0] = 1.0 / variance[kf.octave[k, i]]
            info[o, 1] = kf.info[k, i]
            if j == 0 and kf.far[k, i]:
                obs[o, 2], info[o, 1] = far[0], far[1]
            o += 1
        start[m + 1] = o
    return Problem(R, t, X, start, pose, obs, info, np.ones(total, np.bool_))
