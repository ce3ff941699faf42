"""Missions in real processes, one after the other, with something that fails at a random moment of each."""

from __future__ import annotations

import signal
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import numpy as np

from schemas.command import Command, CommandReply, NonceReply, NonceRequest
from schemas.topics import COMMAND, COMMAND_NONCE
from services.common.errors import InputError
from services.evaluate.faults.flown import ENDED, FLYING
from services.evaluate.faults.rig import Rig
from services.navigator.client import send_command

_SENDER = "faults"
_READY_WITHIN_S = 300.0
_GROUND_WITHIN_S = 240.0
_SETTLE_SIM_S = 2.0
_MOMENT_S = (1.0, 45.0)
"""Simulated seconds after the start command between which the moment is drawn: from arming to docked."""
NEVER_S = 1e9
_ROOM_M = 1.3
"""Free way to the nearest trunk that a start asks for: more than docking leaves."""


@dataclass(frozen=True, slots=True)
class Seen:
    """What one fault did. Times in simulated seconds since the fault, but for ``noticed_s`` and ``back_s`` (of the wall)."""

    what: str
    state: str
    """The mission's state when it struck."""
    at_s: float
    """Simulated time since the start command."""
    moved_m_s: float
    """True speed over ground when it struck."""
    noticed_s: float | None
    back_s: float | None
    ready_s: float | None
    """As ``back_s``; on an overloaded machine by the process's own work (``Comeback.ready_after_s``)."""
    held_s: float | None
    """Until somebody held or landed."""
    rest_s: float | None
    """Until the true aircraft stood still over ground."""
    way_m: float
    """How far it went in the two seconds after."""
    end: str
    """The state it settled in, flying on or ended."""
    reason: str
    words: tuple[str, ...]
    """Reasons of all states on the way."""
    touches: int
    armings: int
    starts: int
    """Armings and accepted start commands since the flights began: more of the former is a command carried out twice."""
    replays_refused: bool
    trees_lost: int
    armed_after: bool
    flew: bool = True
    """Whether the aircraft was armed when it struck or was armed after: one that stays on the ground has nothing to hold."""
    bridge_landed: str = ""
    """Why the bridge landed by itself, in its own words: a navigator that comes back then finds no mission to go on with."""
    docked: bool = False
    """Whether it docked after the fault."""
    holds: tuple[str, ...] = ()
    """Why the mission held after it."""


class Back(NamedTuple):
    """When what was harmed was noticed and back; None where nothing was to come back."""

    noticed_s: float | None = None
    back_s: float | None = None
    ready_s: float | None = None


