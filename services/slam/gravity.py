"""Which way is up: the map's vertical from accelerometer, attitude or nothing."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from services.common.geometry import pose

F64 = NDArray[np.float64]

SIGMA_ACCEL_RAD = math.radians(1.0)
"""A hand-held or hovering camera's single reading against true gravity."""
SIGMA_ATTITUDE_RAD = math.radians(0.5)
SIGMA_UNKNOWN_RAD = math.radians(10.0)
"""The first camera taken as level."""


def first_pose(up_camera: F64 | None) -> F64:
    """Return T_map_camera (4, 4) of the first camera: at the origin, z up, x its heading on the horizontal.

    ``up_camera`` (3,) is up in the camera's frame, any length; None takes the camera as level. A camera that looks
    straight up or down has no heading: its image's top then points along x.
    """
    up = np.array([0.0, -1.0, 0.0]) if up_camera is None else np.asarray(up_camera, dtype=float)
    up = up / np.linalg.norm(up)
    forward = np.array([0.0, 0.0, 1.0])
    if abs(float(up @ forward)) > math.cos(math.radians(2.0)):
        forward = np.array([0.0, -1.0, 0.0])
    x = forward - (forward @ up) * up
    x /= np.linalg.norm(x)
    return pose(np.stack([x, np.cross(up, x), up]), np.zeros(3))
