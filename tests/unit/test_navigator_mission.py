"""The mission's course: from the ground to the trunk and back, and what each order does."""

from __future__ import annotations

import numpy as np
import pytest

from services.navigator.config import NavigatorConfig
from tests.unit.navigator_world import STEP_S, World, tree


def _course(world: World) -> list[str]:
    return [event.after for event in world.events]


def test_one_tree_from_the_ground_to_the_dock_and_down() -> None:
    world = World()
    world.start()
    assert world.run("docked") == "docked", world.mission.reason
    offset = np.array([-3.0, 2.0]) - world.position_m[:2]
    assert 0.85 <= np.linalg.norm(offset) <= 1.0
    assert world.run("landed", 60.0) == "landed"
    assert _course(world) == [
        "preflight", "take_off", "scan", "select", "face", "approach", "dock", "docked", "landing", "landed",
    ]  # fmt: skip
    assert all(event.reason for event in world.events)
    assert world.armings == 1


def test_three_trees_then_home() -> None:
    trees = [tree(1, 4.0, 1.0), tree(2, -3.0, 2.0), tree(3, 0.5, -4.0), tree(4, 2.0, 3.5, 0.4, suitable=False)]
    world = World(NavigatorConfig(trees_wanted=3), trees)
    world.start()
    assert world.run("landed", 400.0) == "landed", world.mission.reason
    assert sorted(world.mission.board.visited_ids) == [1, 2, 3]
    assert _course(world).count("docked") == 3
    assert "return" in _course(world)
    assert np.linalg.norm(world.position_m[:2]) < 0.5


def test_the_target_keeps_its_trunk_when_the_list_numbers_anew() -> None:
    world = World()
    world.start()
    world.run("approach")
    before = world.mission.board.target_id
    assert before is not None
    world.trees = [t.model_copy(update={"id": t.id + 10}) for t in world.trees]
    world.revision += 1
    assert world.run("docked") == "docked", world.mission.reason
    assert world.mission.board.visited_ids == [before + 10]
    assert "hold" not in _course(world)


def swapped(world: World) -> None:
    """The list gives the two trees each other's id."""
    world.trees = [t.model_copy(update={"id": 3 - t.id}) for t in world.trees]
    world.revision += 1


@pytest.mark.parametrize("state", ["face", "dock"])
def test_ids_that_change_trees_take_the_target_nowhere(state: str) -> None:
    """A detector that forgot its ids may call another tree by the target's: the place counts, seen already or not."""
    world = World()
    world.start()
    world.run(state)
    b = world.mission.board
    before, axis = b.target_id, np.array(b.axis_m)
    swapped(world)
    assert world.run("docked") == "docked", world.mission.reason
    assert b.visited_ids == [3 - (before or 0)]
    assert np.linalg.norm(b.axis_m - axis) < 0.1
    assert "hold" not in _course(world)


@pytest.mark.parametrize("state", ["face", "dock"])
def test_a_target_that_stands_elsewhere_all_at_once_is_not_followed_there(state: str) -> None:
    """The id names a tree 1.5 m away and nothing is listed where the target was: chosen anew, and the reason is told."""
    world = World(trees=[tree(1, -3.0, 2.0), tree(2, 4.0, 1.0, suitable=False)])
    world.start()
    world.run(state)
    jumped_ns = world.now_ns
    world.trees = [t.model_copy(update={"y_m": t.y_m - 1.5}) if t.id == 1 else t for t in world.trees]
    world.revision += 1
    assert world.run("select", 20.0) == "select"
    why = next(e for e in world.events if e.stamp_ns > jumped_ns)
    assert why.reason == "the list has tree 1 1.5 m from where it was"
    assert why.after == ("undock" if state == "dock" else "select")
    assert world.mission.board.target_id is None
    assert world.run("docked", 120.0) == "docked", world.mission.reason
    assert 0.85 <= np.linalg.norm(np.array([-3.0, 0.5]) - world.position_m[:2]) <= 1.0


def test_a_tree_that_bears_the_targets_id_is_in_the_way_like_any_other() -> None:
    world = World()
    world.start()
    world.run("face")
    board = world.mission.board
    assert len(board.discs(0.0)) == len(world.trees) - 1, "the target is no obstacle"
    board.following.astray = "the list has it elsewhere"
    assert len(board.discs(0.0)) == len(world.trees)


def test_a_trunk_in_front_is_flown_around_and_hides_nothing_forever() -> None:
    world = World(trees=[tree(1, 4.5, 0.0), tree(2, 2.2, 0.05, 0.3, suitable=False)])
    world.start()
    clearance = []
    while world.state not in ("docked", "landed", "failed", "released"):
        world.step()
        clearance.append(float(np.linalg.norm(world.position_m[:2] - [2.2, 0.05])) - 0.3)
    assert world.state == "docked", world.mission.reason
    assert min(clearance) > world.config.aircraft_radius_m + 0.2
    assert "hold" not in _course(world)


