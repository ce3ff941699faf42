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
