"""What must hold before the propellers turn. Pure."""

from __future__ import annotations

from collections.abc import Iterator

from services.common.version import running_version
from services.doctor.aboard import against_flight
from services.doctor.model import VehicleFact
from services.navigator.board import Board
from services.navigator.claiming import start_goal
from services.navigator.config import NavigatorConfig

_VIEW_FRESH_S = 2.0
_NEEDED = ("camera", "slam", "mapper", "detector", "refiner")


def missing(board: Board, config: NavigatorConfig) -> list[str]:
    """Return what is not well, in words for the operator; empty when the aircraft may take off."""
    faults = [] if board.here is not None else ["slam gives no pose"]
    start = start_goal(board)
    if board.claims.on and start is not None and board.claims.want(start) != "held":
        faults.append(f"the place to start from is not claimed: {board.claims.word}")
    if config.handheld:
        return faults
    if config.live_guard and board.inputs.view_age_s > _VIEW_FRESH_S:
        faults.append("the live guard sees no depth images (navigator.live_guard=false flies without it)")
    v = board.vehicle
    if v is None:
        return [*faults, "no word from the autopilot"]
    if not v.vision_fused:
        faults.append("the autopilot does not use the vision pose yet")
    if v.landed in ("in_air", "taking_off", "landing"):
        faults.append(f"the vehicle says it is {v.landed.replace('_', ' ')}")
    if v.battery_share is not None and v.battery_share < config.failsafe.battery_start_share:
        faults.append(
            f"battery at {100.0 * v.battery_share:.0f} %, {100.0 * config.failsafe.battery_start_share:.0f} needed"
        )
    faults += list(_unheard(board, config))
    # what `treedock doctor` calls a failure of services, versions, clocks, certificates, disk or autopilot is one here
    faults += against_flight(board.inputs.aboard, VehicleFact(v.connected, v.note, v.battery_share), running_version())
    if config.ground_required and board.inputs.service_age_s("station") > config.failsafe.ground_silent_s:
        faults.append("no ground station")
    return faults


def warnings(board: Board, config: NavigatorConfig) -> list[str]:
    """Return what the operator should know and what is no reason to stay: some vehicles have no gauge."""
    v = board.vehicle
    unknown = not config.handheld and v is not None and v.battery_share is None
    return ["battery: the vehicle does not tell its share, watch the time"] if unknown else []


def _unheard(board: Board, config: NavigatorConfig) -> Iterator[str]:
    """Yield which of the services that a mission needs say nothing; in memory none of them tells of itself."""
    heard = board.inputs.services
    for name in _NEEDED:
        if heard and name not in heard:
            yield f"{name} is not up"
        elif name in heard and board.inputs.service_age_s(name) > config.failsafe.service_silent_s:
            yield f"{name} is dead or hung"
