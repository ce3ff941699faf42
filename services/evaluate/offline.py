"""The chain offline: slam, mapper, detector and refiner on the in-memory bus, frame by frame in lockstep.

The services are the live ones; only the bus differs. Every frame is processed, nothing depends on the wall clock, so
the same input and configuration give the same result.
"""

from __future__ import annotations

import importlib
import itertools
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from numpy.typing import NDArray

from schemas.camera import RgbdFrame
from schemas.slam import Pose
from schemas.topics import CAMERA_RGBD, SLAM_POSE, TREES_TARGET, VEHICLE_STATE
from schemas.trees import Target, Tree
from schemas.vehicle import VehicleState
from services.camera.sources.base import BadFrame
from services.common.clock import SimulatedClock
from services.common.config import TreedockConfig
from services.common.context import Context
from services.common.errors import InputError
from services.common.geometry import from_transform
from services.common.memory import Hub, MemoryContext
from services.evaluate.exports import Stamped, Viewpoints

if TYPE_CHECKING:
    from services.slam.slam import Slam

SETTLE_S = 3.0
"""Time that passes after the last frame: timers of the services fire, the last corrections reach the map."""

_ADJUSTMENTS = 2
"""Each throws out what the one before has shown to be wrong."""

_NO_POINTS = np.empty((0, 3), np.float32)
_NO_COLOURS = np.empty((0, 3), np.uint8)

Builder = Callable[[Context], Any]
"""A service's ``build``; what it returns is asked for the final results."""


@dataclass(slots=True)
class Counts:
    """What came in and what became of it."""

    frames: int = 0
    """Good frames that were processed."""
    tracked: int = 0
    """Frames with a pose when they came."""
    skipped: list[str] = field(default_factory=list)
    """Why each bad frame was left out."""


@dataclass(frozen=True, slots=True)
class OfflineResult:
    """All that one run found, in map."""

    counts: Counts
    trajectory: list[Stamped]
    """Final estimate, T_map_camera of each tracked frame."""
    online: list[Stamped]
    """The poses as a live run would have published them."""
    points_m: NDArray[np.float32]
    rgb: NDArray[np.uint8]
    trees: list[Tree]
    targets: list[Target]
    stage_ms: dict[str, list[float]]
    """Durations of each service's stages and, as ``frame``, of the whole chain per frame."""
    counters: dict[str, int]
    setup_s: float
    """Importing the services and loading (on a machine's first run: compiling) their kernels."""
    duration_s: float
    """Of all, with the set-up."""
    seen: Viewpoints | None = None
    """From where each of ``points_m`` was seen."""
    adjusted: list[Stamped] = field(default_factory=list)
    """The trajectory after a last adjustment of all keyframes together, where that was asked for."""


def default_builders() -> dict[str, Builder]:
    """Return the chain's services; importing them is the slow part."""
    modules = {
        "slam": "services.slam.service",
        "mapper": "services.mapper.service",
        "detector": "services.detector.service",
        "refiner": "services.detector.refine.service",
    }
    return {name: importlib.import_module(module).build for name, module in modules.items()}


class Chain:
    """The services of the chain on one hub, and what they said."""

    def __init__(self, config: TreedockConfig, builders: Mapping[str, Builder] | None, start_ns: int) -> None:
        self._begin_s = time.perf_counter()
        builders = default_builders() if builders is None else builders
        self._hub = Hub(config, SimulatedClock(start_ns), config.uav)
        self._contexts: dict[str, MemoryContext] = {name: self._hub.context(name) for name in builders}
        # mypy: the protocol's clock is writable, so it wants exactly Clock
        self._services = {name: build(cast("Context", self._contexts[name])) for name, build in builders.items()}
        self._setup_s = time.perf_counter() - self._begin_s
        self._camera, self._autopilot = self._hub.context("camera"), self._hub.context("autopilot")
        self._frame_ms: list[float] = []
        self._online: list[Stamped] = []
        self._targets: list[Target] = []
        self.counts = Counts()
        listener = self._hub.context("process")
        listener.on(SLAM_POSE, self._on_pose)
        listener.on(TREES_TARGET, self._on_target)

    def feed(self, frame: RgbdFrame) -> None:
        """Process one frame to the end of everything it causes."""
        begin = time.perf_counter()
        self._hub.advance_to(frame.stamp_ns)
        self._camera.publish(CAMERA_RGBD, frame)
        self._hub.run()
        self._frame_ms.append((time.perf_counter() - begin) * 1e3)
        self.counts.frames += 1

    def follow(self, keyframes_ns: Iterable[int]) -> None:
        """Have slam make keyframes of the frames with these stamps."""
        slam = self._services.get("slam")
        if slam is not None:
            slam.keyframes_ns = tuple(keyframes_ns)

    def hear(self, state: VehicleState) -> None:
        """Take what the autopilot said."""
        self._autopilot.publish(VEHICLE_STATE, state)
        self._hub.run()

    def result(self, adjust_keyframes: int = 0) -> OfflineResult:
        """Let the chain come to rest and collect the final estimates; a service left out contributes nothing.

        With ``adjust_keyframes`` a last bundle adjustment of up to so many keyframes gives ``adjusted``; nothing else changes.
        """
        self._hub.advance_to(self._hub.clock.now_ns() + round(SETTLE_S * 1e9))
        slam, mapper, detector = (self._services.get(name) for name in ("slam", "mapper", "detector"))
        core = None if slam is None else slam.slam
        cloud = None if mapper is None else mapper.cloud()
        trajectory = [] if core is None else list(core.final_trajectory())
        return OfflineResult(
            counts=self.counts,
            trajectory=trajectory,
            adjusted=_adjusted(core, adjust_keyframes),
            online=self._online,
            points_m=_NO_POINTS if cloud is None else cloud.points_m,
            rgb=_NO_COLOURS if cloud is None else cloud.rgb,
            trees=[] if detector is None else list(detector.final_trees()),
            targets=self._targets,
            stage_ms=self._stages(),
            counters=self._counters(),
            setup_s=self._setup_s,
            duration_s=time.perf_counter() - self._begin_s,
            seen=None if mapper is None else _viewpoints(mapper.map.submaps.values()),
        )

    def _on_pose(self, pose: Pose) -> None:
        if pose.T_map_camera is not None:
            self._online.append((pose.stamp_ns, from_transform(pose.T_map_camera)))
            self.counts.tracked += 1

    def _on_target(self, target: Target) -> None:
        self._targets.append(target)

    def _stages(self) -> dict[str, list[float]]:
        stages = {"frame": self._frame_ms}
        for name, context in self._contexts.items():
            stages.update({f"{name}.{stage}": list(ms) for stage, ms in sorted(context.health.stage_ms.items())})
        return stages

    def _counters(self) -> dict[str, int]:
        return {
            f"{name}.{counter}": value
            for name, context in self._contexts.items()
            for counter, value in sorted(context.health.counters.items())
        }


