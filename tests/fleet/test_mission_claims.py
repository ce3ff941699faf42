"""The mission with claims: no tree without one, the next nearest when it is refused, home or down when it is lost."""

from __future__ import annotations

import pytest

from services.fleet.config import ClaimConfig
from services.navigator.config import DockConfig, NavigatorConfig
from tests.fleet.claims_world import ClaimsWorld, ordered
from tests.unit.navigator_world import World, tree


def reasons(world: World, after: str) -> list[str]:
    return [e.reason for e in world.events if e.after == after]


def test_a_mission_claims_its_place_its_trees_and_its_way_home() -> None:
    world = ClaimsWorld(ordered(trees_wanted=2))
    world.start()
    assert world.run("scan") == "scan"
    assert world.held == "place"
    assert world.run("approach") == "approach"
    assert world.held == "tree"
    assert "claimed" in reasons(world, "face")[0]
    assert world.run("return", 300.0) == "return"
    world.run(seconds=2.0)
    assert world.held == "way"
    assert world.run("landed") == "landed"
    world.run(seconds=3.0)
    assert world.held == "", "all is given back"
    assert [d.tree_id for d in world.book.done] == [1, 2] or [d.tree_id for d in world.book.done] == [2, 1]


def test_without_an_arbiter_nothing_takes_off_and_preflight_says_why() -> None:
    world = ClaimsWorld(linked=False)
    world.start()
    assert world.run("failed", 80.0) == "failed"
    assert world.armings == 0
    assert "the place to start from is not claimed: the arbiter does not answer" in world.mission.reason


def test_a_tree_that_another_holds_is_left_for_the_next_nearest() -> None:
    world = ClaimsWorld(trees=[tree(1, 3.0, 1.0), tree(2, -4.0, 2.0)])
    world.start()
    world.run("scan")
    world.other_claims(3.05, 1.0)
    assert world.run("face") == "face"
    assert world.mission.board.target_id == 2
    assert any("uav2 holds this tree" in e.reason for e in world.events)


def test_a_tree_that_another_visited_is_not_visited_again_but_by_order() -> None:
    world = ClaimsWorld(trees=[tree(1, 3.0, 1.0)])
    world.start()
    world.run("scan")
    world.other_claims(3.05, 1.0, done=True)
    assert world.run(("face", "landing"), 60.0) == "landing"
    assert "uav2 has docked at this tree" in world.mission.reason
    again = ClaimsWorld(trees=[tree(1, 3.0, 1.0)])
    again.start()
    again.run("scan")
    again.other_claims(3.05, 1.0, done=True)
    assert again.mission.order("choose", 1, again.now_ns).accepted
    assert again.run("face", 60.0) == "face"


def test_what_was_refused_to_one_mission_is_asked_again_in_the_next() -> None:
    world = ClaimsWorld(trees=[tree(1, 3.0, 1.0)])
    world.start()
    world.run("scan")
    world.other_claims(3.05, 1.0, done=True)
    assert world.run("landed", 100.0) == "landed"
    assert "uav2 has docked" in world.holder.note
    world.book.done.clear()  # the operator began a new round
    world.run(seconds=2.0)
    world.start()
    assert world.run("approach", 100.0) == "approach"


def test_it_waits_for_a_tree_that_another_holds_and_says_so() -> None:
    world = ClaimsWorld(trees=[tree(1, 3.0, 1.0)])
    world.start()
    world.run("scan")
    world.other_claims(3.05, 1.0)
    world.run("select")
    world.run(seconds=10.0)
    assert world.state == "select"
    assert world.mission.reason == "waiting: tree 1: uav2 holds this tree"
    assert world.run("face", 60.0) == "face", "uav2 never renewed"


def test_it_gives_way_to_its_start_and_asks_on_from_there() -> None:
    """The other may be waiting for the place that this one hovers at."""
    claims = ClaimConfig(enabled=True, give_way_s=10.0)
    config = NavigatorConfig(claims=claims, live_guard=False, trees_wanted=2)
    world = ClaimsWorld(config, trees=[tree(1, 4.0, 0.0), tree(2, 4.0, 4.0)])
    world.start()
    world.run("dock")
    world.other_claims(4.0, 4.05)
    assert world.run("return", 60.0) == "return"
    assert "giving way: tree 2: uav2 holds this tree" in reasons(world, "return")
    world.other_claims(4.0, 4.05)
    assert world.run("select", 60.0) == "select"
    assert world.mission.board.from_home_m < 0.3
    world.run(seconds=12.0)
    assert world.state == "select", "at its start it blocks nobody: there it waits"
    assert world.run("docked", 120.0) == "docked", "uav2 never renewed"
    assert world.mission.board.docked_count == 2
    assert world.run("landed", 120.0) == "landed"


def test_it_does_not_wait_for_a_tree_that_is_no_longer_listed() -> None:
    world = ClaimsWorld(trees=[tree(1, 3.0, 1.0)])
    world.start()
    world.run("scan")
    world.other_claims(3.05, 1.0)
    world.run("select")
    world.run(seconds=5.0)
    assert world.mission.reason == "waiting: tree 1: uav2 holds this tree"
    world.trees.clear()
    world.revision += 1
    world.run("landing", 10.0)
    assert world.state == "landing"
    assert "no suitable tree left among 0 listed" in world.mission.reason


def test_it_does_not_wait_for_ever() -> None:
    world = ClaimsWorld(trees=[tree(1, 3.0, 1.0)])
    world.start()
    world.run("scan")
    for _ in range(8):
        world.other_claims(3.05, 1.0)
        world.run(("landing", "return"), 15.0)
    assert world.state in ("landing", "landed")
    assert any("no suitable tree left" in e.reason for e in world.events)


@pytest.mark.parametrize("state", ["face", "approach", "dock", "docked"])
def test_a_claim_that_is_not_renewed_ends_on_the_ground_before_another_may_have_it(state: str) -> None:
    world = ClaimsWorld(ordered(trees_wanted=2, dock=DockConfig(hold_s=60.0)))
    world.start()
    assert world.run(state) == state
    world.linked = False
    world.run("hold", 60.0)
    assert world.mission.fault is not None
    assert world.mission.fault.name == "claim lost"
    assert world.run("landed", 60.0) == "landed"
    assert world.held != "", "still alone there when it came down"
    if state in ("dock", "docked"):
        assert any(e.after == "undock" and "away from the trunk, then landing" in e.reason for e in world.events)


def test_a_link_that_comes_back_in_time_goes_on() -> None:
    world = ClaimsWorld()
    world.start()
    world.run("approach")
    world.linked = False
    world.run("hold", 60.0)
    world.linked = True
    assert world.run("docked", 100.0) == "docked"


def test_a_lost_ground_link_and_a_lost_claim_end_the_same() -> None:
    """The station that is out of reach is the arbiter: its own failsafe must not stop the backing off."""
    world = ClaimsWorld(ordered(dock=DockConfig(hold_s=60.0)), station=True)
    world.start()
    world.run("dock")
    world.linked = world.station = False
    assert world.run("landed", 60.0) == "landed"
    assert world.held != ""
    assert any(e.after == "undock" for e in world.events)


def test_nothing_is_asked_where_claims_are_off() -> None:
    world = World()
    world.start()
    world.run("docked", 200.0)
    assert world.outputs is not None
    assert world.outputs.wish.goal is None
    assert world.outputs.wish.release is False
    assert world.state == "docked"
