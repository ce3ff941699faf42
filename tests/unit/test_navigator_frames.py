"""The live guard's frames, raw from the same machine or compressed from another."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from schemas.camera import Intrinsics, RgbdFrame
from schemas.slam import Pose
from schemas.topics import CAMERA_COMPRESSED, CAMERA_RGBD, SLAM_POSE
from services.camera.codecs import recode
from services.common.config import TreedockConfig
from services.common.geometry import level_camera, to_transform
from services.common.memory import Hub
from services.navigator.config import NavigatorConfig
from services.navigator.service import Navigator

INTRINSICS = Intrinsics(width=160, height=120, fx=125.0, fy=125.0, cx=79.5, cy=59.5)
WALL_MM = 2000


def frame(stamp_ns: int) -> RgbdFrame:
    depth = np.full((120, 160), WALL_MM, dtype=np.uint16)
    return RgbdFrame(
        stamp_ns=stamp_ns, seq=1, intrinsics=INTRINSICS, colour=bytes(120 * 160 * 3), depth=depth.tobytes()
    )


def pose(stamp_ns: int) -> Pose:
    return Pose(
        stamp_ns=stamp_ns, seq=1, map_id="m", status="tracking", T_map_camera=to_transform(level_camera([0.0, 0.0, 1.5], 0.0)),
        covariance=(0.0,) * 21, reset_counter=0, graph_version=0, keyframe_id=None, T_keyframe_camera=None, inliers=300,
        up_sigma_rad=0.01, processing_ms=1.0,
    )  # fmt: skip


@pytest.mark.parametrize("frames", ["raw", "compressed"])
def test_the_guard_sees_through_either_key(frames: str) -> None:
    hub = Hub(TreedockConfig())
    context = hub.context("navigator")
    navigator = Navigator(context, NavigatorConfig(frames=frames))  # type: ignore[arg-type]
    navigator.register(20.0)
    navigator.mission.state = "approach"
    others, stamp_ns = hub.context("slam"), 1_000_000_000
    others.publish(SLAM_POSE, pose(stamp_ns))
    hub.run()
    navigator.step()
    others.publish(CAMERA_RGBD, frame(stamp_ns))
    packed = recode(frame(stamp_ns), "jpeg", "png", 90)
    others.publish(CAMERA_COMPRESSED, dataclasses.replace(packed, depth=packed.depth[:-9]))
    hub.run()
    if frames == "compressed":
        assert navigator._view is None, "the raw key is not its own, and the damaged frame is refused"
        assert context.health.counters["frames_refused"] == 1
        others.publish(CAMERA_COMPRESSED, packed)
        hub.run()
    assert navigator._view is not None
    points = navigator._view.message.points_m
    assert np.allclose(points[:, 0], WALL_MM / 1000.0, atol=0.01)
