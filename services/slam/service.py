"""slam as a process: RGB-D frames in; poses, keyframes and the graph out."""

from __future__ import annotations

import logging
import os

import numpy as np
from numpy.typing import NDArray

from schemas.camera import Intrinsics, RgbdFrame
from schemas.slam import Graph, Keyframe
from schemas.topics import CAMERA_COMPRESSED, CAMERA_RGBD, SLAM_GRAPH, SLAM_KEYFRAME, SLAM_POSE, VEHICLE_STATE
from schemas.vehicle import VehicleState
from services.camera.codecs import FrameError, decode_colour, decode_depth_raw, recode
from services.common.context import Context
from services.common.geometry import Matrix, rotation_from_quaternion, to_transform
from services.common.mount import Mount
from services.common.state import user_state
from services.slam.config import SlamConfig
from services.slam.maps import LiveMaps, LockstepMap, Maps
from services.slam.messages import Nodes, pose_message
from services.slam.results import GraphUpdate, TrackResult
from services.slam.slam import Slam
from services.slam.warm import warm, warm_beside

LOG = logging.getLogger(__name__)

_JPEG_QUALITY = 80
_ATTITUDE_AGE_NS = 200_000_000
_IDLE_PERIOD_S = 0.5
_IDLE_PERIODS = 3
"""After so many without a frame the map is polished."""


def build(context: Context) -> SlamService:
    """Warm the kernels and register the work; the returned service's ``slam`` holds the final trajectory."""
    service = SlamService(context, context.config.slam, _maps(context))
    context.on(CAMERA_COMPRESSED if context.config.slam.frames == "compressed" else CAMERA_RGBD, service.on_frame)
    context.on(VEHICLE_STATE, service.on_vehicle)
    context.every_wall(_IDLE_PERIOD_S, service.on_idle)
    context.on_stop(service.on_stop)
    return service


def _maps(context: Context) -> Maps:
    config = context.config.slam
    if context.lockstep:
        warm()
        return LockstepMap(config)
    folder = (config.map_folder or user_state(context.uav, os.environ) / "slam") if config.keep_map else None
    maps = LiveMaps(config, folder, context.health)
    warm_beside(maps.crew)
    return maps