def test_a_tree_whose_docking_place_is_outside_the_fence_is_left() -> None:
    config = NavigatorConfig()
    config = config.model_copy(update={"motion": config.motion.model_copy(update={"fence_radius_m": 4.0})})
    world = World(config, trees=[tree(1, 5.5, 0.0)])
    world.start()
    assert world.run("landed") == "landed"
    assert any(e.reason == "no clear way to tree 1" for e in world.events)


def test_a_tree_that_cannot_be_reached_is_given_up() -> None:
    ring = [
        tree(10 + i, 4.0 + 1.1 * np.cos(a), 1.1 * np.sin(a), 0.25, suitable=False)
        for i, a in enumerate(np.linspace(0, 5.6, 9))
    ]
    world = World(trees=[tree(1, 4.0, 0.0), *ring, tree(2, -3.5, 0.0)])
    world.mission.board.trees_wanted = 1
    world.start()
    world.run("docked", 300.0)
    assert world.state == "docked", world.mission.reason
    assert world.mission.board.visited_ids == [2]


def test_no_tree_at_all_comes_down_and_says_so() -> None:
    world = World(trees=[tree(4, 3.0, 0.0, 0.35, suitable=False)])
    world.start()
    assert world.run("landed", 120.0) == "landed"
    assert any("no suitable tree" in e.reason for e in world.events)
    assert world.mission.board.docked_count == 0


def test_the_same_inputs_give_the_same_bytes() -> None:
    def flown() -> list[str]:
        world = World()
        world.start()
        out = []
        for _ in range(600):
            assert world.step()
            assert world.outputs is not None
            out.append(world.outputs.guidance.model_dump_json() + world.outputs.state.model_dump_json())
        return out

    assert flown() == flown()


def test_handheld_guides_a_person_without_a_vehicle() -> None:
    world = World(NavigatorConfig(handheld=True))
    world.vehicle_silent = True
    world.position_m = np.array([0.0, 0.0, 1.4])
    world.start()
    commands = set()
    for _ in range(round(120.0 / 0.05)):
        out = world.step()
        g = out.guidance
        commands.add(g.command)
        assert not g.engage
        if g.command in ("turn_left", "turn_right"):
            world.yaw_rad += (1 if g.command == "turn_left" else -1) * min(0.5 * 0.05, g.magnitude)
        elif g.command in ("toward", "backward"):
            forward = np.array([np.cos(world.yaw_rad), np.sin(world.yaw_rad), 0.0])
            world.position_m = world.position_m + (1 if g.command == "toward" else -1) * forward * min(
                0.02, g.magnitude
            )
        if world.state == "docked":
            break
    assert world.state == "docked", world.mission.reason
    assert {"turn_left", "toward", "docked"} <= commands


def test_slam_that_falters_in_the_scan_is_turned_back_for() -> None:
    """Few points at one heading: back to where slam was sure, then on again slowly, and in the end all was seen."""
    world = World()
    world.start()
    assert world.run("scan") == "scan"
    world.run(seconds=4.0)
    farthest, backward, slow, t = 0.0, 0.0, False, world.mission.board.trajectory
    for _ in range(round(60.0 / STEP_S)):
        turned = world.mission.board.scan_turned_rad
        world.inliers = 30 if 1.9 < turned < 2.2 and world.mission.board.relocks < 2 else 200
        world.step()
        farthest = max(farthest, world.mission.board.scan_turned_rad)
        backward = max(backward, farthest - world.mission.board.scan_turned_rad)
        slow = slow or (backward > 0.0 and 0.1 < t.yaw_rate_rad_s < 0.5 * world.config.scan_rate_rad_s)
        if world.state != "scan":
            break
    assert backward > np.radians(0.5)
    assert slow
    assert world.mission.board.scan_gaps == 0
    assert world.run("docked") == "docked"


def test_slam_that_stays_unsure_does_not_stop_the_scan() -> None:
    world = World()
    world.start()
    world.run("scan")
    world.run(seconds=2.0)
    world.inliers = 30
    assert world.run("select", 60.0) == "select"


def test_a_second_turn_when_headings_were_missed() -> None:
    world = World()
    world.start()
    world.run("scan")
    world.run(seconds=3.0)
    seen = world.mission.board.scan_seen
    for _ in range(round(30.0 / STEP_S)):
        world.step()
        seen.discard(10)
        if abs(world.mission.board.scan_turned_rad) > 2.0 * np.pi + np.radians(30.0):
            break
    assert world.state == "scan", "one heading is still unseen"
    assert world.run("select", 60.0) == "select"
    assert "unseen" not in world.mission.reason


def test_a_low_battery_sends_it_home_before_the_next_tree() -> None:
    world = World(NavigatorConfig(trees_wanted=2))
    world.start()
    assert world.run("docked") == "docked"
    world.battery = 0.25
    world.run("return", 60.0)
    assert world.state == "return", world.mission.reason
    assert world.run("landed", 120.0) == "landed"
    assert np.hypot(*world.position_m[:2]) < 0.5
    assert world.mission.board.docked_count == 1
