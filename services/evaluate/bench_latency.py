"""From the camera's stamp to ``trees/target``: the real services as processes, joined by the bus, over a recording.

A frame's stamp is when the camera was due to send it, on the machine's one clock; an observer notes when frame, pose
and target of each stamp arrive. What lies between two arrivals is a stage; its parts come from the services' health.
"""

from __future__ import annotations

import contextlib
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self

import numpy as np

from schemas.camera import RgbdFrame
from schemas.health import Health
from schemas.slam import Pose
from schemas.topics import CAMERA_RGBD, HEALTH, SLAM_POSE, TREES_TARGET
from schemas.trees import Target
from services.common.config import TreedockConfig
from services.common.errors import InputError
from services.evaluate.bench import BenchOptions, BenchReport

SCENE = "multi-04"
RATES_HZ = (15.0, 30.0)
_RECORDED_HZ = 15.0
_FRAMES, _QUICK_FRAMES = 450, 90
_CHAIN = ("slam", "mapper", "detector", "refiner")
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
    health: dict[str, Health] = field(default_factory=dict)
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
        self.health[health.service] = health
        for stage in _PARTS.get(health.service, ()):
            if stage in health.work_ms:
                self.work_ms[f"{health.service} {stage}"].append(health.work_ms[stage])


def run(options: BenchOptions) -> BenchReport:
    """Replay a simulated recording (or one of ``--scenes tum:DIR``) through the live system at 15 and at 30 Hz."""
    name = options.scenes[0] if options.scenes else SCENE
    if options.seed is not None and not options.scenes:
        name = f"random-multi-{options.seed}"
    frames = _QUICK_FRAMES if options.quick else _FRAMES
    rates = RATES_HZ[:1] if options.quick else RATES_HZ
    figures: dict[str, float] = {}
    lines = [
        "| rate | frames | answered | measured | p50 (ms) | p90 | p99 | max |",
        "|---|---|---|---|---|---|---|---|",
    ]
    stages: list[str] = []
    with _recording(name, frames, options) as folder:
        for rate in rates:
            seen = measure(folder, rate / _RECORDED_HZ)
            found = figures_of(seen)
            first = rate == rates[0]
            figures |= found if first else {f"{key}_{rate:.0f}hz": value for key, value in found.items()}
            lines.append(_line(rate, found))
            stages += [*_stage_lines(rate, seen), ""]
            options.tell(lines[-1])
    conditions = {
        "recording": f"{name}, {frames} frames, JPEG and PNG files read by the camera service in its own process",
        "processes": "router, camera, slam, mapper, detector, refiner and the observer, Zenoh over TCP on one machine",
        "latency": "from the camera's stamp (when the frame was due) to the arrival of trees/target at the observer",
    }
    return BenchReport(figures, conditions, "\n".join([*lines, "", *stages]).rstrip())


@contextlib.contextmanager
def _recording(name: str, frames: int, options: BenchOptions) -> Iterator[Path]:
    if name.startswith("tum:"):
        yield Path(name.removeprefix("tum:"))
        return
    from services.simulator.catalogue import scene_by_name
    from services.simulator.write import write_sequence

    store = options.out / "sequences"
    store.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f"latency-{name}-", dir=store) as folder:
        options.tell(f"rendering {frames} frames of {name}")
        write_sequence(scene_by_name(name), Path(folder), rate_hz=_RECORDED_HZ, frames=frames)
        yield Path(folder)


