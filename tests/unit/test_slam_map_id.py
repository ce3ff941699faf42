"""A new map never passes for the old one."""

from __future__ import annotations

import numpy as np

from schemas.camera import Intrinsics, RgbdFrame
from schemas.slam import Pose
from schemas.topics import CAMERA_RGBD, SLAM_POSE
from services.common.config import TreedockConfig
from services.common.memory import Hub
from services.slam.service import build

INTRINSICS = Intrinsics(width=640, height=480, fx=500.0, fy=500.0, cx=319.5, cy=239.5)


def textured_wall(stamp_ns: int) -> RgbdFrame:
    blocks = np.random.default_rng(3).integers(0, 255, (60, 80), dtype=np.uint8)
    grey = np.kron(blocks, np.ones((8, 8), dtype=np.uint8))
    colour = np.repeat(grey[:, :, None], 3, axis=2)
    depth = np.full((480, 640), 2000, dtype=np.uint16)
    return RgbdFrame(stamp_ns, stamp_ns // 10**8, INTRINSICS, colour.tobytes(), depth.tobytes())


def poses_of_a_slam_started_at(stamp_ns: int) -> list[Pose]:
    hub = Hub(TreedockConfig())
    poses: list[Pose] = []
    hub.context("listener").on(SLAM_POSE, poses.append)
    build(hub.context("slam"))
    for step in range(3):
        hub.advance_to(stamp_ns + step * 10**8)
        hub.context("camera").publish(CAMERA_RGBD, textured_wall(stamp_ns + step * 10**8))
        hub.run()
    return poses


def test_a_restarted_slam_names_its_map_anew() -> None:
    first, second = poses_of_a_slam_started_at(10**9), poses_of_a_slam_started_at(5 * 10**9)
    assert len({pose.map_id for pose in first}) == len({pose.map_id for pose in second}) == 1
    assert first[0].map_id != second[0].map_id
    assert [pose.status for pose in first][-1] == "tracking"
