"""What must hold after a fault, asked of what was measured. Pure."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from services.evaluate.faults.flown import ENDED
from services.evaluate.faults.missions import Seen

HOLD_S = 0.5
MOMENT_S = 0.15
"""What is uncertain of the fault's moment in simulated time: how far the clock was ahead of what had been heard."""
PX4_LEAVES_S = 1.4
"""PX4 leaves offboard so long after the last setpoint (measured on PX4 v1.16), and lands."""
_MOVING = frozenset({"take_off", "scan", "select", "face", "approach", "dock", "docked", "undock", "return"})
_SIGHTED = frozenset({"approach", "dock"})
_AFTER_DOCKING = frozenset({"docked", "undock", "return", "landing"})
_UNSEEN = frozenset({"recorder", "preview", "second_camera", "second_slam"})
"""The mission does not know whether they live."""


@dataclass(frozen=True, slots=True)
class Limits:
    """Seconds of the wall that a machine is given; a loaded one may be given more."""

    back_s: float = 3.5
    noticed_s: float = 11.5
    """A hung service: ``supervisor.hung_after_s`` and one period of its health."""


def faults_of(service: str, seen: Seen, limits: Limits) -> Iterator[str]:
    """Yield in words what did not hold after ``service`` was harmed; nothing when all did."""
    yield from _flight(service, seen)
    yield from common(seen)
    if seen.noticed_s is None or seen.noticed_s > limits.noticed_s:
        yield f"its hanging was noticed after {seen.noticed_s} s, not within {limits.noticed_s}"
    if seen.ready_s is None or seen.ready_s > limits.back_s:
        yield f"ready after {seen.ready_s} s, not within {limits.back_s}"


def common(seen: Seen) -> Iterator[str]:
    """Yield what must hold after any fault."""
    if seen.touches:
        yield f"{seen.touches} touches"
    if seen.armings > seen.starts:
        yield f"armed {seen.armings} times for {seen.starts} start commands"
    if not seen.replays_refused:
        yield "a start command was carried out a second time"
    if seen.trees_lost:
        yield f"{seen.trees_lost} trees lost"
    if seen.end in ENDED and not seen.reason:
        yield f"the mission ended ({seen.end}) without a reason"
    if seen.end in ENDED and seen.armed_after:
        yield f"the mission ended ({seen.end}) with the aircraft armed"
    # the bridge lands by itself, or goes on with the landing that was ordered: a navigator that comes back finds nothing to do
    landed = bool(seen.bridge_landed) or seen.state == "landing" or not seen.flew
    ended_by_bridge = seen.end == "idle" and landed and not seen.armed_after
    if seen.end not in ENDED and seen.end not in _MOVING | {"landing"} and not ended_by_bridge:
        yield f"the mission neither went on nor ended: {seen.end or 'no word'}, {seen.reason}"


def _flight(service: str, seen: Seen) -> Iterator[str]:
    """Yield what the aircraft did too late, by the safety table."""
    within_s = hold_within_s(service, seen.state)
    if within_s is None:
        yield from _flies_on(service, seen)
        return
    if not seen.flew:  # it stays on the ground: failed, or forgotten by a navigator that begins anew
        if seen.end not in {"failed", "idle"}:
            yield f"not armed in {seen.state}, and then {seen.end} instead of failed"
        return
    if seen.held_s is None or seen.held_s > within_s + MOMENT_S:
        yield f"held after {seen.held_s} s in {seen.state}, not within {within_s} s"


def held_late(seen: Seen, moment_s: float = MOMENT_S) -> str:
    """Return in words that a fault in flight was not held for within half a second, empty when it was, or nothing was to hold."""
    if (
        seen.state in {"hold", "landing"}
        or not seen.flew
        or (seen.held_s is not None and seen.held_s <= HOLD_S + moment_s)
    ):
        return ""
    return f"held after {seen.held_s} s, not within {HOLD_S} s"


def _flies_on(service: str, seen: Seen) -> Iterator[str]:
    """Yield what of a flight did not go on that does not need the service, or only when it is away for long: then it holds first."""
    if goes_on(seen) or seen.state not in _MOVING or not seen.flew:
        return
    if service in _UNSEEN:
        yield f"the mission ended ({seen.end}: {seen.reason}) although it does not need {service}"
    elif not seen.holds and not seen.bridge_landed and service != "router":
        yield f"the mission ended ({seen.end}: {seen.reason}) and never held before"


def goes_on(seen: Seen) -> bool:
    """Return whether a mission that a fault struck went on, or ended as one does that has docked."""
    return seen.end in _MOVING | {"hold"} or seen.docked or seen.state in _AFTER_DOCKING


def hold_within_s(service: str, state: str) -> float | None:
    """Return within how many seconds somebody must hold or land; None: the flight does not need that service then."""
    if state not in _MOVING:
        return None
    if service in {"slam", "fusion", "camera", "navigator"}:
        return HOLD_S
    if service == "autopilot":
        return PX4_LEAVES_S
    if service == "refiner" and state in _SIGHTED:
        return HOLD_S
    return None


def summary(seen: Sequence[Seen]) -> dict[str, float | None]:
    """Return the worst of several faults."""

    def worst(values: list[float | None]) -> float | None:
        known = [v for v in values if v is not None]
        return round(max(known), 2) if known else None

    return {
        "held_s": worst([s.held_s for s in seen if s.state in _MOVING]), "rest_s": worst([s.rest_s for s in seen]),
        "way_m": worst([s.way_m for s in seen]), "noticed_s": worst([s.noticed_s for s in seen]),
        "back_s": worst([s.back_s for s in seen]), "ready_s": worst([s.ready_s for s in seen]),
    }  # fmt: skip
