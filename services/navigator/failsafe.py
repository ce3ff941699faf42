"""The failsafes: each row of docs/safety.md as a detector. Pure.

A detector looks at the board and says what is wrong, or nothing. The mission answers: release, hold (and land when
the hold's limit has passed), or land.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from schemas.navigation import MissionStateName
from schemas.vehicle import VehicleState
from services.navigator.board import Board
from services.navigator.obstacles import GUARDED, MOVING_M_S, Block, braking_m
from services.navigator.track import Step

Response = Literal["release", "hold", "land"]

AIRBORNE: frozenset[MissionStateName] = frozenset(
    {"take_off", "scan", "select", "face", "approach", "dock", "docked", "undock", "return", "hold"}
)
"""States in which the aircraft may fly under our setpoints."""
_VISUAL: frozenset[MissionStateName] = frozenset({"approach", "dock"})
_NEEDS_LIST: frozenset[MissionStateName] = frozenset({"scan", "select", "face"})


@dataclass(frozen=True, slots=True)
class Fault:
    """A failsafe in force: its name in docs/safety.md, what to do, the operator's word, seconds in hold."""

    name: str
    response: Response
    word: str
    hold_s: float = 0.0
    blind: bool = False
    """Nobody knows where the aircraft is: stop at once instead of braking along a path."""
    back_off: bool = False
    """Leave the trunk before landing."""


@dataclass
class Watch:
    """Runs the detectors in order of precedence; keeps what they need to remember."""

    mission_id: int = 0
    engaged: bool = False
    """The bridge has said that it is engaged for this mission."""
    armed: bool = False
    """The vehicle was armed in offboard for this mission."""
    ground_seen: bool = False
    block: Block = field(default_factory=Block)
    _jumped_ns: int | None = None
    _jump_word: str = ""
    _map_id: str | None = field(default=None)

    def begin(self, mission_id: int) -> None:
        """Forget the last mission."""
        self.mission_id, self.engaged, self.armed = mission_id, False, False
        self.ground_seen, self._jumped_ns, self._map_id, self.block = False, None, None, Block()

    def check(self, board: Board, state: MissionStateName, resume: MissionStateName) -> Fault | None:
        """Return the most pressing fault, or None. ``resume`` is the state a hold interrupts."""
        self._remember(board)
        if state not in AIRBORNE and state != "landing":
            return None
        doing = resume if state == "hold" else state
        for detector in _DETECTORS:
            fault = detector(self, board, doing)
            if fault is not None and (state != "landing" or fault.response == "release"):
                return fault
        return None

    def _remember(self, b: Board) -> None:
        v = b.vehicle
        if v is not None and v.engaged_mission_id == self.mission_id:
            self.engaged = True
            self.armed |= v.armed and v.mode == "offboard"
        self.ground_seen |= b.inputs.service_age_s("station") <= b.config.failsafe.ground_silent_s
        self._remember_jump(b)

    def _remember_jump(self, b: Board) -> None:
        f = b.config.failsafe
        if b.step_kind is Step.JUMP:
            self._jumped_ns, self._jump_word = b.now_ns, "the pose jumped"
        elif b.step_kind is Step.RELOCATED:
            self._jumped_ns, self._jump_word = b.now_ns, "slam found itself again at another place"
        elif b.correction is not None and b.track.latest is not None:
            moved = float(np.linalg.norm(b.track.latest.position_m - b.correction.back(b.track.latest.position_m)))
            if moved > f.correction_hold_m or abs(b.correction.yaw_rad) > f.pose_jump_rad:
                self._jumped_ns, self._jump_word = b.now_ns, f"slam corrected the map by {moved:.2f} m"
        if b.track.latest is not None and not b.track.lost:
            if self._map_id is not None and b.track.latest.map_id != self._map_id:
                self._jumped_ns, self._jump_word = b.now_ns, "slam began a new map"
            self._map_id = b.track.latest.map_id


