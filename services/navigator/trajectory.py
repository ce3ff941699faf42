"""The setpoint's own motion: from where it is towards a goal, never above the limits.

Position: wanted speed from the distance left (square-root braking curve, linear near the goal), acceleration and
its change limited, then the hard limits. Yaw the same in one dimension, counted without wrapping. Pure.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from services.common.geometry import Matrix, wrap_angle
from services.navigator.config import MotionConfig
from services.navigator.track import Correction

_BRAKE_SHARE = 0.6
"""Share of the acceleration limit that the braking curve counts on: the rest covers the jerk limit."""
_NEAR_GAIN_PER_S = 1.2
_RESPONSE_S = 0.25


@dataclass(frozen=True, slots=True)
class Aim:
    """Where the setpoint should go: camera position in map, unwrapped yaw, and how fast at most."""

    position_m: Matrix
    yaw_rad: float
    speed_m_s: float
    yaw_rate_rad_s: float
    gain_per_s: float = _NEAR_GAIN_PER_S


@dataclass(frozen=True, slots=True)
class Fence:
    """The cylinder that no setpoint leaves: centre and floor in map."""

    centre_m: Matrix
    floor_z_m: float
    radius_m: float
    height_m: float

    def clamp(self, p: Matrix) -> Matrix:
        """Return the point of the cylinder nearest to ``p`` (3,)."""
        q = p.copy()
        offset = q[:2] - self.centre_m[:2]
        distance = float(np.linalg.norm(offset))
        if distance > self.radius_m:
            q[:2] = self.centre_m[:2] + offset * (self.radius_m / distance)
        q[2] = float(np.clip(q[2], self.floor_z_m, self.floor_z_m + self.height_m))
        return q

    def excess_m(self, p: Matrix) -> float:
        """Return how far ``p`` is outside, 0 inside; below the floor does not count."""
        out = float(np.linalg.norm(p[:2] - self.centre_m[:2])) - self.radius_m
        return max(out, float(p[2]) - self.floor_z_m - self.height_m, 0.0)


class Trajectory:
    """State of the setpoint: position, velocity, acceleration, yaw (unwrapped), yaw rate."""

    def __init__(self, limits: MotionConfig) -> None:
        self.limits = limits
        self.fence: Fence | None = None
        self.placed = False
        """Whether the position below was ever taken from the aircraft's own: before that it must not be flown to."""
        self.position_m: Matrix = np.zeros(3)
        self.velocity_m_s: Matrix = np.zeros(3)
        self.accel_m_s2: Matrix = np.zeros(3)
        self.yaw_rad = 0.0
        self.yaw_rate_rad_s = 0.0

    def reset(self, position_m: Matrix, yaw_rad: float) -> None:
        """Stand still at a place; ``yaw_rad`` keeps the count of turns nearest to the present one."""
        self.position_m = np.array(position_m, dtype=float)
        self.placed = True
        self.yaw_rad += wrap_angle(yaw_rad - self.yaw_rad)
        self.freeze()

    def freeze(self) -> None:
        """Stop at once: what is commanded while nobody knows where the aircraft is."""
        self.velocity_m_s, self.accel_m_s2, self.yaw_rate_rad_s = np.zeros(3), np.zeros(3), 0.0

    def correct(self, correction: Correction) -> None:
        """Follow a correction of the map."""
        self.position_m = correction.point(self.position_m)
        self.velocity_m_s = correction.vector(self.velocity_m_s)
        self.accel_m_s2 = correction.vector(self.accel_m_s2)
        self.yaw_rad += correction.yaw_rad
        if self.fence is not None:
            floor_z_m = self.fence.floor_z_m + float(correction.shift_m[2])
            self.fence = replace(self.fence, centre_m=correction.point(self.fence.centre_m), floor_z_m=floor_z_m)

    def unwrapped(self, yaw_rad: float) -> float:
        """Return the yaw equal to ``yaw_rad`` that is nearest to the setpoint's: the smaller turn."""
        return self.yaw_rad + wrap_angle(yaw_rad - self.yaw_rad)

    def brake(self, dt_s: float) -> None:
        """Come to rest smoothly."""
        still = Aim(self.position_m, self.yaw_rad, 0.0, 0.0)
        self.advance(still, dt_s, None)

    def advance(self, aim: Aim, dt_s: float, actual_m: Matrix | None) -> None:
        """Move on by ``dt_s``; ``actual_m`` (3,) is where the camera is, for the leash."""
        goal = aim if self.fence is None else replace(aim, position_m=self.fence.clamp(aim.position_m))
        self._advance_position(goal, dt_s, self._leash(actual_m))
        self._advance_yaw(goal, dt_s)

    def _leash(self, actual_m: Matrix | None) -> float:
        if actual_m is None:
            return 1.0
        behind = float(np.linalg.norm(self.position_m - actual_m))
        half = 0.5 * self.limits.leash_m
        return float(np.clip((self.limits.leash_m - behind) / half, 0.0, 1.0))

    def _advance_position(self, aim: Aim, dt_s: float, share: float) -> None:
        lim = self.limits
        to_go = aim.position_m - self.position_m
        distance = float(np.linalg.norm(to_go))
        top = min(aim.speed_m_s, lim.max_speed_m_s) * share
        speed = min(top, aim.gain_per_s * distance, float(np.sqrt(2.0 * _BRAKE_SHARE * lim.max_accel_m_s2 * distance)))
        wanted = to_go * (speed / distance) if distance > 1e-9 else np.zeros(3)
        accel = _clipped((wanted - self.velocity_m_s) / _RESPONSE_S, lim.max_accel_m_s2)
        self.accel_m_s2 = self.accel_m_s2 + _clipped(accel - self.accel_m_s2, lim.max_jerk_m_s3 * dt_s)
        velocity = _clipped(self.velocity_m_s + self.accel_m_s2 * dt_s, lim.max_speed_m_s)
        moved = self.position_m + velocity * dt_s
        if self.fence is not None and self.fence.excess_m(self.position_m) == 0.0:
            kept = self.fence.clamp(moved)
            if not np.array_equal(kept, moved):
                velocity, self.accel_m_s2 = (kept - self.position_m) / max(dt_s, 1e-6), np.zeros(3)
                moved = kept
        self.velocity_m_s, self.position_m = _clipped(velocity, lim.max_speed_m_s), moved

    def _advance_yaw(self, aim: Aim, dt_s: float) -> None:
        lim = self.limits
        to_go = aim.yaw_rad - self.yaw_rad
        top = min(aim.yaw_rate_rad_s, lim.max_yaw_rate_rad_s)
        braking = float(np.sqrt(2.0 * _BRAKE_SHARE * lim.max_yaw_accel_rad_s2 * abs(to_go)))
        rate = float(np.sign(to_go)) * min(top, 2.0 * _NEAR_GAIN_PER_S * abs(to_go), braking)
        change = lim.max_yaw_accel_rad_s2 * dt_s
        self.yaw_rate_rad_s += float(np.clip(rate - self.yaw_rate_rad_s, -change, change))
        self.yaw_rate_rad_s = float(np.clip(self.yaw_rate_rad_s, -lim.max_yaw_rate_rad_s, lim.max_yaw_rate_rad_s))
        self.yaw_rad += self.yaw_rate_rad_s * dt_s


def _clipped(v: Matrix, limit: float) -> Matrix:
    norm = float(np.linalg.norm(v))
    return v if norm <= limit else v * (limit / norm)
