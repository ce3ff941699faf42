"""What a hold does with faults and orders that come meanwhile, orders on the ground, and an aircraft that gets no images."""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np
import pytest

from services.navigator.config import NavigatorConfig
from services.navigator.guard import View
from services.navigator.values import Seen
from tests.unit.navigator_world import STEP_S, World, flying, tree


def ahead(world: World, distance_m: float) -> np.ndarray:
    return world.position_m[:2] + distance_m * np.array([np.cos(world.yaw_rad), np.sin(world.yaw_rad)])


def order(world: World, name: str, tree_id: int | None = None) -> None:
    verdict = world.mission.order(name, tree_id, world.now_ns)  # type: ignore[arg-type]
    assert verdict.accepted, verdict.reason


# -- the live guard's eyes


@pytest.mark.parametrize("state", ["approach", "dock"])
def test_without_depth_images_nothing_is_flown_at(state: str) -> None:
    world = flying(state)
    world.images = False
    world.walkers = [ahead(world, 1.4)] if state == "approach" else []
    begun_ns = world.now_ns
    assert world.run("hold", 2.0) == "hold"
    assert (world.now_ns - begun_ns) * 1e-9 < 0.6
    assert "no depth images" in world.mission.reason
    assert world.run("landed", 30.0) == "landed"
    assert world.least_m > 0.45


def test_depth_images_that_come_again_let_it_go_on() -> None:
    world = flying("approach")
    world.images = False
    assert world.run("hold", 2.0) == "hold"
    world.run(seconds=3.0)
    world.images = True
    assert world.run("docked") == "docked"


# -- how long a fault may last is asked of the fault, not of the hold


def held_by_the_operator() -> World:
    world = flying("approach")
    order(world, "hold")
    world.run(seconds=40.0)
    assert world.state == "hold"
    return world


def test_a_frame_without_a_place_does_not_end_a_long_hold() -> None:
    world = held_by_the_operator()
    world.slam = "lost"
    world.run(seconds=2 * STEP_S)
    world.slam = "tracking"
    world.run(seconds=5.0)
    assert world.state == "hold", world.mission.reason
    order(world, "resume")
    assert world.run("docked") == "docked"


def test_a_target_that_is_hidden_for_a_while_does_not_end_a_long_hold() -> None:
    world = held_by_the_operator()
    world.target_visible = False
    world.run(seconds=5.0)
    assert world.state == "hold", world.mission.reason
    world.run("landing", 10.0)
    assert world.state == "landing", "but not for ever"


def test_a_ground_station_that_falls_silent_in_a_long_hold_has_its_own_time() -> None:
    world = flying("approach", station=True)
    order(world, "hold")
    world.run(seconds=40.0)
    world.station = False
    world.run(seconds=20.0)
    assert world.state == "hold", world.mission.reason
    assert world.run("landing", 20.0) == "landing"


def test_faults_that_take_turns_do_not_hold_for_ever() -> None:
    world = flying("approach")
    begun_ns = world.now_ns
    while world.state in ("approach", "hold") and world.now_ns - begun_ns < 120e9:
        world.target_visible = not world.target_visible
        if world.target_visible:
            world.correct(np.array([1.2, 0.0, 0.0]), 0.0, told=True)
        world.run(("landing",), 0.8)
    assert world.state == "landing", world.mission.reason
    assert (world.now_ns - begun_ns) * 1e-9 < 20.0


# -- a new map before take-off


@pytest.mark.parametrize("lost_steps", [20, 2])
def test_a_map_that_is_new_in_preflight_is_no_new_map_in_flight(lost_steps: int) -> None:
    world = World(NavigatorConfig(return_home=True))
    world.battery = 0.1  # keeps it in preflight
    world.start()
    world.run(seconds=0.5)
    assert world.state == "preflight"
    world.slam = "lost"
    world.run(seconds=lost_steps * STEP_S)
    world.slam, world.map_id, world.shift_m = "tracking", "m2", np.array([5.0, -2.0, 0.3])
    world.run(seconds=1.0)
    world.battery = 0.9
    assert world.run("docked") == "docked"
    world.slam = "lost"
    world.run(seconds=2 * STEP_S)
    world.slam = "tracking"
    assert world.run("landed") == "landed"
    assert "back at the start" in world.mission.reason
    assert float(np.hypot(*world.position_m[:2])) < 0.2


