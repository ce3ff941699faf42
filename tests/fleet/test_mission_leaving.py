"""Backing off without a claim ends on the ground before the lease does, whatever comes in between."""

from __future__ import annotations

import pytest

from services.navigator.config import DockConfig
from tests.fleet.claims_world import ClaimsWorld, ordered


def backing_off() -> ClaimsWorld:
    """Return a world that was cut off in dock and has begun to leave its trunk."""
    world = ClaimsWorld(ordered(trees_wanted=2, dock=DockConfig(hold_s=60.0)))
    world.start()
    world.run("dock")
    world.linked = False
    assert world.run("undock", 60.0) == "undock"
    world.run(seconds=1.0)
    return world


def test_hold_while_backing_off_comes_down_before_the_lease_ends() -> None:
    world = backing_off()
    assert world.mission.order("hold", None, world.now_ns).accepted
    assert world.run("landing", 60.0) == "landing"
    assert "claim" in world.mission.reason
    assert world.run("landed", 60.0) == "landed"
    assert world.held != "", "still alone there when it came down"


@pytest.mark.parametrize("linked", [False, True])
def test_resume_while_backing_off_comes_down_at_once(linked: bool) -> None:
    world = backing_off()
    assert world.mission.order("hold", None, world.now_ns).accepted
    world.linked = linked
    world.run(seconds=1.5)
    assert world.mission.order("resume", None, world.now_ns).accepted
    assert world.state == "landing"


def test_a_new_map_while_backing_off_leads_to_no_other_tree() -> None:
    world = backing_off()
    before = len(world.events)
    world.map_id, world.reset_counter = "m2", 0
    assert world.run("landed", 60.0) == "landed"
    assert world.held != "", "still alone there when it came down"
    assert {e.after for e in world.events[before:]} <= {"hold", "landing", "landed"}