def measure(recording: Path, speed: float) -> Passages:
    """Run the system over a recording, replayed ``speed`` times as fast as recorded, and watch it.

    Raises:
        InputError: the recording cannot be used, or a service ended or was not ready in time.
    """
    from services.camera.sources import open_source
    from services.common.bus import Bus
    from services.common.context import HealthBook
    from services.common.session import free_port, opened_client

    base = TreedockConfig()
    config = base.model_copy(update={
        "camera": base.camera.model_copy(update={"source": f"tum:{recording.resolve()}", "rate": speed}),
        "router": base.router.model_copy(update={"port": free_port(base.router.host)}),
    })  # fmt: skip
    open_source(config.camera.source, config.camera)  # finds its faults half a minute before the camera service would
    seen = Passages()
    with tempfile.TemporaryDirectory(prefix="treedock-latency-") as folder, _Processes(config, Path(folder)) as running:
        running.start("router")
        with opened_client(config.router.endpoint, lambda: False, wait_s=60.0) as session:
            bus = Bus(session, config.uav, HealthBook())
            bus.subscribe_keys(HEALTH, seen.on_health, at_once=True)
            bus.subscribe_keys(SLAM_POSE, seen.on_pose, at_once=True)
            bus.subscribe_keys(TREES_TARGET, seen.on_target, at_once=True)
            bus.subscribe_keys(CAMERA_RGBD, seen.on_frame, at_once=True)
            for name in _CHAIN:
                running.start(name)
            _wait(running, lambda: all(bus.alive(name) for name in _CHAIN), _READY_WITHIN_S, "services to be ready")
            running.start("camera")
            _wait(running, lambda: _count(seen, "camera", "source_done") > 0, 3600.0, "the recording's end")
            time.sleep(_DRAIN_S)
    return seen


def _count(seen: Passages, service: str, name: str) -> int:
    health = seen.health.get(service)
    return health.counters.get(name, 0) if health else 0


class _Processes:
    """The services' processes; all are gone at the end."""

    def __init__(self, config: TreedockConfig, folder: Path) -> None:
        self._folder = folder
        self._config = folder / "config.json"
        self._config.write_text(config.model_dump_json(), encoding="utf-8")
        self._processes: dict[str, subprocess.Popen[bytes]] = {}

    def __enter__(self) -> Self:
        return self

    def start(self, name: str) -> None:
        """Start a service."""
        command = [sys.executable, "-m", "services.cli.app", name, "--config", str(self._config)]
        with (self._folder / f"{name}.log").open("wb") as log:
            self._processes[name] = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=log, stderr=log)

    def check(self) -> None:
        """Raise InputError with the last words of a service that ended."""
        for name, process in self._processes.items():
            if process.poll() is not None:
                lines = (self._folder / f"{name}.log").read_text(errors="replace").strip().splitlines()
                raise InputError(f"{name} ended with {process.returncode}: {lines[-1] if lines else 'it said nothing'}")

    def __exit__(self, *_: object) -> None:
        for name in reversed(self._processes):
            process = self._processes[name]
            process.terminate()
            try:
                process.wait(timeout=5.0)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def _wait(running: _Processes, condition: Callable[[], bool], timeout_s: float, what: str) -> None:
    end_s = time.monotonic() + timeout_s
    while not condition():
        running.check()
        if time.monotonic() > end_s:
            raise InputError(f"waited {timeout_s:.0f} s for {what}")
        time.sleep(0.1)


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
        "frames": float(_count(seen, "camera", "frames")), "answered": float(len(ms)),
        "located": float(sum(p.located for p in passages)), "measured": float(sum(p.measured for p in passages)),
        "latency_ms_p50": round(float(p50), 2), "latency_ms_p90": round(float(p90), 2),
        "latency_ms_p99": round(float(p99), 2), "latency_ms_max": round(float(ms.max()), 2),
    }  # fmt: skip


def _line(rate_hz: float, f: dict[str, float]) -> str:
    return (
        f"| {rate_hz:.0f} Hz | {f['frames']:.0f} | {f['answered']:.0f} | {f['measured']:.0f} | {f['latency_ms_p50']:.1f} "
        f"| {f['latency_ms_p90']:.1f} | {f['latency_ms_p99']:.1f} | {f['latency_ms_max']:.1f} |"
    )


def stages_ms(seen: Passages) -> dict[str, list[float]]:
    """Return the stages of the frames that were seen at each: they add up to the latency."""
    whole = [(stamp, p) for stamp, p in seen.by_stamp.items() if p.frame_ns and p.pose_ns and p.target_ns]
    return {
        "camera: due, read, published, on the bus": [(p.frame_ns - stamp) * 1e-6 for stamp, p in whole],
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
