from __future__ import annotations

from collections.abc import Callable
from typing import cast

import numpy as np
import pytest

from schemas.camera import RgbdFrame
from schemas.slam import Pose
from schemas.topics import CAMERA_RGBD, SLAM_POSE, TREES_LIST, TREES_TARGET
from schemas.trees import Target, Tree, TreeList
from services.camera.codecs import encode_depth
from services.common.config import TreedockConfig
from services.common.context import Context
from services.common.geometry import Matrix, to_transform
from services.common.memory import Hub, MemoryContext
from services.detector.refine.service import build
from tests.unit.refine_scene import CAMERA, Cone, camera_at, render, sensed

PERIOD_NS = 66_666_667
CONE = Cone(2.0, 0.1, 0.1)
DEPTH = sensed(render([CONE], camera_at()), 4)


class Rig:
    def __init__(self) -> None:
        self.hub = Hub(TreedockConfig())
        self.context: MemoryContext = self.hub.context("refiner")
        self.sender = self.hub.context("test")
        self.targets: list[Target] = []
        build(cast("Context", self.context))
        self.sender.on(TREES_TARGET, self.targets.append)

    def trees(self, map_id: str = "m1", cones: tuple[Cone, ...] = (CONE,)) -> None:
        trees = tuple(
            Tree(
                id=k, x_m=c.x, y_m=c.y, z_m=0.0, axis=c.axis, radius_m=c.radius, radius_height_m=1.3, height_seen_m=2.0,
                sigma_xy_m=0.03, sigma_radius_m=0.01, arc_rad=2.0, confidence=0.9, observations=5, suitable=True,
            )
            for k, c in enumerate(cones)
        )  # fmt: skip
        self.sender.publish(TREES_LIST, TreeList(stamp_ns=0, map_id=map_id, version=1, graph_version=1, trees=trees))
        self.hub.run()

    def frame(self, k: int, depth: np.ndarray = DEPTH, depth_bytes: bytes | None = None) -> None:
        raw = np.round(depth * 1000.0).astype(np.uint16).tobytes() if depth_bytes is None else depth_bytes
        message = RgbdFrame(k * PERIOD_NS, k, CAMERA, b"", raw, colour_encoding="none")
        self.hub.advance_to(k * PERIOD_NS)
        self.sender.publish(CAMERA_RGBD, message)
        self.hub.run()

    def pose(self, k: int, T: Matrix | None = None, map_id: str = "m1", *, lost: bool = False, resets: int = 0) -> None:
        message = Pose(
            stamp_ns=k * PERIOD_NS, seq=k, map_id=map_id, status="lost" if lost else "tracking",
            T_map_camera=None if lost else to_transform(camera_at() if T is None else T),
            covariance=None if lost else tuple(float(v) for v in (np.eye(6) * 1e-4)[np.triu_indices(6)]),
            reset_counter=resets, graph_version=1, keyframe_id=0, T_keyframe_camera=None, inliers=100, up_sigma_rad=0.01,
            processing_ms=10.0,
        )  # fmt: skip
        self.sender.publish(SLAM_POSE, message)
        self.hub.run()


@pytest.fixture
def rig() -> Rig:
    return Rig()


def test_a_frame_waits_for_its_pose_and_is_answered_once(rig: Rig) -> None:
    rig.trees()
    rig.frame(1)
    assert rig.targets == []
    rig.pose(1)
    rig.pose(1)
    assert [t.stamp_ns for t in rig.targets] == [PERIOD_NS]
    target = rig.targets[0]
    assert target.status == "tracking"
    assert target.measured
    assert target.tree_id == 0
    assert target.range_m == pytest.approx(np.hypot(2.0, 0.1), abs=0.02)
    assert target.position_map_m == pytest.approx((2.0, 0.1), abs=0.02)


def test_pose_before_frame(rig: Rig) -> None:
    rig.trees()
    rig.pose(1)
    rig.frame(1)
    assert [t.measured for t in rig.targets] == [True]


def test_frame_without_pose_is_answered_when_a_later_pose_comes(rig: Rig) -> None:
    rig.trees()
    for k in (1, 2):
        rig.frame(k)
    rig.pose(2)
    assert [t.seq for t in rig.targets] == [1, 2]
    assert rig.targets[0].status == "none"
    assert "no pose" in rig.targets[0].note
    assert rig.targets[1].measured