def _adjusted(core: Slam | None, keyframes: int) -> list[Stamped]:
    """Return the trajectory after adjusting all keyframes together until that no longer helps much."""
    if core is None or not keyframes:
        return []
    for _ in range(_ADJUSTMENTS):
        core.crew.submit(lambda: core.mapping.adjust_all(most=keyframes))
    return list(core.final_trajectory())


def _viewpoints(submaps: Iterable[Any]) -> Viewpoints | None:
    """Return the keyframes that the map's points were seen from; None where the map holds none, or too many to number."""
    held = list(submaps)
    if not held or len(held) > np.iinfo(np.uint16).max:
        return None
    index = np.repeat(np.arange(len(held), dtype=np.uint16), [len(s.points_m) for s in held])
    return Viewpoints(index, np.stack([s.T_map_submap for s in held]))


def run_offline(
    frames: Iterable[RgbdFrame | BadFrame],
    config: TreedockConfig,
    *,
    builders: Mapping[str, Builder] | None = None,
    companions: Iterable[VehicleState] = (),
    keyframes_ns: Iterable[int] = (),
    skip_bad_frames: bool = False,
    adjust_keyframes: int = 0,
    progress: Callable[[Counts], None] | None = None,
) -> OfflineResult:
    """Process all frames.

    Args:
        frames: a source; stamps must rise.
        config: of every service.
        builders: the services by name (slam, mapper, detector, refiner, or some of them); by default the real ones.
        companions: what the autopilot said meanwhile, in order of time; each is heard before the first frame after it.
        keyframes_ns: stamps of the keyframes that a flight made of these frames; slam follows them.
        skip_bad_frames: go on past frames that cannot be used, and count them.
        adjust_keyframes: adjust up to so many keyframes together once more at the end (``OfflineResult.adjusted``).
        progress: called after each frame with the counts so far.

    Raises:
        InputError: a bad frame (unless skipped), or no good frame at all.
    """
    skipped: list[str] = []
    good = _good(frames, skipped, skip_bad_frames=skip_bad_frames)
    first = next(good, None)
    if first is None:
        raise InputError(
            f"no usable frame among {len(skipped)}: {skipped[0]}" if skipped else "the source has no frames"
        )
    chain = Chain(config, builders, first.stamp_ns)
    chain.counts.skipped = skipped
    chain.follow(keyframes_ns)
    heard = iter(companions)
    waiting = next(heard, None)
    for frame in itertools.chain([first], good):
        while waiting is not None and waiting.stamp_ns <= frame.stamp_ns:
            chain.hear(waiting)
            waiting = next(heard, None)
        chain.feed(frame)
        if progress is not None:
            progress(chain.counts)
    return chain.result(adjust_keyframes)


def _good(frames: Iterable[RgbdFrame | BadFrame], skipped: list[str], *, skip_bad_frames: bool) -> Iterator[RgbdFrame]:
    """Yield the good frames; note the bad ones, or stop at the first."""
    last_ns = -1
    for item in frames:
        if isinstance(item, RgbdFrame) and item.stamp_ns > last_ns:
            last_ns = item.stamp_ns
            yield item
            continue
        late = f"frame {item.seq}: its stamp {item.stamp_ns} does not rise" if isinstance(item, RgbdFrame) else ""
        reason = item.reason if isinstance(item, BadFrame) else late
        if not skip_bad_frames:
            raise InputError(f"{reason} (--skip-bad-frames goes on without such frames)")
        skipped.append(reason)
