"""One aircraft as the station knows it: the latest of everything, its trail, and the events that follow. Pure."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from schemas.fleet import HeldState
from schemas.fusion import Carrier, FusionState
from schemas.health import Health
from schemas.navigation import MissionState
from schemas.slam import Pose
from schemas.trees import Target, TreeList
from schemas.vehicle import VehicleState
from services.common.geometry import camera_yaw, from_transform
from services.station.ages import LinkAges
from services.station.events import EventKind, EventLevel, EventLog
from services.station.trail import Trail

_TRAIL_STEP_M = 0.10
_TRAIL_STEP_RAD = math.radians(8.0)
_BAD_STATES = frozenset({"failed", "released"})
_GOOD_STATES = frozenset({"docked", "landed"})
_BATTERY_WARN = 0.30
_GPS_BAD = frozenset({"distrusted", "silent"})
CARRIER_WORDS: dict[Carrier, str] = {
    "camera": "the camera gives the pose", "second": "the second camera carries the pose", "imu": "the IMU carries the pose",
    "none": "nothing carries the pose",
}  # fmt: skip
_CARRIER_LEVEL: dict[Carrier, EventLevel] = {"camera": "good", "second": "warn", "imu": "warn", "none": "bad"}


@dataclass(slots=True)
class Aircraft:
    """The latest of everything from one aircraft; ``trees_version`` counts what its page must show anew."""

    uav: str
    log: EventLog
    links: LinkAges = field(default_factory=LinkAges)
    pose: Pose | None = None
    placed: tuple[float, float, float, float] | None = None
    """The last trusted place: x, y, z, yaw."""
    mission: MissionState | None = None
    target: Target | None = None
    vehicle: VehicleState | None = None
    held: HeldState | None = None
    fusion: FusionState | None = None
    trees: TreeList | None = None
    trees_version: int = 0
    health: dict[str, Health] = field(default_factory=dict)
    live: set[str] = field(default_factory=set)
    trail: Trail = field(default_factory=Trail)
    trail_map: str = ""
    map_begun_in_air: bool = False
    """The present map replaced another while the aircraft flew: it does not begin at the start point."""
    link_was: str = "none"

    def on_pose(self, pose: Pose) -> None:
        """Take the pose; the trail begins anew in a new map."""
        if self.pose is not None and pose.status != self.pose.status and "lost" in (pose.status, self.pose.status):
            lost = pose.status == "lost"
            self._tell("mission", "warn" if lost else "good", f"slam: {pose.status}")
        self.pose = pose
        if pose.map_id != self.trail_map:
            flying = self.vehicle is not None and self.vehicle.landed != "on_ground"
            self.map_begun_in_air = flying and self.trail_map != ""
            self.trail_map = pose.map_id
            self.trail.clear()
            self.placed = None
        if pose.T_map_camera is None:
            return
        T = from_transform(pose.T_map_camera)
        x, y, z = (float(v) for v in T[:3, 3])
        self.placed = (x, y, z, camera_yaw(T))
        self._extend_trail(self.placed)

    def _extend_trail(self, place: tuple[float, float, float, float]) -> None:
        x, y, z, yaw = place
        if (last := self.trail.newest) is not None:
            turned = abs(math.remainder(yaw - last[2], 2.0 * math.pi))
            if math.hypot(x - last[0], y - last[1]) < _TRAIL_STEP_M and turned < _TRAIL_STEP_RAD:
                return
        self.trail.append((x, y, yaw, z))

    def on_mission(self, mission: MissionState) -> None:
        """Take the mission's state and tell of changes."""
        before = self.mission
        self.mission = mission
        if before is None or (before.state, before.since_ns) != (mission.state, mission.since_ns):
            self._tell("mission", _level_of(mission), f"{mission.state}: {mission.reason}")
        elif before.failsafe != mission.failsafe:
            word = f"failsafe {mission.failsafe}: {mission.reason}" if mission.failsafe else "failsafe over"
            self._tell("mission", "warn" if mission.failsafe else "good", word)

    def on_target(self, target: Target) -> None:
        """Take what the depth image shows."""
        self.target = target

    def on_held(self, held: HeldState) -> None:
        """Take what the aircraft believes to hold."""
        self.held = held

    def on_fusion(self, fusion: FusionState) -> None:
        """Take fusion's account of itself and tell of changes of who carries the pose and of the trust in GPS."""
        before, self.fusion = self.fusion, fusion
        if before is None or before.carrier != fusion.carrier:
            self._tell("mission", _CARRIER_LEVEL[fusion.carrier], f"fusion: {CARRIER_WORDS[fusion.carrier]}")
        if before is not None and before.gps != fusion.gps:
            word = f": {fusion.gps_word}" if fusion.gps_word else ""
            self._tell("mission", "warn" if fusion.gps in _GPS_BAD else "info", f"GPS {fusion.gps}{word}")

    def on_vehicle(self, vehicle: VehicleState) -> None:
        """Take the vehicle's state and tell of changes of mode, arming, battery and connection."""
        before = self.vehicle
        self.vehicle = vehicle
        if before is None:
            return
        if (before.mode, before.armed) != (vehicle.mode, vehicle.armed):
            self._tell("mission", "info", f"mode {vehicle.mode}, {'armed' if vehicle.armed else 'disarmed'}")
        if before.connected != vehicle.connected:
            self._tell("link", "good" if vehicle.connected else "bad",
                       "autopilot connected" if vehicle.connected else "autopilot link lost")  # fmt: skip
        if vehicle.operator_override and not before.operator_override:
            self._tell("mission", "bad", "the pilot took over: the mission is silent")
        now, earlier = vehicle.battery_share, before.battery_share
        if now is not None and now < _BATTERY_WARN and (earlier is None or earlier >= _BATTERY_WARN):
            self._tell("mission", "warn", f"battery at {now:.0%}")

    def on_trees(self, trees: TreeList) -> bool:
        """Take a list unless it is older than ours; return whether it was taken."""
        mine = self.trees
        if (
            mine is not None
            and mine.map_id == trees.map_id
            and trees.stamp_ns < mine.stamp_ns
            and trees.version < mine.version
        ):
            return False
        if mine is not None and mine.trees == trees.trees and mine.map_id == trees.map_id:
            self.trees = trees
            return True
        if mine is None or mine.map_id != trees.map_id:
            self._tell("mission", "info", f"trees of map {trees.map_id}")
        self.trees = trees
        self.trees_version += 1
        return True

    def on_health(self, health: Health) -> None:
        """Take a service's health and tell of what began or ceased to be wrong."""
        before = self.health.get(health.service)
        self.health[health.service] = health
        degraded = health.state == "degraded"
        if before is not None and degraded != (before.state == "degraded"):
            word = f"{health.service}: {health.note}" if degraded else f"{health.service}: well again"
            self._tell("service", "warn" if degraded else "good", word)

    def on_live(self, service: str, *, alive: bool) -> None:
        """Take note of a liveliness token."""
        if alive == (service in self.live):
            return
        if alive:
            self.live.add(service)
            self._tell("service", "info", f"{service} is there")
        else:
            self.live.discard(service)
            self._tell("service", "bad", f"{service} is gone")

    def check_link(self, now_s: float) -> str:
        """Return the link's level and tell when it was lost or came back."""
        level = self.links.link(now_s)
        if level == "lost" and self.link_was not in ("lost", "none"):
            self._tell("link", "bad", "link lost: nothing heard, what is shown is old")
        elif self.link_was == "lost" and level in ("good", "late"):
            self._tell("link", "good", "link is back")
        self.link_was = level
        return level

    def _tell(self, kind: EventKind, level: EventLevel, text: str) -> None:
        self.log.add(self.uav, kind, level, text)


def _level_of(mission: MissionState) -> EventLevel:
    if mission.state in _BAD_STATES:
        return "bad"
    if mission.state in _GOOD_STATES:
        return "good"
    return "warn" if mission.failsafe or mission.state == "hold" else "info"