def _operator(w: Watch, b: Board, doing: MissionStateName) -> Fault | None:
    v = b.vehicle
    if v is None:
        return None
    if v.operator_override and w.engaged:  # an earlier mission's stands until the bridge has taken ours
        return Fault("operator", "release", f"operator took over: {v.note or v.mode}; we are silent")
    if not w.armed or doing == "landing":
        return None
    if not v.armed:
        return Fault("operator", "release", f"disarmed, not by us{_bridge_says(v)}; we are silent")
    if v.mode != "offboard":
        return Fault("operator", "release", f"mode {v.mode}, not by us{_bridge_says(v)}; we are silent")
    return None


def _bridge_says(v: VehicleState) -> str:
    """Return the bridge's own word: it may have landed the aircraft, or never have flown it."""
    return f" ({v.note})" if v.note else ""


def _bridge_restarted(w: Watch, b: Board, doing: MissionStateName) -> Fault | None:
    del doing
    v = b.vehicle
    if v is None or not w.engaged or v.engaged_mission_id == w.mission_id:
        return None
    return Fault("autopilot restarted", "land", "the autopilot bridge was restarted; the aircraft lands by itself")


def _vehicle_link(w: Watch, b: Board, doing: MissionStateName) -> Fault | None:
    del w, doing
    if b.config.handheld or b.vehicle is not None:
        return None
    f = b.config.failsafe
    return Fault("autopilot link lost", "hold", "no word from the autopilot", f.vehicle_hold_s)


def _slam(w: Watch, b: Board, doing: MissionStateName) -> Fault | None:
    f = b.config.failsafe
    del w, doing
    age, blind_s = b.inputs.age_s(b.inputs.pose), b.blind_s
    # a silent slam's last pose is carried on by the bridge for a while, a lost one's is not
    limit_s = f.pose_land_s + (0.0 if b.track.lost else f.pose_carried_s)
    response: Response = "land" if blind_s > limit_s and not b.config.handheld else "hold"
    if age > f.pose_silent_s:
        name, word = _who_is_silent(b)
        return Fault(name, response, f"{word}: no pose for {age:.1f} s", f.pose_hold_s, blind=True)
    if b.poses_late:
        return Fault("poses late", "hold", f"the poses come {b.pose_age_s:.1f} s late", f.pose_hold_s, blind=True)
    if b.track.lost:
        word = "slam lost its place" if response == "hold" else f"slam lost its place {blind_s:.1f} s ago: landing"
        return Fault("slam lost", response, word, f.pose_hold_s, blind=not b.carried)
    return None


def _who_is_silent(b: Board) -> tuple[str, str]:
    limit = b.config.failsafe.service_silent_s
    for service in ("slam", "fusion", "camera"):
        if service in b.inputs.services and b.inputs.service_age_s(service) > limit:
            return ("camera silent" if service == "camera" else "service dead"), f"{service} is dead or hung"
    return "camera silent", "camera or slam silent"


def _pose_jump(w: Watch, b: Board, doing: MissionStateName) -> Fault | None:
    del doing
    if w._jumped_ns is None or (b.now_ns - w._jumped_ns) / 1e9 > b.config.failsafe.clear_s:  # noqa: SLF001
        return None
    return Fault("pose jump", "hold", w._jump_word, b.config.failsafe.pose_hold_s, blind=True)  # noqa: SLF001


def _battery(w: Watch, b: Board, doing: MissionStateName) -> Fault | None:
    del w, doing
    v = b.vehicle
    if v is None or v.battery_share is None or v.battery_share > b.config.failsafe.battery_land_share:
        return None
    return Fault("battery low", "land", f"battery at {100.0 * v.battery_share:.0f} %: landing")


def _geofence(w: Watch, b: Board, doing: MissionStateName) -> Fault | None:
    del w, doing
    fence, here = b.trajectory.fence, b.here
    if fence is None or here is None:
        return None
    excess = fence.excess_m(here.position_m)
    if excess <= b.config.motion.fence_margin_m:
        return None
    return Fault("geofence", "land", f"{excess:.1f} m outside the geofence: landing")


def _services(w: Watch, b: Board, doing: MissionStateName) -> Fault | None:
    del w
    f = b.config.failsafe
    needed = ["slam", "fusion"]  # the second only where it was ever heard: it is optional
    if doing in _VISUAL:
        needed.append("refiner")
    if doing in _NEEDS_LIST:
        needed += ["mapper", "detector"]
    for name in needed:
        if name in b.inputs.services and b.inputs.service_age_s(name) > f.service_silent_s:
            return Fault(
                "service dead", "hold", f"{name} is dead or hung", f.service_hold_s, blind=name in ("slam", "fusion")
            )
    return None


