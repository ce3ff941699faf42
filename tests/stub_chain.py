"""Services that stand in for the chain's where only ``process`` itself is tested."""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
from numpy.typing import NDArray

from schemas.camera import RgbdFrame
from schemas.slam import Pose
from schemas.topics import CAMERA_RGBD, SLAM_POSE
from schemas.trees import Tree
from services.common.context import Context
from services.common.geometry import level_camera, to_transform
from services.evaluate.exports import Stamped
from services.evaluate.offline import Builder


@dataclass
class StubSlam:
    """Knows each frame's pose, but the third's."""

    context: Context

    def __post_init__(self) -> None:
        self.slam = self
        self.poses: list[Stamped] = []
        self.ticks = 0
        self.context.on(CAMERA_RGBD, self.on_frame)
        self.context.every(0.1, self.tick)

    def tick(self) -> None:
        self.ticks += 1

    def on_frame(self, image: RgbdFrame) -> None:
        assert self.context.clock.now_ns() == image.stamp_ns
        with self.context.health.timed("track"):
            T = level_camera((0.1 * image.seq, 0.0, 0.0), 0.0)
        tracked = image.seq != 2
        if tracked:
            self.poses.append((image.stamp_ns, T))
        pose = Pose(
            stamp_ns=image.stamp_ns, seq=image.seq, map_id="m", status="tracking" if tracked else "lost",
            T_map_camera=to_transform(T) if tracked else None, covariance=None, reset_counter=0, graph_version=0,
            keyframe_id=None, T_keyframe_camera=None, inliers=0, up_sigma_rad=0.0, processing_ms=0.0,
        )  # fmt: skip
        self.context.publish(SLAM_POSE, pose)

    def final_trajectory(self) -> list[Stamped]:
        return self.poses


@dataclass
class StubCloud:
    points_m: NDArray[np.float32]
    rgb: NDArray[np.uint8]


class StubMapper:
    def __init__(self, context: Context) -> None:
        del context
        self.map = SimpleNamespace(submaps={})

    def cloud(self) -> StubCloud:
        return StubCloud(np.zeros((2, 3), np.float32), np.zeros((2, 3), np.uint8))


class StubDetector:
    def __init__(self, context: Context) -> None:
        del context

    def final_trees(self) -> list[Tree]:
        return []


BUILDERS: dict[str, Builder] = {"slam": StubSlam, "mapper": StubMapper, "detector": StubDetector}