# -- orders


@pytest.mark.parametrize("state", ["face", "approach", "dock", "docked", "undock", "return"])
def test_a_tree_that_is_chosen_in_hold_is_flown_to(state: str) -> None:
    world = World(NavigatorConfig(return_home=True))
    world.start()
    assert world.run(state) == state
    chosen = next(
        t.id for t in world.trees if t.id not in {world.mission.board.target_id, *world.mission.board.visited_ids}
    )
    order(world, "hold")
    world.run(seconds=2.0)
    order(world, "choose", chosen)
    order(world, "resume")
    assert world.run("docked") == "docked", world.mission.reason
    assert world.mission.board.visited_ids[-1] == chosen


@pytest.mark.parametrize("state", ["undock", "return"])
def test_a_tree_that_is_chosen_on_the_way_home_is_flown_to(state: str) -> None:
    world = World(NavigatorConfig(return_home=True))
    world.start()
    assert world.run(state) == state
    (first,) = world.mission.board.visited_ids
    chosen = next(t.id for t in world.trees if t.id != first)
    order(world, "choose", chosen)
    assert world.run("docked") == "docked"
    assert world.mission.board.visited_ids == [first, chosen]


@pytest.mark.parametrize("state", ["preflight", "take_off"])
def test_hold_on_the_ground_ends_the_mission_and_nothing_arms(state: str) -> None:
    world = World(spent_id=99)  # this bridge never engages
    world.battery = 0.1 if state == "preflight" else 0.9
    world.start()
    assert world.run(state, 5.0) == state
    order(world, "hold")
    assert world.state == "landed"
    assert "hold ordered before take-off" in world.mission.reason
    world.battery, world.spent_id = 0.9, 0
    world.run(seconds=30.0)
    assert world.armings == 0


# -- who did it


def test_a_station_that_was_heard_before_this_mission_is_not_asked_for() -> None:
    world = World(station=True)
    world.run(seconds=1.0)
    world.station = False
    world.run(seconds=60.0)
    world.start()
    assert world.run(("scan", "failed", "landing"), 30.0) == "scan", world.mission.reason


def test_the_takeover_of_an_earlier_mission_does_not_end_the_next() -> None:
    """The bridge tells it until it has taken the new mission's first guidance, a step later."""
    world = World(engaged_id=7, override=True)
    world.run(seconds=0.5)
    order(world, "start")
    for _ in range(100):
        if world.state == "take_off":
            break
        world.step()
    world.step()
    world.override = False
    assert world.run(("scan", "released"), 30.0) == "scan", world.mission.reason


@pytest.mark.parametrize(("armed", "mode"), [(True, "land"), (False, "hold")])
def test_the_bridges_own_word_tells_who_ended_it(armed: bool, mode: str) -> None:
    world = flying("approach")
    world.armed, world.mode, world.note = armed, mode, "component 195 sends setpoints too: landing"
    world.step()
    assert world.state == "released"
    assert "component 195 sends setpoints too: landing" in world.mission.reason


# -- what comes late, and who arms


class Delayed(World):
    """Depth images or poses come, each so many steps after it was taken."""

    late_views = late_poses = 0

    def _view(self) -> Seen[View] | None:
        return self._delayed("views", super()._view(), self.late_views)

    def _sense(self) -> None:
        super()._sense()
        self._pose = self._delayed("poses", self._pose, self.late_poses)

    def _delayed(self, name: str, seen: Any, steps: int) -> Any:
        queue = self.__dict__.setdefault(name, deque())
        if seen is None:
            return None
        queue.append(seen.message)
        while len(queue) > steps + 1:
            queue.popleft()
        return Seen(queue[0], self.now_ns)


