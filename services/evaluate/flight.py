"""One flight without rendering: simulated PX4, bridge, mission and the synthetic chain in simulated time.

One thread, faster than real time, the same every time.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from schemas.navigation import MissionStateName
from schemas.slam import Pose
from schemas.trees import Target, TreeList
from schemas.vehicle import VehicleState
from services.common.geometry import Matrix, camera_yaw, pose, rotation_z, wrap_angle
from services.evaluate.eyes import Round, see
from services.evaluate.synthetic import ChainErrors, SyntheticChain, TrueTrunk
from services.fleet.holder import ClaimView, Wish
from services.navigator.autopilot.bridge import Bridge
from services.navigator.autopilot.config import AutopilotConfig
from services.navigator.autopilot.link import Codec
from services.navigator.config import NavigatorConfig
from services.navigator.guard import View
from services.navigator.mission import Mission
from services.navigator.values import Event, Inputs, Outputs, Seen
from services.simulator.px4.config import Px4Config, WindConfig
from services.simulator.px4.inprocess import InProcessLink
from services.simulator.px4.simulated import SimulatedPx4

TICK_NS = 10_000_000
_START_NS = 1_700_000_000_000_000_000
_VIEW_EVERY = 7
"""Ticks between two depth images: 14 a second."""
_CARRY_NS = 300_000_000
_SERVICES = ("camera", "slam", "mapper", "detector", "refiner", "autopilot")
_END: frozenset[MissionStateName] = frozenset({"landed", "released", "failed"})


@dataclass(frozen=True, slots=True)
class Walker:
    """Somebody who walks from one place to another when the aircraft has been on its way to the tree for a while."""

    from_m: tuple[float, float]
    to_m: tuple[float, float]
    speed_m_s: float
    begin_s: float
    """Seconds after the approach began."""
    radius_m: float = 0.25

    def at(self, since_s: float) -> Round:
        """Return where they are, so many seconds after the approach began."""
        a, b = np.array(self.from_m), np.array(self.to_m)
        length = float(np.linalg.norm(b - a))
        share = float(np.clip((since_s - self.begin_s) * self.speed_m_s / max(length, 1e-6), 0.0, 1.0))
        place = a + share * (b - a)
        return Round(float(place[0]), float(place[1]), self.radius_m)


@dataclass(frozen=True)
class FlightCase:
    """What is flown: the trunks, the weather, the errors, the configuration."""

    seed: int
    trunks: tuple[TrueTrunk, ...]
    errors: ChainErrors = field(default_factory=ChainErrors)
    wind: WindConfig = field(default_factory=WindConfig)
    things: tuple[Round, ...] = ()
    """What stands there and no detector tells: bushes, people."""
    walkers: tuple[Walker, ...] = ()
    start_m: tuple[float, float] = (0.0, 0.0)
    start_yaw_rad: float = 0.0
    """Of the first view: the map's x axis."""
    navigator: NavigatorConfig = field(default_factory=NavigatorConfig)
    autopilot: AutopilotConfig = field(default_factory=AutopilotConfig)


class Desk(Protocol):
    """The aircraft's claims on trees, among several (``services.evaluate.fleet_flight``)."""

    def view(self) -> ClaimView:
        """Return what the mission is to know now."""
        ...

    def follow(self, wish: Wish) -> None:
        """Take what a step of the mission wants."""
        ...


