"""Rigid transforms as 4x4 matrices, rotations as 3x3 matrices or quaternions (x, y, z, w). Pure numpy.

``T_a_b`` takes points of frame b to frame a, so that ``T_a_c = T_a_b @ T_b_c``. Formulas: Sola, Deray and
Atchuthan, "A micro Lie theory for state estimation in robotics" (2018), equations 145 to 148.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from schemas.slam import Transform

Matrix = NDArray[np.float64]

_SMALL_ANGLE_RAD = 1e-8

R_BODY_CAMERA: Matrix = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""A camera that looks forward: optical axes (right, down, forward) in body (forward, left, up)."""


def hat(v: ArrayLike) -> Matrix:
    """Return the 3x3 matrix with ``hat(v) @ w == cross(v, w)``."""
    x, y, z = np.asarray(v, dtype=float)
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def exp_rotation(r: ArrayLike) -> Matrix:
    """Return the rotation by the vector ``r`` (3,), radians (Rodrigues)."""
    r = np.asarray(r, dtype=float)
    angle = float(np.linalg.norm(r))
    K = hat(r)
    if angle < _SMALL_ANGLE_RAD:
        return np.eye(3) + K + 0.5 * K @ K
    return np.eye(3) + np.sin(angle) / angle * K + (1.0 - np.cos(angle)) / angle**2 * K @ K


def log_rotation(R: Matrix) -> Matrix:
    """Return the rotation vector (3,) of a rotation matrix, norm at most pi."""
    x, y, z, w = quaternion_from_rotation(R)
    v = np.array([x, y, z])
    if w < 0.0:
        v, w = -v, -w
    n = float(np.linalg.norm(v))
    if n < _SMALL_ANGLE_RAD:
        return 2.0 * v
    return 2.0 * np.arctan2(n, w) / n * v


def quaternion_from_rotation(R: Matrix) -> Matrix:
    """Return the unit quaternion (x, y, z, w), w >= 0, of a rotation matrix (Shepperd's method)."""
    m = np.asarray(R, dtype=float)
    trace = m[0, 0] + m[1, 1] + m[2, 2]
    squares = np.array([m[0, 0], m[1, 1], m[2, 2], trace])
    i = int(np.argmax(squares))
    q = np.empty(4)
    if i == 3:
        q[:] = m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1], 1.0 + trace
    else:
        j, k = (i + 1) % 3, (i + 2) % 3
        q[i] = 1.0 + m[i, i] - m[j, j] - m[k, k]
        q[j] = m[j, i] + m[i, j]
        q[k] = m[k, i] + m[i, k]
        q[3] = m[k, j] - m[j, k]
    q /= np.linalg.norm(q)
    return q if q[3] >= 0.0 else -q


def rotation_from_quaternion(q: ArrayLike) -> Matrix:
    """Return the rotation matrix of a quaternion (x, y, z, w), normalised first."""
    x, y, z, w = np.asarray(q, dtype=float) / np.linalg.norm(q)
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip


def orthonormal(R: Matrix) -> Matrix:
    """Return the rotation nearest to ``R`` (polar decomposition by SVD)."""
    U, _, Vt = np.linalg.svd(R)
    return U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt


def pose(R: Matrix, t: ArrayLike) -> Matrix:
    """Return the 4x4 transform of rotation ``R`` and translation ``t``."""
    T = np.eye(4)
    T[:3, :3] = R
    T[:3, 3] = t
    return T


def inverse(T: Matrix) -> Matrix:
    """Return the inverse of a rigid transform."""
    R = T[:3, :3].T
    return pose(R, -R @ T[:3, 3])


def apply(T: Matrix, points: Matrix) -> Matrix:
    """Return points (N, 3) moved by ``T``."""
    return points @ T[:3, :3].T + T[:3, 3]


def wrap_angle(angle_rad: float) -> float:
    """Return the same angle in [-pi, pi)."""
    return float((angle_rad + np.pi) % (2.0 * np.pi) - np.pi)


def rotation_z(yaw_rad: float) -> Matrix:
    """Return the rotation about z by ``yaw_rad``."""
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def level_camera(position_m: ArrayLike, yaw_rad: float) -> Matrix:
    """Return ``T_map_camera`` of a level camera that looks along ``yaw_rad`` (0 is map x, positive left)."""
    return pose(rotation_z(yaw_rad) @ R_BODY_CAMERA, position_m)


def camera_yaw(T_map_camera: Matrix) -> float:
    """Return the heading of the optical axis about map z, radians, 0 along x, positive to the left."""
    forward = T_map_camera[:3, 2]
    return float(np.arctan2(forward[1], forward[0]))


def rotation_aligning(a: ArrayLike, b: ArrayLike) -> Matrix:
    """Return the smallest rotation that takes direction ``a`` to direction ``b``."""
    u = np.asarray(a, dtype=float) / np.linalg.norm(a)
    v = np.asarray(b, dtype=float) / np.linalg.norm(b)
    axis, cosine = np.cross(u, v), float(u @ v)
    sine = float(np.linalg.norm(axis))
    if sine < 1e-12:
        if cosine > 0.0:
            return np.eye(3)
        helper = np.eye(3)[int(np.argmin(np.abs(u)))]
        perpendicular = np.cross(u, helper)
        return exp_rotation(np.pi * perpendicular / np.linalg.norm(perpendicular))
    return exp_rotation(axis / sine * np.arctan2(sine, cosine))


def to_transform(T: Matrix) -> Transform:
    """Return the message form of a 4x4 transform."""
    x, y, z = (float(v) for v in T[:3, 3])
    a, b, c, d = (float(v) for v in quaternion_from_rotation(T[:3, :3]))
    return Transform(position_m=(x, y, z), quaternion_xyzw=(a, b, c, d))


def from_transform(transform: Transform) -> Matrix:
    """Return the 4x4 transform of its message form."""
    return pose(rotation_from_quaternion(transform.quaternion_xyzw), transform.position_m)
