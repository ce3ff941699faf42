"""How good a trajectory is: absolute trajectory error after the best rigid alignment, and rotation errors.

ATE as in Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems" (IROS 2012); alignment by Umeyama,
"Least-squares estimation of transformation parameters between two point patterns" (PAMI 1991), without scale.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from services.camera.sources.associate import associate
from services.camera.sources.text import read_rows, stamp_ns_of
from services.common.errors import InputError
from services.common.geometry import Matrix, log_rotation, pose, rotation_from_quaternion

WITHIN_S = 0.020


@dataclass(frozen=True, slots=True)
class Trajectory:
    """Poses by stamp."""

    stamps_ns: NDArray[np.int64]
    poses: NDArray[np.float64]
    """(N, 4, 4), camera in the trajectory's own world."""


@dataclass(frozen=True, slots=True)
class Ate:
    """Errors of an estimate against the truth."""

    rmse_m: float
    max_m: float
    matched: int
    rotation_deg_max: float
    """Largest rotation between estimate and truth after the first matched poses were laid upon each other."""


def read_trajectory(path: Path) -> Trajectory:
    """Read a file in TUM's format: ``stamp tx ty tz qx qy qz qw``.

    Raises:
        InputError: naming file, line and fault.
    """
    rows = read_rows(path, columns=8, what="'stamp tx ty tz qx qy qz qw'")
    poses = np.empty((len(rows), 4, 4))
    for index, row in enumerate(rows):
        values = [row.number(column, path) for column in range(1, 8)]
        if not any(values[3:]):
            raise InputError(f"{path}:{row.line}: the quaternion is zero")
        poses[index] = pose(rotation_from_quaternion(values[3:]), values[:3])
    return Trajectory(np.array([stamp_ns_of(row, 0, path) for row in rows], dtype=np.int64), poses)


def rigid_alignment(source: Matrix, target: Matrix) -> Matrix:
    """Return the transform (4, 4) that takes ``source`` (N, 3) nearest to ``target`` (N, 3), least squares."""
    a, b = source - source.mean(axis=0), target - target.mean(axis=0)
    U, _, Vt = np.linalg.svd(b.T @ a)
    R = U @ np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))]) @ Vt
    return pose(R, target.mean(axis=0) - R @ source.mean(axis=0))


def ate(estimate: Trajectory, truth: Trajectory, within_s: float = WITHIN_S) -> Ate:
    """Compare an estimate with the truth, matched by nearest stamps.

    Raises:
        InputError: fewer than three poses match.
    """
    pairs = associate(estimate.stamps_ns, truth.stamps_ns, round(within_s * 1e9))
    if len(pairs) < 3:
        raise InputError(f"{len(pairs)} poses of estimate and truth match within {within_s} s, at least 3 are needed")
    mine = estimate.poses[[i for i, _ in pairs]]
    true = truth.poses[[k for _, k in pairs]]
    T = rigid_alignment(mine[:, :3, 3], true[:, :3, 3])
    errors = np.linalg.norm(mine[:, :3, 3] @ T[:3, :3].T + T[:3, 3] - true[:, :3, 3], axis=1)
    return Ate(
        rmse_m=float(np.sqrt(np.mean(errors**2))), max_m=float(errors.max()), matched=len(pairs),
        rotation_deg_max=float(np.degrees(_rotation_errors(mine, true).max())),
    )  # fmt: skip


def _rotation_errors(mine: NDArray[np.float64], true: NDArray[np.float64]) -> Matrix:
    """Angles (N,) between the rotations since the first pose."""
    first_mine, first_true = mine[0, :3, :3], true[0, :3, :3]
    differences = (first_mine.T @ m[:3, :3] @ (first_true.T @ t[:3, :3]).T for m, t in zip(mine, true, strict=True))
    return np.array([np.linalg.norm(log_rotation(R)) for R in differences])
