"""A pose that fusion carries on is for braking by: the mission holds all the same, and lands when it must."""

from __future__ import annotations

import copy

import numpy as np
import pytest

from schemas.slam import Pose, SlamStatus
from services.common.geometry import level_camera, to_transform
from services.navigator.track import PoseTrack, Step
from tests.unit.navigator_world import STEP_S, World


@pytest.fixture(scope="module")
def quick() -> World:
    """A mission in its approach, at speed; tests take copies of it."""
    world = World()
    world.start()
    assert world.run("approach") == "approach"
    for _ in range(200):
        setpoint = world.step().guidance.setpoint
        if setpoint is not None and np.linalg.norm(setpoint.velocity_m_s) > 0.3:
            break
    return world


def setpoints(quick: World, status: SlamStatus, steps: int = 14) -> tuple[World, list[np.ndarray]]:
    """Take the camera away; returns the setpoints after that."""
    world = copy.deepcopy(quick)
    world.slam = status
    found = []
    for _ in range(steps):
        setpoint = world.step().guidance.setpoint
        assert setpoint is not None
        found.append(np.array(setpoint.position_m))
    return world, found


def test_a_carried_pose_lets_the_aircraft_brake_and_never_approach(quick: World) -> None:
    stopped, hard = setpoints(quick, "lost")
    braked, soft = setpoints(quick, "dead_reckoned")
    assert stopped.state == braked.state == "hold"
    assert np.allclose(hard[0], hard[-1]), "blind it stops at once"
    way = float(np.linalg.norm(soft[-1] - soft[0]))
    assert 0.05 < way < 0.5, "with a carried pose it brakes within its limits"
    speeds = np.linalg.norm(np.diff(soft, axis=0), axis=1) / STEP_S
    assert np.all(np.diff(speeds) < 0.01), "it only slows down"
    assert speeds[-1] < 0.5 * speeds[0]
    assert braked.outputs is not None
    assert braked.outputs.guidance.command == "stop"


def test_a_carried_pose_does_not_put_off_the_landing(quick: World) -> None:
    world, _ = setpoints(quick, "dead_reckoned", steps=1)
    assert world.run("landing", seconds=8.0) == "landing"


def test_a_carried_pose_is_none_to_the_track() -> None:
    """The bridge must not give PX4 its own IMU back as vision, nor the mission count it as a place slam knows."""
    track, T = PoseTrack(), to_transform(level_camera((0.0, 0.0, 1.0), 0.0))
    values = {
        "map_id": "m", "T_map_camera": T, "covariance": None, "reset_counter": 0, "graph_version": 0, "keyframe_id": None,
        "T_keyframe_camera": None, "inliers": 0, "up_sigma_rad": 0.0, "processing_ms": 0.0,
    }  # fmt: skip
    assert track.add(Pose.model_validate({"stamp_ns": 1, "seq": 1, "status": "tracking", **values}), 1) is Step.FIRST
    assert (
        track.add(Pose.model_validate({"stamp_ns": 2, "seq": 2, "status": "dead_reckoned", **values}), 2) is Step.LOST
    )
    assert track.lost


def test_a_dead_fusion_is_a_dead_slam(quick: World) -> None:
    """Its health was heard and is old, and no pose comes."""
    world = copy.deepcopy(quick)
    world._seen_ns["fusion"] = world.now_ns - 4_000_000_000
    world.slam = None
    assert world.run("hold", seconds=1.0) == "hold"
    assert "fusion is dead or hung" in world.mission.reason
    assert world.run("landing", seconds=5.0) == "landing"
