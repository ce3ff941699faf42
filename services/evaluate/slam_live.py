"""The live slam service over a rendered walk: a process on the bus, watched from outside, fed at a camera's rate.

This process is the camera: it publishes raw 1.5 MB frames, each at its time, but not before the one before is answered: on a
machine that has other things to do the walk takes longer and is the same walk. How slam drops frames is for a test to show.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from schemas.camera import RgbdFrame
from schemas.slam import Graph, Keyframe, Pose
from schemas.topics import CAMERA_RGBD, SLAM_GRAPH, SLAM_KEYFRAME, SLAM_POSE
from services.common.config import TreedockConfig
from services.common.errors import InputError
from services.common.geometry import from_transform
from services.evaluate.processes import Processes
from services.evaluate.slam_walk import WalkFrame, read_walk

if TYPE_CHECKING:
    from services.common.bus import Bus

F64 = NDArray[np.float64]

SERVICE = "slam"
_FIRST_POSE_WITHIN_S = 240.0
"""Kernels that are not compiled yet take minutes."""
_ANSWER_WITHIN_S = 5.0
_LIMIT_S = 240.0
"""Wall time after which the rest of the walk is left out, and told: on a busy machine."""
_LOOK_EVERY = 100
_DRAIN_S = 1.0


@dataclass(slots=True)
class Live:
    """What was measured; lists of one entry per pose in order of arrival, unless said otherwise."""

    index: list[int] = field(default_factory=list)
    """The walk's frame."""
    track_ms: list[float] = field(default_factory=list)
    """Wall time of the tracking call, as the pose tells it."""
    latency_ms: list[float] = field(default_factory=list)
    """From the frame's publishing to the pose's arrival."""
    error_m: list[float] = field(default_factory=list)
    """Distance to the true position; of located frames."""
    alive: list[int] = field(default_factory=list)
    """Keyframes in the map, every hundredth frame."""
    cpu_s: list[float] = field(default_factory=list)
    """CPU time since the walk's first frame, all threads, every hundredth frame."""
    rss_mb: list[float] = field(default_factory=list)
    """Memory held, every hundredth frame."""
    sent: int = 0
    lost: int = 0
    keyframes: int = 0
    loops: int = 0
    resets: int = 0
    walk_s: float = 0.0
    """Length of the walk at the camera's rate."""
    wall_s: float = 0.0
    """And what it took."""
    first_pose_s: float = 0.0
    """From the start of the process (interpreter, imports, kernels from the cache, bus) to its first pose."""
    peak_mb: float = 0.0

    @property
    def cores(self) -> float:
        """CPU time of the service over the walk's length."""
        return self.cpu_s[-1] / self.walk_s

    @property
    def dropped(self) -> int:
        """Frames that were sent and not answered within 5 s."""
        return self.sent - len(self.index)


class _Watch:
    """Notes what the service sends."""

    def __init__(self, live: Live) -> None:
        self._live = live
        self.sent: dict[int, tuple[int, F64, float]] = {}
        """Stamp to index, true pose and moment of sending."""
        self.first_pose_s = 0.0
        self.alive = 0

    def on_pose(self, _: str, pose: Pose) -> None:
        """Note a pose; those of the frames sent before the walk only tell that the service works."""
        now_s = time.monotonic()
        self.first_pose_s = self.first_pose_s or now_s
        sent = self.sent.pop(pose.stamp_ns, None)
        if sent is None:
            return
        live, (index, truth, sent_s) = self._live, sent
        live.index.append(index)
        live.track_ms.append(round(pose.processing_ms, 2))
        live.latency_ms.append(round((now_s - sent_s) * 1e3, 2))
        live.resets = pose.reset_counter
        if pose.T_map_camera is None:
            live.lost += 1
        else:
            off_m = float(np.linalg.norm(from_transform(pose.T_map_camera)[:3, 3] - truth[:3, 3]))
            live.error_m.append(round(off_m, 4))

    def await_answers(self) -> None:
        """Wait until each frame has its pose; what is not answered in time is given up."""
        end_s = time.monotonic() + _ANSWER_WITHIN_S
        while self.sent and time.monotonic() < end_s:
            time.sleep(0.001)
        self.sent.clear()

    def on_keyframe(self, _: str, keyframe: Keyframe) -> None:
        """Count a keyframe."""
        del keyframe
        self._live.keyframes += 1

    def on_graph(self, _: str, graph: Graph) -> None:
        """Note how large the map is."""
        self.alive = len(graph.nodes)
        self._live.loops += graph.reason == "loop"