def test_silent_slam(rig: Rig) -> None:
    rig.trees()
    for k in range(1, 12):
        rig.frame(k)
    rig.hub.advance_to(30 * PERIOD_NS)
    assert [t.seq for t in rig.targets] == list(range(1, 12))


def test_without_trees_and_with_trees_of_another_map(rig: Rig) -> None:
    rig.frame(1)
    rig.pose(1)
    rig.trees(map_id="old")
    rig.frame(2)
    rig.pose(2)
    assert [t.status for t in rig.targets] == ["none", "none"]
    assert rig.targets[1].map_id == "m1"


def test_new_map_drops_the_target(rig: Rig) -> None:
    rig.trees()
    rig.frame(1)
    rig.pose(1)
    rig.frame(2)
    rig.pose(2, map_id="m2")
    assert [t.status for t in rig.targets] == ["tracking", "none"]


@pytest.mark.parametrize(
    "spoil",
    [
        lambda: np.zeros(480 * 640, np.uint16).tobytes(),
        lambda: np.full(480 * 640, 65535, np.uint16).tobytes(),
        lambda: b"\x00" * 100,
    ],
)
def test_bad_depth_is_counted_told_and_answered(rig: Rig, spoil: Callable[[], bytes]) -> None:
    rig.trees()
    rig.frame(1)
    rig.pose(1)
    rig.frame(2, depth_bytes=spoil())
    rig.pose(2)
    assert [t.measured for t in rig.targets] == [True, False]
    assert rig.targets[1].status == "tracking"
    assert rig.targets[1].note
    assert rig.context.health.counters["dropped_bad_depth"] == 1
    assert "camera/rgbd" in rig.context.health.notes
    rig.frame(3)
    rig.pose(3)
    assert rig.targets[2].measured
    assert "camera/rgbd" not in rig.context.health.notes


def test_slam_lost_keeps_the_target_for_a_moment_without_a_place_in_map(rig: Rig) -> None:
    rig.trees()
    rig.frame(1)
    rig.pose(1)
    rig.frame(2)
    rig.pose(2, lost=True)
    assert rig.targets[1].status == "tracking"
    assert rig.targets[1].position_map_m is None
    rig.frame(30)
    rig.pose(30, lost=True)
    assert rig.targets[2].status == "none"


def test_lost_and_found(rig: Rig) -> None:
    rig.trees()
    rig.frame(1)
    rig.pose(1)
    empty = sensed(render([], camera_at()), 1)
    for k in range(2, 14):
        rig.frame(k, empty)
        rig.pose(k)
    statuses = [t.status for t in rig.targets]
    assert statuses[1] == "tracking"
    assert not rig.targets[1].measured
    assert statuses[-1] == "lost"
    rig.frame(14)
    rig.pose(14)
    assert rig.targets[-1].measured


def test_pose_jump_does_not_throw_the_filters_off(rig: Rig) -> None:
    rig.trees()
    for k in range(1, 5):
        rig.frame(k)
        rig.pose(k)
    jumped = camera_at(x=0.08, y=0.05)
    for k in range(5, 8):
        rig.frame(k)
        rig.pose(k, jumped, resets=1)
    assert [t.measured for t in rig.targets] == [True] * 7
    # the camera did not move: what is relative to it stays, the place in map jumps with the pose
    assert rig.targets[-1].range_m == pytest.approx(rig.targets[0].range_m, abs=0.01)
    assert rig.targets[-1].position_map_m == pytest.approx((2.08, 0.15), abs=0.02)


def test_compressed_depth(rig: Rig) -> None:
    rig.trees()
    raw = np.round(DEPTH * 1000.0).astype(np.uint16)
    frame = RgbdFrame(PERIOD_NS, 1, CAMERA, b"", encode_depth(raw, "png"), colour_encoding="none", depth_encoding="png")
    rig.sender.publish(CAMERA_RGBD, frame)
    rig.pose(1)
    assert rig.targets[0].measured


def test_two_runs_are_the_same() -> None:
    runs = []
    for _ in range(2):
        rig = Rig()
        rig.trees()
        for k in range(1, 5):
            rig.frame(k)
            rig.pose(k)
        runs.append([t.model_dump_json() for t in rig.targets])
    assert runs[0] == runs[1]