@dataclass
class Flight:
    """The closed loop. ``tick`` it; everything that may fail is a public switch."""

    case: FlightCase
    now_ns: int = _START_NS
    events: list[Event] = field(default_factory=list)
    outputs: Outputs | None = None
    clearance_m: float = float("inf")
    """Least distance of the aircraft's centre to a trunk's bark so far."""
    touches: int = 0
    dock_errors: list[tuple[float, float]] = field(default_factory=list)
    """True distance (m) and heading error (rad) at each docking: means over the dock's window."""
    navigator_alive: bool = True
    bridge_alive: bool = True
    silent: set[str] = field(default_factory=set)
    """Services without health."""
    setpoints: list[tuple[int, Any]] = field(default_factory=list)
    desk: Desk | None = None
    others: list[Round] = field(default_factory=list)
    """Other aircraft in the air, where they are now."""

    def __post_init__(self) -> None:
        rng = np.random.default_rng(self.case.seed)
        R_start = rotation_z(self.case.start_yaw_rad)
        T = pose(R_start, (*self.case.start_m, 0.1))
        config = Px4Config(wind=self.case.wind)
        self.px4 = SimulatedPx4(_flat, T, config, int(rng.integers(2**31)))
        self.mission = Mission(self.case.navigator)
        self.bridge = Bridge(self.case.autopilot)
        self.codec = Codec(self.case.autopilot.component_id, 1, lambda: self.now_ns)
        self._link = InProcessLink(self.px4, self.codec)
        T_world_map = pose(R_start, self._camera()[:3, 3])
        self.chain = SyntheticChain(self.case.trunks, T_world_map, self.case.errors, rng)
        self._eyes_rng = np.random.default_rng([self.case.seed, 79])
        self._view: Seen[View] | None = None
        self._approach_ns = 0
        self.near_person_m = float("inf")
        """Least distance of the aircraft's centre to somebody's surface so far."""
        self._T_world_map_inverse = np.linalg.inv(T_world_map)
        self._pose: Seen[Pose] | None = None
        self._target: Seen[Target] | None = None
        self._trees: Seen[TreeList] | None = None
        self._vehicle: Seen[VehicleState] | None = None
        self._history: list[tuple[float, float]] = []
        self._ticks = 0
        self._touching = False

    @property
    def state(self) -> MissionStateName:
        """The mission's state."""
        return self.mission.state

    @property
    def place_m(self) -> Matrix:
        """Where it truly is (3,)."""
        return self.px4.true_pose()[:3, 3]

    @property
    def elapsed_s(self) -> float:
        """Simulated time flown."""
        return (self.now_ns - _START_NS) / 1e9

    def order(self, name: Any, tree_id: int | None = None) -> str:  # noqa: ANN401
        """Give the mission an order; returns why it was refused, or nothing."""
        verdict = self.mission.order(name, tree_id, self.now_ns)
        return "" if verdict.accepted else verdict.reason

    def start(self, patience_s: float = 30.0) -> None:
        """Wait for the autopilot to fuse vision, then order the mission."""
        for _ in range(round(patience_s * 1e9 / TICK_NS)):
            self.tick()
            if self._vehicle is not None and self._vehicle.message.vision_fused:
                break
        refusal = self.order("start")
        if refusal:
            raise RuntimeError(f"start refused: {refusal}")

    def run(self, until: tuple[MissionStateName, ...] = (), limit_s: float = 300.0) -> MissionStateName:
        """Tick until one of the states, the end of the mission, or the limit."""
        for _ in range(round(limit_s * 1e9 / TICK_NS)):
            self.tick()
            if self.state in until or self.state in _END:
                break
        return self.state

    def tick(self) -> None:
        """Let 10 ms pass for everybody."""
        self.now_ns += TICK_NS
        self._ticks += 1
        self.px4.step(TICK_NS / 1e9)
        self._judge()
        self.chain.target_id = self.mission.board.target_id
        self.chain.observe(self._camera(), self.now_ns)
        for message in self.chain.due(self.now_ns):
            self._deliver(message)
        if self._ticks % _VIEW_EVERY == 0 and not self.chain.blind:
            self._look()
        self._run_bridge()
        if self.navigator_alive and self._ticks % 5 == 0:
            self._run_mission()

    def _deliver(self, message: Pose | Target | TreeList) -> None:
        if isinstance(message, Pose):
            self._pose = Seen(message, self.now_ns)
            if self.bridge_alive:
                self.bridge.on_pose(message, self.now_ns)
        elif isinstance(message, Target):
            self._target = Seen(message, self.now_ns)
        else:
            self._trees = Seen(message, self.now_ns)

    def _run_bridge(self) -> None:
        if not self.bridge_alive:
            return
        for message, received_ns in self._link.poll():
            self.bridge.handle(message, received_ns)
        for message in self.bridge.tick(self.now_ns):
            if message.get_type() == "SET_POSITION_TARGET_LOCAL_NED":
                self.setpoints.append((self.now_ns, message))
            self._link.send(message)
        if self._ticks % 5 == 0:
            self._vehicle = Seen(self.bridge.state(self.now_ns), self.now_ns)

    def _run_mission(self) -> None:
        services = {name: self.now_ns for name in _SERVICES if name not in self.silent}
        inputs = Inputs(self.now_ns, self._pose, self._trees, self._target, self._vehicle, services, self._view,
                        claims=None if self.desk is None else self.desk.view())  # fmt: skip
        self.outputs = self.mission.step(inputs)
        if self.desk is not None:
            self.desk.follow(self.outputs.wish)
        self.events.extend(self.outputs.events)
        for event in self.outputs.events:
            if event.after == "approach" and not self._approach_ns:
                self._approach_ns = self.now_ns
            if event.after == "docked":
                self.dock_errors.append(self._docked_truth())
        if self.bridge_alive:
            self.bridge.on_guidance(self.outputs.guidance, self.now_ns)

    def _look(self) -> None:
        """See what stands around, through the pose that the navigator believes in at this moment."""
        track = self.mission.board.track
        last = track.latest
        if last is None or track.lost or abs(self.now_ns - last.stamp_ns) > _CARRY_NS:
            return
        T = track.predict(self.now_ns)
        true = self._T_world_map_inverse @ self._camera()
        things = [Round(*self._in_map(t.x_m, t.y_m), t.radius_m) for t in self.case.trunks]
        things += [
            Round(*self._in_map(t.x_m, t.y_m), t.radius_m) for t in (*self.people(), *self.case.things, *self.others)
        ]
        key = (last.map_id, last.reset_counter)
        view = see(things, true[:2, 3], camera_yaw(true), T[:3, 3], camera_yaw(T), self.now_ns, key, self._eyes_rng)
        self._view = Seen(view, self.now_ns)

    def people(self) -> list[Round]:
        """Return where the walkers are now."""
        since_s = (self.now_ns - self._approach_ns) / 1e9 if self._approach_ns else -1e9
        return [w.at(since_s) for w in self.case.walkers]

    def _in_map(self, x_m: float, y_m: float) -> tuple[float, float]:
        p = self._T_world_map_inverse @ np.array([x_m, y_m, 0.0, 1.0])
        return float(p[0]), float(p[1])

    # -- truth --------------------------------------------------------------------------------------------------
    def _camera(self) -> Matrix:
        return self.px4.true_pose() @ self.bridge.mount.T_body_camera

    def _judge(self) -> None:
        p = self.px4.true_pose()[:2, 3]
        clear = min(
            (float(np.hypot(p[0] - t.x_m, p[1] - t.y_m)) - t.radius_m for t in self.case.trunks), default=np.inf
        )
        people = min((float(np.hypot(p[0] - t.x_m, p[1] - t.y_m)) - t.radius_m for t in self.people()), default=np.inf)
        things = min(
            (float(np.hypot(p[0] - t.x_m, p[1] - t.y_m)) - t.radius_m for t in self.case.things), default=np.inf
        )
        self.near_person_m = min(self.near_person_m, people)
        clear = min(clear, people, things)
        self.clearance_m = min(self.clearance_m, clear)
        touching = clear < self.case.navigator.aircraft_radius_m
        self.touches += int(touching and not self._touching)
        self._touching = touching
        target = self.mission.board.target_id
        if target is not None and target < len(self.case.trunks):
            T, trunk = self._camera(), self.case.trunks[target]
            offset = np.array([trunk.x_m, trunk.y_m]) - T[:2, 3]
            bearing = wrap_angle(float(np.arctan2(offset[1], offset[0])) - camera_yaw(T))
            self._history = [*self._history[-299:], (float(np.linalg.norm(offset)), bearing)]
        else:
            self._history = []

    def _docked_truth(self) -> tuple[float, float]:
        distance, bearing = np.mean(self._history, axis=0)
        return float(distance), float(bearing)


