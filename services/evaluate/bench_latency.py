"""From the camera's stamp to ``trees/target``: the real services as processes, joined by the bus, over a recording.

This process is the sensor: it holds the recording's raw images in memory, as a camera would deliver them, and hands them
to the camera service at the rate asked for, stamped when it does. It also observes: it notes when frame, pose and target
of each stamp arrive. What lies between two arrivals is a stage; its parts come from the services' health. Frames are
dropped where a service is still busy, as from any camera.
"""

from __future__ import annotations

import itertools
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from schemas.camera import RgbdFrame
from schemas.health import Health
from schemas.slam import Pose
from schemas.topics import CAMERA_RGBD, HEALTH, SIM_RGBD, SLAM_POSE, TREES_TARGET
from schemas.trees import Target
from services.common.config import TreedockConfig
from services.common.errors import InputError
from services.evaluate.bench import BenchOptions, BenchReport, code_version
from services.evaluate.processes import Processes

if TYPE_CHECKING:
    from services.common.bus import Bus

SCENE = "multi-04"
RATES_HZ = (15.0, 30.0)
_RECORDED_HZ = 15.0
_FRAMES, _QUICK_FRAMES = 330, 90
_SERVICES = ("camera", "slam", "mapper", "detector", "refiner")
_READY_WITHIN_S = 240.0
_DRAIN_S = 2.0
_PARTS = {"slam": ("track",), "refiner": ("wait_for_pose", "refine"), "camera": ("frame",)}


@dataclass(slots=True)
class Passage:
    """One frame's way: arrivals at the observer, ns of the machine's clock; 0 what never came."""

    frame_ns: int = 0
    pose_ns: int = 0
    target_ns: int = 0
    track_ms: float = 0.0
    located: bool = False
    measured: bool = False


@dataclass
class Passages:
    """What the observer saw, by stamp."""

    by_stamp: defaultdict[int, Passage] = field(default_factory=lambda: defaultdict(Passage))
    sent: int = 0
    work_ms: defaultdict[str, list[float]] = field(default_factory=lambda: defaultdict(list))
    """Medians of the services' stages over each second."""

    def on_frame(self, _: str, frame: RgbdFrame) -> None:
        """Note a frame's arrival."""
        self.by_stamp[frame.stamp_ns].frame_ns = time.time_ns()

    def on_pose(self, _: str, pose: Pose) -> None:
        """Note a pose's arrival."""
        passage = self.by_stamp[pose.stamp_ns]
        passage.pose_ns, passage.track_ms = time.time_ns(), pose.processing_ms
        passage.located = pose.T_map_camera is not None

    def on_target(self, _: str, target: Target) -> None:
        """Note a target's arrival."""
        passage = self.by_stamp[target.stamp_ns]
        passage.target_ns, passage.measured = time.time_ns(), target.measured

    def on_health(self, _: str, health: Health) -> None:
        """Note how a service is and how long its stages took in the last second."""
        for stage in _PARTS.get(health.service, ()):
            if stage in health.work_ms:
                self.work_ms[f"{health.service} {stage}"].append(health.work_ms[stage])


def run(options: BenchOptions) -> BenchReport:
    """Send a simulated recording (or one of ``--scenes tum:DIR``) through the live system at 15 and at 30 Hz."""
    name = options.scenes[0] if options.scenes else SCENE
    if options.seed is not None and not options.scenes:
        name = f"random-multi-{options.seed}"
    wanted = _QUICK_FRAMES if options.quick else _FRAMES
    rates = RATES_HZ[:1] if options.quick else RATES_HZ
    figures: dict[str, float] = {}
    lines = [
        "| rate | frames | answered | located | measured | p50 (ms) | p90 | p99 | max |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    stages: list[str] = []
    frames = read_frames(_recording(name, wanted, options), wanted)
    for rate in rates:
        seen = measure(frames, rate)
        found = figures_of(seen)
        figures |= found if rate == rates[0] else {f"{key}_{rate:.0f}hz": value for key, value in found.items()}
        lines.append(_line(rate, found))
        stages += [*_stage_lines(rate, seen), ""]
        options.tell(lines[-1])
    conditions = {
        "recording": f"{name}, {len(frames)} raw frames of {frames[0].intrinsics.width}x{frames[0].intrinsics.height} from memory",
        "processes": "router, camera, slam, mapper, detector, refiner, and this one; Zenoh on one machine",
        "latency": "from the camera's stamp to the arrival of trees/target at an observer",
    }
    return BenchReport(figures, conditions, "\n".join([*lines, "", *stages]).rstrip())


def _recording(name: str, frames: int, options: BenchOptions) -> Path:
    """Return the folder of a recording; a rendered one is kept for the next call."""
    if name.startswith("tum:"):
        return Path(name.removeprefix("tum:"))
    from services.simulator.catalogue import scene_by_name
    from services.simulator.write import write_sequence

    store = options.out / "sequences"
    kept = store / f"latency-{name}-{frames}-{code_version(('services.simulator',))}"
    if not kept.is_dir():
        store.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=f"latency-{name}-", dir=store) as folder:
            options.tell(f"rendering {frames} frames of {name}")
            sequence = Path(folder) / name
            write_sequence(scene_by_name(name), sequence, rate_hz=_RECORDED_HZ, frames=frames)
            sequence.rename(kept)
    return kept


