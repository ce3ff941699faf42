"""What the endpoint tells: one builder per MAVLink message, and the rates at which a link carries them."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import common as m

from services.simulator.px4.flight import Ground
from services.simulator.px4.frames import euler_from_wxyz, rotation_from_wxyz
from services.simulator.px4.geodesy import TRUTH_ORIGIN, to_global
from services.simulator.px4.modes import NavState
from services.simulator.px4.vehicle import Vehicle

Message = Any
"""A pymavlink message: its classes are generated, their fields unknown to the type checker."""

Builder = Callable[[Vehicle], Message]
"""Returns a MAVLink message, or None when the vehicle does not have it to tell."""

_LANDED = {
    Ground.LANDED: m.MAV_LANDED_STATE_ON_GROUND,
    Ground.SPOOLING: m.MAV_LANDED_STATE_ON_GROUND,
    Ground.CLIMBING: m.MAV_LANDED_STATE_IN_AIR,
    Ground.FLYING: m.MAV_LANDED_STATE_IN_AIR,
    Ground.LANDING: m.MAV_LANDED_STATE_LANDING,
}
_CELL_MV, _CELL_EMPTY_MV, _CELLS = 4150, 3500, 4
_UPPER_TRIANGLE = 21
_GRAVITY_M_S2 = 9.80665
_FIX_LOST_S = 1.0


def _boot_ms(v: Vehicle) -> int:
    return int(v.now_s * 1e3)


def heartbeat(v: Vehicle) -> Message:
    """HEARTBEAT: a PX4 quadrotor; custom_mode is the mode that really flies."""
    c = v.commander
    base = m.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED | (m.MAV_MODE_FLAG_SAFETY_ARMED if c.armed else 0)
    status = m.MAV_STATE_CRITICAL if c.failsafe else (m.MAV_STATE_ACTIVE if c.armed else m.MAV_STATE_STANDBY)
    return m.MAVLink_heartbeat_message(m.MAV_TYPE_QUADROTOR, m.MAV_AUTOPILOT_PX4, base, c.state.custom_mode, status, 3)


def sys_status(v: Vehicle) -> Message:
    """SYS_STATUS: sensors, load and battery."""
    gyro_accel = m.MAV_SYS_STATUS_SENSOR_3D_GYRO | m.MAV_SYS_STATUS_SENSOR_3D_ACCEL
    present = gyro_accel | m.MAV_SYS_STATUS_SENSOR_ABSOLUTE_PRESSURE | m.MAV_SYS_STATUS_SENSOR_VISION_POSITION
    healthy = present if v.estimator.flags.position else present & ~m.MAV_SYS_STATUS_SENSOR_VISION_POSITION
    if not v.commander.arming_fault():
        healthy |= m.MAV_SYS_STATUS_PREARM_CHECK
    return m.MAVLink_sys_status_message(
        present | m.MAV_SYS_STATUS_PREARM_CHECK, present, healthy, 250, _battery_mv(v), 900,
        int(v.battery_share * 100), 0, 0, 0, 0, 0, 0,
    )  # fmt: skip


def _battery_mv(v: Vehicle) -> int:
    return int(_CELLS * (_CELL_EMPTY_MV + v.battery_share * (_CELL_MV - _CELL_EMPTY_MV)))


def battery_status(v: Vehicle) -> Message:
    """BATTERY_STATUS: four cells."""
    cell = _battery_mv(v) // _CELLS
    cells = [cell] * _CELLS + [65535] * (10 - _CELLS)
    used = int((1.0 - v.battery_share) * 4000)
    return m.MAVLink_battery_status_message(0, 1, 1, 2500, cells, 900, used, -1, int(v.battery_share * 100))


def attitude(v: Vehicle) -> Message:
    """ATTITUDE: Euler angles of the estimate."""
    roll, pitch, yaw = euler_from_wxyz(v.estimator.quaternion_wxyz)
    p, q, r = _rates(v)
    return m.MAVLink_attitude_message(_boot_ms(v), roll, pitch, yaw, p, q, r)


def attitude_quaternion(v: Vehicle) -> Message:
    """ATTITUDE_QUATERNION of the estimate."""
    w, x, y, z = (float(c) for c in v.estimator.quaternion_wxyz)
    p, q, r = _rates(v)
    return m.MAVLink_attitude_quaternion_message(_boot_ms(v), w, x, y, z, p, q, r)


def _rates(v: Vehicle) -> tuple[float, float, float]:
    rates = v.last_gyro_rad_s - v.estimator.gyro_bias_rad_s
    return float(rates[0]), float(rates[1]), float(rates[2])


def local_position_ned(v: Vehicle) -> Message:
    """LOCAL_POSITION_NED, only while the estimate is valid."""
    if not v.estimator.horizontal_valid:
        return None
    p, s = v.estimator.position_m, v.estimator.velocity_m_s
    return m.MAVLink_local_position_ned_message(
        _boot_ms(v), float(p[0]), float(p[1]), float(p[2]), float(s[0]), float(s[1]), float(s[2])
    )


def odometry(v: Vehicle) -> Message:
    """ODOMETRY: the estimate with its variances, velocity in the body frame."""
    e = v.estimator
    if not e.horizontal_valid:
        return None
    frame = m.MAV_FRAME_LOCAL_NED if e.frame_is_ned else m.MAV_FRAME_LOCAL_FRD
    speed = rotation_from_wxyz(e.quaternion_wxyz).T @ e.velocity_m_s
    pose_covariance, velocity_covariance = [0.0] * _UPPER_TRIANGLE, [0.0] * _UPPER_TRIANGLE
    variance = e.position_sigma_m**2
    pose_covariance[0] = pose_covariance[6] = variance
    pose_covariance[11] = e.height_sigma_m**2
    p, q, r = _rates(v)
    return m.MAVLink_odometry_message(
        int(v.now_s * 1e6), frame, m.MAV_FRAME_BODY_FRD, *(float(c) for c in e.position_m),
        [float(c) for c in e.quaternion_wxyz], *(float(c) for c in speed), p, q, r,
        pose_covariance, velocity_covariance, e.resets % 256, m.MAV_ESTIMATOR_TYPE_AUTOPILOT, 0,
    )  # fmt: skip


def position_target_local_ned(v: Vehicle) -> Message:
    """POSITION_TARGET_LOCAL_NED: what the controller flies to, while it flies to somebody's setpoint."""
    if v.commander.state is not NavState.OFFBOARD or not v.commander.armed or not v.external.has_position:
        return None
    p, s = v.external.position_m, np.nan_to_num(v.external.velocity_m_s)
    return m.MAVLink_position_target_local_ned_message(
        _boot_ms(v), m.MAV_FRAME_LOCAL_NED, 0, *(float(c) for c in p), *(float(c) for c in s), 0.0, 0.0, 0.0,
        v.external.yaw_rad, v.external.yaw_rate_rad_s,
    )  # fmt: skip


