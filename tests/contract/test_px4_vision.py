"""Design section 7: what external vision must be like, and what the craft does on it."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import common as m

from services.simulator.px4.geodesy import TRUTH_ORIGIN, to_local
from services.simulator.px4.modes import NavState
from services.simulator.px4.timesync import CONVERGENCE_SAMPLES
from tests.contract.px4_companion import TICK_S, Companion, quiet


def fused(c: Companion, seconds: float = 3.0) -> bool:
    """Run and return whether the estimator uses the vision position."""
    c.run(seconds)
    flags = c.px4.vehicle.estimator.flags
    return bool(flags.position and flags.yaw)


def test_vision_at_thirty_hertz_is_fused_and_told() -> None:
    c = Companion(quiet())
    assert fused(c)
    status = c.got["ESTIMATOR_STATUS"][-1][1].flags
    assert status & m.ESTIMATOR_POS_HORIZ_REL
    assert not status & m.ESTIMATOR_CONST_POS_MODE
    assert c.got["LOCAL_POSITION_NED"]


def test_vision_at_four_hertz_is_never_fused() -> None:
    c = Companion(quiet())
    c.vision.rate_hz = 4.0
    assert not fused(c, 20.0)
    assert not c.got["LOCAL_POSITION_NED"]


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("estimator", m.MAV_ESTIMATOR_TYPE_MOCAP),
        ("estimator", m.MAV_ESTIMATOR_TYPE_GPS),
        ("norm", 1.0 + 3e-5),
        ("norm", 1.0 - 3e-5),
        ("frame", m.MAV_FRAME_LOCAL_ENU),
        ("frame", m.MAV_FRAME_LOCAL_FLU),
        ("child", m.MAV_FRAME_LOCAL_NED),
    ],
)
def test_wrong_odometry_is_never_fused(field: str, value: Any) -> None:
    c = Companion(quiet())
    setattr(c.vision, field, value)
    assert not fused(c)
    assert not c.got["STATUSTEXT"]
    setattr(c.vision, field, getattr(Companion(quiet()).vision, field))
    assert fused(c)


def test_norm_within_the_tolerance_is_fused() -> None:
    c = Companion(quiet())
    c.vision.norm = 1.0 + 0.8e-5
    assert fused(c)


@pytest.mark.parametrize(("frame", "available"), [(m.MAV_FRAME_LOCAL_NED, True), (m.MAV_FRAME_LOCAL_FRD, False)])
def test_origin_with_local_ned_makes_hold_available(frame: int, available: bool) -> None:
    c = Companion(quiet())
    c.vision.frame = frame
    c.set_origin()
    assert fused(c)
    assert bool(c.got["GPS_GLOBAL_ORIGIN"]) is available
    c.hover()
    assert c.set_mode(NavState.HOLD) == [0, 0 if available else 1]
    c.run(1.1)
    assert (c.heartbeat_mode() == (4, 3)) is available
    assert bool(c.got["GLOBAL_POSITION_INT"]) is available


def test_vision_bias_moves_the_true_craft() -> None:
    c = Companion(quiet())
    c.hover()
    before = c.true_ned()
    for i in range(1, 31):  # the bias grows over three seconds, as a drifting map's does
        c.vision.bias_world_m = (0.01 * i, 0.0, 0.0)
        c.run(0.1)
    c.run(6.0)
    moved = c.true_ned() - before
    assert moved[0] == pytest.approx(-0.3, abs=0.06)
    assert abs(moved[1]) < 0.06


def test_cut_vision_lets_it_drift_and_is_noticed_after_five_seconds() -> None:
    drifts = []
    for seed in range(1, 5):
        c = Companion(quiet(), seed=seed)
        c.set_integer("EKF2_NOAID_TOUT", 5_000_000)
        c.hover()
        c.vision.on = False
        start, place = c.now_s, c.true_ned()
        while c.flies() is NavState.OFFBOARD and c.now_s - start < 9.0:
            c.run(TICK_S)
        assert 4.9 <= c.now_s - start <= 5.7
        assert c.flies() is NavState.DESCEND
        drifts.append(float(np.linalg.norm(c.true_ned()[:2] - place[:2])))
    assert 0.1 < float(np.median(drifts)) < 4.0


def test_short_timeout_reacts_within_a_second_and_a_half() -> None:
    c = Companion(quiet())
    c.hover()
    c.vision.on = False
    start = c.now_s
    while c.flies() is NavState.OFFBOARD and c.now_s - start < 9.0:
        c.run(TICK_S)
    assert 0.9 <= c.now_s - start <= 1.6


def test_announced_jump_moves_the_craft_at_walking_pace() -> None:
    c = Companion(quiet())
    c.hover()
    place = c.true_ned()
    c.vision.bias_world_m, c.vision.reset_counter = (-1.0, 0.0, 0.0), 1
    seen = []
    c.run(6.0, lambda: seen.append(float(c.true_ned()[0])))
    assert c.true_ned()[0] - place[0] == pytest.approx(1.0, abs=0.12)
    speed = np.diff(seen[::25]) / (25 * TICK_S)
    assert speed.max() == pytest.approx(0.6, abs=0.12)


def test_setpoint_shifted_in_the_same_tick_keeps_it_in_place() -> None:
    c = Companion(quiet())
    c.hover()
    place = c.true_ned()
    c.vision.bias_world_m, c.vision.reset_counter = (-1.0, 0.0, 0.0), 1
    c.setpoints.place = lambda _t: (-1.0, 0.0, -1.5)
    away: list[float] = []
    c.run(6.0, lambda: away.append(abs(float(c.true_ned()[0] - place[0]))))
    assert max(away) < 0.4
    assert away[-1] < 0.12


def test_unannounced_jump_is_gated_then_taken() -> None:
    c = Companion(quiet())
    c.hover()
    c.vision.bias_world_m = (-1.0, 0.0, 0.0)
    estimator = c.px4.vehicle.estimator
    resets = estimator.resets
    c.run(0.8)
    assert estimator.resets == resets
    assert abs(float(estimator.position_m[0])) < 0.3
    c.run(1.0)
    assert estimator.resets > resets


def test_yaw_lag_is_as_measured() -> None:
    rate = math.radians(30.0)
    for with_rate, expected, tolerance in ((False, 13.0, 1.0), (True, 1.8, 0.6)):
        c = Companion(quiet())
        c.hover()
        start = c.now_s

        def heading(t: float, start: float = start) -> float:
            return math.remainder(rate * max(0.0, t - start), 2.0 * math.pi)

        c.setpoints.yaw = heading
        c.setpoints.yaw_rate = rate if with_rate else math.nan
        c.run(5.0)
        lags: list[float] = []

        def note(lags: list[float] = lags, c: Companion = c, heading: Any = heading) -> None:
            T = c.px4.true_pose()
            yaw = -math.atan2(T[1, 0], T[0, 0])
            lags.append(math.degrees(math.remainder(heading(c.now_s) - yaw, 2.0 * math.pi)))

        c.run(5.0, note)
        assert float(np.mean(lags)) == pytest.approx(expected, abs=tolerance)


def test_hover_error_in_wind_is_as_measured() -> None:
    peaks, means = [], []
    for seed in (11, 12, 13):
        c = Companion(seed=seed)
        c.hover()
        c.run(5.0)
        errors: list[float] = []

        def note(errors: list[float] = errors, c: Companion = c) -> None:
            errors.append(float(np.linalg.norm(c.true_ned() - np.array([0.0, 0.0, -1.5]))))

        c.run(10.0, note)
        means.append(float(np.mean(errors)))
        peaks.append(max(errors))
    assert 0.03 < float(np.median(means)) < 0.2
    assert 0.06 < float(np.median(peaks)) < 0.35


def test_true_pose_is_told_on_request_only() -> None:
    c = Companion()
    c.hover()
    assert not c.got["HIL_STATE_QUATERNION"]
    assert c.command(m.MAV_CMD_SET_MESSAGE_INTERVAL, m.MAVLINK_MSG_ID_HIL_STATE_QUATERNION, 50_000.0) == [0]
    c.run(1.0)
    told = c.got["HIL_STATE_QUATERNION"]
    assert 18 <= len(told) <= 24
    last = told[-1][1]
    c.run(0.0)
    place = to_local(TRUTH_ORIGIN, (last.lat * 1e-7, last.lon * 1e-7, last.alt * 1e-3))
    assert np.allclose(place, c.true_ned(), atol=0.06)
    assert c.command(m.MAV_CMD_SET_MESSAGE_INTERVAL, m.MAVLINK_MSG_ID_HIL_STATE_QUATERNION, -1.0) == [0]
    count = len(c.got["HIL_STATE_QUATERNION"])
    c.run(0.5)
    assert len(c.got["HIL_STATE_QUATERNION"]) == count


# -- time ------------------------------------------------------------------------------------------------------------


def test_time_sync_converges_after_five_hundred_samples() -> None:
    c = Companion(quiet())
    c.run(49.0)
    assert not c.synced()
    c.run(2.0)
    assert c.synced()
    assert c.port.timesync.samples >= CONVERGENCE_SAMPLES
    truth = c.px4.vehicle.now_s - (c.now_s + c.clock_offset_s)
    assert c.port.timesync.offset_s == pytest.approx(truth, abs=0.006)
    assert fused(c)


def test_a_wrong_clock_flies_well_for_fifty_seconds_then_loses_vision() -> None:
    c = Companion(quiet())
    c.vision.stamp_offset_s = -3.0
    c.run(48.0)
    assert c.px4.vehicle.estimator.flags.position
    c.run(4.0)
    assert not c.px4.vehicle.estimator.flags.position


def test_answers_later_than_ten_milliseconds_are_never_used() -> None:
    c = Companion(quiet(), timesync_delay_s=0.02)
    c.vision.stamp_offset_s = -3.0
    c.run(55.0)
    assert c.port.timesync.samples == 0
    assert c.port.timesync.slow_answers > 500
    assert c.px4.vehicle.estimator.flags.position


def test_timesync_requests_are_answered_with_our_clock() -> None:
    c = Companion(quiet())
    c.run(1.0)
    c.send(m.MAVLink_timesync_message(0, 123))
    c.run(0.02)
    answer = next(p for _, p in c.got["TIMESYNC"] if p.ts1 == 123)
    assert answer.tc1 * 1e-9 == pytest.approx(c.px4.vehicle.now_s, abs=0.05)
