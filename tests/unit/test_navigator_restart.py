"""A navigator that comes up in flight never asks for a place that it did not take from the aircraft itself."""

from __future__ import annotations

import numpy as np
import pytest

from services.navigator.values import Inputs, Seen
from tests.unit.navigator_world import World

AWAY = np.array([3.0, -1.0, 1.4])


def flying() -> World:
    return World(position_m=AWAY.copy(), armed=True, mode="offboard", engaged_id=1)


def test_a_first_pose_too_old_to_trust_gives_no_setpoint() -> None:
    # as after a restart on a busy machine: the pose waited in the queue while the clock moved on
    world = flying()
    world._sense()
    assert world._pose is not None
    old = Seen(world._pose.message, world.now_ns - 2_000_000_000)
    outputs = world.mission.step(Inputs(world.now_ns, old, None, None, world._vehicle, dict(world._seen_ns), None))
    assert outputs.guidance.setpoint is None, "the origin of the map is where it would have flown to"


def test_the_next_fresh_pose_is_where_it_holds() -> None:
    world = flying()
    world._sense()
    assert world._pose is not None
    old = Seen(world._pose.message, world.now_ns - 2_000_000_000)
    world.mission.step(Inputs(world.now_ns, old, None, None, world._vehicle, dict(world._seen_ns), None))
    outputs = world.step()
    assert world.state == "hold"
    assert outputs.guidance.setpoint is not None
    assert outputs.guidance.setpoint.position_m == pytest.approx(tuple(AWAY), abs=0.01)


def test_the_start_of_an_adopted_mission_is_the_maps_origin_and_not_where_it_hung() -> None:
    """Also when the vehicle's word came before the first pose, and the operator said hold and resume."""
    world = flying()
    world._sense()
    world.mission.step(Inputs(world.now_ns, None, None, None, world._vehicle, dict(world._seen_ns), None))
    world.run(seconds=1.0)
    board = world.mission.board
    assert board.trajectory.fence is not None, "no flight without a geofence"
    assert world.mission.order("hold", None, world.now_ns).accepted
    world.run(seconds=1.0)
    assert world.mission.order("resume", None, world.now_ns).accepted
    assert board.home_m == pytest.approx(np.zeros(3))
    assert board.trajectory.fence.centre_m == pytest.approx(np.zeros(3))
    assert board.flight_z_m == pytest.approx(1.4)


def test_an_adopted_mission_does_not_fly_back_to_a_start_that_it_has_not_seen() -> None:
    world = flying()
    world.run(seconds=1.0)
    assert world.state == "hold"
    assert not world.mission.board.home_known


def test_the_mission_after_an_adopted_one_starts_where_it_stands() -> None:
    world = flying()
    assert world.run("landed", 60.0) == "landed"
    world.start()
    assert world.run("scan", 60.0) == "scan"
    board = world.mission.board
    assert board.home_known
    assert board.home_m is not None
    assert board.home_m[:2] == pytest.approx(AWAY[:2], abs=0.2)