def extended_sys_state(v: Vehicle) -> Message:
    """EXTENDED_SYS_STATE: on the ground, in the air; taking off and landing only in the modes of that name."""
    landed = _LANDED[v.land.state]
    going_down = v.commander.state in (NavState.LAND, NavState.DESCEND)
    if landed == m.MAV_LANDED_STATE_IN_AIR and going_down:
        landed = m.MAV_LANDED_STATE_LANDING
    if landed == m.MAV_LANDED_STATE_IN_AIR and v.commander.state is NavState.TAKEOFF:
        landed = m.MAV_LANDED_STATE_TAKEOFF
    return m.MAVLink_extended_sys_state_message(m.MAV_VTOL_STATE_UNDEFINED, landed)


def estimator_status(v: Vehicle) -> Message:
    """ESTIMATOR_STATUS: which parts of the solution are usable."""
    e = v.estimator
    flags = m.ESTIMATOR_ATTITUDE
    if e.horizontal_valid:
        flags |= m.ESTIMATOR_VELOCITY_HORIZ | m.ESTIMATOR_POS_HORIZ_REL
        if e.frame_is_ned:
            flags |= m.ESTIMATOR_POS_HORIZ_ABS
    else:
        flags |= m.ESTIMATOR_CONST_POS_MODE
    if e.height_valid:
        flags |= m.ESTIMATOR_VELOCITY_VERT | m.ESTIMATOR_POS_VERT_ABS
    return m.MAVLink_estimator_status_message(
        int(v.now_s * 1e6), flags, 0.0, e.ratio_position, e.ratio_position, 0.0, 0.0, 0.0,
        e.position_sigma_m, e.height_sigma_m,
    )  # fmt: skip


def system_time(v: Vehicle) -> Message:
    """SYSTEM_TIME: no satellites, so no Unix time."""
    return m.MAVLink_system_time_message(0, _boot_ms(v))


