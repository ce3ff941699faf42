"""One test per row of docs/safety.md that the navigator answers for: detector, time limit, response, word."""

from __future__ import annotations

import numpy as np
import pytest

from services.navigator.config import NavigatorConfig
from services.navigator.mission import Mission
from tests.unit.navigator_world import STEP_S, World, flying, tree


def _in(world: World, state: str) -> None:
    assert world.state == state, f"{world.state}: {world.mission.reason}"


def _setpoint(world: World) -> tuple[np.ndarray, np.ndarray, float]:
    assert world.outputs is not None
    s = world.outputs.guidance.setpoint
    assert s is not None
    return np.array(s.position_m), np.array(s.velocity_m_s), s.yaw_rate_rad_s


def _seconds_until(world: World, state: str, limit_s: float) -> float:
    begin = world.now_ns
    world.run(state, limit_s)
    assert world.state == state, f"{world.state}: {world.mission.reason}"
    return (world.now_ns - begin) / 1e9


@pytest.mark.parametrize("state", ["take_off", "scan", "face", "approach", "dock", "docked", "landing"])
def test_operator_takes_over_at_any_moment(state: str) -> None:
    world = flying(state)
    world.override, world.mode = True, "position"
    world.step()
    assert world.state == "released"
    assert world.outputs is not None
    assert not world.outputs.guidance.engage
    assert not world.outputs.guidance.land
    world.mode = "offboard"
    world.override = False
    world.run(seconds=20.0)
    assert world.state == "released", "it resumed by itself"


def test_disarmed_by_another_releases() -> None:
    world = flying("approach")
    world.armed = False
    world.step()
    world.run(seconds=0.2)
    assert world.state == "released"
    assert "disarmed, not by us" in world.mission.reason
    assert world.outputs is not None
    assert not world.outputs.guidance.engage
    armings = world.armings
    world.run(seconds=20.0)
    assert world.state == "released"
    assert world.armings == armings
    assert world.armings == 1


def test_mode_left_offboard_releases_even_before_the_bridge_says_so() -> None:
    world = flying("scan")
    world.mode = "position"
    world.step()
    assert world.state == "released"


def test_slam_lost_stops_at_once_then_goes_on() -> None:
    world = flying("approach")
    world.slam = "lost"
    world.step()
    assert world.state == "hold"
    place, velocity, yaw_rate = _setpoint(world)
    assert not velocity.any()
    assert yaw_rate == 0.0
    world.run(seconds=0.6)
    assert np.array_equal(_setpoint(world)[0], place)
    world.slam = "tracking"
    assert world.run("docked") == "docked"


def test_slam_lost_for_long_lands() -> None:
    world = flying("approach")
    world.slam = "lost"
    took = _seconds_until(world, "landing", 20.0)
    assert took == pytest.approx(world.config.failsafe.pose_land_s, abs=0.1)
    assert "slam" in world.mission.reason


def test_slam_flickering_is_not_slam_lost_for_long() -> None:
    """The limit counts from the last pose, not from when the hold began: what PX4 goes by."""
    world = flying("approach")
    for _ in range(3):
        world.slam = "lost"
        world.run(seconds=0.6)
        world.slam = "tracking"
        world.run(seconds=0.2)
    _in(world, "hold")
    assert world.run("docked") == "docked"


def test_handheld_waits_for_slam() -> None:
    world = World(NavigatorConfig(handheld=True))
    world.start()
    world.run("scan")
    world.slam = "lost"
    world.run(seconds=10.0)
    _in(world, "hold")


@pytest.mark.parametrize("dead", ["slam", "camera"])
def test_no_pose_holds_within_half_a_second(dead: str) -> None:
    world = flying("approach")
    world.slam = None
    world.dead.add(dead)
    assert _seconds_until(world, "hold", 2.0) <= 0.5
    assert _seconds_until(world, "landing", 20.0) <= world.config.failsafe.pose_land_s + 0.4
    assert f"{dead} is dead" in world.mission.reason or dead in world.mission.reason
    assert world.outputs is not None
    assert world.outputs.guidance.land


def test_pose_jump_untold_holds() -> None:
    world = flying("approach")
    world.correct(np.array([0.8, 0.0, 0.0]), 0.0, told=False)
    world.step()
    assert world.state == "hold"
    assert "jump" in world.mission.reason
    believed = world.believed(world.position_m)
    assert np.linalg.norm(_setpoint(world)[0] - believed) < 0.25