def read_frames(recording: Path, count: int) -> list[RgbdFrame]:
    """Return the first good frames of a recording.

    Raises:
        InputError: there are none, or the recording cannot be used.
    """
    from services.camera.sources import open_recording

    source = open_recording(recording, TreedockConfig().camera)
    frames = list(itertools.islice((item for item in source if isinstance(item, RgbdFrame)), count))
    if not frames:
        raise InputError(f"{recording}: no usable frame")
    return frames


def measure(frames: Sequence[RgbdFrame], rate_hz: float) -> Passages:
    """Run the system over raw frames at a rate, and watch it.

    Raises:
        InputError: a service ended, or was not ready in time.
    """
    from services.common.bus import Bus
    from services.common.context import HealthBook
    from services.common.session import free_port, opened_client

    base = TreedockConfig()
    config = base.model_copy(update={
        "camera": base.camera.model_copy(update={"source": "sim"}),
        "router": base.router.model_copy(update={"port": free_port(base.router.host)}),
    })  # fmt: skip
    seen = Passages()
    with tempfile.TemporaryDirectory(prefix="treedock-latency-") as folder, Processes(config, Path(folder)) as running:
        running.start("router")
        with opened_client(config.router.endpoint, lambda: False, wait_s=60.0) as session:
            bus = Bus(session, config.uav, HealthBook())
            bus.subscribe_keys(HEALTH, seen.on_health, at_once=True)
            bus.subscribe_keys(SLAM_POSE, seen.on_pose, at_once=True)
            bus.subscribe_keys(TREES_TARGET, seen.on_target, at_once=True)
            bus.subscribe_keys(CAMERA_RGBD, seen.on_frame, at_once=True)
            for name in _SERVICES:
                running.start(name)
            running.wait(lambda: all(bus.alive(name) for name in _SERVICES), _READY_WITHIN_S, "services to be ready")
            _send(bus, frames, rate_hz, running, seen)
            time.sleep(_DRAIN_S)
    return seen


def _send(bus: Bus, frames: Sequence[RgbdFrame], rate_hz: float, running: Processes, seen: Passages) -> None:
    """Hand out the frames, each at its time."""
    begin_s = time.monotonic()
    for k, frame in enumerate(frames):
        time.sleep(max(0.0, begin_s + k / rate_hz - time.monotonic()))
        stamp_ns = time.time_ns()
        bus.publish(SIM_RGBD, replace(frame, stamp_ns=stamp_ns, seq=k))
        seen.sent += 1
        if k % 15 == 0:
            running.check()


def latencies_ms(seen: Passages) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Return the latency of each answered frame in order of stamps."""
    answered = [(p.target_ns - stamp) * 1e-6 for stamp, p in sorted(seen.by_stamp.items()) if p.target_ns]
    return np.array(answered, dtype=np.float64)


def figures_of(seen: Passages) -> dict[str, float]:
    """Return the figures of one run."""
    passages = list(seen.by_stamp.values())
    ms = latencies_ms(seen)
    if not len(ms):
        raise InputError("no frame was answered")
    p50, p90, p99 = np.quantile(ms, [0.5, 0.9, 0.99])
    return {
        "frames": float(seen.sent), "answered": float(len(ms)),
        "located": float(sum(p.located for p in passages)), "measured": float(sum(p.measured for p in passages)),
        "latency_ms_p50": round(float(p50), 2), "latency_ms_p90": round(float(p90), 2),
        "latency_ms_p99": round(float(p99), 2), "latency_ms_max": round(float(ms.max()), 2),
    }  # fmt: skip


def _line(rate_hz: float, f: dict[str, float]) -> str:
    return (
        f"| {rate_hz:.0f} Hz | {f['frames']:.0f} | {f['answered']:.0f} | {f['located']:.0f} | {f['measured']:.0f} | {f['latency_ms_p50']:.1f} "
        f"| {f['latency_ms_p90']:.1f} | {f['latency_ms_p99']:.1f} | {f['latency_ms_max']:.1f} |"
    )


def stages_ms(seen: Passages) -> dict[str, list[float]]:
    """Return the stages of the frames that were seen at each: they add up to the latency."""
    whole = [(stamp, p) for stamp, p in seen.by_stamp.items() if p.frame_ns and p.pose_ns and p.target_ns]
    return {
        "camera: to the service, conditioned, on the bus": [(p.frame_ns - stamp) * 1e-6 for stamp, p in whole],
        "to slam and back, without tracking": [(p.pose_ns - p.frame_ns) * 1e-6 - p.track_ms for _, p in whole],
        "slam: tracking": [p.track_ms for _, p in whole],
        "refiner: pose to target": [(p.target_ns - p.pose_ns) * 1e-6 for _, p in whole],
    }


def _stage_lines(rate_hz: float, seen: Passages) -> Iterator[str]:
    stages = stages_ms(seen)
    total = sum(float(np.mean(ms)) for ms in stages.values() if ms)
    yield f"| stage at {rate_hz:.0f} Hz | p50 (ms) | p99 (ms) | share of the mean |"
    yield "|---|---|---|---|"
    for name, ms in stages.items():
        if ms:
            p50, p99 = np.quantile(ms, [0.5, 0.99])
            yield f"| {name} | {p50:.1f} | {p99:.1f} | {float(np.mean(ms)) / total:.0%} |"
    yield ""
    parts = {name: float(np.median(values)) for name, values in sorted(seen.work_ms.items())}
    yield "Medians told by the services: " + ", ".join(f"{name} {ms:.1f} ms" for name, ms in parts.items()) + "."