def timesync(v: Vehicle) -> Message:
    """TIMESYNC request in our own clock."""
    return m.MAVLink_timesync_message(0, int(v.now_s * 1e9))


def gps_global_origin(v: Vehicle) -> Message:
    """GPS_GLOBAL_ORIGIN once somebody has set it and the position is global by it."""
    if v.origin is None or not (v.estimator.horizontal_valid and v.estimator.frame_is_ned):
        return None
    latitude, longitude, height = v.origin
    return m.MAVLink_gps_global_origin_message(
        round(latitude * 1e7), round(longitude * 1e7), round(height * 1e3), int(v.now_s * 1e6)
    )


def global_position_int(v: Vehicle) -> Message:
    """GLOBAL_POSITION_INT when an origin is known and the vision's frame is LOCAL_NED."""
    if v.origin is None or not (v.estimator.horizontal_valid and v.estimator.frame_is_ned):
        return None
    x, y, z = (float(c) for c in v.estimator.position_m)
    latitude, longitude, height = to_global(v.origin, (x, y, z))
    speed = [int(100.0 * float(c)) for c in v.estimator.velocity_m_s]
    yaw = euler_from_wxyz(v.estimator.quaternion_wxyz)[2]
    return m.MAVLink_global_position_int_message(
        _boot_ms(v), round(latitude * 1e7), round(longitude * 1e7), round(height * 1e3),
        round(1e3 * (float(v.modes.home_m[2]) - z)), *speed, round(math.degrees(yaw) % 360.0 * 100) % 36000,
    )  # fmt: skip


def home_position(v: Vehicle) -> Message:
    """HOME_POSITION once there is an origin."""
    if v.origin is None:
        return None
    x, y, z = (float(c) for c in v.modes.home_m)
    latitude, longitude, height = to_global(v.origin, (x, y, z))
    return m.MAVLink_home_position_message(
        round(latitude * 1e7), round(longitude * 1e7), round(height * 1e3), x, y, z, [1.0, 0.0, 0.0, 0.0],
        0.0, 0.0, 0.0, int(v.now_s * 1e6),
    )  # fmt: skip


def hil_state_quaternion(v: Vehicle) -> Message:
    """HIL_STATE_QUATERNION: the true pose, as SITL tells it.

    Latitude and longitude resolve 1.1 cm, speeds are whole cm/s cut off towards zero, accelerations whole m/s^2. It has
    no stamp: PX4 leaves ``time_usec`` at 0.
    """
    s = v.body.state
    latitude, longitude, height = to_global(TRUTH_ORIGIN, (float(s[0]), float(s[1]), float(s[2])))
    speed = [int(100.0 * float(c)) for c in s[3:6]]
    accel = [
        int(np.clip(c, -32768, 32767)) for c in rotation_from_wxyz(s[6:10]) @ v.body.force + (0.0, 0.0, _GRAVITY_M_S2)
    ]
    return m.MAVLink_hil_state_quaternion_message(
        0, [float(c) for c in s[6:10]], float(s[10]), float(s[11]), float(s[12]),
        int(latitude * 1e7), int(longitude * 1e7), int(height * 1e3), *speed, 0, 0, *accel,
    )  # fmt: skip


def highres_imu(v: Vehicle) -> Message:
    """HIGHRES_IMU: the last inertial sample as it was measured, bias and all; no magnetometer, no pressure told."""
    if not math.isfinite(v.last_imu_s):
        return None
    accel, gyro = (tuple(float(c) for c in values) for values in (v.last_accel_m_s2, v.last_gyro_rad_s))
    fields = 0b111111
    return m.MAVLink_highres_imu_message(
        round(v.last_imu_s * 1e6), *accel, *gyro, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 25.0, fields
    )


