"""The work loop without a bus: timers by either clock, guarded handlers, topics that fall silent."""

from __future__ import annotations

import time
from typing import cast

import pytest
import zenoh

from schemas.command import NonceRequest
from schemas.topics import CAMERA_RGBD, SLAM_POSE, TREES_LIST
from services.common.clock import SimulatedClock
from services.common.config import TreedockConfig
from services.common.errors import InputError
from services.common.live_context import LiveContext
from services.common.overdue import Overdue


def live(clock: SimulatedClock | None = None) -> LiveContext:
    """A context whose bus is never used."""
    return LiveContext("slam", TreedockConfig(), cast("zenoh.Session", None), clock)


def turn(context: LiveContext) -> None:
    """A few turns that never wait."""
    for _ in range(3):
        context.inbox.wake()
        context.turn()


def test_timers_follow_simulated_time_and_skip_what_was_missed() -> None:
    clock = SimulatedClock()
    context = live(clock)
    fired: list[tuple[str, int]] = []
    context.every(1.0, lambda: fired.append(("slow", clock.now_ns())))
    context.every(0.4, lambda: fired.append(("fast", clock.now_ns())))
    for _ in range(3):
        turn(context)
    assert fired == []
    for stamp_ns in (400_000_000, 1_000_000_000, 9_000_000_000):
        clock.set_ns(stamp_ns)
        turn(context)
    assert fired == [
        ("fast", 400_000_000), ("fast", 1_000_000_000), ("slow", 1_000_000_000), ("fast", 9_000_000_000),
        ("slow", 9_000_000_000),
    ]  # fmt: skip


def test_wall_timers_go_on_while_simulated_time_stands_still() -> None:
    context = live(SimulatedClock())
    fired: list[int] = []
    context.every_wall(0.02, lambda: fired.append(1))
    end_s = time.monotonic() + 5.0
    while len(fired) < 3 and time.monotonic() < end_s:
        context.turn()
    assert len(fired) == 3


@pytest.mark.parametrize("off_s", [-3600.0, 60.0])
def test_timers_do_not_mind_that_the_wall_clock_is_corrected(off_s: float) -> None:
    """Before they are set (a service starts on a machine whose clock is off) and after."""
    context = live()
    context.wall.correct(round(off_s * 1e9), at_once=True)
    fired: list[str] = []
    context.every(0.02, lambda: fired.append("clock"))
    context.every_wall(0.02, lambda: fired.append("wall"))
    context.wall.correct(round(-off_s * 1e9), at_once=True)
    end_s = time.monotonic() + 5.0
    while not {"clock", "wall"} <= set(fired) and time.monotonic() < end_s:
        context.turn()
    assert {"clock", "wall"} <= set(fired)
    assert len(fired) < 20, "nor is anything made up for"


def test_refused_data_is_counted_and_a_bug_is_not_hidden() -> None:
    context = live()

    command = NonceRequest(sender="test")

    def refuse(_: object) -> None:
        raise InputError("no good")

    def fail(_: object) -> None:
        raise ZeroDivisionError

    context.guarded("slam/pose", refuse)(command)
    assert context.health.counters["refused.slam/pose"] == 1
    with pytest.raises(ZeroDivisionError):
        context.guarded("slam/pose", fail)(command)


def test_a_topic_that_falls_silent_is_a_fault_one_never_heard_is_only_told() -> None:
    clock = SimulatedClock()
    context = live(clock)
    context.topics_in = [CAMERA_RGBD, SLAM_POSE, TREES_LIST]
    overdue = Overdue(context)
    assert overdue.update() == "waiting for camera/rgbd, slam/pose"
    context.bus.last_received_s[CAMERA_RGBD.name] = 5.0
    assert overdue.update() == "waiting for slam/pose"
    clock.set_ns(900_000_000)
    overdue.update()
    assert context.health.notes == {}
    clock.set_ns(3_000_000_000)
    overdue.update()
    assert "is the camera service alive?" in context.health.notes["silence.camera/rgbd"]
    context.bus.last_received_s[CAMERA_RGBD.name] = 6.0
    overdue.update()
    assert context.health.notes == {}
