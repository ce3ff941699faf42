"""The mission's course: from the ground to the trunk and back, and what each order does."""

from __future__ import annotations

import numpy as np

from services.navigator.config import NavigatorConfig
from tests.unit.navigator_world import World, tree


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
