"""Flights without rendering: mission, bridge and simulated PX4 in one loop, and what happens when a part fails."""

from __future__ import annotations

import numpy as np
import pytest

from services.evaluate.bench_avoid import meeting
from services.evaluate.eyes import Round
from services.evaluate.flight import Flight, FlightCase, obstacle_case, random_case, weather
from services.evaluate.synthetic import TrueTrunk
from services.navigator.autopilot.bridge import Bridge
from services.navigator.config import NavigatorConfig
from services.navigator.mission import Mission
from services.simulator.px4.modes import NavState

SEED = 5


def _flying(state: str, seed: int = SEED) -> Flight:
    flight = Flight(random_case(seed))
    flight.start()
    assert flight.run((state,)) == state, flight.mission.reason  # type: ignore[arg-type]
    return flight


def _ticks(flight: Flight, seconds: float) -> None:
    for _ in range(round(seconds * 100)):
        flight.tick()


def _speed(flight: Flight) -> float:
    before = flight.px4.true_pose()[:3, 3].copy()
    _ticks(flight, 0.5)
    return float(np.linalg.norm(flight.px4.true_pose()[:3, 3] - before)) / 0.5


@pytest.mark.parametrize("seed", [5, 6])
def test_docks_and_lands(seed: int) -> None:
    flight = _flying("docked", seed)
    distance, bearing = flight.dock_errors[0]
    assert 0.85 <= distance <= 1.0
    assert abs(bearing) <= np.radians(3.0)
    assert flight.run(("landed",), 60.0) == "landed"
    assert flight.touches == 0
    assert not flight.px4.armed


def test_the_pilot_takes_over_in_the_approach() -> None:
    flight = _flying("approach")
    _ticks(flight, 2.0)
    flight.px4.pilot_takes(NavState.POSITION)
    taken_ns = flight.now_ns
    _ticks(flight, 10.0)
    assert flight.state == "released"
    last_ns = flight.setpoints[-1][0]
    assert (last_ns - taken_ns) / 1e9 < 0.25
    assert flight.px4.mode is NavState.POSITION
    assert flight.order("start"), "a start in the air must be refused"


@pytest.mark.parametrize("timeout_us", [1_000_000, 5_000_000])
def test_slam_lost_for_long_lands_by_our_order(timeout_us: int) -> None:
    """EKF2_NOAID_TOUT is 1 s (5 s is PX4's default): our landing comes before PX4 gives offboard up by itself."""
    flight = _flying("approach")
    flight.px4.vehicle.params.set("EKF2_NOAID_TOUT", timeout_us)
    flight.chain.slam_lost = True
    assert flight.run(("hold",), 1.0) == "hold"
    held_s = flight.elapsed_s
    assert flight.run(("landing",), 10.0) == "landing", flight.mission.reason
    assert flight.elapsed_s - held_s < 1.0
    assert flight.run(("landed",), 60.0) == "landed"
    assert not flight.px4.armed
    assert flight.px4.on_ground
    assert flight.touches == 0


def test_camera_silent_lands_by_our_order() -> None:
    flight = _flying("approach")
    flight.chain.blind = True
    assert flight.run(("landing",), 3.0) == "landing", flight.mission.reason
    assert flight.run(("landed",), 60.0) == "landed"


def test_px4_that_gives_up_first_is_not_fought() -> None:
    """Where our limit is set too long, PX4 lands by its own failsafe and we stay silent."""
    slow = NavigatorConfig(
        failsafe=NavigatorConfig().failsafe.model_copy(update={"pose_land_s": 30.0, "pose_hold_s": 30.0})
    )
    flight = Flight(random_case(SEED, navigator=slow))
    flight.start()
    assert flight.run(("approach",)) == "approach"
    flight.chain.slam_lost = True
    _ticks(flight, 0.5)
    held_s = flight.elapsed_s
    assert flight.run((), 60.0) == "released"
    assert flight.elapsed_s - held_s < 1.5
    assert "failsafe" in flight.mission.reason
    _ticks(flight, 20.0)
    assert not flight.px4.armed
    assert flight.px4.on_ground


