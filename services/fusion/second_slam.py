"""Slam of the second camera as a process: the same slam, a map of its own that nobody keeps, its motion for fusion alone."""

from __future__ import annotations

from schemas.topics import CAMERA_RGBD, SECOND_POSE, SECOND_RGBD, SLAM_GRAPH, SLAM_KEYFRAME, SLAM_POSE, VEHICLE_STATE
from services.common.context import Context
from services.fusion.renamed import RenamedContext, require_second
from services.slam.service import SlamService
from services.slam.service import build as build_slam


def build(context: Context) -> SlamService:
    """Start slam on the second camera's frames.

    Only the motion from frame to frame is wanted: no loops, nothing on disk, and nobody asks whether this map is level: the
    autopilot's attitude, which slam would turn by the first camera's mount, is not listened to.

    Raises:
        InputError: there is no second camera.
    """
    require_second(context.config)
    slam = context.config.slam.model_copy(update={"frames": "raw", "loop_closing": False, "keep_map": False})
    config = context.config.model_copy(update={"slam": slam})
    names = {
        CAMERA_RGBD: SECOND_RGBD,
        SLAM_POSE: SECOND_POSE,
        SLAM_KEYFRAME: None,
        SLAM_GRAPH: None,
        VEHICLE_STATE: None,
    }
    return build_slam(RenamedContext(context, config, names))
