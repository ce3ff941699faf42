"""Nothing that arrives on a link may stop the simulated autopilot or poison its state."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common as m

from services.simulator.px4.links import LoopbackLink
from services.simulator.px4.modes import NavState
from services.simulator.px4.params import INT32, NAMES, REAL32
from tests.contract.px4_companion import CUSTOM, Companion, quiet

floats = st.one_of(
    st.floats(width=32), st.sampled_from([0.0, 1.0, -1.0, math.nan, math.inf, -math.inf, 3.4e38, -3.4e38, 1e-40])
)
byte = st.integers(0, 255)
COMMANDS = [
    m.MAV_CMD_COMPONENT_ARM_DISARM, m.MAV_CMD_DO_SET_MODE, m.MAV_CMD_NAV_TAKEOFF, m.MAV_CMD_NAV_LAND,
    m.MAV_CMD_SET_MESSAGE_INTERVAL, m.MAV_CMD_REQUEST_MESSAGE, m.MAV_CMD_NAV_RETURN_TO_LAUNCH, 65535,
]  # fmt: skip


@st.composite
def messages(draw: st.DrawFn) -> Any:
    def several(count: int) -> list[float]:
        return draw(st.lists(floats, min_size=count, max_size=count))

    kind = draw(st.integers(0, 7))
    if kind == 0:
        return m.MAVLink_odometry_message(
            draw(st.integers(0, 2**64 - 1)), draw(st.sampled_from([1, 20, 4])), draw(st.sampled_from([12, 1])),
            *several(3), draw(st.sampled_from([[1.0, 0.0, 0.0, 0.0], [0.0] * 4, [math.nan] * 4])), *several(6),
            several(21), several(21), draw(byte), draw(st.integers(0, 8)), 0,
        )  # fmt: skip
    if kind == 1:
        frame, mask = draw(st.sampled_from([1, 8, 7])), draw(st.integers(0, 4095))
        return m.MAVLink_set_position_target_local_ned_message(0, 1, 1, frame, mask, *several(11))
    if kind == 2:
        return m.MAVLink_command_long_message(1, 1, draw(st.sampled_from(COMMANDS)), 0, *several(7))
    if kind == 3:
        name = draw(st.sampled_from([*NAMES, "NOT_THERE"])).encode()
        return m.MAVLink_param_set_message(1, 1, name, draw(floats), draw(st.sampled_from([INT32, REAL32, 1])))
    if kind == 4:
        whole = st.integers(-(2**31), 2**31 - 1)
        return m.MAVLink_set_gps_global_origin_message(1, draw(whole), draw(whole), draw(whole), 0)
    if kind == 5:
        wide = st.integers(-(2**63), 2**63 - 1)
        return m.MAVLink_timesync_message(draw(wide), draw(wide))
    if kind == 6:
        place = st.integers(-(2**31), 2**31 - 1)
        return m.MAVLink_command_int_message(
            1, 1, 0, draw(st.sampled_from(COMMANDS)), 0, 0, *several(4), draw(place), draw(place), draw(floats)
        )
    return m.MAVLink_set_mode_message(1, draw(byte), draw(st.integers(0, 2**32 - 1)))


def sound(c: Companion) -> bool:
    v = c.px4.vehicle
    return bool(np.isfinite(v.body.state).all() and np.isfinite(v.estimator.position_m).all())


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(st.lists(messages(), min_size=1, max_size=12), st.booleans())
def test_any_message_is_survived(batch: list[Any], flying: bool) -> None:
    c = Companion(quiet())
    c.setpoints.on = flying
    c.run(2.2 if flying else 0.4)
    if flying:
        c.set_mode(NavState.OFFBOARD)
        c.arm()
    for message in batch:
        c.send(message)
        c.run(0.02)
    c.run(0.6)
    assert sound(c)
    assert c.got["HEARTBEAT"]


def test_a_position_that_does_not_fit_the_wire_is_dropped_and_counted() -> None:
    c = Companion(quiet())
    c.set_origin()
    c.run(1.0)
    c.px4.vehicle.origin = (47.0, 8.0, 3e6)
    c.run(1.0)
    assert c.px4.counters["unpackable"] > 0
    assert c.got["HEARTBEAT"][-1][0] > c.now_s - 1.1


@settings(max_examples=40, deadline=None)
@given(st.binary(max_size=300))
def test_any_bytes_are_survived(data: bytes) -> None:
    c = Companion(quiet())
    c.run(0.1)
    c.link.send(data)
    c.run(0.05)
    assert sound(c)


def test_a_ground_station_takes_the_mode_away_over_mavlink() -> None:
    c = Companion(quiet())
    ours, theirs = LoopbackLink.pair()
    c.px4.attach(theirs, ground_station=True)
    station = m.MAVLink(None, srcSystem=255, srcComponent=190)
    c.hover()
    main, sub = NavState.POSITION.value
    order = m.MAVLink_command_long_message(1, 1, m.MAV_CMD_DO_SET_MODE, 0, CUSTOM, main, sub, 0, 0, 0, 0)
    ours.send(order.pack(station))
    c.setpoints.place = lambda _t: (5.0, 0.0, -1.5)
    c.run(3.0)
    assert c.heartbeat_mode() == (3, 0)
    assert abs(float(c.true_ned()[0])) < 0.3


def test_a_ground_stations_link_is_quiet_until_somebody_answers() -> None:
    c = Companion(quiet())
    ours, theirs = LoopbackLink.pair()
    c.px4.attach(theirs, ground_station=True)
    station = m.MAVLink(None, srcSystem=255, srcComponent=190)

    def kinds() -> set[str]:
        found = set()
        while (data := ours.receive()) is not None:
            found |= {p.get_type() for p in station.parse_buffer(data) or []}
        return found

    c.run(2.0)
    assert kinds() <= {"HEARTBEAT", "STATUSTEXT"}
    ours.send(m.MAVLink_heartbeat_message(m.MAV_TYPE_GCS, 8, 0, 0, 4, 3).pack(station))
    c.run(2.0)
    assert {"LOCAL_POSITION_NED", "ATTITUDE", "SYS_STATUS"} <= kinds()
