"""The way of each frame through the live system, seen by an observer on the bus: latencies and where they arise.

What lies between two arrivals is a stage; its parts come from the services' health.
"""

from __future__ import annotations

import time
from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from schemas.camera import RgbdFrame
from schemas.health import Health
from schemas.slam import Pose
from schemas.topics import CAMERA_RGBD, HEALTH, SLAM_POSE, TREES_TARGET, VEHICLE_STATE
from schemas.trees import Target
from schemas.vehicle import VehicleState
from services.common.errors import InputError

if TYPE_CHECKING:
    from services.common.bus import Bus

_FIRST_NS = 1_000_000_000
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
    health: dict[str, Health] = field(default_factory=dict)
    """The latest of each service."""
    connected: bool = False
    """Whether the autopilot's bridge hears its autopilot."""

    def observe(self, bus: Bus) -> None:
        """Listen from now on, on Zenoh's own thread."""
        bus.subscribe_keys(HEALTH, self.on_health, at_once=True)
        bus.subscribe_keys(SLAM_POSE, self.on_pose, at_once=True)
        bus.subscribe_keys(TREES_TARGET, self.on_target, at_once=True)
        bus.subscribe_keys(CAMERA_RGBD, self.on_frame, at_once=True)
        bus.subscribe_keys(VEHICLE_STATE, self.on_vehicle, at_once=True)

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

    def on_vehicle(self, _: str, vehicle: VehicleState) -> None:
        """Note whether the autopilot is there."""
        self.connected = vehicle.connected

    def on_health(self, _: str, health: Health) -> None:
        """Note how a service is and how long its stages took in the last second."""
        self.health[health.service] = health
        for stage in _PARTS.get(health.service, ()):
            if stage in health.work_ms:
                self.work_ms[f"{health.service} {stage}"].append(health.work_ms[stage])


def _stamps_ns(seen: Passages) -> np.ndarray[Any, np.dtype[np.int64]]:
    """Return the stamps of ``latencies_ms``."""
    return np.array([stamp for stamp, p in sorted(seen.by_stamp.items()) if p.target_ns], dtype=np.int64)


def latencies_ms(seen: Passages) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Return the latency of each answered frame in order of stamps."""
    answered = [(p.target_ns - stamp) * 1e-6 for stamp, p in sorted(seen.by_stamp.items()) if p.target_ns]
    return np.array(answered, dtype=np.float64)


def late_line(seen: Passages, late_ms: float) -> str:
    """Return when in the run frames were late, or never answered by slam: second of the run and how many."""
    begin_ns = min(seen.by_stamp, default=0)
    late = Counter(
        (stamp - begin_ns) // 1_000_000_000
        for stamp, p in seen.by_stamp.items() if p.target_ns and (p.target_ns - stamp) * 1e-6 > late_ms
    )  # fmt: skip
    without = sum(p.target_ns > 0 and p.pose_ns == 0 for p in seen.by_stamp.values())
    when = ", ".join(f"{n} in second {second}" for second, n in sorted(late.items())) or "none"
    return (
        f"Later than {late_ms:.0f} ms: {when}. Without a pose, so that the refiner waited for it in vain: {without}; slam leaves "
        f"frames out while mapping catches up, as when a loop is closed."
    )


def figures_of(seen: Passages) -> dict[str, float]:
    """Return the figures of one run. ``latency_ms_p99_under_way`` leaves out the first second, in which the first frame is.

    Raises:
        InputError: no frame was answered.
    """
    passages = list(seen.by_stamp.values())
    ms = latencies_ms(seen)
    if not len(ms):
        raise InputError("no frame was answered")
    p50, p90, p99 = np.quantile(ms, [0.5, 0.9, 0.99])
    under_way = ms[_stamps_ns(seen) >= min(seen.by_stamp) + _FIRST_NS]
    return {
        "frames": float(seen.sent), "answered": float(len(ms)),
        "located": float(sum(p.located for p in passages)), "measured": float(sum(p.measured for p in passages)),
        "latency_ms_p50": round(float(p50), 2), "latency_ms_p90": round(float(p90), 2),
        "latency_ms_p99": round(float(p99), 2), "latency_ms_max": round(float(ms.max()), 2),
        "latency_ms_p99_under_way": round(float(np.quantile(under_way if len(under_way) else ms, 0.99)), 2),
    }  # fmt: skip


HEAD = (
    "| rate | frames | answered | located | measured | p50 (ms) | p90 | p99 | max |",
    "|---|---|---|---|---|---|---|---|---|",
)


def line_of(rate_hz: float, f: dict[str, float]) -> str:
    """Return the figures as a row of the table that ``HEAD`` begins."""
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


def stage_lines(rate_hz: float, seen: Passages) -> Iterator[str]:
    """Yield the table of the stages."""
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
