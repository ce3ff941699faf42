"""The refiner as a process: frames, poses, trees and the mission's wish in; one target per frame out."""

from __future__ import annotations

import gc
from collections import OrderedDict
from dataclasses import dataclass

import numpy as np

from schemas.camera import RgbdFrame
from schemas.navigation import MissionState
from schemas.slam import Pose
from schemas.topics import CAMERA_COMPRESSED, CAMERA_RGBD, MISSION_STATE, SLAM_POSE, TREES_LIST, TREES_TARGET
from schemas.trees import Target, Tree, TreeList
from services.camera.depth_codec import FrameError, decode_depth
from services.common.context import Context
from services.common.geometry import Matrix, from_transform
from services.detector.refine.agreement import Colour
from services.detector.refine.config import RefinerConfig
from services.detector.refine.model import Depth, ExpectedTree
from services.detector.refine.state import TargetState
from services.detector.refine.tracker import RefinerTracker
from services.detector.refine.view import ray_table
from services.detector.refine.warm import warm

_KEPT_POSES = 32
_SAMPLE_STRIDE = 8
_MIN_VALID_SHARE = 0.002
_UPPER = np.triu_indices(6)


def build(context: Context) -> None:
    """Make the refiner and register its handlers."""
    config = getattr(context.config, "refiner", None) or RefinerConfig()
    service = RefinerService(context, config)
    warm()
    # what was loaded stays for good: each full collection over it takes 80 ms
    gc.freeze()
    context.on(TREES_LIST, service.on_trees)
    context.on(MISSION_STATE, service.on_mission)
    context.on(CAMERA_COMPRESSED if config.frames == "compressed" else CAMERA_RGBD, service.on_frame)
    context.on(SLAM_POSE, service.on_pose)
    context.every(config.pose_wait_s / 3.0, service.on_tick)


@dataclass(frozen=True, slots=True)
class _Waiting:
    """A frame that waits for its pose, its depth in metres, and why there is none."""

    received_ns: int
    frame: RgbdFrame
    depth_m: Depth | None
    fault: str


class RefinerService:
    """Pairs each frame with the pose of its stamp and answers each frame exactly once, in order of stamps."""

    def __init__(self, context: Context, config: RefinerConfig) -> None:
        self._context, self._config = context, config
        self._health = context.health
        self._tracker = RefinerTracker(config)
        self._waiting: OrderedDict[int, _Waiting] = OrderedDict()
        self._poses: OrderedDict[int, Pose] = OrderedDict()
        self._last_ns = -1
        self._reset_counter = 0
        self._trees_map_id, self._pose_map_id = "none", "none"

    def on_trees(self, trees: TreeList) -> None:
        """Take the newest list of trees."""
        expected = [expected_tree(tree) for tree in trees.trees]
        suitable = [tree.id for tree in trees.trees if tree.suitable]
        self._tracker.set_trees(expected, suitable, trees.map_id, trees.graph_version)
        self._trees_map_id = trees.map_id
        self._health.count("tree_lists")

    def on_mission(self, mission: MissionState) -> None:
        """Follow the mission's tree."""
        self._tracker.choose(mission.target_tree_id)

    def on_frame(self, frame: RgbdFrame) -> None:
        """Answer the frame at once when its pose is here already, else let it wait for it."""
        self._health.count("frames")
        if frame.stamp_ns <= self._last_ns or frame.stamp_ns in self._waiting:
            self._health.count("frames_out_of_order")
            return
        # decoded while it waits for its pose, not after
        self._waiting[frame.stamp_ns] = _Waiting(self._context.clock.now_ns(), frame, *depth_of(frame))
        if frame.stamp_ns in self._poses:
            self._answer_until(frame.stamp_ns)
        while len(self._waiting) > self._config.max_waiting_frames:
            self._answer_oldest()

    def on_pose(self, pose: Pose) -> None:
        """Answer the frame of this pose, and before it those whose pose never came."""
        self._poses[pose.stamp_ns] = pose
        while len(self._poses) > _KEPT_POSES:
            self._poses.popitem(last=False)
        self._answer_until(pose.stamp_ns)

    def on_tick(self) -> None:
        """Answer frames that have waited too long: slam is silent."""
        limit_ns = self._context.clock.now_ns() - round(self._config.pose_wait_s * 1e9)
        while self._waiting and next(iter(self._waiting.values())).received_ns < limit_ns:
            self._answer_oldest()

    def _answer_until(self, stamp_ns: int) -> None:
        while self._waiting and next(iter(self._waiting)) <= stamp_ns:
            self._answer_oldest()

    def _answer_oldest(self) -> None:
        stamp_ns, waiting = self._waiting.popitem(last=False)
        frame = waiting.frame
        self._last_ns = stamp_ns
        self._health.stage_ms["wait_for_pose"].append((self._context.clock.now_ns() - waiting.received_ns) * 1e-6)
        with self._health.timed("refine"):
            state = self._state(waiting, self._poses.get(stamp_ns))
        self._health.count("measured", int(state.measured))
        self._context.publish(TREES_TARGET, target_message(frame, self._pose_map_id, state))

    def _state(self, waiting: _Waiting, pose: Pose | None) -> TargetState:
        frame, depth, fault = waiting.frame, waiting.depth_m, waiting.fault
        self._health.note("camera/rgbd", fault)
        if fault:
            self._health.count("dropped_bad_depth")
        if pose is None:
            self._health.count("frames_without_pose")
            return self._tracker.step(frame.stamp_ns, depth, frame.intrinsics, None, None, fault or "no pose from slam")
        self._pose_map_id = pose.map_id
        if pose.reset_counter != self._reset_counter:
            self._reset_counter = pose.reset_counter
            self._tracker.pose_jumped()
        if pose.map_id != self._trees_map_id:
            return TargetState("none", note=fault or f"no trees of map {pose.map_id} yet")
        T = from_transform(pose.T_map_camera) if pose.T_map_camera is not None else None
        note = fault or ("" if T is not None else f"slam is {pose.status}")
        state = self._tracker.step(
            frame.stamp_ns, depth, frame.intrinsics, T, covariance_of(pose), note, colour_of(frame)
        )
        self._health.note("camera", self._tracker.camera_fault)
        return state


