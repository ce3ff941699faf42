"""The mission: an explicit state machine from the ground to the tree and back. Pure: no bus, no clock, no files.

``order`` takes the operator's commands, ``step`` everything else. A step first looks at the board, then at the
failsafes, then lets the present state speak. Whatever is wanted, the setpoint moves by ``Trajectory`` alone, so no
state can exceed the limits.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from schemas.navigation import MissionStateName
from schemas.orders import CommandName
from services.navigator.approaching import at_height
from services.navigator.battery import fell_silent
from services.navigator.board import Board
from services.navigator.config import NavigatorConfig
from services.navigator.failsafe import AIRBORNE, Fault, Watch
from services.navigator.orders import Verdict, carry_out
from services.navigator.preflight import missing, warnings
from services.navigator.states import STATES
from services.navigator.surroundings import START_COLUMN_M
from services.navigator.telling import Telling
from services.navigator.track import Step
from services.navigator.trajectory import Aim, Fence
from services.navigator.values import Event, Inputs, Intent, Next, Outputs

_RESUME: dict[MissionStateName, MissionStateName] = {"approach": "face", "dock": "approach"}
"""Where a hold resumes when not in the state it interrupted: the target is looked for again."""
_FLOOR_M = 0.3
"""The geofence's floor lies this far below the start: ground may fall away."""

HoldCause = Literal["operator", "fault", "restart"]


