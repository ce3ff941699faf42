"""The preview as a process: the newest frame with the overlay, a few times a second, while somebody looks."""

from __future__ import annotations

from schemas.camera import RgbdFrame
from schemas.navigation import Guidance, MissionState
from schemas.preview import PreviewImage
from schemas.slam import Pose
from schemas.topics import (
    CAMERA_RGBD,
    MISSION_GUIDANCE,
    MISSION_STATE,
    PREVIEW_IMAGE,
    SLAM_POSE,
    TREES_LIST,
    TREES_TARGET,
)
from schemas.trees import Target, TreeList
from services.camera.codecs import FrameError, decode_colour
from services.common.context import Context
from services.preview.config import PreviewConfig
from services.preview.draw import Encoder, draw, scaled
from services.preview.overlay import Overlay, overlay_of

_STALE_NS = 1_000_000_000
"""What is older than this against the frame is not drawn: an outline in the wrong place is worse than none."""


def build(context: Context) -> PreviewService:
    """Register the work."""
    service = PreviewService(context, context.config.preview)
    context.on(CAMERA_RGBD, service.on_frame)
    context.on(SLAM_POSE, service.on_pose)
    context.on(TREES_LIST, service.on_trees)
    context.on(TREES_TARGET, service.on_target)
    context.on(MISSION_STATE, service.on_mission)
    context.on(MISSION_GUIDANCE, service.on_guidance)
    context.every_wall(1.0 / context.config.preview.rate_hz, service.show)
    return service


class PreviewService:
    """Keeps the latest of everything; draws when it is time and somebody listens."""

    def __init__(self, context: Context, config: PreviewConfig) -> None:
        self._context = context
        self._config = config
        self._encoder = Encoder(config.max_kb * 1000, config.best_quality)
        self._frame: RgbdFrame | None = None
        self._pose: Pose | None = None
        self._trees: TreeList | None = None
        self._target: Target | None = None
        self._mission: MissionState | None = None
        self._guidance: Guidance | None = None

    def on_frame(self, frame: RgbdFrame) -> None:
        """Keep the newest frame."""
        self._frame = frame

    def on_pose(self, pose: Pose) -> None:
        """Keep the newest pose."""
        self._pose = pose

    def on_trees(self, trees: TreeList) -> None:
        """Keep the map's trees."""
        self._trees = trees

    def on_target(self, target: Target) -> None:
        """Keep the refined target."""
        self._target = target

    def on_mission(self, mission: MissionState) -> None:
        """Keep the mission's state."""
        self._mission = mission

    def on_guidance(self, guidance: Guidance) -> None:
        """Keep the latest command."""
        self._guidance = guidance

    def show(self) -> None:
        """Draw and send the newest frame, once, and only while somebody looks."""
        frame, self._frame = self._frame, None
        if frame is None or not self._context.listened(PREVIEW_IMAGE):
            return
        with self._context.health.timed("preview"):
            try:
                colour = decode_colour(frame)
            except FrameError as error:
                self._context.health.count("dropped_bad_frames")
                self._context.health.note("camera/rgbd", str(error))
                return
            self._context.health.note("camera/rgbd", "")
            image, factor = scaled(colour, self._config.width_px)
            draw(image, self._overlay(frame), factor)
            jpeg = self._encoder.encode(image)
        self._context.publish(PREVIEW_IMAGE, PreviewImage(jpeg))
        self._context.health.count("pictures")

    def _overlay(self, frame: RgbdFrame) -> Overlay:
        pose = self._pose if self._pose and _fresh(frame, self._pose.stamp_ns) else None
        same_map = pose is not None and self._trees is not None and self._trees.map_id == pose.map_id
        return overlay_of(
            frame.intrinsics,
            pose,
            self._trees.trees if same_map and self._trees else (),
            self._target if self._target and _fresh(frame, self._target.stamp_ns) else None,
            self._mission if self._mission and _fresh(frame, self._mission.stamp_ns) else None,
            self._guidance if self._guidance and _fresh(frame, self._guidance.stamp_ns) else None,
        )


def _fresh(frame: RgbdFrame, stamp_ns: int) -> bool:
    return abs(frame.stamp_ns - stamp_ns) < _STALE_NS
