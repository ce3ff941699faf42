"""What goes into a step of the mission, what comes out, and what states say to it. Pure."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Generic, Literal, TypeVar

from schemas.navigation import Guidance, GuidanceCommand, MissionState, MissionStateName
from schemas.slam import Pose
from schemas.trees import Target, TreeList
from schemas.vehicle import VehicleState
from services.doctor.model import ServiceFact
from services.fleet.holder import ClaimView, Wish
from services.navigator.guard import View
from services.navigator.trajectory import Aim

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Seen(Generic[T]):
    """A message and when it came, on the aircraft's own clock."""

    message: T
    received_ns: int


@dataclass(frozen=True, slots=True)
class Inputs:
    """The latest of everything, at ``now_ns``; ``services`` maps a service to its last health's arrival."""

    now_ns: int
    pose: Seen[Pose] | None = None
    trees: Seen[TreeList] | None = None
    target: Seen[Target] | None = None
    vehicle: Seen[VehicleState] | None = None
    services: Mapping[str, int] = field(default_factory=dict)
    view: Seen[View] | None = None
    """What the depth image shows, for the live guard."""
    aboard: tuple[ServiceFact, ...] = ()
    """What the services' latest health says, for preflight."""
    claims: ClaimView | None = None
    """Of the claims on trees; None where they are switched off."""

    def age_s(self, seen: Seen[T] | None) -> float:
        """Return the seconds since a message came, inf when none did."""
        return float("inf") if seen is None else (self.now_ns - seen.received_ns) / 1e9

    @property
    def view_age_s(self) -> float:
        """Return the seconds since the last depth image was taken, inf before the first: one that comes late shows what was."""
        seen = self.view
        return float("inf") if seen is None else (self.now_ns - min(seen.received_ns, seen.message.stamp_ns)) / 1e9

    def service_age_s(self, name: str) -> float:
        """Return the seconds since a service's last health, inf when it never spoke."""
        at = self.services.get(name)
        return float("inf") if at is None else (self.now_ns - at) / 1e9


@dataclass(frozen=True, slots=True)
class Event:
    """One transition and its reason."""

    stamp_ns: int
    before: MissionStateName
    after: MissionStateName
    reason: str


@dataclass(frozen=True, slots=True)
class Outputs:
    """What one step gives."""

    guidance: Guidance
    state: MissionState
    events: tuple[Event, ...]
    wish: Wish = field(default_factory=Wish)
    """What is wanted of the claims on trees."""


Motion = Literal["aim", "brake", "freeze", "follow"]
"""How the setpoint moves: to the aim; to rest; stop at once; stand where the aircraft is."""


@dataclass(frozen=True, slots=True)
class Intent:
    """What a state wants done now."""

    command: GuidanceCommand
    motion: Motion = "brake"
    aim: Aim | None = None
    magnitude: float = 0.0
    unit: Literal["m", "rad", ""] = ""
    engage: bool = True
    land: bool = False
    word: str = ""
    """Why the state waits, for the operator; empty: the reason it was entered for stands."""


@dataclass(frozen=True, slots=True)
class Next:
    """The state to go to, and why."""

    state: MissionStateName
    reason: str