def run_live(walk: Path, frames: int, rate_hz: float) -> Live:
    """Run ``treedock slam`` over the walk's first ``frames``.

    Raises:
        InputError: the service ended, or gave no pose in time.
    """
    from services.common.bus import Bus
    from services.common.context import HealthBook
    from services.common.session import free_port, opened_client

    live = Live()
    watch = _Watch(live)
    with tempfile.TemporaryDirectory(prefix="treedock-walk-") as folder:
        base = TreedockConfig()
        config = base.model_copy(update={
            "slam": base.slam.model_copy(update={"map_folder": Path(folder) / "map"}),
            "router": base.router.model_copy(update={"port": free_port(base.router.host)}),
        })  # fmt: skip
        with Processes(config, Path(folder)) as running:
            running.start("router")
            with opened_client(config.router.endpoint, lambda: False, wait_s=60.0) as session:
                bus = Bus(session, config.uav, HealthBook())
                bus.subscribe_keys(SLAM_POSE, watch.on_pose, at_once=True)
                bus.subscribe_keys(SLAM_KEYFRAME, watch.on_keyframe, at_once=True)
                bus.subscribe_keys(SLAM_GRAPH, watch.on_graph, at_once=True)
                _walk(bus, running, watch, live, read_walk(walk), frames, rate_hz)
    return live


def _walk(
    bus: Bus, running: Processes, watch: _Watch, live: Live, walk: Iterator[WalkFrame], frames: int, rate_hz: float
) -> None:
    """Start slam before a standing camera; walk from its first pose on."""
    first = next(walk)
    standing, seq, begin_s = _message(first), 0, time.monotonic()
    running.start(SERVICE)
    while not watch.first_pose_s:
        running.check()
        if time.monotonic() - begin_s > _FIRST_POSE_WITHIN_S:
            raise InputError(f"slam gave no pose within {_FIRST_POSE_WITHIN_S:.0f} s")
        bus.publish(CAMERA_RGBD, replace(standing, stamp_ns=time.time_ns(), seq=seq))
        seq += 1
        time.sleep(1.0 / rate_hz)
    live.first_pose_s = watch.first_pose_s - begin_s
    cpu_s, begin_s = running.cpu_s(SERVICE), time.monotonic()
    for item in walk:
        if item.index >= frames or time.monotonic() - begin_s > _LIMIT_S:
            break
        frame = _message(item)
        time.sleep(max(0.0, begin_s + live.sent / rate_hz - time.monotonic()))
        watch.await_answers()
        stamp_ns = time.time_ns()
        watch.sent[stamp_ns] = (item.index, item.T_map_camera, time.monotonic())
        bus.publish(CAMERA_RGBD, replace(frame, stamp_ns=stamp_ns, seq=seq + live.sent))
        live.sent += 1
        if live.sent % _LOOK_EVERY == 0 or item.index == frames - 1:
            running.check()
            live.alive.append(watch.alive)
            live.cpu_s.append(round(running.cpu_s(SERVICE) - cpu_s, 2))
            live.rss_mb.append(round(running.memory_mb(SERVICE), 1))
    live.walk_s, live.wall_s = live.sent / rate_hz, time.monotonic() - begin_s
    time.sleep(_DRAIN_S)
    live.peak_mb = running.memory_mb(SERVICE, peak=True)


def _message(item: WalkFrame) -> RgbdFrame:
    from services.simulator.render import DEFAULT_INTRINSICS

    up: F64 = item.T_map_camera[:3, :3].T @ np.array([0.0, 0.0, 9.81])
    raw = (item.depth_m * np.float32(1000.0) + np.float32(0.5)).astype(np.uint16)
    colour = np.repeat(item.grey[:, :, None], 3, axis=2)
    return RgbdFrame(
        stamp_ns=1, seq=item.index, intrinsics=DEFAULT_INTRINSICS, colour=colour.tobytes(), depth=raw.tobytes(),
        accel_camera=(float(up[0]), float(up[1]), float(up[2])),
    )  # fmt: skip
