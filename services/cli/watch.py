"""What ``treedock run`` sees of the system: everything it shows comes over the bus, as any other node would see it."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field

import zenoh

from schemas.health import Health
from schemas.navigation import MissionState
from schemas.simulation import SimClock, SimTruth
from schemas.slam import Pose
from schemas.topics import HEALTH, MISSION_STATE, SIM_CLOCK, SIM_TRUTH, SLAM_POSE, TREES_LIST
from schemas.trees import TreeList
from services.common.bus import Bus
from services.common.context import HealthBook

_QUIET_REPORTS = 2
_DRAINED_INPUTS = {"slam": "camera/rgbd", "mapper": "slam/keyframe", "detector": "map/cloud"}
"""The input that must have fallen quiet before a service has nothing under way."""


@dataclass
class Watch:
    """The latest of everything worth showing. ``pump`` brings it up to date."""

    session: zenoh.Session
    uav: str
    on_health: Callable[[Health], None]
    health: dict[str, Health] = field(default_factory=dict)
    trees: TreeList | None = None
    clock: SimClock | None = None
    truth: SimTruth | None = None
    pose: Pose | None = None
    mission: MissionState | None = None
    _quiet: dict[str, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.bus = Bus(self.session, self.uav, HealthBook())
        self.bus.subscribe(HEALTH, self._on_health)
        self.bus.subscribe(TREES_LIST, self._on_trees)
        self.bus.subscribe(SLAM_POSE, self._on_pose)
        self.bus.subscribe(SIM_CLOCK, self._on_clock)
        self.bus.subscribe(SIM_TRUTH, self._on_truth)
        self.bus.subscribe(MISSION_STATE, self._on_mission)

    def pump(self, for_s: float) -> None:
        """Take in what comes for ``for_s`` seconds."""
        until_s = time.monotonic() + for_s
        while True:
            while (taken := self.bus.inbox.take()) is not None:
                taken[0].handler(taken[1])
            left_s = until_s - time.monotonic()
            if left_s <= 0.0:
                return
            time.sleep(min(0.05, left_s))  # a screen needs no sooner news

    @property
    def frames(self) -> int:
        """Frames that the camera has sent so far."""
        camera = self.health.get("camera")
        return camera.counters.get("frames", 0) if camera else 0

    @property
    def source_ended(self) -> bool:
        """Whether no further frame will come."""
        camera = self.health.get("camera")
        return (self.clock is not None and self.clock.phase == "done") or (
            camera is not None and camera.counters.get("source_done", 0) > 0
        )

    @property
    def drained(self) -> bool:
        """Whether slam, mapper and detector have worked off their inputs: two reports in a row without any."""
        return all(self._quiet.get(name, 0) >= _QUIET_REPORTS for name in _DRAINED_INPUTS if name in self.health)

    def dropped(self) -> dict[str, int]:
        """Return the dropped samples per service, where there are any."""
        sums = {
            name: sum(count for key, count in health.counters.items() if key.startswith("dropped"))
            for name, health in self.health.items()
        }
        return {name: count for name, count in sorted(sums.items()) if count}

    def _on_health(self, message: Health) -> None:
        name = message.service
        before = self.health.get(name)
        self.health[name] = message
        topic = _DRAINED_INPUTS.get(name)
        if topic is not None:
            busy = message.rates_hz.get(topic, 0.0) > 0.0 or (
                name == "detector" and self._trees_changed(before, message)
            )
            self._quiet[name] = 0 if busy or not self.source_ended else self._quiet.get(name, 0) + 1
        self.on_health(message)

    @staticmethod
    def _trees_changed(before: Health | None, now: Health) -> bool:
        return before is None or now.rates_hz.get("trees/list", 0.0) > 0.0

    def _on_trees(self, message: TreeList) -> None:
        self.trees = message

    def _on_pose(self, message: Pose) -> None:
        self.pose = message

    def _on_clock(self, message: SimClock) -> None:
        self.clock = message

    def _on_truth(self, message: SimTruth) -> None:
        self.truth = message

    def _on_mission(self, message: MissionState) -> None:
        self.mission = message
