"""Design section 7: heartbeat, setpoints, modes and their acknowledgements, loss and re-entry, the pilot."""

from __future__ import annotations

import math

import pytest
from pymavlink.dialects.v20 import common as m

from services.simulator.px4.links import LoopbackLink
from services.simulator.px4.modes import NavState
from tests.contract.px4_companion import TICK_S, Companion, quiet


def loss_s(c: Companion) -> float:
    """Stop the setpoints and return after how long the heartbeat's mode would leave OFFBOARD."""
    c.setpoints.on = False
    last = c.now_s
    while c.flies() is NavState.OFFBOARD and c.now_s - last < 5.0:
        c.run(TICK_S)
    return c.now_s - last


def test_heartbeat_is_a_px4_quadrotor_at_one_hertz() -> None:
    c = Companion(quiet())
    c.run(5.0)
    beats = c.got["HEARTBEAT"]
    assert len(beats) in (5, 6)
    beat = beats[-1][1]
    assert (beat.type, beat.autopilot) == (m.MAV_TYPE_QUADROTOR, m.MAV_AUTOPILOT_PX4)
    assert (beat.get_srcSystem(), beat.get_srcComponent()) == (1, 1)
    assert c.heartbeat_mode() == (4, 3)


def test_companion_is_known_by_its_type_and_the_autopilots_own_system_id() -> None:
    c = Companion(quiet())
    c.mav.srcSystem = 42
    c.run(1.5)
    assert math.isinf(c.px4.link_age_s())
    c.mav.srcSystem = 1
    c.run(1.5)
    assert c.px4.link_age_s() <= 1.0


def test_mode_command_is_acknowledged_twice_and_the_first_says_nothing() -> None:
    c = Companion(quiet())
    c.hover()
    c.set_integer("EKF2_NOAID_TOUT", 5_000_000)
    # no origin is set: Hold cannot run, yet the first acknowledgement accepts
    assert c.set_mode(NavState.HOLD) == [0, 1]
    c.run(1.1)
    assert c.heartbeat_mode() == (6, 0)


def test_offboard_needs_a_second_of_setpoints() -> None:
    c = Companion(quiet())
    c.run(2.0)
    c.set_mode(NavState.OFFBOARD)
    assert c.arm() == [1]
    c.setpoints.on = True
    c.run(0.8)
    assert c.arm() == [1]
    c.run(0.4)
    assert c.arm() == [0]


def test_a_slow_stream_is_no_stream() -> None:
    c = Companion(quiet())
    c.setpoints.on, c.setpoints.rate_hz = True, 1.5
    c.run(6.0)
    c.set_mode(NavState.OFFBOARD)
    assert c.arm() == [1]


@pytest.mark.parametrize(("action", "state"), [(4, NavState.LAND), (5, NavState.HOLD)])
def test_setpoints_stop_then_the_configured_action(action: int, state: NavState) -> None:
    c = Companion(quiet())
    c.set_origin()
    c.set_integer("COM_OBL_RC_ACT", action)
    c.hover()
    assert 1.2 <= loss_s(c) <= 1.4
    assert c.flies() is state


def test_hold_without_a_global_position_falls_to_land() -> None:
    c = Companion(quiet())
    c.set_integer("COM_OBL_RC_ACT", 5)
    c.hover()
    loss_s(c)
    assert c.flies() is NavState.LAND


def test_resumed_setpoints_take_the_craft_back_by_themselves() -> None:
    c = Companion(quiet())
    c.hover()
    loss_s(c)
    c.run(1.0)
    height = -float(c.true_ned()[2])
    assert c.flies() is NavState.LAND
    c.setpoints.on = True
    c.run(0.5)
    assert c.flies() is NavState.OFFBOARD
    c.run(4.0)
    assert -float(c.true_ned()[2]) > height + 0.2


def test_resumed_setpoints_even_take_off_again_before_the_disarming() -> None:
    """The trap that the bridge must not spring."""
    c = Companion(quiet())
    c.hover()
    loss_s(c)
    while not c.px4.vehicle.land.landed:
        c.run(0.02)
    assert c.px4.armed
    c.setpoints.on = True
    c.run(6.0)
    assert c.px4.armed
    assert -float(c.true_ned()[2]) > 1.0


def test_after_landing_it_disarms_and_resumed_setpoints_do_nothing() -> None:
    c = Companion(quiet())
    c.hover()
    loss_s(c)
    c.run(7.0)
    assert not c.px4.armed
    c.setpoints.on = True
    c.run(3.0)
    assert not c.px4.armed
    assert c.px4.on_ground


