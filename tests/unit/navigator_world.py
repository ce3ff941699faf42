"""A small world for the mission's tests: a vehicle that follows setpoints with a lag, perfect eyes, and switches
that take each of them away."""

from __future__ import annotations

import copy
import functools
from dataclasses import dataclass, field

import numpy as np

from schemas.slam import Pose, SlamStatus
from schemas.trees import Target, Tree, TreeList
from schemas.vehicle import VehicleState
from services.common.geometry import Matrix, level_camera, rotation_z, to_transform, wrap_angle
from services.evaluate.eyes import Round, see
from services.fleet.holder import ClaimView
from services.navigator.config import NavigatorConfig
from services.navigator.guard import View
from services.navigator.mission import Mission
from services.navigator.values import Event, Inputs, Outputs, Seen

STEP_S = 0.05
CAMERA_STEPS = 1
SERVICES = ("camera", "slam", "mapper", "detector", "refiner")


def tree(
    tree_id: int, x_m: float, y_m: float, radius_m: float = 0.1, *, suitable: bool = True, z_m: float = -0.1
) -> Tree:
    return Tree(
        id=tree_id, x_m=x_m, y_m=y_m, z_m=z_m, axis=(0.0, 0.0, 1.0), radius_m=radius_m, radius_height_m=1.3,
        height_seen_m=2.0, sigma_xy_m=0.01, sigma_radius_m=0.005, arc_rad=1.5, confidence=0.9, observations=9,
        suitable=suitable,
    )  # fmt: skip


