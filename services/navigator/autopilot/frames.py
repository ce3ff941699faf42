"""Between our frames and MAVLink's. NED's north is map x, east is minus map y, down is minus map z. Pure.

With ``D = diag(1, -1, -1)``: ``p_ned = D p_map``, ``R_ned_frd = D R_map_flu D``, ``yaw_ned = -yaw_map``.
"""

from __future__ import annotations

import numpy as np

from services.common.geometry import Matrix, hat, quaternion_from_rotation, rotation_from_quaternion
from services.common.mount import Mount

D: Matrix = np.diag([1.0, -1.0, -1.0])
_SIGNS: Matrix = np.diag([1.0, -1.0, -1.0, 1.0, -1.0, -1.0])


def to_ned(v_map: Matrix) -> Matrix:
    """Return a vector or point (3,) of map in NED; the same function goes back."""
    return D @ v_map


def quaternion_ned(R_map_body: Matrix) -> tuple[float, float, float, float]:
    """Return (w, x, y, z) of the body (FRD) in NED; norm 1 within 1e-7 also in float32."""
    x, y, z, w = quaternion_from_rotation(D @ R_map_body @ D)
    return float(w), float(x), float(y), float(z)


def rotation_map_body(q_wxyz: tuple[float, float, float, float]) -> Matrix:
    """Return ``R_map_body`` (FLU) of MAVLink's quaternion (w, x, y, z), FRD in NED."""
    w, x, y, z = q_wxyz
    return D @ rotation_from_quaternion((x, y, z, w)) @ D


def covariance_ned(upper_map: tuple[float, ...], R_map_body: Matrix, mount: Mount) -> Matrix:
    """Return the (6, 6) covariance of the body's pose in NED from the camera's in map (21 values, upper triangle).

    ``p_body = p_camera - R r`` and a left perturbation ``exp(w) R`` give ``dp_body = dp_camera + hat(R r) w``.
    """
    C = np.zeros((6, 6))
    C[np.triu_indices(6)] = upper_map
    C = C + np.triu(C, 1).T
    J = np.eye(6)
    J[:3, 3:] = hat(R_map_body @ mount.offset_m)
    return _SIGNS @ J @ C @ J.T @ _SIGNS
