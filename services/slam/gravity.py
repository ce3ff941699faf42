"""Which way is up: the map's vertical from accelerometer, attitude or nothing."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from services.common.geometry import pose, rotation_aligning, rotation_z

F64 = NDArray[np.float64]

SIGMA_ACCEL_RAD = math.radians(3.0)
"""A hand-held or hovering camera's single reading against true gravity."""
SIGMA_ATTITUDE_RAD = math.radians(0.5)
SIGMA_UNKNOWN_RAD = math.radians(10.0)
"""The first camera taken as level."""
_LEAST_NORM = 0.5
"""Of a measured up or specific force (1 or 9.81 at rest): below it there is no sensor, or free fall."""
_LEVEL_AT_S = (2.0, 5.0, 12.0)
_LEVEL_SIGMA_RAD = (math.radians(2.0), math.radians(2.0), math.radians(2.0))
"""After so long the vertical is corrected, and is then good to this: the accelerometer's own bias and mounting (3 to 4 deg
on the Kinect of the recordings, against their motion capture; 0.5 deg in simulation)."""


def direction(vector: F64 | None) -> F64 | None:
    """Return a measured vector (3,) if it has a direction at all; a dead sensor's zeros and NaN give None."""
    if vector is None or not np.isfinite(vector).all() or float(np.linalg.norm(vector)) < _LEAST_NORM:
        return None
    return np.asarray(vector, dtype=float)


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


class Level:
    """Finds the map's error against gravity from what the tracked camera felt; asks for a correction now and then.

    Specific force turned into the map is gravity plus the camera's acceleration. Under a smooth window w that vanishes at
    both ends, the mean acceleration is the mean of the positions under w'' (integration by parts, twice), so that the
    motion is taken out without differentiating noisy positions.
    """

    def __init__(self) -> None:
        self._rows: list[tuple[float, F64, F64]] = []
        self._start_ns = -1
        self._stage = 0

    def add(self, stamp_ns: int, T_map_camera: F64, accel_camera: F64) -> tuple[F64, float] | None:
        """Take one frame's mean specific force (3,), m/s^2; return now and then (up in the map (3,), its sigma, rad)."""
        if self._stage == len(_LEVEL_AT_S):
            return None
        if self._start_ns < 0:
            self._start_ns = stamp_ns
        t_s = (stamp_ns - self._start_ns) * 1e-9
        self._rows.append((t_s, T_map_camera[:3, :3] @ accel_camera, T_map_camera[:3, 3].copy()))
        if t_s < _LEVEL_AT_S[self._stage]:
            return None
        sigma_rad = _LEVEL_SIGMA_RAD[self._stage]
        self._stage += 1
        return self.up(), sigma_rad

    def up(self) -> F64:
        """Return up (3,), unit, in the map as it stood when the frames were added."""
        t = np.array([row[0] for row in self._rows])
        force = np.array([row[1] for row in self._rows])
        position = np.array([row[2] for row in self._rows])
        length = t[-1] - t[0]
        phase = 2.0 * math.pi * (t - t[0]) / length
        share = np.gradient(t) / length
        weight = share * (1.0 - np.cos(phase))
        weight /= weight.sum()
        curvature = share * (2.0 * math.pi / length) ** 2 * np.cos(phase)
        gravity = weight @ force - curvature @ (position - position.mean(axis=0))
        return gravity / np.linalg.norm(gravity)

    def turn(self, R: F64) -> None:
        """Turn all that was added with the map: ``R`` takes old map directions to new ones."""
        self._rows = [(t, R @ force, R @ position) for t, force, position in self._rows]

    def restart(self) -> None:
        """Forget what was added: the map has jumped or tracking was lost."""
        self._rows = []
        self._start_ns = -1


def levelling(up_map: F64, forward_map: F64) -> F64:
    """Return the rotation (3, 3) of the map that makes ``up_map`` z while the heading of ``forward_map`` stays along x."""
    R = rotation_aligning(up_map, [0.0, 0.0, 1.0])
    forward = R @ forward_map
    if math.hypot(forward[0], forward[1]) < math.sin(math.radians(2.0)):
        return R
    return rotation_z(-math.atan2(forward[1], forward[0])) @ R
