"""Which way is up: the map's vertical from accelerometer, attitude, the ground, or nothing."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.common.geometry import inverse, pose, rotation_aligning, rotation_z

F64 = NDArray[np.float64]
PoseOf = Callable[[int], F64]
"""T_map_keyframe (4, 4) of a keyframe by its id, as it is now; KeyError when it is gone."""

SIGMA_ACCEL_RAD = math.radians(3.0)
"""A hand-held or hovering camera's single reading against true gravity."""
SIGMA_ATTITUDE_RAD = math.radians(0.8)
"""The autopilot's: its own accelerometer's bias."""
SIGMA_GROUND_RAD = math.radians(6.0)
"""Ground slopes."""
SIGMA_UNKNOWN_RAD = math.radians(10.0)
"""The first camera taken as level."""
STANDARD_M_S2 = 9.80665
_LEAST_NORM = 0.5
"""Of a measured up or specific force (1 or 9.81 at rest): below it there is no sensor, or free fall."""
_WINDOW_S = 2.0
_HOP_S = 0.5
_GAP_S = 0.5
"""Rows farther apart belong to no common window."""
_MOST_WINDOWS = 600
_BIAS_M_S2 = 0.3
"""Standard deviation, per axis, of what an accelerometer or an attitude is wrong by in its own body (as a force): 0.08 in
simulation, 0.6 on the Kinect of the recordings, most of it mounting."""
_MAGNITUDE_M_S2 = 0.05
"""Local gravity, and the scale of the sensor."""
_LEAST_NOISE_M_S2 = 0.03
_LEAST_ROWS = 8
_LEAN_RAD = math.radians(0.25)
_SELDOM_NS = 2_000_000_000
_MAP_SIGMA_RAD = math.radians(0.1)
"""The map's own bend."""
_OVERLAP = _WINDOW_S / _HOP_S
"""Windows share their rows: so many count for one."""


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


@dataclass(frozen=True, slots=True)
class _Row:
    """What was felt at one tracked frame."""

    t_s: float
    keyframe: int
    T_keyframe_camera: F64
    force_camera: F64


@dataclass(frozen=True, slots=True)
class _Window:
    """Some seconds of rows as one equation, in the frame of a keyframe: ``mean = gravity + turn @ bias``."""

    keyframe: int
    turn: F64
    """(3, 3) mean rotation from the body to the keyframe."""
    mean: F64
    """(3,) specific force less the camera's own acceleration, m/s^2."""


@dataclass(frozen=True, slots=True)
class Vertical:
    """Which way is up."""

    up: F64
    """(3,), unit, map."""
    sigma_rad: float
    """Standard deviation about the worse horizontal axis."""
    bias_m_s2: F64
    """(3,) of the sensor, its own axes."""


class Level:
    """Finds gravity in the map together with the sensor's bias in its body, from what the tracked camera felt.

    Specific force turned into the map is gravity, plus the sensor's bias turned with the camera, plus the camera's
    acceleration. Gravity stays and the bias turns: a turn on the spot tells them apart. Under a smooth window w that
    vanishes at both ends the mean acceleration is the mean of the positions under w'' (integration by parts, twice), so
    that the motion is taken out without differentiating noisy positions. All is kept relative to keyframes: it follows
    what later becomes of the map. ``feels_motion`` is false for an attitude's up, which gives gravity alone.
    """

    def __init__(self, *, feels_motion: bool = True) -> None:
        self._feels_motion = feels_motion
        self._rows: deque[_Row] = deque()
        self._windows: deque[_Window] = deque(maxlen=_MOST_WINDOWS)
        self._next_s = 0.0

    def add(
        self, stamp_ns: int, keyframe: int, T_keyframe_camera: F64, force_camera: F64, keyframe_pose: PoseOf
    ) -> bool:
        """Take one frame's mean specific force (3,), m/s^2 (an attitude: its up times gravity); True at a new window.

        The frame stands at ``T_keyframe_camera`` from a keyframe near to it.
        """
        t_s = stamp_ns * 1e-9
        if self._rows and not 0.0 < t_s - self._rows[-1].t_s <= _GAP_S:
            self._rows.clear()
        if not self._rows:
            self._next_s = t_s + _WINDOW_S
        self._rows.append(_Row(t_s, keyframe, T_keyframe_camera, force_camera))
        if t_s < self._next_s or len(self._rows) < _LEAST_ROWS:
            return False
        self._next_s = t_s + _HOP_S
        while t_s - self._rows[1].t_s >= _WINDOW_S:
            self._rows.popleft()
        try:
            self._windows.append(self._condense(keyframe_pose))
        except KeyError:  # a keyframe under these rows has left the map for good
            self._rows.clear()
            return False
        return True

    def _condense(self, keyframe_pose: PoseOf) -> _Window:
        rows = self._rows
        keyframe = rows[-1].keyframe
        base = inverse(keyframe_pose(keyframe))
        relative = {k: base @ keyframe_pose(k) for k in sorted({row.keyframe for row in rows})}
        T = np.array([relative[row.keyframe] @ row.T_keyframe_camera for row in rows])
        t = np.array([row.t_s for row in rows])
        R, position = T[:, :3, :3], T[:, :3, 3]
        force = np.einsum("nij,nj->ni", R, np.array([row.force_camera for row in rows]))
        length = t[-1] - t[0]
        phase = 2.0 * math.pi * (t - t[0]) / length
        share = np.gradient(t) / length
        weight = share * (1.0 - np.cos(phase))
        weight /= weight.sum()
        mean = weight @ force
        if self._feels_motion:
            curvature = share * (2.0 * math.pi / length) ** 2 * np.cos(phase)
            mean = mean - curvature @ (position - position.mean(axis=0))
        return _Window(keyframe, np.einsum("n,nij->ij", weight, R), mean)

    def vertical(self, keyframe_pose: PoseOf) -> Vertical | None:
        """Return up as all windows tell it, None before the first."""
        known: dict[int, F64 | None] = {}
        turns, means = [], []
        for window in self._windows:
            if window.keyframe not in known:
                known[window.keyframe] = _rotation(keyframe_pose, window.keyframe)
            R = known[window.keyframe]
            if R is not None:
                turns.append(R @ window.turn)
                means.append(R @ window.mean)
        return fit(np.array(turns), np.array(means)) if turns else None


