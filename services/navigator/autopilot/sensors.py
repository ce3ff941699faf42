"""The autopilot's raw sensors for fusion: HIGHRES_IMU (or SCALED_IMU) and GPS_RAW_INT, in our frames and on our clock. Pure.

Asked for only while fusion is on: at 125 Hz they are 9 KB/s on the wire.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from pymavlink.dialects.v20 import common as mav

from schemas.vehicle import GpsFix, GpsFixType, ImuSample, ImuSamples
from services.common.geometry import Matrix
from services.navigator.autopilot.frames import to_ned

_MOST_SAMPLES = 100
_FIXES: dict[int, GpsFixType] = {
    mav.GPS_FIX_TYPE_2D_FIX: "2d", mav.GPS_FIX_TYPE_3D_FIX: "3d", mav.GPS_FIX_TYPE_DGPS: "differential",
    mav.GPS_FIX_TYPE_RTK_FLOAT: "rtk_float", mav.GPS_FIX_TYPE_RTK_FIXED: "rtk_fixed", mav.GPS_FIX_TYPE_STATIC: "3d",
    mav.GPS_FIX_TYPE_PPP: "rtk_float",
}  # fmt: skip
_UNKNOWN_EPH = 65535
_RANGE_SIGMA_M = 1.5
"""Horizontal error at a dilution of one, where the receiver tells only its dilution."""
_MILLI_G = 9.80665e-3
_STRANGE_NS = 5_000_000_000
"""A fix whose stamp is farther from its arrival than this is on another clock (Unix time): its arrival counts."""


class Sensors:
    """Collects samples; ``imu`` and ``fix`` give out what came since the last call.

    ``imu_hz``, ``gps_hz``: rates to ask for; 0: not wanted, and not listened to.
    """

    def __init__(self, imu_hz: float = 0.0, gps_hz: float = 0.0) -> None:
        self._imu_hz, self._gps_hz = imu_hz, gps_hz
        self._samples: list[ImuSample] = []
        self._fix: GpsFix | None = None
        self._last_imu_ns = self._last_fix_usec = -1
        self._imu_seq = self._gps_seq = 0
        self._best = False
        """HIGHRES_IMU comes: SCALED_IMU, coarser, is not listened to."""

    @property
    def streams_hz(self) -> dict[int, float]:
        """Return the messages to ask for, with their rates."""
        wanted = {mav.MAVLINK_MSG_ID_HIGHRES_IMU: self._imu_hz, mav.MAVLINK_MSG_ID_GPS_RAW_INT: self._gps_hz}
        return {ident: rate for ident, rate in wanted.items() if rate > 0.0}

    def take(self, message: Any, received_ns: int, offset_ns: int | None) -> None:  # noqa: ANN401 - pymavlink's classes share no typed base
        """Take a message of the autopilot; ``offset_ns``: its clock minus ours, without which nothing can be stamped."""
        kind = message.get_type()
        if offset_ns is None:
            return
        if kind == "HIGHRES_IMU" and self._imu_hz:
            self._best = True
            accel, gyro = (message.xacc, message.yacc, message.zacc), (message.xgyro, message.ygyro, message.zgyro)
            self._add(message.time_usec * 1000 - offset_ns, np.array(accel), np.array(gyro))
        elif kind == "SCALED_IMU" and self._imu_hz and not self._best:
            accel, gyro = (message.xacc, message.yacc, message.zacc), (message.xgyro, message.ygyro, message.zgyro)
            stamp_ns = message.time_boot_ms * 1_000_000 - offset_ns
            self._add(stamp_ns, _MILLI_G * np.array(accel, dtype=float), 1e-3 * np.array(gyro, dtype=float))
        elif kind == "GPS_RAW_INT" and self._gps_hz:
            self._take_fix(message, received_ns, offset_ns)

    def imu(self) -> ImuSamples | None:
        """Return the samples since the last call."""
        if not self._samples:
            return None
        samples, self._samples = tuple(self._samples[-_MOST_SAMPLES:]), []
        self._imu_seq += 1
        return ImuSamples(stamp_ns=samples[-1].stamp_ns, seq=self._imu_seq, samples=samples)

    def fix(self) -> GpsFix | None:
        """Return the fix since the last call."""
        fix, self._fix = self._fix, None
        return fix

    def _add(self, stamp_ns: int, accel_frd: Matrix, gyro_frd: Matrix) -> None:
        if not (np.isfinite(accel_frd).all() and np.isfinite(gyro_frd).all()) or stamp_ns <= max(self._last_imu_ns, 0):
            return
        self._last_imu_ns = stamp_ns
        self._samples.append(
            ImuSample(stamp_ns=stamp_ns, gyro_rad_s=_tuple(to_ned(gyro_frd)), accel_m_s2=_tuple(to_ned(accel_frd)))
        )

    def _take_fix(self, message: Any, received_ns: int, offset_ns: int) -> None:  # noqa: ANN401
        latitude, longitude, height = message.lat * 1e-7, message.lon * 1e-7, message.alt * 1e-3
        if message.time_usec == self._last_fix_usec or abs(latitude) > 90.0 or abs(longitude) > 180.0:
            return
        self._last_fix_usec = message.time_usec
        stamp_ns = message.time_usec * 1000 - offset_ns
        if abs(stamp_ns - received_ns) > _STRANGE_NS:
            stamp_ns = received_ns
        self._gps_seq += 1
        known = getattr(message, "h_acc", 0)
        by_dilution = None if message.eph == _UNKNOWN_EPH else _RANGE_SIGMA_M * message.eph * 0.01
        vertical = getattr(message, "v_acc", 0)
        self._fix = GpsFix(
            stamp_ns=max(stamp_ns, 0), seq=self._gps_seq, fix=_FIXES.get(message.fix_type, "none"),
            satellites=0 if message.satellites_visible == 255 else message.satellites_visible,
            latitude_deg=latitude, longitude_deg=longitude, altitude_m=float(np.clip(height, -1e4, 1e5)),
            horizontal_sigma_m=known * 1e-3 if known else by_dilution,
            vertical_sigma_m=min(vertical * 1e-3, 1e5) if vertical else None,
        )  # fmt: skip


def _tuple(v: Matrix) -> tuple[float, float, float]:
    return float(v[0]), float(v[1]), float(v[2])
