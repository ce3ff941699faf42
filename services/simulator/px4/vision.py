"""External vision as the estimator takes it."""

from __future__ import annotations

from dataclasses import dataclass

from services.common.geometry import Matrix

EV_HPOS, EV_VPOS, EV_VEL, EV_YAW = 1, 2, 4, 8
"""Bits of EKF2_EV_CTRL."""


@dataclass(frozen=True, slots=True)
class VisionSample:
    """One accepted ODOMETRY message in the estimator's time and axes. NaN means: not told."""

    stamp_s: float
    position_m: Matrix
    quaternion_wxyz: Matrix
    velocity_body_m_s: Matrix
    position_var: Matrix
    yaw_var: float
    velocity_var: Matrix
    frame_is_ned: bool
    reset_counter: int
    quality: int = 0


@dataclass(slots=True)
class VisionFlags:
    """What of the vision is being fused."""

    position: bool = False
    height: bool = False
    yaw: bool = False
    velocity: bool = False