def _target(w: Watch, b: Board, doing: MissionStateName) -> Fault | None:
    del w
    if doing not in _VISUAL or b.axis_m is None or not b.target_lost:
        return None
    seen = b.to_axis()
    far = seen is not None and seen[0] > b.config.visual_range_m
    if not b.refiner_silent and (b.looking or (doing == "approach" and (b.hidden or far))):
        return None  # out of sight on purpose: the camera looks where it flies, or the map will do for now
    return Fault("target lost", "hold", "the target is out of sight", b.config.failsafe.target_hold_s)


def _trees(w: Watch, b: Board, doing: MissionStateName) -> Fault | None:
    del w
    f = b.config.failsafe
    if doing not in ("select", "face") or b.inputs.trees is None or b.inputs.age_s(b.inputs.trees) <= f.trees_stale_s:
        return None
    return Fault("trees stale", "hold", "the list of trees is old", f.trees_hold_s)


def _eyes(w: Watch, b: Board, doing: MissionStateName) -> Fault | None:
    """Stop where the live guard has nothing to look at: without images every way looks free."""
    del w
    f = b.config.failsafe
    if doing not in GUARDED or not b.config.live_guard or b.config.handheld:
        return None
    if b.inputs.view_age_s <= f.view_silent_s:
        return None
    late = b.inputs.age_s(b.inputs.view) <= f.view_silent_s
    word = (
        f"the live guard's depth images are {b.inputs.view_age_s:.1f} s old"
        if late
        else "the live guard gets no depth images"
    )
    return Fault("guard blind", "hold", word, f.obstacle_hold_s)


def _obstacle(w: Watch, b: Board, doing: MissionStateName) -> Fault | None:
    here, velocity = b.here, b.trajectory.velocity_m_s[:2]
    if here is None:
        return None
    word = w.block.still(b, doing) if w.block.way is not None else w.block.by(b, doing, velocity)
    return Fault("obstacle", "hold", word, b.config.failsafe.obstacle_hold_s) if word else None


def _unseen(w: Watch, b: Board, doing: MissionStateName) -> Fault | None:
    """Brake before space that nobody has looked into; the states look first, this is behind them."""
    del w
    here, velocity = b.here, b.trajectory.velocity_m_s[:2]
    speed = float(np.linalg.norm(velocity))
    space = b.around.space
    if here is None or speed < 2.0 * MOVING_M_S or doing not in GUARDED or not (b.config.live_guard and space.fed):
        return None
    braking = braking_m(b, speed)
    start = here.position_m[:2]
    if (
        space.known_ahead_m(start, start + velocity / speed * braking, 0.5 * b.config.aircraft_radius_m)
        >= braking - 1e-9
    ):
        return None
    return Fault("unknown space", "hold", "nobody has looked where the way leads", b.config.failsafe.obstacle_hold_s)


def _ground_link(w: Watch, b: Board, doing: MissionStateName) -> Fault | None:
    f = b.config.failsafe
    if b.claims.backing_off(doing) or not w.ground_seen or b.inputs.service_age_s("station") <= f.ground_silent_s:
        return None
    return Fault("ground link lost", "hold", "the ground station is out of reach", f.ground_hold_s)


def _claim(w: Watch, b: Board, doing: MissionStateName) -> Fault | None:
    """Come down while the claim still holds, when no renewal comes: afterwards another may be granted this place."""
    word = b.claims.lost(doing)
    if not word or not (w.armed or b.config.handheld):
        return None
    return Fault("claim lost", "hold", word, b.config.claims.hold_s, back_off=True)


_DETECTORS: tuple[Callable[[Watch, Board, MissionStateName], Fault | None], ...] = (
    _operator, _bridge_restarted, _vehicle_link, _battery, _geofence, _slam, _pose_jump, _services, _target, _trees,
    _eyes, _obstacle, _unseen, _claim, _ground_link,
)  # fmt: skip
