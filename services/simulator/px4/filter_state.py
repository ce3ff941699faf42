"""The estimator's state, what others read of it, and its resets. The logic of fusion is in estimator.py."""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from services.common.geometry import Matrix, wrap_angle
from services.simulator.px4.estimator_kernels import STATES, fuse
from services.simulator.px4.frames import rotation_from_wxyz, yaw_from_wxyz
from services.simulator.px4.params import Parameters
from services.simulator.px4.vision import VisionFlags, VisionSample

_FAILING_S = 1.0
RESETS_IN_AIR = 5
_QUEUE = 30


class FilterState:
    """State and covariance at the delayed horizon, the inertial samples since, and the output now."""

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
        self._resets_left = RESETS_IN_AIR
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