def test_small_correction_shifts_the_setpoint_in_the_same_step() -> None:
    world = flying("approach")
    before = _setpoint(world)[0]
    world.correct(np.array([0.2, -0.1, 0.0]), 0.0)
    world.step()
    assert world.state == "approach"
    moved = _setpoint(world)[0] - before
    assert np.linalg.norm(moved - [0.2, -0.1, 0.0]) < 0.05
    assert world.run("docked") == "docked"


def test_large_correction_holds_then_goes_on() -> None:
    world = flying("approach")
    world.correct(np.array([1.5, 0.0, 0.0]), 0.0)
    world.step()
    assert world.state == "hold"
    assert world.run("docked", 120.0) == "docked"


def test_new_map_holds_and_drops_the_target() -> None:
    world = flying("approach")
    assert world.mission.board.target_id is not None
    world.map_id = "m2"
    world.step()
    _in(world, "hold")
    board = world.mission.board
    assert board.target_id is None
    assert "new map" in world.mission.reason
    assert world.run("scan", 10.0) == "scan", "what was scanned is gone"
    assert world.run("docked") == "docked"


def test_target_lost_holds_then_goes_on_when_it_returns() -> None:
    world = flying("approach")
    while (world.mission.board.to_axis() or (9.0, 0.0))[0] > 2.0:
        world.step()
    world.target_visible = False
    assert _seconds_until(world, "hold", 2.0) <= 0.55
    world.target_visible = True
    assert world.run("docked") == "docked"


def test_target_lost_for_long_lands() -> None:
    world = flying("dock")
    world.target_visible = False
    assert _seconds_until(world, "landing", 20.0) <= world.config.failsafe.target_hold_s + 1.0


def test_refiner_killed_holds_within_half_a_second_and_goes_on_after_restart() -> None:
    world = flying("dock")
    world.refiner_alive = False
    world.dead.add("refiner")
    assert _seconds_until(world, "hold", 2.0) <= 0.55
    world.run(seconds=3.0)
    world.refiner_alive = True
    world.dead.clear()
    assert world.run("docked") == "docked"


@pytest.mark.parametrize("service", ["mapper", "detector"])
def test_dead_map_holds_while_it_is_needed(service: str) -> None:
    world = flying("scan")
    world.dead.add(service)
    assert _seconds_until(world, "hold", 10.0) <= world.config.failsafe.service_silent_s + 0.1
    assert service in world.mission.reason
    assert _seconds_until(world, "landing", 60.0) <= world.config.failsafe.service_hold_s + 1.0


def test_dead_map_does_not_stop_the_approach() -> None:
    world = flying("approach")
    world.dead.update({"mapper", "detector"})
    assert world.run("docked") == "docked"


def test_stale_list_of_trees_holds() -> None:
    quick = NavigatorConfig()
    quick = quick.model_copy(update={"failsafe": quick.failsafe.model_copy(update={"trees_stale_s": 5.0})})
    world = World(quick)
    world.start()
    world.run("hold", 60.0)
    assert world.state == "hold"
    assert "list of trees is old" in world.mission.reason
    assert _seconds_until(world, "landing", 60.0) <= quick.failsafe.trees_hold_s + 0.2


def test_autopilot_link_lost_holds_then_lands() -> None:
    world = flying("approach")
    world.vehicle_silent = True
    assert _seconds_until(world, "hold", 2.0) <= 0.6
    assert _seconds_until(world, "landing", 20.0) <= world.config.failsafe.vehicle_hold_s + 0.2


def test_bridge_restarted_is_noticed() -> None:
    world = flying("approach")
    world.engaged_id = 0
    world.step()
    assert world.state == "landing"
    assert "bridge was restarted" in world.mission.reason


def test_ground_link_lost_holds_then_lands_and_only_if_there_was_one() -> None:
    world = flying("scan", station=True)
    world.station = False
    assert _seconds_until(world, "hold", 20.0) <= world.config.failsafe.ground_silent_s + 0.1
    assert _seconds_until(world, "landing", 60.0) <= world.config.failsafe.ground_hold_s + 0.2


def test_battery_low_lands() -> None:
    world = flying("approach")
    world.battery = 0.19
    world.step()
    assert world.state == "landing"
    assert "battery" in world.mission.reason


def test_a_battery_that_was_never_known_takes_off_and_that_is_told() -> None:
    world = World(battery=None)
    world.start()
    assert world.run("scan", 60.0) == "scan"
    assert any("preflight passed; battery" in event.reason for event in world.events)


def test_low_battery_does_not_take_off() -> None:
    world = World(battery=0.3)
    world.start()
    assert world.run("failed", 70.0) == "failed"
    assert "battery" in world.mission.reason
    assert world.armings == 0


