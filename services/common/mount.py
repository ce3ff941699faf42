"""How a camera sits on the aircraft. Pure."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from services.common.geometry import R_BODY_CAMERA, Matrix, pose, rotation_z, wrap_angle


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
