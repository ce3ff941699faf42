"""Habits of a real PX4 v1.16 on the wire that a client must not count on being otherwise (docs/decisions/px4-sim.md)."""

from __future__ import annotations

import numpy as np
from pymavlink.dialects.v20 import common as m

from services.common.geometry import pose
from services.simulator.px4.config import Px4Config
from services.simulator.px4.modes import NavState
from services.simulator.px4.simulated import SimulatedPx4
from services.simulator.px4.telemetry import hil_state_quaternion
from tests.contract.px4_companion import CALM, ORIGIN, Companion


def _quiet() -> Px4Config:
    return Px4Config(wind=CALM)


def test_the_heartbeats_rate_is_fixed_but_one_may_be_asked_for() -> None:
    c = Companion(_quiet())
    c.run(0.1)
    assert c.command(m.MAV_CMD_SET_MESSAGE_INTERVAL, m.MAVLINK_MSG_ID_HEARTBEAT, 1e5) == [4]
    before = len(c.got["HEARTBEAT"])
    c.run(3.0)
    assert len(c.got["HEARTBEAT"]) - before == 3
    assert c.command(m.MAV_CMD_REQUEST_MESSAGE, m.MAVLINK_MSG_ID_HEARTBEAT) == [0]
    assert c.command(m.MAV_CMD_REQUEST_MESSAGE, m.MAVLINK_MSG_ID_HEARTBEAT) == [0]
    assert len(c.got["HEARTBEAT"]) - before >= 5


def test_the_origin_is_told_once_when_the_position_is_global_by_it_and_when_asked_for() -> None:
    c = Companion(_quiet())
    c.vision.on = False
    c.set_origin()
    c.run(3.0)
    assert not c.got["GPS_GLOBAL_ORIGIN"], "set, but no position yet"
    c.vision.on = True
    c.run(8.0)
    assert len(c.got["GPS_GLOBAL_ORIGIN"]) == 1
    assert c.got["GPS_GLOBAL_ORIGIN"][0][1].latitude == ORIGIN[0]
    assert c.command(m.MAV_CMD_REQUEST_MESSAGE, m.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN) == [0]
    assert len(c.got["GPS_GLOBAL_ORIGIN"]) == 2


def test_a_climb_in_offboard_is_told_as_in_the_air_not_as_a_take_off() -> None:
    c = Companion(_quiet())
    c.hover()
    states = {message.landed_state for _, message in c.got["EXTENDED_SYS_STATE"]}
    assert states == {m.MAV_LANDED_STATE_ON_GROUND, m.MAV_LANDED_STATE_IN_AIR}
    assert c.flies() is NavState.OFFBOARD


def test_the_true_pose_comes_without_a_stamp_in_whole_centimetres() -> None:
    px4 = SimulatedPx4(lambda _x, _y: 0.0, pose(np.eye(3), (0.0, 0.0, 0.1)), Px4Config(links=()), 1)
    px4.vehicle.body.state[3:6] = (0.126, -0.126, 0.0)
    told = hil_state_quaternion(px4.vehicle)
    assert told.time_usec == 0
    assert (told.vx, told.vy, told.vz) == (12, -12, 0)
    assert (told.xacc, told.yacc) == (0, 0)
