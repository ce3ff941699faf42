"""Stand-ins for slam, mapper, detector, refiner and the second slam, each a process of its own: they say what the real ones would say.

``python -m services.evaluate.faults.standins NAME --config FILE --parent PID``. They live by the camera's frames as the real
ones do (no frame, no pose) but read the truth in place of the pictures, with the errors of ``services.evaluate.synthetic``. So
missions fly in real processes at a tenth of the cost. What a stand-in loses at its death says nothing of the real service:
that is asked of the real ones, over a recording.
"""

from __future__ import annotations

import sys
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import numpy as np

from schemas.camera import RgbdFrame
from schemas.navigation import MissionState
from schemas.simulation import SimTruth
from schemas.slam import Pose
from schemas.topics import (
    CAMERA_COMPRESSED,
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
from services.cli.service_command import end_with
from services.common.config import load_config
from services.common.context import Context
from services.common.geometry import from_transform, inverse, to_transform
from services.common.mount import Mount
from services.common.process import prepare_process
from services.common.runtime import run_service
from services.common.stop import end_process
from services.evaluate.synthetic import ChainErrors, SyntheticChain, TrueTrunk

M = TypeVar("M", Pose, Target, TreeList)

ERRORS = ChainErrors(
    frame_s=1e-6, delay_min_s=0.0, delay_max_s=0.0, drop_share=0.0, loop_m=0.0, loop_rad=0.0, list_s=0.0,
    listed_after_rad=-np.inf,
)  # fmt: skip
"""Trees are listed from the start, whichever way it turns (a turn to the right counts as negative); delays and lost frames are the processes' own; the map has no loop to close, as it is that of a slam started again."""
_KEPT = 64


class Standin:
    """The truth of each frame by its stamp, and the chain that says what would be believed of it."""

    def __init__(self, context: Context) -> None:
        self.context = context
        self.chain: SyntheticChain | None = None
        self._truths: OrderedDict[int, SimTruth] = OrderedDict()
        context.on(SIM_TRUTH, self._on_truth, ring=_KEPT)

    def _on_truth(self, truth: SimTruth) -> None:
        self._truths[truth.stamp_ns] = truth
        while len(self._truths) > _KEPT:
            self._truths.popitem(last=False)
        if self.chain is None:
            trunks = [TrueTrunk(t.x_m, t.y_m, t.radius_m, t.suitable) for t in truth.trees]
            seed = self.context.config.simulator.seed
            self.chain = SyntheticChain(trunks, np.eye(4), ERRORS, np.random.default_rng(seed))
        self.on_truth(truth)

    def on_truth(self, truth: SimTruth) -> None:
        """Do what a new truth calls for."""

    def said(self, stamp_ns: int, kind: type[M]) -> M | None:
        """Return what is said of the frame of that stamp; None before its truth is there."""
        truth = self._truths.get(stamp_ns)
        if truth is None or self.chain is None:
            return None
        self.chain.observe(from_transform(truth.T_map_camera), stamp_ns)
        due = self.chain.due(stamp_ns + 1_000_000_000)
        return next((m.model_copy(update={"seq": truth.seq}) for m in due if isinstance(m, kind)), None)


class StandinSlam(Standin):
    """A pose for each frame, once both the frame and its truth are there."""

    def __init__(self, context: Context, frames: Topic | None = None) -> None:
        super().__init__(context)
        self._frame_ns = 0
        compressed = context.config.slam.frames == "compressed"
        context.on(frames or (CAMERA_COMPRESSED if compressed else CAMERA_RGBD), self._on_frame)

    def _on_frame(self, frame: RgbdFrame) -> None:
        self._frame_ns = frame.stamp_ns
        self._answer()

    def on_truth(self, truth: SimTruth) -> None:
        """Answer a frame that was sooner than its truth."""
        if truth.stamp_ns == self._frame_ns:
            self._answer()

    def _answer(self) -> None:
        pose = self.said(self._frame_ns, Pose)
        if pose is not None:
            self._frame_ns = 0
            self.publish(pose)

    def publish(self, pose: Pose) -> None:
        """Say a pose of the first camera."""
        self.context.publish(SLAM_POSE, pose)


class StandinSecondSlam(StandinSlam):
    """The same for the second camera, which is bolted to the first."""

    def __init__(self, context: Context) -> None:
        super().__init__(context, SECOND_RGBD)
        autopilot, second = context.config.autopilot, context.config.fusion.second
        first = Mount.level(autopilot.camera_offset_m, autopilot.camera_pitch_rad, autopilot.camera_yaw_rad)
        of_second = Mount.level(second.offset_m, second.pitch_rad, second.yaw_rad)
        self._T_first_second = inverse(first.T_body_camera) @ of_second.T_body_camera

    def publish(self, pose: Pose) -> None:
        """Say where the second camera is while the first is at ``pose``."""
        if pose.T_map_camera is not None:
            T_map_second = from_transform(pose.T_map_camera) @ self._T_first_second
            pose = pose.model_copy(update={"T_map_camera": to_transform(T_map_second)})
        self.context.publish(SECOND_POSE, pose)


class StandinRefiner(Standin):
    """A target for each pose."""

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self._target_id: int | None = None
        context.on(MISSION_STATE, self._on_mission)
        context.on(SLAM_POSE, self._on_pose)

    def _on_mission(self, mission: MissionState) -> None:
        self._target_id = mission.target_tree_id

    def _on_pose(self, pose: Pose) -> None:
        if self.chain is not None:
            self.chain.target_id = self._target_id
        target = self.said(pose.stamp_ns, Target)
        if target is not None:
            self.context.publish(TREES_TARGET, target)


class StandinDetector(Standin):
    """The list of trees, once a second of simulated time."""

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self._next_ns = 0
        self._last: TreeList | None = None
        context.on(SLAM_POSE, self._on_pose)
        context.answer_state(TREES_LIST, lambda: [self._last] if self._last else [])

    def _on_pose(self, pose: Pose) -> None:
        if pose.stamp_ns < self._next_ns:
            return
        trees = self.said(pose.stamp_ns, TreeList)
        if trees is not None:
            self._next_ns, self._last = pose.stamp_ns + 1_000_000_000, trees
            self.context.publish(TREES_LIST, trees)


def _mapper(context: Context) -> None:
    """Stand in for the mapper: nobody here needs its clouds, only its life."""
    context.on(SLAM_POSE, lambda _: context.health.count("poses"))


BUILDS: dict[str, Callable[[Context], object]] = {
    "slam": StandinSlam, "mapper": _mapper, "detector": StandinDetector, "refiner": StandinRefiner,
    "second_slam": StandinSecondSlam,
}  # fmt: skip


def main(arguments: list[str]) -> int:
    """Run the stand-in that the arguments name."""
    name, config = arguments[0], Path(arguments[arguments.index("--config") + 1])
    return run_service(name, BUILDS[name], load_config(config))


if __name__ == "__main__":
    prepare_process()
    end_with(int(sys.argv[sys.argv.index("--parent") + 1]))
    end_process(main(sys.argv[1:]))