def expected_tree(tree: Tree) -> ExpectedTree:
    """Return the core's form of a tree."""
    return ExpectedTree(
        tree.id, tree.x_m, tree.y_m, tree.z_m, tree.axis, tree.radius_m, tree.sigma_xy_m, tree.sigma_radius_m
    )


def depth_of(frame: RgbdFrame) -> tuple[Depth | None, str]:
    """Return the depth image in metres, or None and what is wrong with it, in one line."""
    i = frame.intrinsics
    try:
        raw = decode_depth(frame.depth, frame.depth_encoding, i.width, i.height)
    except FrameError as error:
        return None, f"frame {frame.seq}: {error}"
    sample = raw[::_SAMPLE_STRIDE, ::_SAMPLE_STRIDE]
    valid = float(np.count_nonzero((sample > 0) & (sample < np.iinfo(np.uint16).max))) / sample.size
    if valid < _MIN_VALID_SHARE:
        return (
            None,
            f"frame {frame.seq}: {valid:.1%} of the depth image is data: is the depth sensor covered or too near?",
        )
    ray_table(i)
    return np.multiply(raw, np.float32(1.0 / i.depth_scale), dtype=np.float32), ""


def colour_of(frame: RgbdFrame) -> Colour | None:
    """Return the colour image (H, W, 3) when it is raw; to decode one for the sake of a check would cost too much."""
    i = frame.intrinsics
    if frame.colour_encoding != "bgr8" or len(frame.colour) != 3 * i.width * i.height:
        return None
    return np.frombuffer(frame.colour, np.uint8).reshape(i.height, i.width, 3)


def covariance_of(pose: Pose) -> Matrix | None:
    """Return the (6, 6) covariance of a pose, or None when slam tells none."""
    if pose.covariance is None:
        return None
    C = np.zeros((6, 6))
    C[_UPPER] = pose.covariance
    return C + np.triu(C, 1).T


def target_message(frame: RgbdFrame, map_id: str, state: TargetState) -> Target:
    """Return the message of a state."""
    return Target(
        stamp_ns=frame.stamp_ns, seq=frame.seq, map_id=map_id, status=state.status, tree_id=state.tree_id,
        measured=state.measured, bearing_rad=state.bearing_rad, range_m=state.range_m, radius_m=state.radius_m,
        image_x_px=state.image_x_px, sigma_bearing_rad=state.sigma_bearing_rad, sigma_range_m=state.sigma_range_m,
        sigma_radius_m=state.sigma_radius_m, raw_image_x_px=state.raw_image_x_px, raw_range_m=state.raw_range_m,
        raw_radius_m=state.raw_radius_m, position_map_m=state.position_map_m,
        covariance_map_m2=state.covariance_map_m2, note=state.note[:500],
    )  # fmt: skip