class Mission:
    """The state machine. Deterministic: the same orders and inputs give the same outputs."""

    def __init__(self, config: NavigatorConfig) -> None:
        self.config = config
        self.state: MissionStateName = "idle"
        self.previous: MissionStateName = "idle"
        self.reason = "waiting for a start command"
        self.since_ns = 0
        self.mission_id = 0
        self.adopted = False
        """The mission was under way when we were started: where its start is, only the map's origin tells."""
        self.board = Board(config)
        self.watch = Watch()
        self.fault: Fault | None = None
        self._hold_cause: HoldCause = "fault"
        self._hold_limit_s = 0.0
        self._resume: MissionStateName = "idle"
        self._clear_since_ns: int | None = None
        self._fault_name, self._fault_since_ns = "", 0
        """The failsafe in force, and since when without a break."""
        self._events: list[Event] = []
        self._seq = 0

    def order(self, name: CommandName, tree_id: int | None, now_ns: int) -> Verdict:
        """Carry out an operator's command, or say why not."""
        return carry_out(self, name, tree_id, now_ns)

    def begin(self, now_ns: int) -> None:
        """Begin a new mission with a board of its own; what is known of poses stays."""
        v = self.board.vehicle
        engaged = v.engaged_mission_id if v is not None else 0
        self.mission_id = max(self.mission_id, engaged) + 1
        board, self.board = self.board, Board(self.config)
        self.board.inputs, self.board.track = board.inputs, board.track
        self.board.trees_wanted = self.config.trees_wanted
        self.watch.begin(self.mission_id)
        self._hold_cause, self.adopted = "fault", False
        self.go(Next("preflight", f"mission {self.mission_id} ordered"), now_ns)

    # -- the step -----------------------------------------------------------------------------------------------
    def step(self, inputs: Inputs) -> Outputs:
        """Advance to ``inputs.now_ns`` and say what to do."""
        if self.state == "idle" and self.since_ns == 0:
            self.since_ns = inputs.now_ns
        self.board.observe(inputs)
        self._place()
        self._adopt(inputs.now_ns)
        self.fault = self.watch.check(self.board, self.state, self._resume)
        self._answer(inputs.now_ns)
        self._tell_battery(inputs.now_ns)
        intent = self._intent(inputs.now_ns)
        self._tell_waiting(intent.word, inputs.now_ns)
        self._move(intent)
        events, self._events = tuple(self._events), []
        self._seq += 1
        failsafe = self.fault.name if self.fault is not None else ""
        telling = Telling(self.state, self.previous, self.since_ns, self.reason, self.mission_id, self._seq, failsafe)
        wish = self.board.claims.wish(self.board, self.state)
        return Outputs(telling.guidance(self.board, intent), telling.state_message(self.board), events, wish)

    def _place(self) -> None:
        """Put the setpoint where the aircraft is when its pose is new or has jumped; until then there is none.

        A pose may be new and already too old to trust (a restart on a busy machine): then the next one counts.
        """
        here, trajectory = self.board.here, self.board.trajectory
        if self.board.step_kind in (Step.FIRST, Step.RELOCATED, Step.JUMP):
            trajectory.placed = False
        if here is not None and not trajectory.placed:
            trajectory.reset(here.position_m, here.yaw_rad)

    def _adopt(self, now_ns: int) -> None:
        """Take over an aircraft that flies under our setpoints when we were started: hold, then land."""
        v = self.board.vehicle
        if self.adopted and self.board.trajectory.fence is None:  # there was no pose yet: no flight without a fence
            self._prepare_flight()
        if self.state != "idle" or self.mission_id or v is None or self.config.handheld:
            return
        if v.engaged_mission_id and v.armed and v.mode == "offboard" and not v.operator_override:
            self.mission_id = v.engaged_mission_id
            self.watch.begin(self.mission_id)
            self.board.trees_wanted = self.config.trees_wanted
            self._resume, self.adopted = "select", True
            self._prepare_flight()
            word = "the navigator was restarted in flight: holding, then landing"
            self.hold(Fault("", "hold", word, self.config.failsafe.restart_hold_s), "restart", now_ns)

    def _answer(self, now_ns: int) -> None:
        """Do what the fault in force asks for."""
        fault = self.fault
        self._time_fault(fault, now_ns)
        released = fault is not None and fault.response == "release"
        if self.state == "hold" and self.board.claims.must_land and not released:
            self.go(Next("landing", "the claim ends: landing here"), now_ns)
            return
        if fault is None:
            if self.state == "hold":
                self._wait_in_hold(now_ns)
            return
        self._clear_since_ns = None
        if fault.response == "release":
            self.go(Next("released", fault.word), now_ns)
        elif self.state == "take_off" and not self.watch.armed and not self.config.handheld:
            self.go(Next("failed", f"before take-off: {fault.word}"), now_ns)
        elif fault.response == "land":
            self.go(Next("landing", fault.word), now_ns)
        elif self.state != "hold":
            self.hold(fault, "fault", now_ns)
        else:
            if self._hold_cause == "fault":  # another fault in the same hold: it has its own time
                self._hold_limit_s = max(self._hold_limit_s, fault.hold_s)
            if self._held_s(now_ns) > self._hold_limit_s or self._fault_s(now_ns) > fault.hold_s:
                self._give_up_hold(fault.word, now_ns)

    def _time_fault(self, fault: Fault | None, now_ns: int) -> None:
        name = fault.name if fault is not None else ""
        if name != self._fault_name:
            self._fault_name, self._fault_since_ns = name, now_ns

    def _fault_s(self, now_ns: int) -> float:
        return (now_ns - self._fault_since_ns) / 1e9

    def _wait_in_hold(self, now_ns: int) -> None:
        if self._clear_since_ns is None:
            self._clear_since_ns = now_ns
        if self._hold_cause == "fault":
            if (now_ns - self._clear_since_ns) / 1e9 >= self.config.failsafe.clear_s:
                self.leave_hold("all is well again", now_ns)
        elif self._held_s(now_ns) > self._hold_limit_s:
            self._give_up_hold(self.reason, now_ns)

    def _held_s(self, now_ns: int) -> float:
        return (now_ns - self.since_ns) / 1e9

    def _give_up_hold(self, word: str, now_ns: int) -> None:
        if self.config.handheld:
            return
        b = self.board
        near = self._resume in ("dock", "docked", "undock") and b.axis_m is not None and b.dock_direction is not None
        if self.fault is not None and self.fault.back_off and near and b.here is not None:
            b.claims.leaving = True
            self.go(Next("undock", f"{word}: away from the trunk, then landing"), now_ns)
            return
        self.go(Next("landing", f"held for {self._held_s(now_ns):.0f} s: {word}"), now_ns)

    def hold(self, fault: Fault, cause: HoldCause, now_ns: int) -> None:
        """Go to hold, to come back from it to what is being done now."""
        if self.state != "hold" and cause != "restart":
            self._resume = self.state
        self._hold_cause, self._hold_limit_s, self._clear_since_ns = cause, fault.hold_s, None
        self.go(Next("hold", fault.word), now_ns)

    def choose_after_hold(self) -> None:
        """Let what follows this hold choose a tree anew, away from the trunk first where the aircraft is at one."""
        b = self.board
        if self._resume in ("face", "approach"):
            b.drop_target()
            self._resume = "select"
        elif self._resume in ("dock", "docked", "undock", "return"):
            b.further_tree()
            self._resume = "select" if self._resume == "return" else "undock"

    def leave_hold(self, reason: str, now_ns: int) -> None:
        """Go on with what the hold interrupted, as far as that is still possible."""
        if self.board.claims.leaving:  # no place is ours any more but the one below
            self.go(Next("landing", f"{reason}; without a claim"), now_ns)
            return
        target = _RESUME.get(self._resume, self._resume)
        if target in ("face", "approach", "docked", "undock") and self.board.axis_m is None:
            target = "select"
        changed, self.board.map_changed = self.board.map_changed, False
        if changed and target != "take_off":
            done = self.board.docked_count >= self.board.trees_wanted
            target, reason = ("landing" if done else "scan"), f"{reason}; in a new map"
        if self.board.trajectory.fence is None:
            self._prepare_flight()
        self.go(Next(target, reason), now_ns)

    def _intent(self, now_ns: int) -> Intent:
        """Return what the present state wants; follow at most a few transitions in one step."""
        for _ in range(4):
            if self.state in ("idle", "landed", "failed", "released"):
                return Intent("stop", "follow", engage=False)
            if self.state == "preflight":
                if not self._preflight(now_ns):
                    return Intent("stop", "follow", engage=False)
                continue
            if self.state == "landing":
                return self._landing(now_ns)
            if self.state == "hold":
                return self._holding()
            result = STATES[self.state](self.board, self._held_s(now_ns))
            if isinstance(result, Intent):
                return result
            self.go(result, now_ns)
        return Intent("stop")

    def _tell_battery(self, now_ns: int) -> None:
        if self.state in AIRBORNE and (word := fell_silent(self.board)):
            self._events.append(Event(now_ns, self.state, self.state, word))

    def _tell_waiting(self, word: str, now_ns: int) -> None:
        if word and word != self.reason:
            self._events.append(Event(now_ns, self.state, self.state, word))
            self.reason = word

    def _holding(self) -> Intent:
        """Stand still; give way to what comes too near."""
        b, fault, here = self.board, self.fault, self.board.here
        blind = fault is not None and fault.blind
        if here is None or blind:
            return Intent("stop", "brake" if b.carried and not blind else "freeze")
        place = self.watch.block.retreat(b) if fault is not None and fault.name == "obstacle" else None
        if place is None:
            return Intent("stop", "brake")
        aim = Aim(at_height(b, place), b.trajectory.yaw_rad, 0.3, 0.0)
        return Intent("backward", "aim", aim, float(np.linalg.norm(place - here.position_m[:2])), "m")

    def _preflight(self, now_ns: int) -> bool:
        """Return whether the state changed."""
        v = self.board.vehicle
        # whoever armed it flies it; it must not take off by itself when he has landed
        if v is not None and v.armed and not self.config.handheld:
            self.go(Next("failed", "preflight: the vehicle was armed, not by us"), now_ns)
            return True
        faults = missing(self.board, self.config)
        if not faults:
            self._prepare_flight()
            self.go(Next("take_off", "; ".join(["preflight passed", *warnings(self.board, self.config)])), now_ns)
        elif self._held_s(now_ns) > self.config.preflight_wait_s:
            self.go(Next("failed", f"preflight: {'; '.join(faults)}"), now_ns)
        else:
            return False
        return True

    def _prepare_flight(self) -> None:
        here, m = self.board.here, self.config.motion
        if here is None:
            return
        self.board.home_m = here.position_m.copy()
        if self.adopted:  # the map's origin is the start, unless the map was begun anew: nothing to fly back to
            self.board.home_m, self.board.home_known = np.zeros(3), False
        else:  # whatever became of the map before, here is the start
            self.board.home_known, self.board.map_changed = True, False
        home = self.board.home_m
        height = m.fence_height_m + _FLOOR_M
        self.board.trajectory.fence = Fence(home.copy(), float(home[2]) - _FLOOR_M, m.fence_radius_m, height)
        self.board.trajectory.reset(here.position_m, here.yaw_rad)
        self.board.around.space.visit(here.position_m[:2], START_COLUMN_M)

    def _landing(self, now_ns: int) -> Intent:
        v = self.board.vehicle
        if self.config.handheld or (v is not None and not v.armed):
            self.go(Next("landed", f"down and disarmed after {self.reason}"), now_ns)
            return Intent("stop", "follow", engage=False)
        return Intent("landing", "freeze" if self.board.here is None else "brake", land=True)

    def _move(self, intent: Intent) -> None:
        b, t = self.board, self.board.trajectory
        before = t.yaw_rad
        if intent.motion == "follow" or self.config.handheld:
            if b.here is not None:
                t.reset(b.here.position_m, b.here.yaw_rad)
        elif intent.motion == "freeze":
            t.freeze()
        elif intent.motion == "aim" and intent.aim is not None:
            t.advance(intent.aim, b.dt_s, None if b.here is None else b.here.position_m)
        else:
            t.brake(b.dt_s)
        if self.state == "scan":
            b.scan_turned_rad += t.yaw_rad - before

    def go(self, to: Next, now_ns: int) -> None:
        """Change the state, with an event that says why."""
        if to.state == self.state and to.state != "hold":
            return
        self._events.append(Event(now_ns, self.state, to.state, to.reason))
        if to.state != self.state:
            self.previous, self.since_ns = self.state, now_ns
        self.state, self.reason = to.state, to.reason
