"""What the bus says of flights, kept for judging: states, guidance, the vehicle, the truth. Times are the services' own."""

from __future__ import annotations

from bisect import bisect_left
from collections import deque
from dataclasses import dataclass, field

import numpy as np

from schemas.navigation import Guidance, MissionState
from schemas.simulation import SimClock, SimTruth
from schemas.slam import Pose
from schemas.topics import (
    MISSION_GUIDANCE,
    MISSION_STATE,
    SIM_CLOCK,
    SIM_TRUTH,
    SLAM_POSE,
    TREES_LIST,
    VEHICLE_STATE,
)
from schemas.trees import TreeList
from schemas.vehicle import VehicleState
from services.common.bus import Bus

ENDED = frozenset({"landed", "released", "failed"})
FLYING = frozenset({"take_off", "scan", "select", "face", "approach", "dock", "docked", "undock", "return", "hold"})
_KEPT = 20_000


@dataclass
class Flown:
    """The latest of everything and the histories; ``Flown.listen`` subscribes."""

    states: deque[MissionState] = field(default_factory=lambda: deque(maxlen=_KEPT))
    guidance: deque[Guidance] = field(default_factory=lambda: deque(maxlen=_KEPT))
    vehicles: deque[VehicleState] = field(default_factory=lambda: deque(maxlen=_KEPT))
    truths: deque[SimTruth] = field(default_factory=lambda: deque(maxlen=_KEPT))
    poses: int = 0
    trees: TreeList | None = None
    now_ns: int = 0
    """Simulated time, where it is."""
    armings: int = 0
    """How often the vehicle went from disarmed to armed."""
    docks: int = 0
    done: bool = False
    """The simulation is over."""

    def listen(self, bus: Bus) -> None:
        """Subscribe to what is kept."""
        bus.subscribe(MISSION_STATE, self._on_state)
        bus.subscribe(MISSION_GUIDANCE, self.guidance.append)
        bus.subscribe(VEHICLE_STATE, self._on_vehicle)
        bus.subscribe(SIM_TRUTH, self.truths.append)
        bus.subscribe(SLAM_POSE, self._on_pose)
        bus.subscribe(TREES_LIST, self._on_trees)
        bus.subscribe_keys(SIM_CLOCK, self._on_clock, at_once=True)

    def _on_clock(self, _: str, clock: SimClock) -> None:
        self.now_ns = max(self.now_ns, clock.stamp_ns)
        self.done = clock.phase == "done"

    def _on_state(self, state: MissionState) -> None:
        entered = not self.states or self.states[-1].since_ns != state.since_ns
        self.docks += int(state.state == "docked" and entered)
        self.states.append(state)

    def _on_vehicle(self, vehicle: VehicleState) -> None:
        before = self.vehicles[-1] if self.vehicles else None
        # the bridge does not know at its own start: what it says before the first heartbeat is no landing
        if vehicle.connected:
            self.armings += int(before is not None and vehicle.armed and not before.armed)
            self.vehicles.append(vehicle)

    def _on_pose(self, _: Pose) -> None:
        self.poses += 1

    def _on_trees(self, trees: TreeList) -> None:
        self.trees = trees

    # -- the present

    @property
    def state(self) -> str:
        """The mission's state, nothing before the navigator spoke."""
        return self.states[-1].state if self.states else ""

    @property
    def mission_id(self) -> int:
        """The mission's number, 0 before the first."""
        return self.guidance[-1].mission_id if self.guidance else 0

    @property
    def vehicle(self) -> VehicleState | None:
        """The vehicle, as told last."""
        return self.vehicles[-1] if self.vehicles else None

    @property
    def armed(self) -> bool:
        """Whether the vehicle is armed."""
        return self.vehicle is not None and self.vehicle.armed

    @property
    def touches(self) -> int:
        """How often the aircraft touched something so far."""
        return self.truths[-1].touched if self.truths else 0

    # -- judged

    def held_after_s(self, from_ns: int) -> float | None:
        """Return when after ``from_ns`` somebody held or landed: mission, bridge, or PX4 by itself; None: nobody did."""
        times = [
            s.since_ns for s in self.states if s.since_ns >= from_ns and s.state in {"hold", "landing", "released"}
        ]
        for vehicle in self.vehicles:
            if vehicle.stamp_ns >= from_ns and ("holding" in vehicle.note or vehicle.mode in {"land", "descend"}):
                times.append(vehicle.stamp_ns)
                break
        return (min(times) - from_ns) * 1e-9 if times else None

    def rest_after_s(self, from_ns: int, still_m_s: float = 0.2) -> float | None:
        """Return when after ``from_ns`` the true aircraft had come to rest over ground for half a second; None: never."""
        truths = [t for t in self.truths if t.stamp_ns >= from_ns]
        stamps = [t.stamp_ns for t in truths]
        for i, truth in enumerate(truths):
            j = bisect_left(stamps, truth.stamp_ns + 500_000_000)
            if j >= len(truths):
                return None
            way = np.subtract(truths[j].T_map_camera.position_m[:2], truth.T_map_camera.position_m[:2])
            if float(np.linalg.norm(way)) / ((stamps[j] - stamps[i]) * 1e-9) < still_m_s:
                return (truth.stamp_ns - from_ns) * 1e-9
        return None

    def way_m(self, from_ns: int, until_ns: int) -> float:
        """Return how far over ground the true aircraft was from where it was at ``from_ns``, at most, until ``until_ns``."""
        places = [t.T_map_camera.position_m[:2] for t in self.truths if from_ns <= t.stamp_ns <= until_ns]
        return max((float(np.hypot(p[0] - places[0][0], p[1] - places[0][1])) for p in places), default=0.0)

    def bridge_landed(self, from_ns: int) -> str:
        """Return why the bridge landed by itself after ``from_ns``, as it told; empty when it did not."""
        words = (v.note for v in reversed(self.vehicles) if v.stamp_ns >= from_ns and "no guidance: landing" in v.note)
        return next(words, "")

    def reason(self) -> str:
        """Return why the mission is in its state."""
        return self.states[-1].reason if self.states else ""
