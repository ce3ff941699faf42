"""A known motion for the fusion's tests: place and attitude as formulas, and what an IMU and a camera make of them."""

from __future__ import annotations

import numpy as np

from services.common.geometry import R_BODY_CAMERA, Matrix, exp_rotation, log_rotation, pose, rotation_z
from services.fusion.inertial import GRAVITY_M_S2
from services.fusion.values import ImuReading, Located

T_BODY_CAMERA: Matrix = pose(R_BODY_CAMERA, (0.1, 0.0, 0.02))
START_NS = 5_000_000_000
FRAME_S = 1.0 / 15.0
_STEP_S = 1e-4


def stamp_ns(t_s: float) -> int:
    return START_NS + round(t_s * 1e9)


def true_body(t_s: float) -> Matrix:
    """Return ``T_map_body``: some metres about, with turns about all axes."""
    t = t_s
    place = np.array([1.5 * np.sin(0.6 * t), 1.2 * (1.0 - np.cos(0.5 * t)), 0.3 * np.sin(0.9 * t)])
    tilt = exp_rotation([0.12 * np.sin(1.1 * t), 0.09 * np.sin(1.7 * t + 0.5), 0.0])
    return pose(rotation_z(0.5 * np.sin(0.4 * t)) @ tilt, place)


def reading(
    t_s: float, period_s: float, rng: np.random.Generator | None = None, bias: float = 0.0, wild: float = 1.0
) -> ImuReading:
    """Return the mean rate and force over the period that ends at ``t_s``."""
    a, b = true_body(t_s - period_s), true_body(t_s)
    gyro = log_rotation(a[:3, :3].T @ b[:3, :3]) / period_s
    middle = t_s - 0.5 * period_s
    before, here, after = (true_body(middle + d)[:3, 3] for d in (-10 * _STEP_S, 0.0, 10 * _STEP_S))
    acceleration = (before - 2.0 * here + after) / (10 * _STEP_S) ** 2
    force = true_body(middle)[:3, :3].T @ (acceleration + np.array([0.0, 0.0, GRAVITY_M_S2]))
    noise = np.zeros(6) if rng is None else wild * rng.standard_normal(6) * np.repeat([0.004, 0.18], 3)
    return ImuReading(stamp_ns(t_s), gyro + noise[:3] + 0.05 * bias, force + noise[3:] + bias)


def located(t_s: float, rng: np.random.Generator | None = None, reset: int = 0, shift_m: float = 0.0) -> Located:
    """Return what slam tells of the camera at a moment."""
    noise = np.zeros(6) if rng is None else rng.standard_normal(6) * np.repeat([0.004, 0.001], 3)
    T = true_body(t_s) @ T_BODY_CAMERA
    T = pose(exp_rotation(noise[3:]) @ T[:3, :3], T[:3, 3] + noise[:3] + [shift_m, 0.0, 0.0])
    return Located(stamp_ns(t_s), T, np.diag(np.repeat([0.006**2, 0.002**2], 3)), ("map-1", reset))