def gps_raw_int(v: Vehicle) -> Message:
    """GPS_RAW_INT of the last fix; without a receiver none, and in an outage one that says so, as PX4 does."""
    if v.gps is None or v.gps.latest is None:
        return None
    fix = v.gps.latest
    now_s = v.now_s - v.config.boot_time_s
    if now_s - fix.given_s > _FIX_LOST_S:
        return m.MAVLink_gps_raw_int_message(
            round(v.now_s * 1e6), m.GPS_FIX_TYPE_NO_FIX, 0, 0, 0, 9999, 9999, 65535, 65535, 3
        )
    x, y, z = (float(c) for c in fix.position_ned_m)
    latitude, longitude, height = to_global(TRUTH_ORIGIN, (x, y, z))
    north, east = (float(c) for c in fix.velocity_ned_m_s[:2])
    return m.MAVLink_gps_raw_int_message(
        round((v.config.boot_time_s + fix.given_s) * 1e6), m.GPS_FIX_TYPE_3D_FIX, round(latitude * 1e7), round(longitude * 1e7),
        round(height * 1e3), 90, 140, round(100.0 * math.hypot(north, east)),
        round(math.degrees(math.atan2(east, north)) % 360.0 * 100.0) % 36000, 14, round(height * 1e3),
        round(1e3 * fix.sigma_m), round(1e3 * fix.vertical_sigma_m), 200, 0,
    )  # fmt: skip


def autopilot_version(v: Vehicle) -> Message:
    """AUTOPILOT_VERSION: PX4 1.16.0 and what it can do."""
    can = (
        m.MAV_PROTOCOL_CAPABILITY_MISSION_INT
        | m.MAV_PROTOCOL_CAPABILITY_COMMAND_INT
        | m.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_BYTEWISE
        | m.MAV_PROTOCOL_CAPABILITY_SET_POSITION_TARGET_LOCAL_NED
        | m.MAV_PROTOCOL_CAPABILITY_MAVLINK2
    )
    version = 1 << 24 | 16 << 16 | 0 << 8 | 255
    return m.MAVLink_autopilot_version_message(
        can, version, 0, 0, 0, [0] * 8, [0] * 8, [0] * 8, 0, 0, v.config.system_id
    )


BUILDERS: dict[int, Builder] = {
    m.MAVLINK_MSG_ID_HEARTBEAT: heartbeat,
    m.MAVLINK_MSG_ID_SYS_STATUS: sys_status,
    m.MAVLINK_MSG_ID_SYSTEM_TIME: system_time,
    m.MAVLINK_MSG_ID_TIMESYNC: timesync,
    m.MAVLINK_MSG_ID_BATTERY_STATUS: battery_status,
    m.MAVLINK_MSG_ID_ATTITUDE: attitude,
    m.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: attitude_quaternion,
    m.MAVLINK_MSG_ID_LOCAL_POSITION_NED: local_position_ned,
    m.MAVLINK_MSG_ID_ODOMETRY: odometry,
    m.MAVLINK_MSG_ID_POSITION_TARGET_LOCAL_NED: position_target_local_ned,
    m.MAVLINK_MSG_ID_EXTENDED_SYS_STATE: extended_sys_state,
    m.MAVLINK_MSG_ID_ESTIMATOR_STATUS: estimator_status,
    m.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN: gps_global_origin,
    m.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: global_position_int,
    m.MAVLINK_MSG_ID_HOME_POSITION: home_position,
    m.MAVLINK_MSG_ID_HIL_STATE_QUATERNION: hil_state_quaternion,
    m.MAVLINK_MSG_ID_HIGHRES_IMU: highres_imu,
    m.MAVLINK_MSG_ID_GPS_RAW_INT: gps_raw_int,
    m.MAVLINK_MSG_ID_AUTOPILOT_VERSION: autopilot_version,
}
"""By message id."""

RATES_HZ: dict[int, float] = {
    m.MAVLINK_MSG_ID_HEARTBEAT: 1.0,
    m.MAVLINK_MSG_ID_SYS_STATUS: 1.0,
    m.MAVLINK_MSG_ID_SYSTEM_TIME: 1.0,
    m.MAVLINK_MSG_ID_TIMESYNC: 10.0,
    m.MAVLINK_MSG_ID_BATTERY_STATUS: 0.5,
    m.MAVLINK_MSG_ID_ATTITUDE: 10.0,
    m.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: 30.0,
    m.MAVLINK_MSG_ID_LOCAL_POSITION_NED: 30.0,
    m.MAVLINK_MSG_ID_ODOMETRY: 30.0,
    m.MAVLINK_MSG_ID_EXTENDED_SYS_STATE: 5.0,
    m.MAVLINK_MSG_ID_ESTIMATOR_STATUS: 2.0,
    m.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN: 0.5,
    m.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: 5.0,
    m.MAVLINK_MSG_ID_HOME_POSITION: 0.5,
}
"""The streams of a fresh link. The true pose is not among them: it must be asked for."""
