"""An aircraft that follows its setpoints with a lag, under the real mission and the synthetic chain.

It takes a tenth of a simulated PX4's processor time, for what does not depend on how it flies: who claims which tree. It has no eyes for the live guard: what keeps two of them apart is their claims alone.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from schemas.navigation import MissionStateName
from schemas.slam import Pose
from schemas.trees import Target, TreeList
from schemas.vehicle import VehicleState
from services.common.geometry import Matrix, level_camera, pose, rotation_z, wrap_angle
from services.evaluate.eyes import Round
from services.evaluate.flight import Desk, FlightCase
from services.evaluate.synthetic import SyntheticChain
from services.navigator.mission import Mission
from services.navigator.values import Event, Inputs, Outputs, Seen

STEP_NS = 50_000_000
_START_NS = 1_700_000_000_000_000_000
_LAG_S, _YAW_LAG_S, _SINK_M_S = 0.25, 0.15, 0.5
_SERVICES = ("camera", "slam", "mapper", "detector", "refiner", "autopilot")


@dataclass
class Glider:
    """One aircraft; ``tick`` it every 50 ms."""

    case: FlightCase
    now_ns: int = _START_NS
    events: list[Event] = field(default_factory=list)
    touches: int = 0
    """Times it came nearer to bark than its radius."""
    desk: Desk | None = None
    others: list[Round] = field(default_factory=list)
    """Where others are: it does not see them."""

    def __post_init__(self) -> None:
        rng = np.random.default_rng(self.case.seed)
        start = (*self.case.start_m, self.case.navigator.start_height_m)
        self._R_world_map = rotation_z(self.case.start_yaw_rad)
        self._start_m = np.array(start)
        self.place_m: Matrix = self._start_m.copy()
        self._yaw_rad = self.case.start_yaw_rad
        self.mission = Mission(self.case.navigator)
        self.chain = SyntheticChain(self.case.trunks, pose(self._R_world_map, start), self.case.errors, rng)
        self._pose: Seen[Pose] | None = None
        self._target: Seen[Target] | None = None
        self._trees: Seen[TreeList] | None = None
        self._armed, self._landing, self._engaged = False, False, 0
        self._touching = False
        self._seq = 0

    @property
    def state(self) -> MissionStateName:
        """The mission's state."""
        return self.mission.state

    def order(self, name: str) -> str:
        """Start the mission; returns why it was refused, or nothing."""
        assert name == "start"
        verdict = self.mission.order("start", None, self.now_ns)
        return "" if verdict.accepted else verdict.reason

    def tick(self) -> None:
        """Let 50 ms pass."""
        self.now_ns += STEP_NS
        self._seq += 1
        self.chain.target_id = self.mission.board.target_id
        self.chain.observe(level_camera(self.place_m, wrap_angle(self._yaw_rad)), self.now_ns)
        for message in self.chain.due(self.now_ns):
            self._take(message)
        services = dict.fromkeys(_SERVICES, self.now_ns)
        vehicle = Seen(self._vehicle(), self.now_ns)
        claims = None if self.desk is None else self.desk.view()
        inputs = Inputs(self.now_ns, self._pose, self._trees, self._target, vehicle, services, claims=claims)
        outputs = self.mission.step(inputs)
        if self.desk is not None:
            self.desk.follow(outputs.wish)
        self.events.extend(outputs.events)
        self._move(outputs)
        self._judge()

    def _take(self, message: Pose | Target | TreeList) -> None:
        if isinstance(message, Pose):
            self._pose = Seen(message, self.now_ns)
        elif isinstance(message, Target):
            self._target = Seen(message, self.now_ns)
        else:
            self._trees = Seen(message, self.now_ns)

    def _vehicle(self) -> VehicleState:
        return VehicleState(
            stamp_ns=self.now_ns, seq=self._seq, connected=True, armed=self._armed, mode=self._mode,
            landed="in_air" if self._armed and self.place_m[2] > self._start_m[2] + 0.05 else "on_ground", quaternion_map_body=None,
            position_map_m=None, velocity_map_m_s=None, battery_share=0.9, vision_fused=True, operator_override=False,
            engaged_mission_id=self._engaged, link_age_s=0.0,
        )  # fmt: skip

    @property
    def _mode(self) -> str:
        return "hold" if not self._armed else "land" if self._landing else "offboard"

    def _move(self, out: Outputs) -> None:
        g = out.guidance
        if g.engage and not self._armed and g.mission_id > self._engaged:
            self._armed, self._landing, self._engaged = True, False, g.mission_id
        if not self._armed:
            return
        self._landing |= g.land
        if self._landing:
            self.place_m = self.place_m - np.array([0.0, 0.0, _SINK_M_S * STEP_NS / 1e9])
            self._armed = bool(self.place_m[2] > self._start_m[2])
        elif g.setpoint is not None:
            goal = self._start_m + self._R_world_map @ np.array(g.setpoint.position_m)
            share, turn = 1.0 - np.exp(-STEP_NS / 1e9 / _LAG_S), 1.0 - np.exp(-STEP_NS / 1e9 / _YAW_LAG_S)
            self.place_m = self.place_m + share * (goal - self.place_m)
            self._yaw_rad += float(turn) * wrap_angle(g.setpoint.yaw_rad + self.case.start_yaw_rad - self._yaw_rad)

    def _judge(self) -> None:
        clear = min(
            (float(np.hypot(self.place_m[0] - t.x_m, self.place_m[1] - t.y_m)) - t.radius_m for t in self.case.trunks),
            default=np.inf,
        )
        touching = clear < self.case.navigator.aircraft_radius_m
        self.touches += int(touching and not self._touching)
        self._touching = touching
