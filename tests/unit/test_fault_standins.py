"""The stand-ins for slam, detector and refiner: they live by the camera's frames and say what the truth makes of them."""

from __future__ import annotations

import numpy as np
import pytest

from schemas.camera import Intrinsics, RgbdFrame
from schemas.navigation import MissionState
from schemas.simulation import SimTruth, TrueTree
from schemas.slam import Pose
from schemas.topics import (
    CAMERA_RGBD,
    MISSION_STATE,
    SECOND_POSE,
    SECOND_RGBD,
    SIM_TRUTH,
    SLAM_POSE,
    TREES_LIST,
    TREES_TARGET,
    Topic,
)
from schemas.trees import Target, TreeList
from services.common.config import TreedockConfig
from services.common.geometry import from_transform, level_camera, to_transform
from services.common.memory import Hub
from services.evaluate.faults.standins import BUILDS

INTRINSICS = Intrinsics(width=8, height=6, fx=6.0, fy=6.0, cx=3.5, cy=2.5)
TREE = TrueTree(x_m=2.0, y_m=0.0, z_m=0.0, axis=(0.0, 0.0, 1.0), radius_m=0.1, suitable=True, fair=True)


class World:
    def __init__(self) -> None:
        self.hub = Hub(TreedockConfig())
        for name, build in BUILDS.items():
            build(self.hub.context(name))
        self.says = self.hub.context("simulator")
        listener = self.hub.context("listener")
        self.poses: list[Pose] = []
        self.seconds: list[Pose] = []
        self.targets: list[Target] = []
        self.lists: list[TreeList] = []
        listener.on(SLAM_POSE, self.poses.append)
        listener.on(SECOND_POSE, self.seconds.append)
        listener.on(TREES_TARGET, self.targets.append)
        listener.on(TREES_LIST, self.lists.append)

    def truth(self, seq: int, yaw_rad: float = 0.0) -> None:
        pose = to_transform(level_camera([0.1 * seq, 0.0, 1.5], yaw_rad))
        self.says.publish(SIM_TRUTH, SimTruth(
            stamp_ns=stamp(seq), seq=seq, scene="x", T_map_camera=pose,
            trees=(TREE,), touched=0, clearance_m=1.0,
        ))  # fmt: skip

    def frame(self, seq: int, camera: Topic = CAMERA_RGBD) -> None:
        self.says.publish(camera, RgbdFrame(
            stamp_ns=stamp(seq), seq=seq, intrinsics=INTRINSICS, colour=bytes(8 * 6 * 3), depth=bytes(8 * 6 * 2),
        ))  # fmt: skip


def stamp(seq: int) -> int:
    return 1_000_000_000 + seq * 66_666_667


@pytest.mark.parametrize("frame_first", [True, False])
def test_a_pose_for_each_frame_whose_truth_is_there(frame_first: bool) -> None:
    world = World()
    for seq in range(3):
        for say in (world.frame, world.truth) if frame_first else (world.truth, world.frame):
            say(seq)
            world.hub.run()
    assert [p.seq for p in world.poses] == [0, 1, 2]
    for seq, pose in enumerate(world.poses):
        assert pose.stamp_ns == stamp(seq)
        assert pose.T_map_camera is not None
        assert np.allclose(pose.T_map_camera.position_m, (0.1 * seq, 0.0, 1.5), atol=0.1)


def test_without_frames_nothing_is_said() -> None:
    world = World()
    for seq in range(5):
        world.truth(seq)
        world.hub.run()
    assert not [*world.poses, *world.targets, *world.lists]


def test_the_tree_is_listed_and_the_target_is_the_missions() -> None:
    world = World()
    world.truth(0)
    world.frame(0)
    world.hub.run()
    assert [t.id for t in world.lists[0].trees] == [0]
    assert world.targets[-1].status == "none"
    world.says.publish(MISSION_STATE, MissionState(
        stamp_ns=1, seq=1, map_id="m", state="approach", previous="face", since_ns=1, reason="", target_tree_id=0,
        visited_tree_ids=(), docked_count=0, distance_m=None, heading_error_rad=None,
    ))  # fmt: skip
    ranges = []
    for seq in range(1, 10):
        world.truth(seq)
        world.frame(seq)
        world.hub.run()
        ranges.append(world.targets[-1].range_m)
    seen = [r for r in ranges if r is not None]
    assert len(seen) >= 7
    assert abs(np.median([r - (2.0 - 0.1 * seq) for seq, r in enumerate(ranges, 1) if r is not None])) < 0.15


@pytest.mark.parametrize("turn_rad", [-0.2, 0.2])
def test_every_list_holds_the_tree_whichever_way_the_aircraft_turns(turn_rad: float) -> None:
    world = World()
    for seq in range(0, 90, 15):
        world.truth(seq, turn_rad * seq / 15)
        world.frame(seq)
        world.hub.run()
    assert len(world.lists) >= 4
    assert all([t.id for t in trees.trees] == [0] for trees in world.lists)


def test_the_second_slam_says_where_a_camera_is_that_looks_down_from_the_same_aircraft() -> None:
    world = World()
    world.truth(0)
    world.frame(0, SECOND_RGBD)
    world.hub.run()
    assert not world.poses
    (second,) = world.seconds
    assert second.stamp_ns == stamp(0)
    assert second.T_map_camera is not None
    T = from_transform(second.T_map_camera)
    assert np.allclose(T[:3, 2], (0.0, 0.0, -1.0), atol=0.05), "it looks at the ground"
    assert np.allclose(T[:3, 3], (0.0, 0.0, 1.5), atol=0.2)
