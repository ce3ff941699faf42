"""The live slam service over a rendered walk, by itself in a process: times, cores, memory. Prints one JSON object.

``python -m services.evaluate.slam_live WALK FRAMES RATE_HZ FOLDER``: frames come in real time (RATE_HZ 0: as fast as they are
taken); those that come while the service works are dropped, as the bus does. Everything but Zenoh itself is in it: raw
1.5 MB frames are decoded, keyframes compressed, the map kept on disk.
"""

from __future__ import annotations

import json
import os
import sys
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from schemas.camera import RgbdFrame
from schemas.slam import Pose
from schemas.topics import SLAM_POSE
from services.common.config import TreedockConfig
from services.common.geometry import from_transform
from services.common.memory import Hub, MemoryContext
from services.common.process import prepare_process
from services.evaluate.slam_walk import WalkFrame, read_walk

LIMIT_S = 300.0
"""Wall time after which the rest of a walk is left out: on a busy machine."""
_START_NS = 10**9


@dataclass(slots=True)
class Live:
    """What was measured; one entry per frame taken."""

    track_ms: list[float] = field(default_factory=list)
    """Wall time of the tracking call."""
    whole_ms: list[float] = field(default_factory=list)
    """With decoding and publishing."""
    whole_cpu_ms: list[float] = field(default_factory=list)
    """CPU time of that thread."""
    error_m: list[float] = field(default_factory=list)
    alive: list[int] = field(default_factory=list)
    """Keyframes in the map, every hundredth frame."""
    dropped: int = 0
    lost: int = 0
    resets: int = 0
    keyframes: int = 0
    loops: int = 0
    cores: float = 0.0
    first_pose_s: float = 0.0
    """From the start of the process (interpreter, imports, kernels from the cache) to its first pose."""
    rss_mb: float = 0.0


class _RealTime(MemoryContext):
    lockstep = False


def run(walk: Path, frames: int, rate_hz: float, folder: Path) -> Live:
    """Run the service over the walk's first ``frames``."""
    import cv2

    from services.slam.config import SlamConfig
    from services.slam.maps import LiveMaps
    from services.slam.service import SlamService
    from services.slam.warm import warm

    cv2.setNumThreads(1)
    warm()
    hub = Hub(TreedockConfig())
    context, config = _RealTime(hub, "slam"), SlamConfig()
    maps = LiveMaps(config, folder, context.health)
    service = SlamService(context, config, maps)
    live = Live()
    poses: list[Pose] = []
    hub.context("listener").on(SLAM_POSE, poses.append)
    begin_s, cpu_s, feeding_s = time.perf_counter(), time.process_time(), 0.0
    for item in read_walk(walk):
        if item.index >= frames or time.perf_counter() - begin_s > LIMIT_S:
            break
        feed_s = time.thread_time()
        frame = _message(item)
        feeding_s += time.thread_time() - feed_s
        if rate_hz > 0.0:
            late_s = time.perf_counter() - begin_s - item.index / rate_hz
            if late_s > 1.0 / rate_hz:
                live.dropped += 1
                continue
            time.sleep(max(-late_s, 0.0))
        _take(live, service, context, frame)
        hub.run()
        if not live.first_pose_s and poses:
            live.first_pose_s = _age_s()
        _judge(live, poses[-1], item)
        if item.index % 100 == 0 and service.slam is not None:
            live.alive.append(len(service.slam.atlas.slots))
    wall_s = time.perf_counter() - begin_s
    live.cores = (time.process_time() - cpu_s - feeding_s) / wall_s
    live.resets = poses[-1].reset_counter
    live.keyframes = context.health.counters["keyframes"]
    if service.slam is not None:
        live.loops = service.slam.loops.closed // 2
    live.rss_mb = _peak_rss_mb()
    maps.end()
    return live


def _take(live: Live, service: object, context: MemoryContext, frame: RgbdFrame) -> None:
    whole_s, cpu_s = time.perf_counter(), time.thread_time()
    service.on_frame(frame)  # type: ignore[attr-defined]  # imported late
    live.whole_ms.append((time.perf_counter() - whole_s) * 1e3)
    live.whole_cpu_ms.append((time.thread_time() - cpu_s) * 1e3)
    live.track_ms.append(context.health.stage_ms["track"][-1])


def _judge(live: Live, pose: Pose, item: WalkFrame) -> None:
    if pose.T_map_camera is None:
        live.lost += 1
        return
    live.error_m.append(float(np.linalg.norm(from_transform(pose.T_map_camera)[:3, 3] - item.T_map_camera[:3, 3])))


def _message(item: WalkFrame) -> RgbdFrame:
    from services.simulator.render import DEFAULT_INTRINSICS

    up: NDArray[np.float64] = item.T_map_camera[:3, :3].T @ np.array([0.0, 0.0, 9.81])
    raw = (item.depth_m * np.float32(1000.0) + np.float32(0.5)).astype(np.uint16)
    colour = np.repeat(item.grey[:, :, None], 3, axis=2)
    return RgbdFrame(
        stamp_ns=_START_NS + item.index * 33_333_333, seq=item.index, intrinsics=DEFAULT_INTRINSICS,
        colour=colour.tobytes(), depth=raw.tobytes(), accel_camera=(float(up[0]), float(up[1]), float(up[2])),
    )  # fmt: skip


def _age_s() -> float:
    """Return how long this process has existed (proc(5), field 22 of stat)."""
    ticks = int(Path("/proc/self/stat").read_text(encoding="ascii").rpartition(")")[2].split()[19])
    return time.clock_gettime(time.CLOCK_BOOTTIME) - ticks / os.sysconf("SC_CLK_TCK")


def _peak_rss_mb() -> float:
    lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    return next((int(line.split()[1]) / 1024.0 for line in lines if line.startswith("VmHWM")), 0.0)


if __name__ == "__main__":
    prepare_process()
    path, count, rate, state = sys.argv[1:5]
    sys.stdout.write(json.dumps(asdict(run(Path(path), int(count), float(rate), Path(state)))) + "\n")