@pytest.mark.parametrize("late_s", [0.6, 1.0, 2.0])
def test_depth_images_of_what_was_guard_nothing(late_s: float) -> None:
    world = Delayed(trees=[tree(1, 5.0, 0.0)])
    world.start()
    assert world.run("approach") == "approach"
    world.late_views = round(late_s / STEP_S)
    world.run("hold", 2.0)
    assert world.state == "hold"
    assert f"depth images are {late_s:.1f} s old" in world.mission.reason or "depth images are" in world.mission.reason
    world.walkers = [ahead(world, 0.95)]
    world.run(seconds=3.0)
    assert world.least_m > 0.6, "it stands, and nobody is run into"


def test_poses_of_where_it_was_are_not_flown_by() -> None:
    world = Delayed()
    world.start()
    assert world.run("approach") == "approach"
    world.late_poses = round(1.5 / STEP_S)
    assert world.run("hold", 3.0) == "hold"
    assert "late" in world.mission.reason
    assert world.mission.board.here is None
    world.late_poses = 0
    world.run(seconds=2.0)
    assert world.state in ("approach", "face", "select"), world.mission.reason


def test_who_arms_while_preflight_waits_has_the_aircraft() -> None:
    world = World()
    world.run(seconds=1.0)
    world.slam = "lost"
    world.start()
    world.run(seconds=3.0)
    assert world.state == "preflight"
    world.armed, world.mode = True, "position"
    world.run(seconds=1.0)
    assert world.state == "failed"
    assert "armed, not by us" in world.mission.reason
    world.armed, world.slam = False, "tracking"
    world.run(seconds=30.0)
    assert (world.state, world.armed, world.armings) == ("failed", False, 0), "it never takes off by itself afterwards"


# -- the battery


@pytest.mark.parametrize("state", ["scan", "docked"])
def test_a_battery_that_is_not_known_any_more_sends_it_home(state: str) -> None:
    """It was known in this flight: a power module that failed is no full battery."""
    config = NavigatorConfig(return_home=True, trees_wanted=2)
    world = World(config.model_copy(update={"dock": config.dock.model_copy(update={"hold_s": 12.0})}))
    world.start()
    assert world.run(state) == state
    world.battery = None
    assert world.run("return", 90.0) == "return", world.mission.reason
    words = [event.reason for event in world.events]
    assert sum("battery: no word for 10 s" in word for word in words) == 1, "told when it begins"
    assert any("battery: no word for" in event.reason for event in world.events if event.after in ("return", "undock"))
    assert world.run("landed", 120.0) == "landed"
    assert world.mission.board.docked_count == int(state == "docked")


@pytest.mark.parametrize("state", ["scan", "docked"])
def test_a_battery_that_is_not_told_for_a_moment_changes_nothing(state: str) -> None:
    world = World(NavigatorConfig(return_home=True, trees_wanted=2))
    world.start()
    assert world.run(state) == state
    world.battery = None
    world.run(seconds=9.0)
    world.battery = 0.9
    world.run("landed", 300.0)
    assert world.mission.board.docked_count == 2
    assert not any("battery" in event.reason for event in world.events)


def test_too_little_for_another_tree_is_asked_also_after_one_that_was_given_up() -> None:
    world = World(NavigatorConfig(return_home=True), trees=[tree(1, 4.0, 1.0), tree(2, -3.0, 2.0)])
    world.start()
    assert world.run("face") == "face"
    world.battery, world.target_visible = 0.25, False
    assert world.run(("return", "landing", "approach"), 60.0) in ("return", "landing"), world.mission.reason
    assert "battery at 25 %: no further tree" in " ".join(event.reason for event in world.events)
