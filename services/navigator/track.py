"""The recent poses: velocity, prediction, and what kind of step each new pose is.

Shared by the mission and the autopilot bridge, so that both see the same corrections. Pure.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from enum import Enum

import numpy as np

from schemas.slam import Pose
from services.common.geometry import (
    Matrix,
    camera_yaw,
    exp_rotation,
    from_transform,
    log_rotation,
    rotation_z,
    wrap_angle,
)


class Step(Enum):
    """How a pose follows the one before."""

    LOST = "lost"
    """No trustworthy pose in it."""
    FIRST = "first"
    SMOOTH = "smooth"
    CORRECTION = "correction"
    """Slam says it moved the map (reset_counter), and by how much is known: see ``Correction``."""
    RELOCATED = "relocated"
    """Slam says it moved the map, or the map is another, and by how much cannot be known."""
    JUMP = "jump"
    """The pose jumped and slam did not say so."""
    STALE = "stale"
    """Not newer than the last one; ignored."""


@dataclass(frozen=True, slots=True)
class Correction:
    """Takes old map coordinates to new ones: ``p_new = Rz(yaw) p_old + shift``. A map stays level."""

    yaw_rad: float
    shift_m: Matrix

    def point(self, p: Matrix) -> Matrix:
        """Return a point (3,) in the corrected map."""
        return rotation_z(self.yaw_rad) @ p + self.shift_m

    def back(self, p: Matrix) -> Matrix:
        """Return where a point (3,) of the corrected map was before."""
        return rotation_z(-self.yaw_rad) @ (p - self.shift_m)

    def vector(self, v: Matrix) -> Matrix:
        """Return a vector (3,) in the corrected map."""
        return rotation_z(self.yaw_rad) @ v

    def after(self, earlier: Correction) -> Correction:
        """Return the correction that does ``earlier`` first and then this one."""
        return Correction(self.yaw_rad + earlier.yaw_rad, self.point(earlier.shift_m))


@dataclass(frozen=True, slots=True)
class Sample:
    """One tracked pose. ``T_map_camera`` (4, 4)."""

    stamp_ns: int
    received_ns: int
    T_map_camera: Matrix
    map_id: str
    reset_counter: int

    @property
    def position_m(self) -> Matrix:
        """Camera centre in map (3,)."""
        return self.T_map_camera[:3, 3]

    @property
    def yaw_rad(self) -> float:
        """Heading of the camera."""
        return camera_yaw(self.T_map_camera)


@dataclass(frozen=True, slots=True)
class TrackLimits:
    """When a step is a jump, and how far back and ahead the constant velocity holds."""

    jump_m: float = 0.4
    jump_rad: float = float(np.radians(15.0))
    speed_m_s: float = 1.5
    """Added to the limits for the time between two poses."""
    turn_rad_s: float = float(np.radians(60.0))
    window_s: float = 0.35
    bridge_s: float = 0.6
    """A correction after a longer gap than this cannot be told from motion."""


class PoseTrack:
    """Follows ``slam/pose``; velocities are least-squares slopes over a short window."""

    def __init__(self, limits: TrackLimits | None = None) -> None:
        self.limits = limits or TrackLimits()
        self.latest: Sample | None = None
        """The last tracked pose, also while lost."""
        self.lost = True
        self.correction: Correction | None = None
        """Of the last pose, when its step was a CORRECTION."""
        self.velocity_m_s: Matrix = np.zeros(3)
        self.turn_rad_s: Matrix = np.zeros(3)
        """Angular velocity in map."""
        self._window: deque[Sample] = deque(maxlen=16)

    def add(self, pose: Pose, received_ns: int) -> Step:
        """Take the next pose; ``correction`` is set only when the answer is CORRECTION."""
        self.correction = None
        if pose.T_map_camera is None or pose.status != "tracking":
            self.lost = True
            return Step.LOST
        if self.latest is not None and pose.stamp_ns <= self.latest.stamp_ns and pose.map_id == self.latest.map_id:
            return Step.STALE
        sample = Sample(pose.stamp_ns, received_ns, from_transform(pose.T_map_camera), pose.map_id, pose.reset_counter)
        step = self._classify(sample)
        if step is not Step.SMOOTH:
            self._window.clear()
        if step in (Step.FIRST, Step.RELOCATED, Step.JUMP):
            self.velocity_m_s, self.turn_rad_s = np.zeros(3), np.zeros(3)
        elif step is Step.CORRECTION:
            self._turn_velocity()
        self._window.append(sample)
        self.latest, self.lost = sample, False
        self._estimate()
        return step

    def predict(self, stamp_ns: int) -> Matrix:
        """Return ``T_map_camera`` (4, 4) at ``stamp_ns`` by constant velocity from the last tracked pose.

        Raises:
            ValueError: before the first pose.
        """
        if self.latest is None:
            raise ValueError("no pose yet")
        dt = (stamp_ns - self.latest.stamp_ns) / 1e9
        T = self.latest.T_map_camera.copy()
        T[:3, 3] += self.velocity_m_s * dt
        T[:3, :3] = exp_rotation(self.turn_rad_s * dt) @ T[:3, :3]
        return T

    def _classify(self, sample: Sample) -> Step:
        last = self.latest
        if last is None:
            return Step.FIRST
        told = sample.reset_counter != last.reset_counter or sample.map_id != last.map_id
        dt = (sample.stamp_ns - last.stamp_ns) / 1e9
        if told and not 0.0 < dt <= self.limits.bridge_s:
            return Step.RELOCATED
        predicted = self.predict(sample.stamp_ns)
        if told:
            self.correction = correction_between(predicted, sample.T_map_camera)
            return Step.CORRECTION
        distance = float(np.linalg.norm(sample.position_m - predicted[:3, 3]))
        turn = abs(wrap_angle(sample.yaw_rad - camera_yaw(predicted)))
        if distance > self.limits.jump_m + self.limits.speed_m_s * max(
            dt - 0.1, 0.0
        ) or turn > self.limits.jump_rad + self.limits.turn_rad_s * max(dt - 0.1, 0.0):
            return Step.JUMP
        return Step.SMOOTH

    def _turn_velocity(self) -> None:
        if self.correction is not None:
            self.velocity_m_s = self.correction.vector(self.velocity_m_s)

    def _estimate(self) -> None:
        newest = self._window[-1].stamp_ns
        recent = [s for s in self._window if newest - s.stamp_ns <= self.limits.window_s * 1e9]
        if len(recent) < 3:
            return
        t = np.array([(s.stamp_ns - newest) / 1e9 for s in recent])
        t -= t.mean()
        spread = float(t @ t)
        if spread < 1e-6:
            return
        self.velocity_m_s = t @ np.array([s.position_m for s in recent]) / spread
        last = recent[-1].T_map_camera[:3, :3]
        turns = np.array([-log_rotation(last @ s.T_map_camera[:3, :3].T) for s in recent])
        self.turn_rad_s = t @ turns / spread


def correction_between(T_old: Matrix, T_new: Matrix) -> Correction:
    """Return the level correction that takes pose ``T_old`` to ``T_new`` (both ``T_map_camera``)."""
    yaw = wrap_angle(camera_yaw(T_new) - camera_yaw(T_old))
    return Correction(yaw, T_new[:3, 3] - rotation_z(yaw) @ T_old[:3, 3])
