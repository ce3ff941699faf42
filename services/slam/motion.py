"""How the camera moves between frames: where it is expected next, and what it cannot have done."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.common.geometry import exp_rotation, inverse, log_rotation, pose

F64 = NDArray[np.float64]

_KEEPS_S = 0.35
"""A velocity is worth something for so long."""
_LEAST_S = 0.008
"""Frames nearer in time tell no velocity: a centimetre of noise in a millisecond is 10 m/s, and stamps made on arrival bunch."""
_ACCELERATION_M_S2 = 15.0
_ANGULAR_ACCELERATION_RAD_S2 = 60.0
_SLACK_M = 0.04
_SLACK_RAD = 0.04
_SPEED_M_S = 3.0
_TURN_RAD_S = 7.0
"""Hands and aircraft do not exceed these; a pose that asks for more is a wrong pose."""


@dataclass(frozen=True, slots=True)
class Velocity:
    """Of the camera, in its own axes."""

    v_m_s: F64
    w_rad_s: F64


STILL = Velocity(np.zeros(3), np.zeros(3))


class Motion:
    """Constant velocity in the camera's frame, over any time between frames."""

    def __init__(self) -> None:
        self._stamp_ns: int | None = None
        self._v_m_s = np.zeros(3)
        self._w_rad_s = np.zeros(3)
        self._sure = False
        """Whether a velocity has been measured since tracking (re)started."""
        self._step_s = 0.0

    def forget(self) -> None:
        """Start anew: the last pose has nothing to do with the next."""
        self._stamp_ns, self._sure = None, False
        self._v_m_s, self._w_rad_s = np.zeros(3), np.zeros(3)

    def predict(self, stamp_ns: int) -> F64:
        """Return T_last_camera (4, 4) expected at a stamp."""
        dt_s = self.since_s(stamp_ns)
        if self.stale(stamp_ns):
            return np.eye(4)
        return pose(exp_rotation(self._w_rad_s * dt_s), self._v_m_s * dt_s)

    def velocity(self, stamp_ns: int, T_last_camera: F64 | None = None) -> Velocity:
        """Return the camera's velocity at a stamp.

        Without ``T_last_camera`` that of the last step goes on; with it, that of this step goes on changing as it did.
        """
        dt_s = self.since_s(stamp_ns)
        if self.stale(stamp_ns):
            return STILL
        if T_last_camera is None or dt_s < _LEAST_S:
            return Velocity(self._v_m_s, self._w_rad_s)
        v_m_s, w_rad_s = T_last_camera[:3, 3] / dt_s, log_rotation(T_last_camera[:3, :3]) / dt_s
        if not self._sure:
            return Velocity(v_m_s, w_rad_s)
        share = dt_s / (dt_s + self._step_s)
        return Velocity(v_m_s + share * (v_m_s - self._v_m_s), w_rad_s + share * (w_rad_s - self._w_rad_s))

    @property
    def measured(self) -> Velocity | None:
        """Return the velocity of the last step, None when there was none."""
        return Velocity(self._v_m_s, self._w_rad_s) if self._sure else None

    def plausible(self, stamp_ns: int, T_last_camera: F64) -> bool:
        """Return whether the camera can have moved so since the last frame."""
        dt_s = max(self.since_s(stamp_ns), self._step_s)  # stamps may bunch: frames were still taken one after another
        if not can_have_moved(dt_s, T_last_camera):
            return False
        if not self._sure or dt_s > _KEEPS_S:
            return True
        off = inverse(self.predict(stamp_ns)) @ T_last_camera
        off_m, off_rad = float(np.linalg.norm(off[:3, 3])), float(np.linalg.norm(log_rotation(off[:3, :3])))
        return (
            off_m <= _ACCELERATION_M_S2 * dt_s**2 + _SLACK_M
            and off_rad <= _ANGULAR_ACCELERATION_RAD_S2 * dt_s**2 + _SLACK_RAD
        )

    def update(self, stamp_ns: int, T_last_camera: F64 | None) -> None:
        """Take the step since the last frame, None when there is none to speak of."""
        dt_s = self.since_s(stamp_ns)
        if T_last_camera is None or not 0.0 < dt_s <= _KEEPS_S:
            self.forget()
        elif dt_s >= _LEAST_S:
            self._v_m_s = T_last_camera[:3, 3] / dt_s
            self._w_rad_s = log_rotation(T_last_camera[:3, :3]) / dt_s
            self._sure, self._step_s = True, dt_s
        self._stamp_ns = stamp_ns

    def stale(self, stamp_ns: int) -> bool:
        """Return whether the last frame is so long ago that its velocity tells nothing of where the camera is now."""
        return self.since_s(stamp_ns) > _KEEPS_S

    def since_s(self, stamp_ns: int) -> float:
        """Return the time since the last frame."""
        return 0.0 if self._stamp_ns is None else (stamp_ns - self._stamp_ns) * 1e-9


def can_have_moved(dt_s: float, T_last_camera: F64) -> bool:
    """Return whether hands or an aircraft can move the camera so far in a time."""
    step_m = float(np.linalg.norm(T_last_camera[:3, 3]))
    step_rad = float(np.linalg.norm(log_rotation(T_last_camera[:3, :3])))
    return step_m <= _SPEED_M_S * dt_s + _SLACK_M and step_rad <= _TURN_RAD_S * dt_s + _SLACK_RAD