class Flights:
    """Missions on a rig. ``rng`` draws the moments."""

    def __init__(self, rig: Rig, rng: np.random.Generator, tell: Callable[[str], None] = lambda _: None) -> None:
        self.rig, self.rng, self._tell = rig, rng, tell
        self.starts = 0
        """Accepted start commands whose missions armed, or may still arm."""
        self._started_ns = 0
        self._touches = 0
        """Judged already: what is touched between two faults counts with the second."""
        self._old: Command | None = None
        """A start command that was carried out, for sending it again."""

    # -- a mission

    def begin(self) -> None:
        """Wait for an aircraft that stands ready, then order the mission.

        Raises:
            InputError: it does not get ready, or the start stays refused: with the last reason.
        """
        rig, flown = self.rig, self.rig.flown
        if not rig.until(lambda: rig.all_ready and self._stands, _READY_WITHIN_S):
            vehicle = flown.vehicle
            raise InputError(f"no aircraft ready to start: {vehicle.note if vehicle else 'no word of the vehicle'}")
        number = flown.mission_id
        for _ in range(90):
            reply = self._order_start()
            if reply is not None and reply.accepted:
                self.starts += 1
                self._started_ns = flown.now_ns
                # what is heard next may still be of the mission before
                rig.until(lambda: flown.mission_id != number and flown.state not in {*ENDED, "idle"}, 10.0)
                return
            rig.pump(0.5)
        raise InputError(f"the start stays refused: {reply.reason if reply else 'nobody answers'}")

    @property
    def _stands(self) -> bool:
        v = self.rig.flown.vehicle
        return v is not None and not v.armed and v.vision_fused and v.landed in {"on_ground", "unknown"}

    def _order_start(self) -> CommandReply | None:
        nonces = self.rig.bus.ask(COMMAND_NONCE, NonceRequest(sender=_SENDER), NonceReply, 2.0)
        if not nonces:
            return None
        command = Command(name="start", sender=_SENDER, nonce=nonces[0].nonce, sequence=nonces[0].next_sequence)
        replies = self.rig.bus.ask(COMMAND, command, CommandReply, 2.0, leaf="start")
        if replies and replies[0].accepted:
            self._old = command
        return replies[0] if replies else None

    @property
    def flying(self) -> bool:
        """Whether a mission is under way."""
        return self.rig.flown.state in FLYING

    @property
    def cramped(self) -> bool:
        """Whether the aircraft stands where nobody would start it: a landing by failsafe may be anywhere."""
        if self.flying or not self.rig.flown.truths:
            return False
        truth = self.rig.flown.truths[-1]
        x, y, _ = truth.T_map_camera.position_m
        return any(np.hypot(t.x_m - x, t.y_m - y) - t.radius_m < _ROOM_M for t in truth.trees)

    def moment(self) -> None:
        """Let the mission come to a random moment: of a new one, or a few seconds on in the one under way."""
        if self.flying and self.rig.flown.state != "hold":
            self.rig.fly_s(float(self.rng.uniform(1.0, 8.0)))
        if self.flying and self.rig.flown.armed:
            return
        self.land()
        self.begin()
        self.rig.fly_s(float(self.rng.uniform(*_MOMENT_S)))

    def land(self, timeout_s: float = _GROUND_WITHIN_S) -> bool:
        """See the mission to its end, by our order when it does not end; true when the aircraft stands disarmed."""
        flown = self.rig.flown
        if flown.state in FLYING:
            send_command(self.rig.bus, "land", sender=_SENDER, timeout_s=1.0)
        return self.rig.until(lambda: not flown.armed, timeout_s)

    # -- a fault

    def strike(self, service: str, number: int = signal.SIGKILL, patience_s: float = 60.0) -> Seen:
        """Send a service a signal now, and see what comes of it."""

        def harm() -> Back:
            pid, at_s = self.rig.harm(service, number)
            back = self.rig.comeback(service, pid, at_s, patience_s)
            if service == "navigator" and back is not None:
                self.rig.until(lambda: self.rig.flown.state == "hold", 3.0)
                send_command(self.rig.bus, "resume", sender=_SENDER, timeout_s=1.0)
            return Back(back.noticed_s, back.back_s, back.ready_after_s()) if back else Back(*(NEVER_S,) * 3)

        return self.see(f"{signal.Signals(number).name} {service}", harm)

    def see(self, what: str, harm: Callable[[], Back]) -> Seen:
        """Do ``harm`` now and see what comes of it; it returns when it was noticed and when the service was back."""
        flown = self.rig.flown
        before = self._moving_m_s()
        state, at_ns, trees, docks = flown.state, flown.now_ns, self._trees(), flown.docks
        armed, armings = flown.armed, flown.armings
        back = harm()
        self._settle(at_ns)
        seen = Seen(
            what=what, state=state, at_s=(at_ns - self._started_ns) * 1e-9, moved_m_s=before,
            noticed_s=back.noticed_s, back_s=back.back_s, ready_s=back.ready_s,
            held_s=flown.held_after_s(at_ns), rest_s=flown.rest_after_s(at_ns),
            way_m=flown.way_m(at_ns, at_ns + 2_000_000_000), end=flown.state, reason=flown.reason(),
            words=tuple(dict.fromkeys(s.reason for s in flown.states if s.since_ns >= at_ns)),
            touches=flown.touches - self._touches, armings=flown.armings, starts=self.starts, replays_refused=self._replay_refused(),
            trees_lost=len(trees - self._trees()), armed_after=flown.armed,
            flew=armed or flown.armings > armings, bridge_landed=flown.bridge_landed(at_ns),
            docked=flown.docks > docks,
            holds=tuple(dict.fromkeys(s.reason for s in flown.states if s.since_ns >= at_ns and s.state == "hold")),
        )  # fmt: skip
        self._touches = flown.touches
        self.starts -= int(not seen.flew and seen.end in {*ENDED, "idle"})  # it never armed: no credit for another
        self._tell(line_of(seen))
        return seen

    def _moving_m_s(self) -> float:
        truths = list(self.rig.flown.truths)[-4:]
        if len(truths) < 2:
            return 0.0
        way = np.subtract(truths[-1].T_map_camera.position_m[:2], truths[0].T_map_camera.position_m[:2])
        return float(np.linalg.norm(way)) / max((truths[-1].stamp_ns - truths[0].stamp_ns) * 1e-9, 1e-3)

    def _trees(self) -> set[int]:
        return {tree.id for tree in self.rig.flown.trees.trees} if self.rig.flown.trees else set()

    def _settle(self, at_ns: int) -> None:
        """Wait until the mission flies on without a failsafe, or has ended with the aircraft disarmed."""
        rig, flown = self.rig, self.rig.flown
        rig.fly_s(_SETTLE_SIM_S)
        since_ns: int | None = None

        def settled() -> bool:
            nonlocal since_ns
            if flown.state in {*ENDED, "idle"} and not flown.armed:
                return True
            last = flown.states[-1] if flown.states else None
            calm = last is not None and last.stamp_ns > at_ns and last.state in FLYING - {"hold"} and not last.failsafe
            since_ns = (since_ns or flown.now_ns) if calm else None
            return since_ns is not None and flown.now_ns - since_ns > _SETTLE_SIM_S * 1e9

        rig.until(settled, _GROUND_WITHIN_S)

    def _replay_refused(self) -> bool:
        """Send the last start command again, word for word; return whether it was refused."""
        if self._old is None:
            return True
        replies = self.rig.bus.ask(COMMAND, self._old, CommandReply, 2.0, leaf="start")
        return all(not reply.accepted for reply in replies)


def line_of(seen: Seen) -> str:
    """Return one fault in a line."""

    def s(value: float | None) -> str:
        return "-" if value is None else f"{value:.2f}" if value < NEVER_S else "never"

    return (
        f"{seen.what} in {seen.state} (at {seen.at_s:.0f} s): held {s(seen.held_s)} s, at rest {s(seen.rest_s)} s, noticed "
        f"{s(seen.noticed_s)} s, back {s(seen.back_s)} s, then {seen.end}: {seen.reason}"
    )


def as_row(seen: Seen) -> dict[str, Any]:
    """Return a fault as plain values."""
    return asdict(seen)
