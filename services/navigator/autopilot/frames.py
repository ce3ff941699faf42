"""Between our frames and MAVLink's. NED's north is map x, east is minus map y, down is minus map z. Pure.

With ``D = diag(1, -1, -1)``: ``p_ned = D p_map``, ``R_ned_frd = D R_map_flu D``, ``yaw_ned = -yaw_map``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from services.common.geometry import (
    R_BODY_CAMERA,
    Matrix,
    hat,
    pose,
    quaternion_from_rotation,
    rotation_from_quaternion,
    rotation_z,
    wrap_angle,
)

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


@dataclass(frozen=True, slots=True)
class Mount:
    """How the camera sits on the aircraft: ``T_body_camera`` (4, 4)."""

    T_body_camera: Matrix

    @classmethod
    def level(cls, offset_m: tuple[float, float, float], pitch_rad: float = 0.0, yaw_rad: float = 0.0) -> Mount:
        """Return the mount of a camera that looks forward, turned by ``yaw_rad`` and down by ``pitch_rad``."""
        c, s = np.cos(pitch_rad), np.sin(pitch_rad)
        down = np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
        return cls(pose(rotation_z(yaw_rad) @ down @ R_BODY_CAMERA, offset_m))

    @property
    def offset_m(self) -> Matrix:
        """Camera centre in body (3,)."""
        return self.T_body_camera[:3, 3]

    @property
    def yaw_rad(self) -> float:
        """Heading of the camera relative to the body."""
        forward = self.T_body_camera[:3, 2]
        return float(np.arctan2(forward[1], forward[0]))

    def body(self, T_map_camera: Matrix) -> Matrix:
        """Return ``T_map_body`` (4, 4)."""
        R = T_map_camera[:3, :3] @ self.T_body_camera[:3, :3].T
        return pose(R, T_map_camera[:3, 3] - R @ self.offset_m)

    def body_setpoint(
        self, position_m: Matrix, yaw_rad: float, velocity_m_s: Matrix, yaw_rate_rad_s: float
    ) -> tuple[Matrix, float, Matrix]:
        """Return position (3,), yaw and velocity (3,) of the level body for those of the camera, all in map."""
        yaw = wrap_angle(yaw_rad - self.yaw_rad)
        arm = rotation_z(yaw) @ self.offset_m
        spin = yaw_rate_rad_s * np.array([-arm[1], arm[0], 0.0])
        return position_m - arm, yaw, velocity_m_s - spin


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
