"""IMU readings kept, and integrated between two moments by gtsam (Forster et al., "On-manifold preintegration", 2017)."""

from __future__ import annotations

from collections import deque
from typing import Any

import gtsam
import numpy as np

from services.fusion.config import ImuNoiseConfig
from services.fusion.values import ImuReading

GRAVITY_M_S2 = 9.80665
IMU_LATE_NS = 300_000_000
"""Readings that are late by less come yet."""
_KEPT = 1_500
_AHEAD_NS = 40_000_000
"""The last reading stands for at most so long after it."""
_GAP_NS = 60_000_000
"""Readings farther apart than this are a gap: nothing is integrated over it."""
_INTEGRATION_M2_S = 1e-8
"""Variance that integration itself adds, per second (gtsam's own examples use the same)."""


class Inertial:
    """The recent readings. ``between`` integrates them; a partial reading at either end counts for its part."""

    def __init__(self, noise: ImuNoiseConfig) -> None:
        self._readings: deque[ImuReading] = deque(maxlen=_KEPT)
        self._params = parameters(noise)

    @property
    def newest_ns(self) -> int:
        """Stamp of the last reading, -1 before the first."""
        return self._readings[-1].stamp_ns if self._readings else -1

    def add(self, reading: ImuReading) -> bool:
        """Keep a reading; False when it is not newer than the last."""
        if reading.stamp_ns <= self.newest_ns:
            return False
        self._readings.append(reading)
        return True

    def covers(self, from_ns: int, to_ns: int) -> bool:
        """Whether there are readings without a gap from one moment to another."""
        last_ns = None
        for reading in self._readings:
            if reading.stamp_ns < from_ns:
                last_ns = reading.stamp_ns
                continue
            if last_ns is None or reading.stamp_ns - last_ns > _GAP_NS:
                return False
            last_ns = reading.stamp_ns
            if last_ns >= to_ns:
                return True
        return last_ns is not None and to_ns - last_ns <= _AHEAD_NS and last_ns >= from_ns - _AHEAD_NS

    def flows(self, stamp_ns: int, long_ns: int) -> bool:
        """Whether readings come, about a moment and without a gap for so long: those of the moment itself may come yet."""
        near = abs(stamp_ns - self.newest_ns) < IMU_LATE_NS
        return near and self.covers(self.newest_ns - long_ns, self.newest_ns)

    def between(self, from_ns: int, to_ns: int, bias: Any) -> Any:  # noqa: ANN401 - gtsam has no types
        """Return gtsam's combined preintegrated measurement over ``(from_ns, to_ns]`` about ``bias``."""
        pim = gtsam.PreintegratedCombinedMeasurements(self._params, bias)
        at_ns, last = from_ns, None
        for reading in self._readings:
            if reading.stamp_ns <= from_ns:
                last = reading
                continue
            end_ns = min(reading.stamp_ns, to_ns)
            pim.integrateMeasurement(reading.accel_m_s2, reading.gyro_rad_s, (end_ns - at_ns) * 1e-9)
            at_ns, last = end_ns, reading
            if at_ns >= to_ns:
                return pim
        if last is not None and at_ns < to_ns:
            pim.integrateMeasurement(last.accel_m_s2, last.gyro_rad_s, (to_ns - at_ns) * 1e-9)
        return pim


def parameters(noise: ImuNoiseConfig) -> Any:  # noqa: ANN401
    """Return gtsam's parameters for a world whose z points up."""
    eye = np.eye(3)
    params = gtsam.PreintegrationCombinedParams.MakeSharedU(GRAVITY_M_S2)
    params.setAccelerometerCovariance(eye * noise.accel_m_s2**2)
    params.setGyroscopeCovariance(eye * noise.gyro_rad_s**2)
    params.setIntegrationCovariance(eye * _INTEGRATION_M2_S)
    params.setBiasAccCovariance(eye * noise.accel_walk_m_s3**2)
    params.setBiasOmegaCovariance(eye * noise.gyro_walk_rad_s2**2)
    return params
