"""The autopilot's estimator: inertial dead reckoning at a delayed horizon, corrected by external vision.

Like PX4's EKF2 it filters the past (EKF2_DELAY_MAX behind now), so that a vision sample meets the state of its own
time, and replays the buffered inertial samples up to now for its output. It knows nothing of the truth: it drifts
without vision, and believes a biased vision.
"""

from __future__ import annotations

import math

import numpy as np

from services.common.geometry import Matrix, wrap_angle
from services.simulator.px4.estimator_kernels import fuse, innovation_variance, predict, replay, yaw_row
from services.simulator.px4.filter_state import RESETS_IN_AIR, FilterState
from services.simulator.px4.frames import rotation_from_wxyz, yaw_from_wxyz
from services.simulator.px4.vision import EV_HPOS, EV_VEL, EV_VPOS, EV_YAW, VisionFlags, VisionSample

EV_MAX_INTERVAL_S = 0.2
"""Fusion starts only on samples closer than this, and stops after twice this without one."""
_TOO_LATE_S = 0.1
_FAKE_SPEED_M_S = 2.0
_BARO_SIGMA_M = 0.5


class Estimator(FilterState):
    """Filter with a delayed horizon. ``add_imu`` first, then read ``position_m`` and the other outputs.

    Times are seconds of the autopilot's clock. Frame: NED or, with LOCAL_FRD vision, the vision's own axes.
    """

    # -- inputs --------------------------------------------------------------------------------------------------

    def add_vision(self, sample: VisionSample, arrival_s: float) -> None:
        """Queue a sample until the horizon reaches its stamp."""
        self._queue.append(sample)
        self._last_arrival_s = arrival_s

    def add_imu(self, now_s: float, gyro_rad_s: Matrix, accel_m_s2: Matrix, dt_s: float) -> None:
        """Take one inertial sample of length ``dt_s`` that ends at ``now_s``; advances horizon and output."""
        count = self._imu_count
        self._imu[count, 0], self._imu[count, 1:4], self._imu[count, 4:7] = dt_s, gyro_rad_s, accel_m_s2
        self._imu_count = count + 1
        horizon_s = max(dt_s, self._params["EKF2_DELAY_MAX"] * 1e-3)
        while self._imu_count and (now_s - self.delayed_s >= horizon_s or self._imu_count >= len(self._imu) - 1):
            self._advance_horizon()
        replay(self._x, self._imu, self._imu_count, self._out)

    def add_barometer(self, height_m: float) -> None:
        """Take a barometric height (up); fused only while vision gives none (EKF2_HGT_REF 3: vision leads)."""
        if self.flags.height or not self._params.integer("EKF2_BARO_CTRL"):
            self._baro_offset_m = None if self._baro_offset_m is None else height_m + float(self._x[2])
            return
        if self._baro_offset_m is None:
            self._baro_offset_m = height_m + float(self._x[2])
        self._fuse(2, -(height_m - self._baro_offset_m) - float(self._x[2]), _BARO_SIGMA_M**2)

    # -- the delayed filter --------------------------------------------------------------------------------------

    def _advance_horizon(self) -> None:
        first = self._imu[0]
        dt_s = float(first[0])
        predict(self._x, self._P, first[1:4], first[4:7], dt_s, self._noise)
        self._imu[: self._imu_count - 1] = self._imu[1 : self._imu_count]
        self._imu_count -= 1
        self.delayed_s += dt_s
        sample = self._pop_vision()
        if sample is not None:
            self._control_vision(sample)
        elif self._previous is not None and self.delayed_s - self._previous.stamp_s > 2.0 * EV_MAX_INTERVAL_S:
            self.flags = VisionFlags()
        if not self.flags.position and not self.flags.velocity:
            self._fake_aiding()

    def _pop_vision(self) -> VisionSample | None:
        found: VisionSample | None = None
        while self._queue and self._queue[0].stamp_s <= self.delayed_s:
            found = self._queue.popleft()
        return found if found is not None and self.delayed_s - found.stamp_s < _TOO_LATE_S else None

    def _control_vision(self, sample: VisionSample) -> None:
        previous, self._previous = self._previous, sample
        if sample.quality < self._params.integer("EKF2_EV_QMIN"):
            return
        recent = previous is not None and sample.stamp_s - previous.stamp_s < EV_MAX_INTERVAL_S
        announced = previous is not None and sample.reset_counter != previous.reset_counter
        bits = self._params.integer("EKF2_EV_CTRL")
        self._control_yaw(sample, recent, announced, wanted=bool(bits & EV_YAW))
        if not (self.yaw_aligned or self.flags.yaw):
            return
        self.frame_is_ned = sample.frame_is_ned
        if bits & EV_VEL:
            self._control_velocity(sample, recent)
        self._control_position(sample, recent, announced, wanted=bool(bits & EV_HPOS))
        self._control_height(sample, recent, announced, wanted=bool(bits & EV_VPOS))
        if self.landed:
            self._resets_left = RESETS_IN_AIR

    def _control_yaw(self, sample: VisionSample, recent: bool, announced: bool, *, wanted: bool) -> None:
        if not wanted or not np.isfinite(sample.quaternion_wxyz).all():
            self.flags.yaw = False
            return
        measured = yaw_from_wxyz(sample.quaternion_wxyz)
        variance = self._variance(sample.yaw_var, "EKF2_EVA_NOISE")
        if not self.flags.yaw:
            if recent:
                self._reset_yaw(measured, variance)
                self.flags.yaw = self.yaw_aligned = True
            return
        innovation = wrap_angle(measured - yaw_from_wxyz(self._x[6:10]))
        yaw_row(self._x[6:10], self._row)
        s = innovation_variance(self._P, self._row, variance)
        if announced or (innovation**2 > self._params["EKF2_HDG_GATE"] ** 2 * s and self._failing(self._last_yaw_s)):
            self._reset_yaw(measured, variance)
        elif innovation**2 <= self._params["EKF2_HDG_GATE"] ** 2 * s:
            fuse(self._x, self._P, self._row, innovation, variance)
            self._last_yaw_s = self.delayed_s

    def _control_position(self, sample: VisionSample, recent: bool, announced: bool, *, wanted: bool) -> None:
        if not wanted or not np.isfinite(sample.position_m[:2]).all():
            self.flags.position = False
            return
        variance = np.array([self._variance(float(v), "EKF2_EVP_NOISE") for v in sample.position_var[:2]])
        if not self.flags.position:
            if recent:
                self._reset_position(sample.position_m, variance)
                self.flags.position = True
            return
        innovation = sample.position_m[:2] - self._x[:2]
        gate = max(1.0, self._params["EKF2_EVP_GATE"])
        ratios = innovation**2 / (gate**2 * (np.diag(self._P)[:2] + variance))
        self.ratio_position = float(math.sqrt(ratios.max()))
        if announced:
            self._reset_position(sample.position_m, variance)
        elif ratios.max() <= 1.0:
            for i in range(2):
                self._fuse(i, float(sample.position_m[i] - self._x[i]), float(variance[i]))
            self.last_horizontal_s = self.delayed_s
            self.fused += 1
        elif self._failing(self.last_horizontal_s):
            if self._resets_left > 0:
                self._reset_position(sample.position_m, variance)
                self._resets_left -= 0 if self.landed else 1
            else:
                self.flags.position = False

    def _control_height(self, sample: VisionSample, recent: bool, announced: bool, *, wanted: bool) -> None:
        if not wanted or not math.isfinite(float(sample.position_m[2])):
            self.flags.height = False
            return
        variance = self._variance(float(sample.position_var[2]), "EKF2_EVP_NOISE")
        innovation = float(sample.position_m[2] - self._x[2])
        gate = max(1.0, self._params["EKF2_EVP_GATE"])
        good = innovation**2 <= gate**2 * (float(self._P[2, 2]) + variance)
        if not self.flags.height:
            if recent:
                self._reset_height(float(sample.position_m[2]), variance)
                self.flags.height = True
        elif announced or (not good and self._failing(self._last_height_s)):
            self._reset_height(float(sample.position_m[2]), variance)
        elif good:
            self._fuse(2, innovation, variance)
            self._last_height_s = self.delayed_s

    def _control_velocity(self, sample: VisionSample, recent: bool) -> None:
        self.flags.velocity = False
        if not recent or not np.isfinite(sample.velocity_body_m_s).all():
            return
        measured = rotation_from_wxyz(self._x[6:10]) @ sample.velocity_body_m_s
        gate = max(1.0, self._params["EKF2_EVV_GATE"])
        for i in range(3):
            variance = self._variance(float(sample.velocity_var[i]), "EKF2_EVV_NOISE")
            innovation = float(measured[i] - self._x[3 + i])
            if innovation**2 <= gate**2 * (float(self._P[3 + i, 3 + i]) + variance):
                self._fuse(3 + i, innovation, variance)
                self.flags.velocity = True
        if self.flags.velocity:
            self.last_horizontal_s = self.delayed_s

    def _fake_aiding(self) -> None:
        """Keep tilt bounded without any aid: standing still on the ground, "not fast" once vision has timed out."""
        if self.delayed_s - self._last_fake_s < 0.1 or (self.horizontal_valid and not self.landed):
            return
        self._last_fake_s = self.delayed_s
        sigma = 0.3 if self.landed else _FAKE_SPEED_M_S
        for i in range(2):
            self._fuse(3 + i, -float(self._x[3 + i]), sigma**2)
