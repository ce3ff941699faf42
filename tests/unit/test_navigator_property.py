"""Whatever happens, in whatever order: the limits hold, nothing moves while slam is lost or silent, nobody arms without
a command, and in the end the aircraft is on the ground or in the pilot's hands.

There is a rule for each loss of docs/safety.md that the navigator answers for, and for its end.
"""

from __future__ import annotations

import copy
import functools

import numpy as np
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from services.navigator.config import NavigatorConfig
from services.navigator.mission import Mission
from tests.unit.navigator_world import STEP_S, World, tree

_SHORT = NavigatorConfig()
_FAST = _SHORT.model_copy(
    update={
        "scan_rate_rad_s": float(np.radians(30.0)),
        "trees_wanted": 2,
        "motion": _SHORT.motion.model_copy(update={"fence_radius_m": 6.0}),
    }
)
_EPS = 1e-6


_FORESTS = (
    (tree(1, 4.0, 1.0), tree(2, -3.0, 2.0)),
    (tree(1, 2.5, 0.0), tree(2, 2.6, 0.55), tree(3, 0.0, -3.0)),
    (tree(1, 6.2, 3.0), tree(2, 5.0, -4.6)),  # docking there is at the fence
    (tree(1, 6.6, 3.0),),  # docking there would be outside
    (tree(1, 5.0, 3.0, 0.3, suitable=False),),
    (),
)
_AT_THE_FENCE = 2


@functools.cache
def _snapshot(layout: int, state: str) -> World:
    """Fly to a state once, or as far towards it as this forest allows."""
    world = World(_FAST, list(_FORESTS[layout]))
    if state != "idle":
        world.start()
        world.run((state, "landing", "landed"), 60.0)
        world.run(seconds=1.5 if state != "landing" else 0.0)
    return world