def test_the_pilot_wins_and_setpoints_do_not_take_it_back() -> None:
    c = Companion(quiet())
    c.hover()
    assert c.px4.pilot_takes(NavState.POSITION)
    c.run(0.2)
    c.setpoints.place = lambda _t: (5.0, 0.0, -1.5)
    c.run(3.0)
    assert c.heartbeat_mode() == (3, 0)
    assert abs(float(c.true_ned()[0])) < 0.3
    c.setpoints.on = False
    c.run(2.0)
    c.setpoints.on = True
    c.run(2.0)
    assert c.heartbeat_mode() == (3, 0)


@pytest.mark.parametrize("frame", [7, 9, 12, 20, 21])
def test_other_setpoint_frames_are_refused(frame: int) -> None:
    c = Companion(quiet())
    c.setpoints.on, c.setpoints.frame = True, frame
    c.run(2.0)
    assert c.px4.counters["setpoints_refused"] > 30
    c.set_mode(NavState.OFFBOARD)
    assert c.arm() == [1]


def test_body_frame_takes_velocity_along_the_heading_and_no_position() -> None:
    c = Companion(quiet(), yaw_world_rad=-math.pi / 2)  # heading east in NED
    c.setpoints.yaw = lambda _t: math.pi / 2
    c.hover()
    c.setpoints.frame = m.MAV_FRAME_BODY_NED
    refused = c.px4.counters.get("setpoints_refused", 0)
    c.run(0.5)
    assert c.px4.counters["setpoints_refused"] > refused
    c.setpoints.velocity = (0.5, 0.0, 0.0)
    c.run(4.0)
    north, east, _ = (float(v) for v in c.true_ned())
    assert east > 1.0
    assert abs(north) < 0.3


def test_statustext_reaches_only_ground_station_links() -> None:
    c = Companion(quiet())
    ours, theirs = LoopbackLink.pair()
    c.px4.attach(theirs, ground_station=True)
    station = m.MAVLink(None, srcSystem=255, srcComponent=190)
    c.run(2.0)
    c.arm()  # refused: Hold cannot run without an origin
    texts = []
    while (data := ours.receive()) is not None:
        texts += [p.text for p in station.parse_buffer(data) or [] if p.get_type() == "STATUSTEXT"]
    assert any("Arming denied" in t for t in texts)
    assert not c.got["STATUSTEXT"]


def test_arming_requirements() -> None:
    for name, value in (("COM_ARM_WO_GPS", 0), ("NAV_DLL_ACT", 2), ("COM_RC_IN_MODE", 0)):
        c = Companion(quiet())
        c.setpoints.on = True
        c.run(2.5)
        c.set_mode(NavState.OFFBOARD)
        c.set_integer(name, value)
        assert c.arm() == [1], name
    c.px4.vehicle.commander.remote_control = True
    assert c.arm() == [0]


def test_disarming_in_the_air_is_refused_unless_forced() -> None:
    c = Companion(quiet())
    c.hover()
    assert c.command(m.MAV_CMD_COMPONENT_ARM_DISARM, 0.0) == [1]
    assert c.px4.armed
    assert c.command(m.MAV_CMD_COMPONENT_ARM_DISARM, 0.0, 21196.0) == [0]
    assert not c.px4.armed


def test_armed_without_take_off_disarms_by_itself() -> None:
    c = Companion(quiet())
    c.setpoints.on, c.setpoints.place = True, lambda _t: (0.0, 0.0, 0.5)
    c.run(2.5)
    c.set_mode(NavState.OFFBOARD)
    assert c.arm() == [0]
    c.run(11.0)
    assert not c.px4.armed
    assert c.px4.on_ground


def test_unknown_command_and_garbage_do_no_harm() -> None:
    c = Companion(quiet())
    assert c.command(31999) == [3]
    for junk in (b"", b"\xfd", b"\xfd" * 300, bytes(range(256))):
        c.link.send(junk)
    c.run(1.2)
    assert c.got["HEARTBEAT"][-1][0] > 0.9


def test_two_runs_are_the_same_bytes() -> None:
    def flight() -> bytes:
        c = Companion(seed=9)
        c.hover()
        c.run(1.0)
        return c.px4.vehicle.body.state.tobytes() + b"".join(p.pack(c.mav) for _, p in c.got["ODOMETRY"][-3:])

    assert flight() == flight()
