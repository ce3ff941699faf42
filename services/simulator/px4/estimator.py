"""The autopilot's estimator: inertial dead reckoning at a delayed horizon, corrected by external vision.

Like PX4's EKF2 it filters the past (EKF2_DELAY_MAX behind now), so that a vision sample meets the state of its own
time, and replays the buffered inertial samples up to now for its output. It knows nothing of the truth: it drifts
without vision, and believes a biased vision.
"""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from services.common.geometry import Matrix, wrap_angle
from services.simulator.px4.estimator_kernels import STATES, fuse, innovation_variance, predict, replay, yaw_row
from services.simulator.px4.frames import rotation_from_wxyz, yaw_from_wxyz
from services.simulator.px4.params import Parameters
from services.simulator.px4.vision import EV_HPOS, EV_VEL, EV_VPOS, EV_YAW, VisionFlags, VisionSample

EV_MAX_INTERVAL_S = 0.2
"""Fusion starts only on samples closer than this, and stops after twice this without one."""
_TOO_LATE_S = 0.1
_FAILING_S = 1.0
_RESETS_IN_AIR = 5
_FAKE_SPEED_M_S = 2.0
_QUEUE = 30
_BARO_SIGMA_M = 0.5
_YAW_VARIANCE_START = 0.5


class Estimator:
    """Filter with a delayed horizon. ``add_imu`` first, then read ``position_m`` and the other outputs.

    Times are seconds of the autopilot's clock. Frame: NED or, with LOCAL_FRD vision, the vision's own axes.
    """

    def __init__(self, params: Parameters, now_s: float, quaternion_wxyz: Matrix) -> None:
        self._params = params
        self._x = np.zeros(16)
        # tilt comes from the accelerometer at rest; yaw is unknown and starts at zero, without a compass
        self._x[6:10] = _without_yaw(quaternion_wxyz)
        self._P = np.diag([1.0] * 3 + [0.01] * 3 + [1e-4, 1e-4, 0.5] + [4e-5] * 3 + [2e-2] * 3)
        self._noise = np.array([0.01, 0.35, 5e-5, 2e-3])
        self._imu = np.zeros((64, 7))
        self._imu_count = 0
        self.delayed_s = now_s
        self._queue: deque[VisionSample] = deque(maxlen=_QUEUE)
        self._last_arrival_s = -math.inf
        self._previous: VisionSample | None = None
        self._out = self._x.copy()
        self._row = np.zeros(STATES)
        self.flags = VisionFlags()
        self.last_horizontal_s = -math.inf
        self._last_height_s = -math.inf
        self._last_yaw_s = -math.inf
        self._resets_left = _RESETS_IN_AIR
        self._baro_offset_m: float | None = None
        self._last_fake_s = now_s
        self.yaw_aligned = False
        self.frame_is_ned = False
        self.resets = 0
        self.reset_delta_m = np.zeros(3)
        self.reset_delta_yaw_rad = 0.0
        self.fused = 0
        self.ratio_position = 0.0
        self.landed = True

    # -- outputs -------------------------------------------------------------------------------------------------

    @property
    def position_m(self) -> Matrix:
        """Estimated position now."""
        return self._out[:3]

    @property
    def velocity_m_s(self) -> Matrix:
        """Estimated velocity now."""
        return self._out[3:6]

    @property
    def quaternion_wxyz(self) -> Matrix:
        """Estimated attitude now, FRD to the local frame."""
        return self._out[6:10]

    @property
    def gyro_bias_rad_s(self) -> Matrix:
        """Estimated gyro bias."""
        return self._out[10:13]

    @property
    def position_sigma_m(self) -> float:
        """Estimated horizontal standard deviation."""
        return math.sqrt(max(float(self._P[0, 0]), float(self._P[1, 1])))

    @property
    def height_sigma_m(self) -> float:
        """Estimated vertical standard deviation."""
        return math.sqrt(float(self._P[2, 2]))

    @property
    def horizontal_valid(self) -> bool:
        """The horizontal position was aided within EKF2_NOAID_TOUT: the commander may fly on it."""
        return self.delayed_s - self.last_horizontal_s <= self._params["EKF2_NOAID_TOUT"] * 1e-6

    @property
    def height_valid(self) -> bool:
        """Height is vision's, or the barometer's."""
        return self.flags.height or self._baro_offset_m is not None

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
            self._resets_left = _RESETS_IN_AIR

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

    # -- helpers -------------------------------------------------------------------------------------------------

    def _failing(self, last_s: float) -> bool:
        return self.delayed_s - last_s > _FAILING_S

    def _variance(self, told: float, noise_name: str) -> float:
        floor = float(self._params[noise_name]) ** 2
        if self._params.integer("EKF2_EV_NOISE_MD") == 1 or not math.isfinite(told):
            return floor
        return max(told, floor)

    def _fuse(self, index: int, innovation: float, variance: float) -> None:
        self._row[:] = 0.0
        self._row[index] = 1.0
        fuse(self._x, self._P, self._row, innovation, variance)

    def _decorrelate(self, index: int, variance: float) -> None:
        self._P[index, :] = 0.0
        self._P[:, index] = 0.0
        self._P[index, index] = variance

    def _reset_position(self, position_m: Matrix, variance: Matrix) -> None:
        delta = np.array([*(position_m[:2] - self._x[:2]), 0.0])
        self._x[:2] = position_m[:2]
        for i in range(2):
            self._decorrelate(i, float(variance[i]))
        self.last_horizontal_s = self.delayed_s
        self._note_reset(delta, 0.0)

    def _reset_height(self, z_m: float, variance: float) -> None:
        delta = np.array([0.0, 0.0, z_m - self._x[2]])
        self._x[2] = z_m
        self._decorrelate(2, variance)
        self._last_height_s = self.delayed_s
        self._note_reset(delta, 0.0)

    def _reset_yaw(self, yaw_rad: float, variance: float) -> None:
        delta = wrap_angle(yaw_rad - yaw_from_wxyz(self._x[6:10]))
        half = 0.5 * delta
        w, x, y, z = self._x[6:10].copy()
        c, s = math.cos(half), math.sin(half)
        self._x[6:10] = [c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w]
        R = rotation_from_wxyz(np.array([c, 0.0, 0.0, s]))
        self._x[3:6] = R @ self._x[3:6]
        self._decorrelate(8, max(variance, 1e-4))
        self._last_yaw_s = self.delayed_s
        self._note_reset(np.zeros(3), delta)

    def _note_reset(self, delta_m: Matrix, delta_yaw_rad: float) -> None:
        self.resets += 1
        self.reset_delta_m = self.reset_delta_m + delta_m
        self.reset_delta_yaw_rad += delta_yaw_rad

    def take_reset(self) -> tuple[Matrix, float]:
        """Return and clear the jumps since the last call: position (metres) and yaw (radians)."""
        delta, yaw = self.reset_delta_m, self.reset_delta_yaw_rad
        self.reset_delta_m, self.reset_delta_yaw_rad = np.zeros(3), 0.0
        return delta, yaw


def _without_yaw(q: Matrix) -> Matrix:
    half = -0.5 * yaw_from_wxyz(q)
    c, s = math.cos(half), math.sin(half)
    w, x, y, z = q
    return np.array([c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w])
