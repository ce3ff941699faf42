"""The bridge: frames, vision out, engagement, setpoints that follow corrections, the pilot's precedence."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common as mav

from services.common.geometry import exp_rotation, level_camera, pose, rotation_from_quaternion
from services.common.mount import Mount
from services.navigator.autopilot.bridge import timesync_answer
from services.navigator.autopilot.frames import covariance_ned, quaternion_ned, rotation_map_body, to_ned
from tests.unit.autopilot_rig import HOLD_MODE, LAND_MODE, MS, OFFBOARD_MODE, POSITION_MODE, SECOND, Rig

# -- frames -------------------------------------------------------------------------------------------------------


@given(st.tuples(*[st.floats(-3.0, 3.0)] * 3))
def test_quaternion_is_of_norm_one_in_float32_and_goes_back(r: tuple[float, float, float]) -> None:
    R = exp_rotation(r)
    q = quaternion_ned(R)
    assert abs(float(np.linalg.norm(np.array(q, dtype=np.float32))) - 1.0) < 1e-5
    assert np.allclose(rotation_map_body(q), R, atol=1e-9)


def test_left_is_west_and_up_is_negative_down() -> None:
    assert to_ned(np.array([1.0, 2.0, 3.0])).tolist() == [1.0, -2.0, -3.0]
    w, _, _, z = quaternion_ned(exp_rotation((0.0, 0.0, 0.5)))
    assert 2.0 * math.atan2(z, w) == pytest.approx(-0.5)


def test_mount_gives_the_body_and_its_setpoint() -> None:
    mount = Mount.level((0.1, 0.02, -0.05), pitch_rad=0.2, yaw_rad=0.3)
    T_map_body = pose(exp_rotation((0.0, 0.0, 0.7)), (1.0, 2.0, 3.0))
    assert np.allclose(mount.body(T_map_body @ mount.T_body_camera), T_map_body, atol=1e-12)
    camera = T_map_body @ mount.T_body_camera
    position, yaw, velocity = mount.body_setpoint(camera[:3, 3], 0.7 + 0.3, np.zeros(3), 0.5)
    assert np.allclose(position, (1.0, 2.0, 3.0))
    assert yaw == pytest.approx(0.7)
    # the camera stands still while turning: the body circles it
    step = 1e-6
    turned, _, _ = mount.body_setpoint(camera[:3, 3], 1.0 + 0.5 * step, np.zeros(3), 0.5)
    assert np.allclose((turned - position) / step, velocity, atol=1e-5)


def test_covariance_moves_with_the_lever_arm() -> None:
    C = np.diag([1e-4] * 3 + [1e-3] * 3)
    upper = tuple(C[np.triu_indices(6)])
    near = covariance_ned(upper, np.eye(3), Mount.level((0.0, 0.0, 0.0)))
    far = covariance_ned(upper, np.eye(3), Mount.level((0.5, 0.0, 0.0)))
    assert np.allclose(near, C)
    assert far[1, 1] == pytest.approx(1e-4 + 0.25 * 1e-3)
    rng = np.random.default_rng(0)
    w = rng.normal(0.0, math.sqrt(1e-3), (20000, 3))
    moved = np.array([-exp_rotation(v) @ (0.5, 0.0, 0.0) for v in w])
    sampled = np.diag([1.0, -1.0, -1.0]) @ np.cov(moved.T) @ np.diag([1.0, -1.0, -1.0])
    assert np.allclose(far[:3, :3] - 1e-4 * np.eye(3), sampled, atol=2e-5)


# -- vision -------------------------------------------------------------------------------------------------------


def _odometry(messages: list[Any]) -> list[Any]:
    return [m for m in messages if m.get_type() == "ODOMETRY"]


def test_odometry_goes_out_at_thirty_hertz_from_sixteen() -> None:
    rig = Rig()
    rig.velocity = np.array([0.3, 0.1, 0.0])
    rig.run(1.0)
    sent = _odometry(rig.run(4.0))
    assert 4 * 28 <= len(sent) <= 4 * 36
    stamps = np.array([m.time_usec for m in sent])
    assert (np.diff(stamps) > 0).all()
    assert sent[-1].frame_id == mav.MAV_FRAME_LOCAL_NED
    assert sent[-1].child_frame_id == mav.MAV_FRAME_BODY_FRD
    assert sent[-1].estimator_type == mav.MAV_ESTIMATOR_TYPE_VIO
    assert math.isnan(sent[-1].vx)
    x = np.array([m.x for m in sent])
    speed = np.diff(x) / (np.diff(stamps) / 1e6)
    assert np.allclose(np.median(speed), 0.3, atol=0.01)
    assert np.abs(x - np.polyval(np.polyfit(stamps - stamps[0], x, 1), stamps - stamps[0])).max() < 0.01


def test_vision_falls_silent_when_slam_is_lost_or_silent() -> None:
    rig = Rig()
    rig.run(1.0)
    rig.T_map_camera = None
    rig.run(0.1)
    assert not _odometry(rig.run(1.0))
    rig.T_map_camera = level_camera((0.0, 0.0, 0.0), 0.0)
    assert _odometry(rig.run(0.3))


def test_reset_counter_rises_with_each_kind_of_jump() -> None:
    rig = Rig()
    rig.run(1.0)
    assert rig.bridge.vision.reset_counter == 0
    rig.reset_counter += 1
    rig.T_map_camera = level_camera((0.3, 0.0, 0.0), 0.1)
    rig.run(0.2)
    assert rig.bridge.vision.reset_counter == 1
    rig.T_map_camera = level_camera((2.0, 0.0, 0.0), 0.1)  # a jump that slam did not tell
    rig.run(0.2)
    assert rig.bridge.vision.reset_counter == 2
    assert _odometry(rig.run(0.2))[-1].reset_counter == 2


def test_no_heartbeat_of_the_autopilot_no_words_but_our_heartbeat() -> None:
    rig = Rig()
    rig.telemetry = False
    kinds = {m.get_type() for m in rig.run(3.0)}
    assert kinds == {"HEARTBEAT"}
    assert rig.sent[0][1].type == mav.MAV_TYPE_ONBOARD_CONTROLLER


def test_timesync_is_answered_with_our_clock_and_answers_are_not() -> None:
    answer = timesync_answer(mav.MAVLink_timesync_message(0, 123), 456)
    assert answer is not None
    assert (answer.tc1, answer.ts1) == (456, 123)
    assert timesync_answer(mav.MAVLink_timesync_message(9, 123), 456) is None


# -- engagement ---------------------------------------------------------------------------------------------------


def test_engages_in_order_stream_offboard_arm() -> None:
    rig = Rig()
    rig.engage()
    kinds = [
        (at, m.get_type(), getattr(m, "command", 0))
        for at, m in rig.sent
        if m.get_type() == "SET_POSITION_TARGET_LOCAL_NED"
        or (m.get_type() == "COMMAND_LONG" and m.command in (mav.MAV_CMD_DO_SET_MODE, 400))
    ]
    first: dict[tuple[str, int], int] = {}
    for at, kind, command in kinds:
        first.setdefault((kind, command), at)
    stream = first["SET_POSITION_TARGET_LOCAL_NED", 0]
    offboard = first["COMMAND_LONG", mav.MAV_CMD_DO_SET_MODE]
    assert offboard - stream > SECOND
    assert first["COMMAND_LONG", 400] > offboard
    assert len(rig.setpoints(2.0)) >= 2 * 20


def test_no_setpoint_before_it_is_engaged() -> None:
    rig = Rig()
    assert not rig.setpoints(3.0)


def test_a_mission_under_way_when_the_bridge_starts_is_never_engaged() -> None:
    rig = Rig()
    rig.guidance = {"engage": True, "mission_id": 4}
    assert not rig.setpoints(5.0)
    assert not rig.armed
    assert rig.bridge.state(rig.now_ns).engaged_mission_id == 4
    rig.engage(5)


def test_the_pilot_takes_over_and_the_stream_never_returns() -> None:
    rig = Rig()
    rig.engage()
    rig.mode = POSITION_MODE
    rig.run(0.1)  # one heartbeat
    begin = len(rig.sent)
    rig.run(5.0)
    later = {m.get_type() for _, m in rig.sent[begin:]}
    assert "SET_POSITION_TARGET_LOCAL_NED" not in later
    assert not [m for _, m in rig.sent[begin:] if getattr(m, "command", 0) in (176, 400)]
    assert rig.bridge.state(rig.now_ns).operator_override
    rig.mode = OFFBOARD_MODE  # PX4 or the pilot goes back: not our business any more
    assert not rig.setpoints(5.0)
    rig.armed = False
    assert not rig.setpoints(5.0)
    rig.mode = HOLD_MODE
    rig.engage(2)
    assert not rig.bridge.state(rig.now_ns).operator_override


@pytest.mark.parametrize("after_s", [0.3, 1.6, 1.75, 2.0])
def test_the_pilot_may_take_over_while_engaging(after_s: float) -> None:
    rig = Rig()
    rig.run(2.0)
    rig.guidance = {"engage": True, "mission_id": 1}
    rig.run(after_s)
    rig.obedient = False
    rig.mode, rig.armed = POSITION_MODE, True
    rig.run(10.0)
    assert not rig.setpoints(2.0)
    assert rig.mode == POSITION_MODE


def test_a_gap_in_the_link_ends_the_stream_for_good() -> None:
    rig = Rig()
    rig.engage()
    rig.telemetry = False
    rig.run(1.2)
    assert not rig.setpoints(1.0)
    rig.telemetry, rig.mode = True, OFFBOARD_MODE
    assert not rig.setpoints(5.0)
    assert rig.bridge.state(rig.now_ns).operator_override


def test_silent_navigator_holds_where_the_aircraft_is_and_then_lands() -> None:
    rig = Rig()
    rig.engage()
    rig.velocity = np.array([0.3, 0.0, 0.0])
    rig.setpoint = (np.array([2.0, 0.0, 1.0]), 0.0, np.array([0.3, 0.0, 0.0]), 0.0)
    rig.run(1.0)
    rig.guidance = None
    rig.run(0.45)
    rig.velocity = np.zeros(3)
    assert rig.T_map_camera is not None
    held = rig.setpoints(0.5)
    assert (held[-1].vx, held[-1].vy, held[-1].vz, held[-1].yaw_rate) == (0.0, 0.0, 0.0, 0.0)
    assert held[-1].x == pytest.approx(rig.T_map_camera[0, 3], abs=0.1)
    rig.run(rig.bridge.config.guidance_land_s + 0.5)
    assert rig.mode == LAND_MODE
    assert not rig.setpoints(1.0)


def test_a_restarted_navigator_is_held_for_until_it_speaks_for_the_mission() -> None:
    rig = Rig()
    rig.engage()
    rig.guidance = {"engage": False, "mission_id": 0}
    rig.run(2.0)
    assert rig.mode == OFFBOARD_MODE
    assert rig.setpoints(0.5)[-1].vx == 0.0
    rig.guidance = {"engage": True, "mission_id": 1}
    rig.setpoint = (np.array([0.2, 0.1, 1.0]), 0.0, np.zeros(3), 0.0)
    assert rig.setpoints(0.5)[-1].x == pytest.approx(0.2)


def test_lands_when_told_and_is_quiet_afterwards() -> None:
    rig = Rig()
    rig.engage()
    rig.guidance = {"engage": True, "mission_id": 1, "land": True}
    rig.run(0.3)
    assert rig.mode == LAND_MODE
    assert not rig.bridge.state(rig.now_ns).operator_override
    assert not rig.setpoints(2.0)
    rig.armed, rig.mode = False, HOLD_MODE
    rig.run(0.3)
    assert rig.bridge.engagement.phase == "quiet"
    rig.guidance = {"engage": True, "mission_id": 1}
    assert not rig.setpoints(5.0), "a mission number engages once"


def test_the_pilot_may_break_off_our_landing() -> None:
    rig = Rig()
    rig.engage()
    rig.guidance = {"engage": True, "mission_id": 1, "land": True}
    rig.run(0.5)
    rig.mode = POSITION_MODE
    rig.run(2.0)
    assert rig.mode == POSITION_MODE
    assert rig.bridge.state(rig.now_ns).operator_override


def test_refused_arming_gives_up() -> None:
    rig = Rig()
    rig.run(1.5)
    rig.obedient = False
    rig.guidance = {"engage": True, "mission_id": 1}
    rig.run(15.0)
    assert rig.bridge.engagement.phase == "quiet"
    assert not rig.setpoints(1.0)


def test_without_fused_vision_nothing_is_engaged() -> None:
    rig = Rig()
    rig.believes = level_camera((3.0, 0.0, 0.0), 0.0)
    rig.run(1.5)
    rig.guidance = {"engage": True, "mission_id": 1}
    rig.run(12.0)
    assert not rig.armed
    assert rig.mode == HOLD_MODE


# -- setpoints ----------------------------------------------------------------------------------------------------


def test_setpoint_carries_position_velocity_yaw_and_yaw_rate_in_ned() -> None:
    rig = Rig()
    rig.engage()
    rig.setpoint = (np.array([1.0, 0.8, 1.5]), 0.5, np.array([0.1, 0.2, 0.0]), 0.3)
    m = rig.setpoints(0.5)[-1]
    assert m.coordinate_frame == mav.MAV_FRAME_LOCAL_NED
    assert m.type_mask == 448
    assert (m.vx, m.vy, m.vz) == pytest.approx((0.1, -0.2, 0.0))
    assert m.x == pytest.approx(1.0, abs=0.02)
    assert m.y == pytest.approx(-0.8, abs=0.04)
    assert m.z == pytest.approx(-1.5)
    assert m.yaw == pytest.approx(-0.5, abs=0.06)
    assert m.yaw_rate == pytest.approx(-0.3)


def test_correction_moves_pose_and_setpoint_in_the_same_tick() -> None:
    rig = Rig()
    rig.engage()
    rig.setpoint = (np.array([0.5, 0.0, 1.0]), 0.0, np.zeros(3), 0.0)
    before = rig.setpoints(0.5)[-1]
    old = rig.guidance_message()
    rig.guidance = None
    rig.reset_counter += 1
    rig.T_map_camera = level_camera((1.0, 0.0, 0.0), 0.2)
    rig.believes = rig.T_map_camera
    rig.now_ns += 10 * MS
    rig.bridge.on_guidance(old, rig.now_ns)
    rig.bridge.on_pose(rig.pose_message(), rig.now_ns)
    rig.bridge._due["setpoint"] = 0
    out = rig.bridge.tick(rig.now_ns)
    odometry = next(m for m in out if m.get_type() == "ODOMETRY")
    setpoint = next(m for m in out if m.get_type() == "SET_POSITION_TARGET_LOCAL_NED")
    assert odometry.reset_counter == 1
    assert odometry.x == pytest.approx(1.0, abs=0.01)
    assert setpoint.x == pytest.approx(1.0 + 0.5 * math.cos(0.2), abs=0.01)
    assert setpoint.y == pytest.approx(-0.5 * math.sin(0.2), abs=0.01)
    assert setpoint.yaw - before.yaw == pytest.approx(-0.2, abs=1e-3)


def test_guidance_of_a_map_that_cannot_be_related_is_not_followed() -> None:
    rig = Rig()
    rig.engage()
    rig.setpoint = (np.array([0.5, 0.0, 1.0]), 0.0, np.zeros(3), 0.0)
    rig.run(0.5)
    old = rig.guidance_message()
    rig.guidance = None
    rig.T_map_camera = level_camera((2.0, 0.0, 0.0), 0.0)  # an untold jump
    rig.believes = rig.T_map_camera
    rig.bridge.on_pose(rig.pose_message(), rig.now_ns + 1)
    rig.bridge.on_guidance(old, rig.now_ns + 2)
    held = rig.setpoints(0.2)[-1]
    assert held.x == pytest.approx(2.0, abs=0.05)


def test_state_is_told_in_our_frames() -> None:
    rig = Rig()
    rig.T_map_camera = level_camera((1.0, 2.0, 0.5), 0.4)
    rig.run(3.0)
    state = rig.bridge.state(rig.now_ns)
    assert state.connected
    assert state.mode == "hold"
    assert state.vision_fused
    assert state.position_map_m == pytest.approx((1.0, 2.0, 0.5), abs=1e-5)
    assert state.quaternion_map_body is not None
    R = rotation_from_quaternion(state.quaternion_map_body)
    assert math.atan2(R[1, 0], R[0, 0]) == pytest.approx(0.4, abs=1e-5)


def test_words_of_others_on_the_link_are_not_heard() -> None:
    rig = Rig()
    message = mav.MAVLink_heartbeat_message(6, mav.MAV_AUTOPILOT_INVALID, 128, OFFBOARD_MODE, 4, 3)
    message._header.srcSystem, message._header.srcComponent = 255, 190
    rig.bridge.handle(message, rig.now_ns)
    assert rig.bridge.telemetry.system is None
    rig.run(1.0)
    rig.bridge.handle(message, rig.now_ns)
    assert rig.bridge.telemetry.mode == "hold"


def test_a_setpoint_far_from_the_aircraft_is_refused_and_told() -> None:
    rig = Rig()
    rig.engage()
    rig.setpoint = (np.array([9.0, 0.0, 1.0]), 0.0, np.zeros(3), 0.0)
    sent = rig.setpoints(0.5)[2:]
    assert sent
    assert max(abs(m.x) for m in sent) < 0.5
    assert rig.bridge.setpoints_refused > 0
    assert "the navigator asks for a place 9" in rig.bridge.state(rig.now_ns).note
