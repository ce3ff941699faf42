"""Vision out: ODOMETRY at a steady rate from poses that come slower, and never a made-up pose. Pure.

Each measured pose goes out with its own stamp. Between two of them the last is carried on at constant velocity, its
stamp by as much, so that the delay PX4 sees stays that of the camera. Lost or silent, nothing goes out.
"""

from __future__ import annotations

import numpy as np
from pymavlink.dialects.v20 import common as mav

from schemas.slam import Pose
from services.common.geometry import Matrix
from services.common.mount import Mount
from services.navigator.autopilot.config import AutopilotConfig
from services.navigator.autopilot.frames import D, covariance_ned, quaternion_ned, to_ned
from services.navigator.track import PoseTrack, Step

_ACCEL_SIGMA_M_S2 = 0.5
_NAN = float("nan")


class Vision:
    """Follows ``slam/pose`` and makes ODOMETRY messages of it."""

    def __init__(self, config: AutopilotConfig, mount: Mount) -> None:
        self.config = config
        self.mount = mount
        self.track = PoseTrack()
        self.reset_counter = 0
        self.sent = 0
        self.last_sent_ns = 0
        self._measured: Pose | None = None
        """The last tracked pose message, for its covariance; ``_fresh`` until it was sent as it is."""
        self._fresh = False
        self._due_ns = 0
        self._stamp_ns = -1

    def add(self, pose: Pose, received_ns: int) -> Step:
        """Take the next pose; our own reset counter goes up with every kind of jump."""
        step = self.track.add(pose, received_ns)
        if step in (Step.CORRECTION, Step.RELOCATED, Step.JUMP):
            self.reset_counter = (self.reset_counter + 1) % 256
        if step not in (Step.LOST, Step.STALE):
            self._measured, self._fresh = pose, True
            if step is not Step.SMOOTH:
                self._stamp_ns = min(self._stamp_ns, pose.stamp_ns - 1)
        return step

    def alive(self, now_ns: int) -> bool:
        """Whether the last pose is tracked and young enough to be carried on."""
        last = self.track.latest
        return last is not None and not self.track.lost and now_ns - last.received_ns <= self.config.propagate_s * 1e9

    def body(self, now_ns: int) -> Matrix | None:
        """Return ``T_map_body`` (4, 4) now, by constant velocity, or None while vision is not alive."""
        last = self.track.latest
        if last is None or not self.alive(now_ns):
            return None
        return self.mount.body(self.track.predict(min(now_ns, last.stamp_ns + round(self.config.propagate_s * 1e9))))

    def message(self, now_ns: int) -> mav.MAVLink_odometry_message | None:
        """Return the ODOMETRY that is due at ``now_ns``, or None."""
        last = self.track.latest
        if last is None or not self.alive(now_ns):
            return None
        period_ns = round(1e9 / self.config.odometry_hz)
        if not self._fresh and now_ns < self._due_ns:
            return None
        stamp_ns = last.stamp_ns if self._fresh else last.stamp_ns + (now_ns - last.received_ns)
        self._fresh = False
        if stamp_ns <= self._stamp_ns:
            return None
        self._stamp_ns, self.last_sent_ns = stamp_ns, now_ns
        self._due_ns = max(self._due_ns + period_ns, now_ns + period_ns // 2) if self._due_ns else now_ns + period_ns
        self.sent += 1
        return self._odometry(stamp_ns)

    def _odometry(self, stamp_ns: int) -> mav.MAVLink_odometry_message:
        T = self.mount.body(self.track.predict(stamp_ns))
        p, R = to_ned(T[:3, 3]), T[:3, :3]
        velocity = [_NAN] * 3
        if self.config.send_velocity:
            velocity = [float(v) for v in D @ R.T @ self.track.velocity_m_s]
        unknown = [_NAN] + [0.0] * 20
        return mav.MAVLink_odometry_message(
            stamp_ns // 1000, mav.MAV_FRAME_LOCAL_NED, mav.MAV_FRAME_BODY_FRD, float(p[0]), float(p[1]), float(p[2]),
            quaternion_ned(R), *velocity, _NAN, _NAN, _NAN, self._covariance(stamp_ns, R), unknown,
            reset_counter=self.reset_counter, estimator_type=mav.MAV_ESTIMATOR_TYPE_VIO, quality=100,
        )  # fmt: skip

    def _covariance(self, stamp_ns: int, R_map_body: Matrix) -> list[float]:
        assert self._measured is not None
        C = np.zeros((6, 6))
        if self._measured.covariance is not None:
            C = covariance_ned(self._measured.covariance, R_map_body, self.mount)
        dt = max((stamp_ns - self._measured.stamp_ns) / 1e9, 0.0)
        grown = (0.5 * _ACCEL_SIGMA_M_S2 * dt * dt) ** 2
        C[np.arange(3), np.arange(3)] = np.maximum(C.diagonal()[:3], self.config.position_sigma_m**2) + grown
        C[np.arange(3, 6), np.arange(3, 6)] = np.maximum(C.diagonal()[3:], self.config.angle_sigma_rad**2)
        return [float(v) for v in C[np.triu_indices(6)]]