@dataclass
class World:
    """Closes the loop around a mission; ``run`` until a condition or a time."""

    config: NavigatorConfig = field(default_factory=NavigatorConfig)
    trees: list[Tree] = field(default_factory=lambda: [tree(1, 4.0, 1.0), tree(2, -3.0, 2.0)])
    now_ns: int = 1_000_000_000
    position_m: Matrix = field(default_factory=lambda: np.zeros(3))
    yaw_rad: float = 0.0
    armed: bool = False
    mode: str = "hold"
    engaged_id: int = 0
    spent_id: int = 0
    """The highest mission that was ever engaged; a bridge that was restarted does not know it, and engages none anew."""
    override: bool = False
    note: str = ""
    """The bridge's word."""
    connected: bool = True
    vehicle_silent: bool = False
    slam: SlamStatus | None = "tracking"
    map_id: str = "m1"
    inliers: int = 200
    reset_counter: int = 0
    shift_m: Matrix = field(default_factory=lambda: np.zeros(3))
    shift_yaw_rad: float = 0.0
    target_visible: bool = True
    refiner_alive: bool = True
    target_error_m: Matrix = field(default_factory=lambda: np.zeros(2))
    """How far off the refiner has the target's axis."""
    dead: set[str] = field(default_factory=set)
    battery: float | None = 0.9
    station: bool = False
    revision: int = 0
    """Of the list of trees: raise it after changing them."""
    walkers: list[Matrix] = field(default_factory=list)
    """People (x, y) whom the camera sees and the map does not know."""
    walker_velocity_m_s: Matrix = field(default_factory=lambda: np.zeros(2))
    eyes: bool = True
    """Whether the live guard sees anything."""
    images: bool = True
    """Whether depth images come to the live guard at all."""
    least_m: float = float("inf")
    """Least distance to a walker's middle so far."""
    events: list[Event] = field(default_factory=list)
    outputs: Outputs | None = None
    armings: int = 0
    _seen_ns: dict[str, int] = field(default_factory=dict)
    _pose: Seen[Pose] | None = None
    _target: Seen[Target] | None = None
    _vehicle: Seen[VehicleState] | None = None
    _trees: Seen[TreeList] | None = None
    _last_view: Seen[View] | None = None
    _steps: int = 0

    def __post_init__(self) -> None:
        self.mission = Mission(self.config)

    @property
    def state(self) -> str:
        return self.mission.state

    def believed(self, p: Matrix) -> Matrix:
        """Return a true point in slam's map."""
        return rotation_z(self.shift_yaw_rad) @ p + self.shift_m

    def correct(self, shift_m: Matrix, yaw_rad: float, *, told: bool = True) -> None:
        """Move slam's map."""
        self.shift_m, self.shift_yaw_rad = self.shift_m + shift_m, self.shift_yaw_rad + yaw_rad
        self.reset_counter = (self.reset_counter + int(told)) % 256

    def step(self) -> Outputs:
        self.now_ns += round(STEP_S * 1e9)
        self._steps += 1
        self.walkers = [w + STEP_S * self.walker_velocity_m_s for w in self.walkers]
        self.least_m = min([self.least_m, *(float(np.hypot(*(w - self.position_m[:2]))) for w in self.walkers)])
        self._sense()
        inputs = Inputs(
            self.now_ns, self._pose, self._trees, self._target, self._vehicle, dict(self._seen_ns), self._view(),
            claims=self.claims(),
        )  # fmt: skip
        self.outputs = self.mission.step(inputs)
        self.events.extend(self.outputs.events)
        self._actuate(self.outputs)
        return self.outputs

    def claims(self) -> ClaimView | None:
        """What the mission knows of its claims: nothing, they are off."""
        return None

    def run(self, until: str | tuple[str, ...] | None = None, seconds: float = 200.0) -> str:
        wanted = (until,) if isinstance(until, str) else until or ()
        for _ in range(round(seconds / STEP_S)):
            self.step()
            if self.state in wanted:
                break
        return self.state

    def list_falls_silent(self, for_s: float) -> None:
        """Let the last list of trees be so old; a new one comes with the next revision."""
        if self._trees is not None:
            self._trees = Seen(self._trees.message, self.now_ns - round(for_s * 1e9))

    def start(self) -> None:
        self.run(seconds=0.5)
        verdict = self.mission.order("start", None, self.now_ns)
        assert verdict.accepted, verdict.reason

    def _sense(self) -> None:
        for name in SERVICES:
            if name not in self.dead:
                self._seen_ns[name] = self.now_ns
        if self.station:
            self._seen_ns["station"] = self.now_ns
        if self.slam is not None:
            self._pose = Seen(self._pose_message(self.slam), self.now_ns)
        if self.refiner_alive:
            self._target = Seen(self._target_message(), self.now_ns)
        listed = self.revision + self.reset_counter
        if self._trees is None or self._trees.message.version != listed or self._trees.message.map_id != self.map_id:
            self._trees = Seen(self._list(listed), self.now_ns)
        if not self.vehicle_silent:
            self._vehicle = Seen(self._vehicle_message(), self.now_ns)

    def _view(self) -> Seen[View] | None:
        if not self.images:
            return self._last_view
        things = [Round(t.x_m, t.y_m, t.radius_m) for t in self.trees]
        things += [Round(float(w[0]), float(w[1]), 0.25) for w in self.walkers]
        things = things if self.eyes else []
        place, yaw = self.believed(self.position_m), wrap_angle(self.yaw_rad + self.shift_yaw_rad)
        key = (self.map_id, self.reset_counter)
        view = see(things, self.position_m[:2], self.yaw_rad, place, yaw, self.now_ns, key)
        self._last_view = Seen(view, self.now_ns)
        return self._last_view

    def _pose_message(self, status: SlamStatus) -> Pose:
        T = level_camera(self.believed(self.position_m), wrap_angle(self.yaw_rad + self.shift_yaw_rad))
        return Pose(
            stamp_ns=self.now_ns, seq=self._steps, map_id=self.map_id, status=status,
            T_map_camera=to_transform(T) if status in ("tracking", "dead_reckoned") else None, covariance=None,
            reset_counter=self.reset_counter, graph_version=0, keyframe_id=None, T_keyframe_camera=None,
            inliers=self.inliers, up_sigma_rad=0.01, processing_ms=10.0,
        )  # fmt: skip

    def _list(self, version: int) -> TreeList:
        moved = []
        for t in self.trees:
            p = self.believed(np.array([t.x_m, t.y_m, t.z_m]))
            moved.append(t.model_copy(update={"x_m": float(p[0]), "y_m": float(p[1]), "z_m": float(p[2])}))
        return TreeList(stamp_ns=self.now_ns, map_id=self.map_id, version=version, graph_version=0, trees=tuple(moved))

    def _target_message(self) -> Target:
        wanted = self.mission.board.target_id
        t = next((t for t in self.trees if t.id == wanted), None)
        bearing = distance = None
        axis = np.zeros(2)
        if t is not None:
            axis = np.array([t.x_m, t.y_m]) + self.target_error_m
            offset = axis - self.position_m[:2]
            distance = float(np.linalg.norm(offset))
            bearing = wrap_angle(float(np.arctan2(offset[1], offset[0])) - self.yaw_rad)
        seen = t is not None and bearing is not None and abs(bearing) < 0.5 and self.target_visible
        place = None if t is None else self.believed(np.array([*axis, 0.0]))
        return Target(
            stamp_ns=self.now_ns, seq=self._steps, map_id=self.map_id,
            status="tracking" if seen else "lost" if t else "none", tree_id=wanted, measured=seen,
            bearing_rad=bearing if seen else None, range_m=distance if seen else None, radius_m=0.1 if seen else None,
            image_x_px=None, sigma_bearing_rad=None, sigma_range_m=None, sigma_radius_m=None, raw_image_x_px=None,
            raw_range_m=None, raw_radius_m=None,
            position_map_m=(float(place[0]), float(place[1])) if seen and place is not None else None,
            covariance_map_m2=None,
        )  # fmt: skip

    def _vehicle_message(self) -> VehicleState:
        return VehicleState(
            stamp_ns=self.now_ns, seq=self._steps, connected=self.connected, armed=self.armed, mode=self.mode,
            landed="in_air" if self.position_m[2] > 0.05 else "on_ground", quaternion_map_body=None,
            position_map_m=None, velocity_map_m_s=None, battery_share=self.battery, vision_fused=True,
            operator_override=self.override, engaged_mission_id=self.engaged_id, link_age_s=0.0, note=self.note,
        )  # fmt: skip

    def _actuate(self, out: Outputs) -> None:
        g = out.guidance
        if self.override or self.vehicle_silent:
            return
        if g.engage and not self.armed and g.mission_id > self.spent_id:
            self.engaged_id = self.spent_id = g.mission_id
            self.armed, self.mode = True, "offboard"
            self.armings += 1
        if self.armed and g.land and self.mode == "offboard":
            self.mode = "land"
        if self.mode == "land":
            self.position_m = self.position_m - np.array([0.0, 0.0, 0.5 * STEP_S])
            if self.position_m[2] <= 0.0:
                self.position_m[2], self.armed, self.mode = 0.0, False, "hold"
        elif self.armed and self.mode == "offboard" and g.engage and g.setpoint is not None:
            goal = rotation_z(-self.shift_yaw_rad) @ (np.array(g.setpoint.position_m) - self.shift_m)
            self.position_m = self.position_m + 0.2 * (goal - self.position_m)
            self.yaw_rad += 0.4 * wrap_angle(g.setpoint.yaw_rad - self.shift_yaw_rad - self.yaw_rad)


@functools.cache
def _snapshot(state: str, *, station: bool) -> World:
    world = World(station=station)
    world.start()
    assert world.run(state) == state, world.mission.reason
    world.run(seconds=0.5)
    return world


def flying(state: str, *, station: bool = False) -> World:
    """Return a world that flew to a state: flown once, each test gets a copy."""
    return copy.deepcopy(_snapshot(state, station=station))
