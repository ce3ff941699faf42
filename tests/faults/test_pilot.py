"""The pilot takes the mode away, at any moment: our setpoints stop at once, and nothing ever takes off again."""

from __future__ import annotations

import numpy as np
import pytest

from services.evaluate.flight import Flight, random_case
from services.simulator.px4.flight import Sticks
from services.simulator.px4.modes import NavState

_MOMENTS = (
    ("take_off", 1.5), ("scan", 4.0), ("select", 0.5), ("face", 0.5), ("approach", 2.0), ("dock", 1.0),
    ("docked", 1.0), ("landing", 1.0),
)  # fmt: skip


def _flying(state: str, for_s: float) -> Flight:
    flight = Flight(random_case(5))
    flight.start()
    assert flight.run((state,)) == state, flight.mission.reason  # type: ignore[arg-type]
    _pass(flight, for_s)
    assert flight.state == state
    return flight


def _pass(flight: Flight, seconds: float) -> None:
    for _ in range(round(seconds * 100)):
        flight.tick()


@pytest.mark.parametrize(("state", "for_s"), _MOMENTS)
def test_setpoints_stop_at_once_and_the_stream_never_takes_off_again(state: str, for_s: float) -> None:
    flight = _flying(state, for_s)
    assert flight.px4.pilot_takes(NavState.POSITION)
    taken_ns = flight.now_ns
    _pass(flight, 1.0)
    late = [ns for ns, _ in flight.setpoints if ns > taken_ns + 250_000_000]  # the mode is told at 10 Hz
    assert late == []
    assert flight.state == "released"
    assert flight.px4.mode is NavState.POSITION
    flight.px4.pilot_sticks(Sticks(down_m_s=0.7))
    _pass(flight, 12.0)
    flight.px4.pilot_sticks(Sticks())
    assert flight.px4.on_ground
    height_m = flight.px4.true_pose()[2, 3]
    # the pilot hands the aircraft back in offboard, standing: PX4 would follow a stream if one came
    flight.px4.pilot_takes(NavState.OFFBOARD)
    for order in ("resume", "next"):
        assert flight.order(order)
    _pass(flight, 10.0)
    assert [ns for ns, _ in flight.setpoints if ns > taken_ns + 250_000_000] == []
    assert abs(flight.px4.true_pose()[2, 3] - height_m) < 0.05
    assert np.linalg.norm(flight.px4.vehicle.body.state[3:6]) < 0.05


def test_only_a_new_start_for_a_standing_disarmed_aircraft_begins_anew() -> None:
    flight = _flying("approach", 1.0)
    flight.px4.pilot_takes(NavState.POSITION)
    _pass(flight, 1.0)
    assert flight.order("start"), "armed and in the air"
    flight.px4.pilot_takes(NavState.LAND)
    _pass(flight, 10.0)
    assert not flight.px4.armed
    assert flight.order("start") == ""
    _pass(flight, 2.0)
    assert flight.mission.mission_id == 2


@pytest.mark.parametrize("restarted", ["bridge", "navigator"])
def test_a_restarted_part_does_not_take_the_aircraft_back_from_the_pilot(restarted: str) -> None:
    from services.navigator.autopilot.bridge import Bridge
    from services.navigator.mission import Mission

    flight = _flying("approach", 1.0)
    flight.px4.pilot_takes(NavState.POSITION)
    taken_ns = flight.now_ns
    _pass(flight, 0.5)
    if restarted == "bridge":
        flight.bridge = Bridge(flight.case.autopilot)
    else:
        flight.mission = Mission(flight.case.navigator)
    _pass(flight, 15.0)
    assert flight.px4.mode is NavState.POSITION
    assert [ns for ns, _ in flight.setpoints if ns > taken_ns + 250_000_000] == []