def _rotation(keyframe_pose: PoseOf, keyframe: int) -> F64 | None:
    try:
        return keyframe_pose(keyframe)[:3, :3]
    except KeyError:
        return None


class Upright:
    """Keeps the doubt of the map's vertical, and says when the map is to be turned."""

    def __init__(self) -> None:
        self.sigma_rad = SIGMA_UNKNOWN_RAD
        self._levels = (Level(), Level(feels_motion=False))
        self._corrected_ns = -(10**18)

    def begin(
        self, accel_camera: F64 | None, attitude_up_camera: F64 | None, ground_up_camera: Callable[[], F64 | None]
    ) -> F64 | None:
        """Return the first camera's up (3,): from the autopilot, else the accelerometer, else the ground; None: nothing."""
        if attitude_up_camera is not None:
            self.sigma_rad = SIGMA_ATTITUDE_RAD
            return attitude_up_camera
        if accel_camera is not None:
            self.sigma_rad = SIGMA_ACCEL_RAD
            return accel_camera
        ground = ground_up_camera()
        if ground is not None:
            self.sigma_rad = SIGMA_GROUND_RAD
        return ground

    def feel(
        self, stamp_ns: int, keyframe: int, T_keyframe_camera: F64, accel_camera: F64 | None,
        attitude_up_camera: F64 | None, keyframe_pose: PoseOf,
    ) -> F64 | None:  # fmt: skip
        """Take a tracked frame; return up (3,) in the map when the map has to be turned to it.

        It is turned when it leans by more than a bound and by more than half of what is not known; seldom, for all who
        use the map are told to start afresh.
        """
        new = False
        attitude = None if attitude_up_camera is None else attitude_up_camera * STANDARD_M_S2
        for level, force in zip(self._levels, (accel_camera, attitude), strict=True):
            if force is not None:
                new |= level.add(stamp_ns, keyframe, T_keyframe_camera, force, keyframe_pose)
        if not new:
            return None
        found = [v for v in (level.vertical(keyframe_pose) for level in self._levels) if v is not None]
        if not found:
            return None
        best = min(found, key=lambda v: v.sigma_rad)
        lean_rad = math.acos(min(float(best.up[2]), 1.0))
        sigma_rad = math.hypot(best.sigma_rad, _MAP_SIGMA_RAD)
        due = stamp_ns - self._corrected_ns >= _SELDOM_NS
        if due and lean_rad > max(_LEAN_RAD, 0.5 * sigma_rad):
            self._corrected_ns = stamp_ns
            self.sigma_rad = sigma_rad
            return best.up
        self.sigma_rad = math.hypot(sigma_rad, lean_rad)
        return None


def fit(turns: F64, means: F64) -> Vertical:
    """Return up and bias that explain ``means`` (N, 3) = gravity + ``turns`` (N, 3, 3) bias, robustly.

    Priors: gravity's magnitude, the bias's usual size; the noise is taken from what is left over.
    """
    A = np.concatenate([np.tile(np.eye(3), (len(turns), 1, 1)), turns], axis=2)
    x = np.concatenate([means.mean(axis=0), np.zeros(3)])
    weight, sigma = np.ones(len(turns)), 0.2
    covariance = np.eye(6)
    for _ in range(8):
        up = x[:3] / max(float(np.linalg.norm(x[:3])), 1e-9)
        scale = weight / (sigma**2 * _OVERLAP)
        H = np.einsum("n,nia,nib->ab", scale, A, A)
        g = np.einsum("n,nia,ni->a", scale, A, means)
        H[:3, :3] += np.outer(up, up) / _MAGNITUDE_M_S2**2
        g[:3] += up * STANDARD_M_S2 / _MAGNITUDE_M_S2**2
        H[3:, 3:] += np.eye(3) / _BIAS_M_S2**2
        covariance = np.linalg.inv(H)
        x = covariance @ g
        left = np.linalg.norm(means - A @ x, axis=1)
        sigma = max(_LEAST_NOISE_M_S2, float(np.median(left)) / 1.54)  # median of a 3D normal's length
        weight = np.minimum(1.0, 2.5 * sigma / np.maximum(left, 1e-9))
    up = x[:3] / np.linalg.norm(x[:3])
    across = np.eye(3) - np.outer(up, up)
    worst = float(np.linalg.eigvalsh(across @ covariance[:3, :3] @ across)[-1])
    return Vertical(up, math.sqrt(worst) / STANDARD_M_S2, x[3:])


def levelling(up_map: F64, forward_map: F64 | None) -> F64:
    """Return the rotation (3, 3) of the map that makes ``up_map`` z while the heading of ``forward_map`` stays along x.

    None: nothing is known to look along x, and the least rotation is it.
    """
    R = rotation_aligning(up_map, [0.0, 0.0, 1.0])
    if forward_map is None:
        return R
    forward = R @ forward_map
    if math.hypot(forward[0], forward[1]) < math.sin(math.radians(2.0)):
        return R
    return rotation_z(-math.atan2(forward[1], forward[0])) @ R