def test_navigator_killed_the_bridge_holds_and_a_new_one_lands() -> None:
    flight = _flying("approach")
    _ticks(flight, 3.0)
    flight.navigator_alive = False
    _ticks(flight, 2.0)
    assert _speed(flight) < 0.25  # wind
    flight.mission = Mission(flight.case.navigator)
    flight.navigator_alive = True
    _ticks(flight, 0.3)
    assert flight.state == "hold"
    assert flight.run((), 60.0) == "landed"
    assert not flight.px4.armed


def test_navigator_killed_for_good_the_bridge_lands() -> None:
    flight = _flying("approach")
    flight.navigator_alive = False
    _ticks(flight, 40.0)
    assert not flight.px4.armed
    assert flight.touches == 0


def test_bridge_killed_px4_lands_and_a_new_bridge_stays_silent() -> None:
    flight = _flying("approach")
    flight.bridge_alive = False
    _ticks(flight, 1.0)
    flight.bridge = Bridge(flight.case.autopilot)
    before = len(flight.setpoints)
    flight.bridge_alive = True
    _ticks(flight, 40.0)
    assert len(flight.setpoints) == before
    assert not flight.px4.armed
    assert flight.state in ("released", "landed")
    _ticks(flight, 10.0)
    assert not flight.px4.armed


def test_around_a_trunk_on_the_way() -> None:
    flight = Flight(obstacle_case(3))
    flight.start()
    assert flight.run(("docked",)) == "docked", flight.mission.reason
    assert flight.touches == 0
    assert flight.clearance_m > flight.case.navigator.aircraft_radius_m + 0.1


@pytest.mark.parametrize("seed", [0, 5])
def test_round_a_post_as_thin_as_a_sapling(seed: int) -> None:
    """It fills one cell of the grid and was forgotten once the camera had turned: touched on the way back, or never passed."""
    rng = np.random.default_rng(seed)
    share, aside = rng.uniform(0.35, 0.6), rng.uniform(-0.25, 0.25)
    post = Round(-2.0 * share + 0.94 * aside, 5.5 * share + 0.34 * aside, 0.042)
    trunk = TrueTrunk(-2.0, 5.5, 0.1)
    home = NavigatorConfig(return_home=True)
    flight = Flight(FlightCase(seed, (trunk,), things=(post,), wind=weather(rng), navigator=home))
    flight.start()
    assert flight.run() == "landed", flight.mission.reason
    assert len(flight.dock_errors) == 1
    assert flight.clearance_m > 0.35


def test_three_trees_then_home() -> None:
    flight = Flight(random_case(2, navigator=NavigatorConfig(trees_wanted=3)))
    flight.start()
    assert flight.run() == "landed", flight.mission.reason
    assert len(flight.dock_errors) == 3
    assert np.linalg.norm(flight.px4.true_pose()[:2, 3]) < 0.3


@pytest.mark.parametrize("seed", [4, 5])
def test_it_comes_down_where_it_took_off(seed: int) -> None:
    """Each mission of a day began 0.4 m from the one before, always on the side of the tree."""
    flight = Flight(random_case(seed, navigator=NavigatorConfig(return_home=True)))
    begin = flight.px4.true_pose()[:2, 3].copy()
    flight.start()
    assert flight.run() == "landed", flight.mission.reason
    assert np.linalg.norm(flight.px4.true_pose()[:2, 3] - begin) < 0.25


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_somebody_who_crosses_stops_or_comes_along_is_not_touched(seed: int) -> None:
    flight = Flight(meeting(seed))
    flight.start()
    assert flight.run(limit_s=240.0) == "landed", flight.mission.reason
    assert len(flight.dock_errors) == 1
    assert flight.touches == 0
    assert flight.near_person_m > 0.35
