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

_QUIET_REPORTS = 3
_CHAIN = {
    "slam": ("camera/rgbd", ("slam/keyframe", "slam/graph")),
    "mapper": ("slam/keyframe", ("map/cloud",)),
    "detector": ("map/cloud", ("trees/list",)),
}
"""What must have fallen quiet before nothing is under way any more: input and outputs of each, upstream first."""
_NUMBERED_AS_FRAMES = {
    "camera/rgbd": "camera", "camera/rgbd_compressed": "camera", "second/rgbd": "second_camera",
    "slam/pose": "slam", "second/pose": "second_slam", "trees/target": "refiner",
}  # fmt: skip
"""Topics whose messages have the number of the frame that they answer, and who answers it."""
_FRAMES_LOST = frozenset({
    "dropped.sim/rgbd", "dropped.sim/second", "dropped.camera/rgbd", "dropped.camera/rgbd_compressed", "dropped.second/rgbd",
    "dropped_bad_frame", "dropped_bad_frames",
})  # fmt: skip
"""Counters of frames that came and were not seen, or could not be used: who counts them sends no answer to them."""


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
    word: str = ""
    """The mission in a few words, where one is flown."""
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
        """Whether slam, mapper and detector are through: three reports in a row (a hung one sends none) without work."""
        return all(self._quiet.get(name, 0) >= _QUIET_REPORTS for name in _CHAIN if name in self.health)

    def dropped(self) -> dict[str, int]:
        """Return the samples that each service itself lost, its frames among them, where there are any."""
        return self._lost(lambda key: key.startswith("dropped"))

    def frames_left_out(self) -> dict[str, int]:
        """Return the frames that each service did not see or could not use, where there are any."""
        return self._lost(_FRAMES_LOST.__contains__)

    def _lost(self, counted: Callable[[str], bool]) -> dict[str, int]:
        sums = {
            name: sum(self._own(key, count) for key, count in health.counters.items() if counted(key))
            for name, health in self.health.items()
        }
        return {name: count for name, count in sorted(sums.items()) if count}

    def _own(self, key: str, count: int) -> int:
        """Return a count of lost samples without those that their producer never sent: its frames' gaps go on in them."""
        health = self.health.get(_NUMBERED_AS_FRAMES.get(key.removeprefix("dropped."), ""))
        unsent = 0 if health is None else sum(n for name, n in health.counters.items() if name in _FRAMES_LOST)
        return max(0, count - unsent)

    def _on_health(self, message: Health) -> None:
        self.health[message.service] = message
        if message.service in _CHAIN:
            self._note_work(message)
        self.on_health(message)

    def _note_work(self, message: Health) -> None:
        """Count reports without input; output makes everything behind it busy again."""
        topic_in, topics_out = _CHAIN[message.service]
        received = message.rates_hz.get(topic_in, 0.0) > 0.0
        sent = any(message.rates_hz.get(topic, 0.0) > 0.0 for topic in topics_out)
        idle = self.source_ended and not received and not sent
        self._quiet[message.service] = self._quiet.get(message.service, 0) + 1 if idle else 0
        if sent:
            names = list(_CHAIN)
            for later in names[names.index(message.service) + 1 :]:
                self._quiet[later] = 0

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