class SlamService:
    """Decodes, calls the core and publishes; keyframe and graph go out before the pose that rests on them."""

    def __init__(self, context: Context, config: SlamConfig, maps: Maps) -> None:
        self.slam: Slam | None = None
        self._context = context
        self._config = config
        self._maps = maps
        self._nodes = Nodes()
        self._intrinsics: Intrinsics | None = None
        autopilot = context.config.autopilot
        mount = Mount.level(autopilot.camera_offset_m, autopilot.camera_pitch_rad, autopilot.camera_yaw_rad)
        self._R_body_camera = mount.T_body_camera[:3, :3]
        self._up: tuple[int, Matrix] | None = None
        """Stamp and (3,) of up in the camera, by the autopilot."""
        self._last_stamp_ns = -1
        self._idle_periods = 0
        self._polished = True
        self._refused = 0
        """Adjustments of the present map."""
        self.keyframes_ns: tuple[int, ...] = ()
        """Stamps of the keyframes of a flight whose recording comes: they are followed."""

    def on_vehicle(self, state: VehicleState) -> None:
        """Keep the autopilot's idea of up (its roll and pitch)."""
        if state.quaternion_map_body is None or not state.connected:
            return
        up_body = rotation_from_quaternion(state.quaternion_map_body).T @ np.array([0.0, 0.0, 1.0])
        up_camera = self._R_body_camera.T @ up_body
        self._up = (state.stamp_ns, up_camera)

    def on_frame(self, frame: RgbdFrame) -> None:
        """Locate one frame; a bad one is dropped, counted and told."""
        health = self._context.health
        health.count("frames")
        try:
            grey, depth_raw = self._decode(frame)
        except FrameError as error:
            health.count("dropped_bad_frames")
            health.note("camera/rgbd", f"{error}; the frame was dropped")
            return
        health.note("camera/rgbd", "")
        slam = self._slam_for(frame)
        with health.timed("track"):
            depth_m = depth_raw.astype(np.float32) / np.float32(frame.intrinsics.depth_scale)
            accel = None if frame.accel_camera is None else np.array(frame.accel_camera)
            attitude_up = self._attitude(frame.stamp_ns)
            result = slam.track(frame.stamp_ns, grey, depth_m, accel, attitude_up, 1e-9 * frame.depth_after_ns)
        self._last_stamp_ns, self._polished, self._idle_periods = frame.stamp_ns, False, 0
        if result.status in {"lost", "relocalising"}:
            health.count("lost_frames")
        self._publish(frame, result)
        self._count_refused(slam)
        while slam.settled_ms:
            health.stage_ms["map"].append(slam.settled_ms.popleft())
        self.slam = self._maps.after(slam, result)

    def _count_refused(self, slam: Slam) -> None:
        """Count the adjustments that ran away and were not taken over."""
        new = slam.mapping.refused - self._refused
        if new > 0:
            self._context.health.count("adjustments_refused", new)
            LOG.warning(
                "%s: an adjustment of the map ran away and was not taken over: %s",
                slam.map_id,
                slam.mapping.refused_last,
            )
        self._refused = slam.mapping.refused

    def on_idle(self) -> None:
        """Tell what mapping has done since the last frame; polish when none comes (a recording's end, a pause).

        Counted in periods, not read from the clock: simulated time stands still while nothing comes.
        """
        self._maps.beat()
        if self.slam is None:
            return
        self._idle_periods += 1
        graph = None
        if not self._polished and self._idle_periods >= _IDLE_PERIODS:
            self._polished = True
            with self._context.health.timed("polish"):
                graph = self.slam.polish()
        elif self._idle_periods > 1:
            graph = self.slam.catch_up()
        if graph is not None:
            self._publish_graph(self._last_stamp_ns, graph)

    def on_stop(self) -> None:
        """End the map."""
        self._maps.end()

    def _decode(self, frame: RgbdFrame) -> tuple[NDArray[np.uint8], NDArray[np.uint16]]:
        import cv2

        if self._intrinsics is not None and frame.intrinsics != self._intrinsics:
            raise FrameError(
                f"frame {frame.seq}: its camera ({frame.intrinsics.width}x{frame.intrinsics.height}, fx {frame.intrinsics.fx:g}) is "
                f"not the one this map was begun with ({self._intrinsics.width}x{self._intrinsics.height}, fx "
                f"{self._intrinsics.fx:g}); restart slam for another camera"
            )
        if frame.stamp_ns <= self._last_stamp_ns:
            raise FrameError(f"frame {frame.seq}: stamp {frame.stamp_ns} is not after {self._last_stamp_ns}")
        grey = cv2.cvtColor(decode_colour(frame), cv2.COLOR_BGR2GRAY)
        return grey.astype(np.uint8, copy=False), decode_depth_raw(frame)

    def _slam_for(self, frame: RgbdFrame) -> Slam:
        if self.slam is None:
            self._intrinsics = frame.intrinsics
            # a new map is named by its first frame: a restarted slam never passes it off as the old one
            self.slam = self._maps.begin(frame.intrinsics, frame.stamp_ns)
            self.slam.follow_keyframes(self.keyframes_ns)
        return self.slam

    def _attitude(self, stamp_ns: int) -> Matrix | None:
        if self._up is None or abs(stamp_ns - self._up[0]) > _ATTITUDE_AGE_NS:
            return None
        return self._up[1]

    def _publish(self, frame: RgbdFrame, result: TrackResult) -> None:
        """In lockstep what the pose rests on goes first; live the pose does not wait for a keyframe's compression."""
        pose = pose_message(frame, result, self._map_id, self._processing_ms())
        if not self._context.lockstep:
            self._context.publish(SLAM_POSE, pose)
        self._publish_keyframes(frame, result)
        if result.graph is not None:
            self._publish_graph(frame.stamp_ns, result.graph)
        if self._context.lockstep:
            self._context.publish(SLAM_POSE, pose)

    def _publish_keyframes(self, frame: RgbdFrame, result: TrackResult) -> None:
        if not result.new_keyframes:
            return
        coded = recode(frame, "jpeg", "zstd", _JPEG_QUALITY)
        for new in result.new_keyframes:
            self._context.publish(SLAM_KEYFRAME, Keyframe(
                keyframe_id=new.keyframe_id, stamp_ns=frame.stamp_ns, map_id=self._map_id,
                graph_version=result.graph_version, T_map_camera=to_transform(new.T_map_camera),
                intrinsics=frame.intrinsics, depth_encoding="zstd", depth=bytes(coded.depth),
                colour_jpeg=bytes(coded.colour),
            ))  # fmt: skip
        self._context.health.count("keyframes", len(result.new_keyframes))

    def _publish_graph(self, stamp_ns: int, graph: GraphUpdate) -> None:
        assert self.slam is not None
        nodes = self._nodes.of(graph)
        self._context.publish(SLAM_GRAPH, Graph(
            stamp_ns=stamp_ns, map_id=self._map_id, version=graph.version, reset_counter=self.slam.reset_counter,
            reason=graph.reason, nodes=nodes, up_sigma_rad=self.slam.up_sigma_rad,
        ))  # fmt: skip
        self._context.health.count("graphs")

    @property
    def _map_id(self) -> str:
        assert self.slam is not None
        return self.slam.map_id

    def _processing_ms(self) -> float:
        return self._context.health.stage_ms["track"][-1]