def _flat(x_m: float, y_m: float) -> float:
    del x_m, y_m
    return 0.0


def random_case(seed: int, clutter: int = 6, navigator: NavigatorConfig | None = None) -> FlightCase:
    """Return a forest drawn from ``seed``: trunks 2..6 m around the start, some too thick, wind up to 2 m/s."""
    rng = np.random.default_rng([seed, 77])
    trunks: list[TrueTrunk] = []
    while len(trunks) < clutter:
        angle, distance = rng.uniform(-np.pi, np.pi), rng.uniform(2.2, 5.5)
        thick = len(trunks) > 1 and rng.random() < 0.2
        radius = float(rng.uniform(0.25, 0.4) if thick else rng.uniform(0.05, 0.19))
        _plant(trunks, TrueTrunk(*_polar(distance, angle), radius, suitable=not thick))
    return FlightCase(seed, tuple(trunks), wind=weather(rng), navigator=navigator or NavigatorConfig())


def obstacle_case(seed: int, navigator: NavigatorConfig | None = None) -> FlightCase:
    """Return a forest whose only suitable tree, 4..5.5 m away, has one to three thick trunks on the way to it."""
    rng = np.random.default_rng([seed, 78])
    angle, distance = float(rng.uniform(-np.pi, np.pi)), float(rng.uniform(4.0, 5.5))
    target = TrueTrunk(*_polar(distance, angle), float(rng.uniform(0.06, 0.19)))
    trunks = [target]
    first = angle + float(rng.normal(0.0, 0.04))
    trunks.append(
        TrueTrunk(
            *_polar(distance * float(rng.uniform(0.4, 0.6)), first), float(rng.uniform(0.22, 0.35)), suitable=False
        )
    )
    for _ in range(40):
        if len(trunks) >= 5:
            break
        place = _polar(float(rng.uniform(2.0, 5.5)), angle + float(rng.uniform(-1.2, 1.2)))
        _plant(trunks, TrueTrunk(*place, float(rng.uniform(0.22, 0.35)), suitable=False))
    return FlightCase(seed, tuple(trunks), wind=weather(rng), navigator=navigator or NavigatorConfig())


def _polar(distance_m: float, angle_rad: float) -> tuple[float, float]:
    return float(distance_m * np.cos(angle_rad)), float(distance_m * np.sin(angle_rad))


def _plant(trunks: list[TrueTrunk], new: TrueTrunk) -> None:
    """Add a trunk unless it crowds another."""
    if all(np.hypot(new.x_m - t.x_m, new.y_m - t.y_m) > 1.2 for t in trunks):
        trunks.append(new)


def weather(rng: np.random.Generator) -> WindConfig:
    """Return a wind of up to 1.5 m/s with gusts."""
    return WindConfig(mean_m_s=float(rng.uniform(0.0, 1.5)), gust_m_s=float(rng.uniform(0.2, 0.8)))
