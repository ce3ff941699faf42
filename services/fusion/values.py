"""What goes into fusion and what comes out: plain values, no bus, no gtsam."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from schemas.fusion import Carrier
from services.common.geometry import Matrix, hat, inverse


@dataclass(frozen=True, slots=True)
class ImuReading:
    """Means since the reading before, body frame (forward, left, up); at rest the force points up."""

    stamp_ns: int
    gyro_rad_s: Matrix
    accel_m_s2: Matrix


@dataclass(frozen=True, slots=True)
class Located:
    """A camera located by slam. Poses of one ``epoch`` (map and reset counter) may be compared with each other."""

    stamp_ns: int
    T_map_camera: Matrix
    covariance: Matrix
    """(6, 6) of (x, y, z, rx, ry, rz), left perturbation in map."""
    epoch: tuple[str, int]


@dataclass(frozen=True, slots=True)
class GpsReading:
    """A fix in the tangent plane (east, north, up) of the first one."""

    stamp_ns: int
    position_m: Matrix
    sigma_m: float
    """What the receiver says of its horizontal error."""


@dataclass(frozen=True, slots=True)
class Moved:
    """A relative pose ``T_from_to`` of the body with its covariance (6, 6): (rotation, translation), right perturbation."""

    T: Matrix
    covariance: Matrix


@dataclass(frozen=True, slots=True)
class Fused:
    """The first camera in slam's map."""

    stamp_ns: int
    T_map_camera: Matrix
    covariance: Matrix
    """As in ``Located``."""
    carrier: Carrier


def adjoint(T: Matrix) -> Matrix:
    """Return the (6, 6) that takes a right perturbation (rotation, translation) in frame b to frame a, for ``T_a_b``."""
    R, t = T[:3, :3], T[:3, 3]
    out = np.zeros((6, 6))
    out[:3, :3] = out[3:, 3:] = R
    out[3:, :3] = hat(t) @ R
    return out


def local_covariance(T_map_camera: Matrix, covariance: Matrix) -> Matrix:
    """Return a pose's covariance as of a right perturbation (rotation, translation) in the camera's own axes.

    The map's form is (position, rotation) with ``exp(r) R``: both halves only turn into the camera's axes.
    """
    turn = np.zeros((6, 6))
    turn[:3, 3:] = turn[3:, :3] = T_map_camera[:3, :3].T
    return np.asarray(turn @ covariance @ turn.T)


def carried(anchor: Located, T_camera_camera: Matrix, covariance_local: Matrix) -> tuple[Matrix, Matrix]:
    """Return pose and covariance (map's form) of a camera that moved by ``T_camera_camera`` from a located one.

    ``covariance_local`` (6, 6) of the motion: right perturbation (rotation, translation) at its end.
    """
    T = anchor.T_map_camera @ T_camera_camera
    R, arm = T[:3, :3], T[:3, 3] - anchor.T_map_camera[:3, 3]
    J = np.eye(6)
    J[:3, 3:] = -hat(arm)
    turn = np.zeros((6, 6))
    turn[:3, 3:] = turn[3:, :3] = R
    total = J @ anchor.covariance @ J.T + turn @ covariance_local @ turn.T
    return T, 0.5 * (total + total.T)


def relative(first: Located, second: Located, T_body_camera: Matrix) -> Moved:
    """Return how the body moved between two located frames of one epoch.

    The map's own error is common to both, so one pose's covariance stands for the pair: twice it would count twice.
    """
    T_camera = inverse(first.T_map_camera) @ second.T_map_camera
    spread = np.maximum(
        local_covariance(second.T_map_camera, second.covariance).diagonal(),
        local_covariance(first.T_map_camera, first.covariance).diagonal(),
    )
    A = adjoint(T_body_camera)
    return Moved(T_body_camera @ T_camera @ inverse(T_body_camera), A @ np.diag(spread) @ A.T)
