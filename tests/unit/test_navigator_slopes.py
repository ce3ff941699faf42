"""On a slope: never down into the ground that is known, and no argument with the list about a leaning trunk's place."""

from __future__ import annotations

import numpy as np
import pytest

from schemas.trees import Tree
from services.navigator.approaching import at_height
from services.navigator.board import Board
from services.navigator.config import NavigatorConfig
from tests.unit.navigator_world import World, flying, tree

_ON_THE_GROUND = ("idle", "preflight", "take_off", "landing", "landed")
_ENDS = ("landed", "failed", "released")


def on_slope(slope: float, uphill_m: float, config: NavigatorConfig) -> World:
    """Return a world that rises along x, with its first tree uphill and its second below."""

    def stands(tree_id: int, x_m: float, y_m: float) -> Tree:
        return tree(tree_id, x_m, y_m, z_m=slope * x_m - 0.1)

    world = World(config=config, trees=[stands(1, uphill_m, 1.0), stands(2, -4.0, 2.0)])
    world.start()
    world.mission.board.wanted_id = 1
    return world


def least_height_m(world: World, slope: float) -> float:
    """Fly to the end; return the least height of the camera over the true ground."""
    least = float("inf")
    for _ in range(6000):
        world.step()
        if world.state in _ENDS:
            break
        if world.state not in _ON_THE_GROUND:
            x, _, z = world.position_m
            least = min(least, float(z) - (slope * float(x) - 0.1))
    assert world.state == "landed"
    return least


@pytest.mark.parametrize(
    ("slope", "uphill_m", "config"),
    [
        (0.25, 8.0, NavigatorConfig(trees_wanted=2)),
        (0.20, 7.0, NavigatorConfig(trees_wanted=2)),
        (0.25, 8.0, NavigatorConfig(return_home=True)),
    ],
)
def test_it_comes_down_from_a_slope_only_as_the_ground_does(
    slope: float, uphill_m: float, config: NavigatorConfig
) -> None:
    world = on_slope(slope, uphill_m, config)
    assert least_height_m(world, slope) > config.min_ground_m - 0.05
    assert world.mission.board.docked_count == config.trees_wanted


def test_known_ground_never_lifts_it_over_the_ceiling() -> None:
    world = flying("scan")
    world.trees.append(tree(3, 1.0, 0.0, z_m=9.0))
    world.revision += 1
    world.step()
    board = world.mission.board
    assert board.home_m is not None
    ceiling_m = float(board.home_m[2]) + board.config.motion.fence_height_m
    assert at_height(board, np.zeros(2))[2] == pytest.approx(ceiling_m)


def test_the_ground_of_a_tree_just_left_is_remembered_in_a_list_without_it() -> None:
    world = on_slope(0.25, 8.0, NavigatorConfig(trees_wanted=2))
    assert world.run("docked") == "docked"
    board = world.mission.board
    high_m = float(world.position_m[2])
    board.drop_target()
    world.trees.pop(0)
    world.revision += 1
    world._sense()
    board.inputs = board.inputs.__class__(world.now_ns, world._pose, world._trees)
    assert at_height(board, world.position_m[:2])[2] == pytest.approx(high_m, abs=0.1)


def test_a_leaning_tree_uphill_is_faced_once() -> None:
    lean = np.radians(18.5)
    leaning = tree(1, 6.0, 0.5, z_m=2.0).model_copy(update={"axis": (0.0, float(np.sin(lean)), float(np.cos(lean)))})
    world = World(trees=[leaning])
    world.start()
    world.run("select")
    before = len(world.events)
    world.run(seconds=10.0)
    assert len(world.events) - before <= 2, world.mission.reason


def test_a_tree_astray_twice_in_one_list_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    def misplaced(board: Board, chosen: Tree) -> None:
        choose(board, chosen)
        assert board.axis_m is not None
        board.axis_m = board.axis_m + np.array([0.8, 0.0])

    world = World(trees=[tree(1, 4.0, 1.0)])
    world.start()
    world.run("select")
    choose = Board.choose
    monkeypatch.setattr(Board, "choose", misplaced)
    assert world.run("landing", 40.0) == "landing", world.mission.reason
    assert world.mission.board.given_up_ids == [1]
    assert sum(e.after == "face" for e in world.events) == 2, "once may be an accident"