class Flights(RuleBasedStateMachine):
    """Random events between stretches of flight, the checks at every single step."""

    @initialize(
        layout=st.integers(0, len(_FORESTS) - 1),
        state=st.sampled_from(["idle", "take_off", "scan", "select", "face", "approach", "approach", "dock", "undock"]),
        first=st.sampled_from(["", "", "slam lost", "target off"]),
    )
    def begin(self, layout: int, state: str, first: str) -> None:
        if first == "target off":
            layout, state = _AT_THE_FENCE, "dock"
        self.world = copy.deepcopy(_snapshot(layout, state))
        self.orders = int(state != "idle")
        self._silent_s = 0.0
        if first == "slam lost":
            self.slam("lost")
        elif first == "target off":
            self.refiner_errs(0.4, 0.0)  # where docking would then be is outside the fence
            self._step(6.0)

    def _step(self, seconds: float) -> None:
        for _ in range(round(seconds / STEP_S)):
            self._silent_s = self._silent_s + STEP_S if self.world.slam is None else 0.0
            self.world.step()
            self._check()

    def _check(self) -> None:
        world, limits = self.world, _FAST.motion
        assert world.outputs is not None
        g = world.outputs.guidance
        s = g.setpoint
        assert world.armings <= self.orders, "armed without a command"
        if s is None:
            return
        velocity = np.array(s.velocity_m_s)
        assert np.linalg.norm(velocity) <= limits.max_speed_m_s + _EPS
        assert abs(s.yaw_rate_rad_s) <= limits.max_yaw_rate_rad_s + _EPS
        if not g.engage:
            return
        assert world.state not in ("idle", "preflight", "released", "landed", "failed")
        if not g.land and world.state != "hold":
            # the fence is where the map had it: a correction moves setpoint and home alike
            home = world.mission.board.home_m
            assert home is not None
            assert world.mission.board.trajectory.fence is not None, "flying without a fence"
            away = np.array(s.position_m) - home
            assert np.hypot(away[0], away[1]) <= limits.fence_radius_m + 0.05
            assert -0.5 <= away[2] <= limits.fence_height_m + 0.05
        lost = world.slam == "lost" or self._silent_s > _SHORT.failsafe.pose_silent_s + 2.0 * STEP_S
        if lost:
            assert not velocity.any(), "moving while slam is lost"
            assert s.yaw_rate_rad_s == 0.0, "turning while slam is lost"
            assert world.state in ("hold", "landing", "take_off")

    @rule()
    def start(self) -> None:
        self._step(0.1)
        if self.world.mission.order("start", None, self.world.now_ns).accepted:
            self.orders += 1
            self.world.override = False
            self._step(0.1)

    @rule(seconds=st.sampled_from([0.05, 0.5, 3.0, 12.0]))
    def fly(self, seconds: float) -> None:
        self._step(seconds)

    @rule(order=st.sampled_from(["hold", "resume", "abort", "land", "next"]))
    def order(self, order: str) -> None:
        self.world.mission.order(order, None, self.world.now_ns)  # type: ignore[arg-type]
        self._step(0.1)

    @rule(tree_id=st.integers(0, 3))
    def choose(self, tree_id: int) -> None:
        self.world.mission.order("choose", tree_id, self.world.now_ns)
        self._step(0.1)

    @rule(status=st.sampled_from(["tracking", "lost", None]))
    def slam(self, status: str | None) -> None:
        self.world.slam = status  # type: ignore[assignment]
        self._step(0.2)

    @rule(x=st.floats(-2.0, 2.0), yaw=st.floats(-0.5, 0.5), told=st.booleans())
    def correct(self, x: float, yaw: float, told: bool) -> None:
        self.world.correct(np.array([x, -0.3 * x, 0.0]), yaw, told=told)
        self._step(0.2)

    @rule(name=st.sampled_from(["m1", "m2"]))
    def new_map(self, name: str) -> None:
        self.world.map_id = name
        self._step(0.2)

    @rule(visible=st.booleans(), alive=st.booleans())
    def target(self, visible: bool, alive: bool) -> None:
        self.world.target_visible, self.world.refiner_alive = visible, alive
        self._step(0.2)

    @rule(outward_m=st.floats(-0.55, 0.55), aside_m=st.floats(-0.3, 0.3))
    def refiner_errs(self, outward_m: float, aside_m: float) -> None:
        """The refiner takes the trunk to be somewhere else: away from the start, say."""
        tree_id = self.world.mission.board.target_id
        t = next((t for t in self.world.trees if t.id == tree_id), None)
        if t is not None:
            out = np.array([t.x_m, t.y_m]) / np.hypot(t.x_m, t.y_m)
            self.world.target_error_m = outward_m * out + aside_m * np.array([-out[1], out[0]])
        self._step(0.2)

    @rule(
        ahead_m=st.floats(0.4, 3.0), aside_m=st.floats(-1.5, 1.5), speed=st.sampled_from([0.0, 0.8]), stay=st.booleans()
    )
    def somebody(self, ahead_m: float, aside_m: float, speed: float, stay: bool) -> None:
        """Somebody stands or walks before the camera, or everybody is gone again."""
        world = self.world
        yaw = world.yaw_rad
        ahead, left = np.array([np.cos(yaw), np.sin(yaw)]), np.array([-np.sin(yaw), np.cos(yaw)])
        place = world.position_m[:2] + ahead_m * ahead + aside_m * left
        world.walkers = [place] if stay else []
        world.walker_velocity_m_s = -speed * np.sign(aside_m or 1.0) * left
        self._step(1.0)
        world.walker_velocity_m_s = np.zeros(2)

    @rule(inliers=st.sampled_from([200, 30]))
    def slam_falters(self, inliers: int) -> None:
        self.world.inliers = inliers
        self._step(0.5)

    @rule(service=st.sampled_from(["camera", "slam", "mapper", "detector", "refiner"]), dead=st.booleans())
    def service(self, service: str, dead: bool) -> None:
        (self.world.dead.add if dead else self.world.dead.discard)(service)
        self._step(0.2)

    @rule(silent=st.booleans())
    def link(self, silent: bool) -> None:
        self.world.vehicle_silent = silent
        self._step(0.2)

    @rule(come=st.booleans(), seconds=st.sampled_from([0.3, 2.0]))
    def images(self, come: bool, seconds: float) -> None:
        self.world.images = come
        self._step(seconds)

    @rule(share=st.sampled_from([0.9, 0.3, 0.1, None]))
    def battery(self, share: float | None) -> None:
        self.world.battery = share
        self._step(0.1)

    @rule(dx=st.floats(-8.0, 8.0))
    def gust(self, dx: float) -> None:
        if self.world.armed:
            self.world.position_m = self.world.position_m + np.array([dx, 0.0, 0.0])
        self._step(0.1)

    @precondition(lambda self: self.world.armed)
    @rule(mode=st.sampled_from(["position", "manual", "hold"]))
    def pilot(self, mode: str) -> None:
        self.world.override, self.world.mode = True, mode
        self._step(0.2)
        assert self.world.outputs is not None
        if not self.world.vehicle_silent:
            assert not self.world.outputs.guidance.engage, "fighting the pilot"

    @precondition(lambda self: self.world.override)
    @rule()
    def pilot_lands(self) -> None:
        self.world.armed = False
        self.world.position_m[2] = 0.0
        self._step(0.1)

    @precondition(lambda self: self.world.armed)
    @rule()
    def disarmed_by_another(self) -> None:
        self.world.armed, self.world.mode = False, "hold"
        self.world.position_m[2] = 0.0
        self._step(0.2)
        assert self.world.outputs is not None
        if not self.world.vehicle_silent:
            assert not self.world.outputs.guidance.engage

    @rule()
    def bridge_restarts(self) -> None:
        self.world.engaged_id = 0
        self._step(0.2)

    @rule(there=st.booleans(), seconds=st.sampled_from([0.2, 6.0]))
    def ground_station(self, there: bool, seconds: float) -> None:
        self.world.station = there
        self._step(seconds)

    @rule(old=st.booleans())
    def list_of_trees(self, old: bool) -> None:
        """The list falls silent, or comes anew."""
        if old:
            self.world.list_falls_silent(_SHORT.failsafe.trees_stale_s + 1.0)
        else:
            self.world.revision += 1
        self._step(0.2)

    @rule(eyes=st.booleans())
    def guard(self, eyes: bool) -> None:
        """The live guard sees nothing at all, or sees again."""
        self.world.eyes = eyes
        self._step(0.2)

    @rule()
    def navigator_restarts(self) -> None:
        self.world.mission = Mission(_FAST)
        self._step(0.2)

    @invariant()
    def reason_is_always_told(self) -> None:
        if hasattr(self, "world"):
            assert self.world.mission.reason

    def teardown(self) -> None:
        if not hasattr(self, "world"):
            return
        world = self.world
        world.vehicle_silent = False
        world.battery = 0.1  # the battery ends every flight
        for _ in range(round(60.0 / STEP_S)):
            self._step(STEP_S)
            if not world.armed or world.override:
                break
        assert not world.armed or world.override, f"still flying: {world.state}, {world.mission.reason}"
        world.run(seconds=0.2)
        assert world.state in ("landed", "released", "failed", "idle", "preflight"), world.state


TestFlights = Flights.TestCase
TestFlights.settings = settings(
    max_examples=100, stateful_step_count=10, deadline=None, suppress_health_check=list(HealthCheck), derandomize=True
)
