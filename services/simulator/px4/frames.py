"""The one place where the simulator changes between our frames and MAVLink's.

World (x, y, z up) and body (forward, left, up) are ours; the autopilot thinks in NED and FRD. With ``C`` =
diag(1, -1, -1) both changes are the same: a turn by pi about x. "North" of the simulator is therefore world x.
"""

from __future__ import annotations

import math

import numpy as np

from services.common.geometry import Matrix, quaternion_from_rotation, rotation_from_quaternion

FLIP: Matrix = np.diag([1.0, -1.0, -1.0])


def ned_from_world(p_world_m: Matrix) -> Matrix:
    """Return a world vector (3,) in the simulator's NED axes."""
    return FLIP @ p_world_m


def world_from_ned(p_ned_m: Matrix) -> Matrix:
    """Return a NED vector (3,) in world axes."""
    return FLIP @ p_ned_m


def quaternion_ned_from_world(R_world_body: Matrix) -> Matrix:
    """Return the quaternion (w, x, y, z) of FRD in NED for a FLU to world rotation."""
    x, y, z, w = quaternion_from_rotation(FLIP @ R_world_body @ FLIP)
    return np.array([w, x, y, z])


def rotation_from_wxyz(q: Matrix) -> Matrix:
    """Return the rotation matrix of a quaternion (w, x, y, z)."""
    return rotation_from_quaternion((q[1], q[2], q[3], q[0]))


def yaw_from_wxyz(q: Matrix) -> float:
    """Return the yaw of a body-to-NED quaternion, radians clockwise from north (z-y-x Euler angles)."""
    w, x, y, z = (float(v) for v in q)
    return math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


def euler_from_wxyz(q: Matrix) -> tuple[float, float, float]:
    """Return roll, pitch and yaw (z-y-x Euler angles), radians."""
    w, x, y, z = (float(v) for v in q)
    roll = math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    pitch = math.asin(max(-1.0, min(1.0, 2.0 * (w * y - z * x))))
    return roll, pitch, yaw_from_wxyz(q)


def wxyz_from_yaw(yaw_rad: float) -> Matrix:
    """Return the quaternion (w, x, y, z) of a level body."""
    return np.array([math.cos(0.5 * yaw_rad), 0.0, 0.0, math.sin(0.5 * yaw_rad)])
