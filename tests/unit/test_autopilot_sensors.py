"""The autopilot's IMU and GPS on the bus: frames, clocks, and nothing of it while nobody wants them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import common as mav

from schemas.vehicle import GpsFix, ImuSample
from services.common.geometry import pose
from services.navigator.autopilot.bridge import Bridge
from services.navigator.autopilot.config import AutopilotConfig
from services.navigator.autopilot.link import Codec
from services.navigator.autopilot.sensors import Sensors
from services.simulator.px4.config import GpsConfig, Px4Config, SensorConfig
from services.simulator.px4.geodesy import TRUTH_ORIGIN, to_global
from services.simulator.px4.gps import GpsReceiver
from services.simulator.px4.inprocess import InProcessLink
from services.simulator.px4.simulated import SimulatedPx4

BEGIN_NS = 1_700_000_000_000_000_000
TICK_S = 0.008


class Flown:
    """A bridge beside a simulated PX4 that stands on its legs, on one clock."""

    def __init__(self, sensors: Sensors | None, config: Px4Config) -> None:
        self.now_ns = BEGIN_NS
        self.px4 = SimulatedPx4(lambda _x, _y: 0.0, pose(np.eye(3), (1.0, 2.0, 0.1)), config, 3)
        self.bridge = Bridge(AutopilotConfig(check_parameters=False), sensors)
        self.link = InProcessLink(self.px4, Codec(191, 1, lambda: self.now_ns))
        self.samples: list[ImuSample] = []
        self.fixes: list[GpsFix] = []
        self.sent: list[Any] = []

    def run(self, seconds: float) -> Flown:
        for _ in range(round(seconds / TICK_S)):
            self.px4.step(TICK_S)
            self.now_ns += round(TICK_S * 1e9)
            for message, received_ns in self.link.poll():
                self.bridge.handle(message, received_ns)
            for message in self.bridge.tick(self.now_ns):
                self.sent.append(message)
                self.link.send(message)
            imu, fix = self.bridge.sensors.imu(), self.bridge.sensors.fix()
            self.samples += imu.samples if imu else ()
            self.fixes += [fix] if fix else []
        return self


def flown(gps: GpsConfig, *, wanted: bool = True) -> Flown:
    quiet = SensorConfig(gyro_noise_rad_s=0.0, gyro_bias_rad_s=0.0, accel_noise_m_s2=0.0, accel_bias_m_s2=0.0)
    return Flown(Sensors(125.0, 5.0) if wanted else None, Px4Config(gps=gps, sensors=quiet))


def test_samples_come_at_their_rate_in_our_frames_and_on_our_clock() -> None:
    rig = flown(GpsConfig()).run(6.0)
    tail = rig.samples[-250:]
    assert len(tail) == 250
    gaps = np.diff([s.stamp_ns for s in tail])
    assert gaps.min() > 0
    assert np.median(gaps) == pytest.approx(TICK_S * 1e9, rel=0.02)
    assert abs(tail[-1].stamp_ns - rig.now_ns) < 20e6
    assert np.allclose(tail[-1].accel_m_s2, (0.0, 0.0, 9.80665), atol=0.01), "at rest the force points up"
    assert not rig.fixes, "there is no receiver"


def test_fixes_are_where_the_aircraft_is() -> None:
    rig = flown(GpsConfig(present=True, white_m=0.0, slow_m=0.5)).run(6.0)
    assert 15 <= len(rig.fixes) <= 30
    fix = rig.fixes[-1]
    latitude, longitude, height = to_global(TRUTH_ORIGIN, (1.0, -2.0, -0.1))
    assert fix.fix == "3d"
    assert abs(fix.latitude_deg - latitude) * 111e3 < 3.0
    assert abs(fix.longitude_deg - longitude) * 75e3 < 3.0
    assert abs(fix.altitude_m - height) < 5.0
    assert fix.horizontal_sigma_m == pytest.approx(0.5, abs=0.01)
    assert abs(fix.stamp_ns - rig.now_ns) < 0.4e9


def test_an_outage_is_a_fix_of_nothing() -> None:
    rig = flown(GpsConfig(present=True, outages_s=((3.0, 9.0),))).run(6.0)
    assert {fix.fix for fix in rig.fixes[-5:]} == {"none"}


def test_nobody_asks_for_them_while_fusion_is_off() -> None:
    rig = flown(GpsConfig(present=True), wanted=False).run(3.0)
    asked = {m.param1 for m in rig.sent if m.get_type() == "COMMAND_LONG"}
    assert mav.MAVLINK_MSG_ID_HIGHRES_IMU not in asked
    assert mav.MAVLINK_MSG_ID_GPS_RAW_INT not in asked
    assert not rig.samples
    assert not rig.fixes


def test_a_coarser_imu_serves_where_the_good_one_does_not_come() -> None:
    sensors = Sensors(50.0)
    sensors.take(mav.MAVLink_scaled_imu_message(100, 100, -200, -1000, 10, 20, -30, 0, 0, 0), 0, 0)
    imu = sensors.imu()
    assert imu is not None
    assert np.allclose(imu.samples[0].accel_m_s2, (0.980665, 1.96133, 9.80665))
    assert np.allclose(imu.samples[0].gyro_rad_s, (0.01, -0.02, 0.03))
    assert imu.samples[0].stamp_ns == 100_000_000


def test_what_cannot_be_is_not_passed_on() -> None:
    sensors = Sensors(50.0, 5.0)
    fields = [0.0] * 13
    sensors.take(mav.MAVLink_highres_imu_message(100, float("nan"), *fields[1:], 63), 0, 0)
    sensors.take(mav.MAVLink_highres_imu_message(200, *fields, 63), 0, None)
    sensors.take(mav.MAVLink_gps_raw_int_message(1, 3, 2**31 - 1, 0, 0, 90, 90, 0, 0, 9), 0, 0)
    assert sensors.imu() is None, "a value that is none, and a clock that is not known yet"
    assert sensors.fix() is None, "a latitude of 214 degrees"
    sensors.take(mav.MAVLink_gps_raw_int_message(10**15, 3, 0, 0, 0, 200, 90, 0, 0, 9), 5_000, 0)
    fix = sensors.fix()
    assert fix is not None
    assert fix.stamp_ns == 5_000, "a stamp on another clock: its arrival counts"
    assert fix.horizontal_sigma_m == pytest.approx(3.0)


def test_the_receivers_lies_are_the_configured_ones() -> None:
    receiver = GpsReceiver(GpsConfig(present=True, jump_at_s=10.0, drag_from_s=20.0, drag_m_s=(0.1, 0.0)), 1)
    assert not receiver.lie_m(5.0).any()
    assert np.allclose(receiver.lie_m(12.0), (8.0, 6.0, 0.0))
    assert np.allclose(receiver.lie_m(30.0), (9.0, 6.0, 0.0))
    errors = [
        receiver.latest.position_ned_m - receiver.lie_m(receiver.latest.given_s - 0.1)
        for k in range(5000)
        if receiver.update(0.2 * k, np.zeros(3), np.zeros(3)) and receiver.latest is not None
    ]
    assert np.std([e[0] for e in errors]) == pytest.approx(np.hypot(0.4, 1.2), rel=0.35)
    assert np.std([e[2] for e in errors]) == pytest.approx(1.8 * np.hypot(0.4, 1.2), rel=0.35)
