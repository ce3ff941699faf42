"""How the camera sits on the aircraft, from one picture of a board that stands in a known place before it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.camera.calibration.board import Board, Sighting
from services.camera.calibration.solve import board_pose
from services.common.geometry import R_BODY_CAMERA, inverse, pose, rotation_z

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Mounting:
    """``T_body_camera`` and what the autopilot bridge wants of it."""

    T_body_camera: Floats

    @property
    def offset_m(self) -> tuple[float, float, float]:
        """Camera centre in body: forward, left, up."""
        x, y, z = (float(v) for v in self.T_body_camera[:3, 3])
        return x, y, z

    @property
    def angles_rad(self) -> tuple[float, float, float]:
        """Roll, pitch (positive: looking down), yaw (positive: looking left) from looking straight ahead."""
        R = self.T_body_camera[:3, :3] @ R_BODY_CAMERA.T
        yaw, pitch = math.atan2(R[1, 0], R[0, 0]), math.atan2(-R[2, 0], math.hypot(R[0, 0], R[1, 0]))
        return math.atan2(R[2, 1], R[2, 2]), pitch, yaw


def board_in_body(centre_m: tuple[float, float, float], roll_pitch_yaw_rad: tuple[float, float, float]) -> Floats:
    """Return ``T_body_board``: angles all zero is a board upright and square to the aircraft's forward axis."""
    roll, pitch, yaw = roll_pitch_yaw_rad
    cr, sr, cp, sp = math.cos(roll), math.sin(roll), math.cos(pitch), math.sin(pitch)
    about_x = np.array([[1.0, 0.0, 0.0], [0.0, cr, -sr], [0.0, sr, cr]])
    about_y = np.array([[cp, 0.0, sp], [0.0, 1.0, 0.0], [-sp, 0.0, cp]])
    return pose(rotation_z(yaw) @ about_y @ about_x @ R_BODY_CAMERA, centre_m)


def mounting(sighting: Sighting, board: Board, K: Floats, distortion: Floats, T_body_board: Floats) -> Mounting | None:
    """Return the mounting: ``T_body_board`` times the inverse of ``T_camera_board``; None without a pose."""
    T_camera_board = board_pose(sighting, board, K, distortion)
    return None if T_camera_board is None else Mounting(T_body_board @ inverse(T_camera_board))
