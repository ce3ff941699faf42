"""The companion's two streams, judged as PX4 judges them: SET_POSITION_TARGET_LOCAL_NED and ODOMETRY."""

from __future__ import annotations

import math

import numpy as np
from pymavlink.dialects.v20 import common as m

from services.common.geometry import Matrix, rotation_z
from services.simulator.px4.control import Setpoint
from services.simulator.px4.telemetry import Message
from services.simulator.px4.vision import VisionSample

QUATERNION_NORM_TOLERANCE = 1e-5
_VISION_TYPES = {
    m.MAV_ESTIMATOR_TYPE_UNKNOWN,
    m.MAV_ESTIMATOR_TYPE_NAIVE,
    m.MAV_ESTIMATOR_TYPE_VISION,
    m.MAV_ESTIMATOR_TYPE_VIO,
}
_FORCE = 512
_FARTHEST_M = 1e5
"""A vision position beyond this is refused: what it would do to the wire formats helps nobody."""
_YAW, _YAW_RATE = 1024, 2048


def _masked(values: tuple[float, float, float], mask: int, first_bit: int) -> Matrix:
    taken = (not mask & (first_bit << i) and math.isfinite(v) for i, v in enumerate(values))
    return np.array([v if take else math.nan for v, take in zip(values, taken, strict=True)])


def setpoint_from_target(message: Message, yaw_rad: float) -> tuple[Setpoint | None, str]:
    """Return the setpoint of a SET_POSITION_TARGET_LOCAL_NED, or None and PX4's complaint.

    Frame LOCAL_NED takes all; BODY_NED takes velocity and acceleration, turned by ``yaw_rad`` alone.
    """
    mask = message.type_mask
    velocity = _masked((message.vx, message.vy, message.vz), mask, 8)
    acceleration = _masked((message.afx, message.afy, message.afz), mask, 64)
    position = np.full(3, math.nan)
    if message.coordinate_frame == m.MAV_FRAME_LOCAL_NED:
        position = _masked((message.x, message.y, message.z), mask, 1)
    elif message.coordinate_frame == m.MAV_FRAME_BODY_NED:
        R = rotation_z(yaw_rad)
        velocity, acceleration = R @ velocity, R @ acceleration
    else:
        return None, f"SET_POSITION_TARGET_LOCAL_NED frame {message.coordinate_frame} unsupported"
    if mask & _FORCE and np.isfinite(acceleration).any():
        return None, "SET_POSITION_TARGET_LOCAL_NED force not supported"
    setpoint = Setpoint(
        position,
        velocity,
        acceleration,
        yaw_rad=math.nan if mask & _YAW else message.yaw,
        yaw_rate_rad_s=math.nan if mask & _YAW_RATE else message.yaw_rate,
    )
    finite = np.isfinite(position) | np.isfinite(velocity) | np.isfinite(acceleration)
    paired = all(bool(np.isfinite(v[0])) == bool(np.isfinite(v[1])) for v in (position, velocity, acceleration))
    if not finite.all() or not paired:
        return None, "SET_POSITION_TARGET_LOCAL_NED invalid"
    return setpoint, ""


def vision_from_odometry(message: Message, stamp_s: float) -> tuple[VisionSample | None, str]:
    """Return the vision sample of an ODOMETRY, or None and what is said aloud (often nothing: PX4 is silent).

    Refused: frames other than LOCAL_NED and LOCAL_FRD, child frames other than BODY_FRD, a quaternion whose norm is
    off by more than 1e-5, and estimator types that are no vision (MOCAP without a word).
    """
    if message.estimator_type not in _VISION_TYPES:
        if message.estimator_type == m.MAV_ESTIMATOR_TYPE_MOCAP:
            return None, ""
        return None, f"ODOMETRY: estimator_type {message.estimator_type} unsupported"
    if message.frame_id not in (m.MAV_FRAME_LOCAL_NED, m.MAV_FRAME_LOCAL_FRD):
        return None, ""
    if message.child_frame_id != m.MAV_FRAME_BODY_FRD:
        return None, ""
    quaternion = np.array(message.q, dtype=float)
    if np.isfinite(quaternion).all() and abs(float(np.linalg.norm(quaternion)) - 1.0) > QUATERNION_NORM_TOLERANCE:
        return None, ""
    if np.abs(np.array([message.x, message.y, message.z])).max() > _FARTHEST_M:
        return None, ""
    told = message.estimator_type != m.MAV_ESTIMATOR_TYPE_NAIVE
    pose, speed = message.pose_covariance, message.velocity_covariance
    unknown = np.full(3, math.nan)
    sample = VisionSample(
        stamp_s=stamp_s,
        position_m=np.array([message.x, message.y, message.z]),
        quaternion_wxyz=quaternion,
        velocity_body_m_s=np.array([message.vx, message.vy, message.vz]),
        position_var=np.array([pose[0], pose[6], pose[11]]) if told else unknown,
        yaw_var=float(pose[20]) if told else math.nan,
        velocity_var=np.array([speed[0], speed[6], speed[11]]) if told else unknown,
        frame_is_ned=message.frame_id == m.MAV_FRAME_LOCAL_NED,
        reset_counter=message.reset_counter,
        quality=message.quality,
    )
    return sample, ""