def test_outside_the_geofence_lands() -> None:
    world = flying("scan")
    world.position_m = world.position_m + np.array([0.3, 0.0, 0.0])
    config = world.config.motion
    assert world.mission.board.trajectory.fence is not None
    world.position_m = np.array([config.fence_radius_m + config.fence_margin_m + 0.1, 0.0, 1.4])
    world.run("landing", 5.0)
    assert world.state == "landing"


def test_a_trunk_in_the_way_brakes() -> None:
    world = flying("approach")
    world.eyes = False  # only the map knows
    here, velocity = world.position_m[:2], _setpoint(world)[1][:2]
    assert np.linalg.norm(velocity) > 0.05
    ahead = here + velocity / np.linalg.norm(velocity) * 0.75
    world.trees.append(tree(9, float(ahead[0]), float(ahead[1])))
    world.revision += 1
    world.run("hold", 2.0)
    assert world.state == "hold"
    assert "trunk stands in the way" in world.mission.reason


def _restarted(world: World) -> World:
    world.mission = Mission(world.config)
    return world


def test_navigator_restarted_in_flight_holds_then_lands() -> None:
    world = _restarted(flying("approach"))
    world.run("hold", 1.0)
    assert world.state == "hold"
    assert "restarted" in world.mission.reason
    assert world.outputs is not None
    assert world.outputs.guidance.mission_id == 1
    assert _seconds_until(world, "landing", 20.0) <= world.config.failsafe.restart_hold_s + 0.2
    assert world.run("landed", 20.0) == "landed"
    assert world.armings == 1


def test_navigator_restarted_in_flight_goes_on_when_told() -> None:
    world = _restarted(flying("approach"))
    world.run("hold", 1.0)
    world.run(seconds=1.0)
    assert world.mission.order("resume", None, world.now_ns).accepted
    assert world.run("docked") == "docked"


def test_navigator_restarted_on_the_ground_waits_for_a_command() -> None:
    world = World()
    world.run(seconds=5.0)
    assert world.state == "idle"
    assert world.armings == 0


@pytest.mark.parametrize("order", ["abort", "land", "hold"])
@pytest.mark.parametrize("state", ["scan", "face", "approach", "dock", "docked"])
def test_orders_act_at_once(order: str, state: str) -> None:
    world = flying(state)
    assert world.mission.order(order, None, world.now_ns).accepted  # type: ignore[arg-type]
    world.step()
    assert world.state == ("hold" if order == "hold" else "landing")
    end = world.run(("landed",), 300.0)
    assert end == "landed"
    assert world.armings == 1


def test_operator_hold_waits_for_resume() -> None:
    world = flying("approach")
    world.mission.order("hold", None, world.now_ns)
    world.run(seconds=30.0)
    assert world.state == "hold"
    place = world.position_m.copy()
    world.run(seconds=5.0)
    assert np.linalg.norm(world.position_m - place) < 0.01
    assert world.mission.order("resume", None, world.now_ns).accepted
    assert world.run("docked") == "docked"


def test_start_is_refused_in_the_air_and_without_a_vehicle() -> None:
    world = flying("scan")
    assert not world.mission.order("start", None, world.now_ns).accepted
    world.override = True
    world.step()
    refused = world.mission.order("start", None, world.now_ns)
    assert not refused.accepted
    assert "armed" in refused.reason


def test_choose_and_next() -> None:
    world = flying("approach")
    first = world.mission.board.target_id
    other = next(t.id for t in world.trees if t.id != first)
    assert not world.mission.order("choose", 77, world.now_ns).accepted
    assert world.mission.order("choose", other, world.now_ns).accepted
    assert world.run("docked") == "docked"
    assert world.mission.board.visited_ids == [other]
    assert world.mission.order("next", None, world.now_ns).accepted
    world.run(seconds=STEP_S)
    assert world.run("docked", 120.0) == "docked"
    assert world.mission.board.visited_ids == [other, first]


def test_a_dead_refiner_stops_it_also_while_the_camera_looks_where_it_flies() -> None:
    """On the way around a trunk the target is out of sight on purpose; that must not hide that nobody looks for it."""
    world = World(trees=[tree(1, 4.5, 0.0), tree(5, 2.4, 0.0, 0.25, suitable=False)])
    world.start()
    assert world.run("approach") == "approach"
    for _ in range(400):
        world.step()
        if world.mission.board.looking and world.state == "approach":
            break
    assert world.mission.board.looking, "this scene is to have a detour"
    world.refiner_alive = False
    begun_ns = world.now_ns
    assert world.run("hold", 3.0) == "hold"
    assert (world.now_ns - begun_ns) * 1e-9 < 0.65
