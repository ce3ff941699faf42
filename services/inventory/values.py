"""The inventory's words: a flight, a tree as one flight sees it, a tree of the inventory. Pure values."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

Frame = Literal["global", "local"]
Status = Literal["present", "merged", "withdrawn"]


@dataclass(frozen=True, slots=True)
class Belief:
    """What one flight's newest list says of one tree, in that flight's map."""

    x_m: float
    y_m: float
    z_m: float
    radius_m: float
    radius_height_m: float
    height_seen_m: float
    sigma_xy_m: float
    sigma_radius_m: float
    confidence: float
    observations: int
    suitable: bool


@dataclass(slots=True)
class Rigid2:
    """Takes a flight's map (x, y, z) to the inventory's frame: a turn about the vertical and a shift."""

    theta_rad: float = 0.0
    x_m: float = 0.0
    y_m: float = 0.0
    z_m: float = 0.0

    def apply(self, x_m: float, y_m: float, z_m: float) -> tuple[float, float, float]:
        """Return a point in the inventory's frame."""
        c, s = math.cos(self.theta_rad), math.sin(self.theta_rad)
        return c * x_m - s * y_m + self.x_m, s * x_m + c * y_m + self.y_m, z_m + self.z_m


@dataclass(slots=True)
class Flight:
    """One map of one aircraft. ``run`` tells apart maps of the same name: simulated time begins anew each time."""

    fid: int
    uav: str
    map_id: str
    run: int
    frame: Frame
    site: int
    """Flights of one site share a frame; a local flight begins a site of its own."""
    place: Rigid2
    sigma_m: float
    """Standard deviation of the place itself: of the start point until trees have confirmed it."""
    sigma_heading_rad: float
    aligned: bool
    """Laid on the inventory by the pattern of its trees (or the first there)."""
    first_ns: int
    last_ns: int
    stamp_ns: int = 0
    """Of the newest list taken."""
    version: int = 0
    note: str = ""


@dataclass(frozen=True, slots=True)
class Laid:
    """Where a flight's map lies on the earth: its place in the plane of its site, and how well that is known."""

    place: Rigid2
    site_deg: tuple[float, float, float]
    """Latitude, longitude, altitude of the site's plane."""
    sigma_m: float
    sigma_heading_rad: float


@dataclass(slots=True)
class Sighting:
    """A tree of one flight and the inventory's tree that it is."""

    fid: int
    flight: int
    tree_id: int
    tree: int
    belief: Belief
    present: bool = True
    """False once the flight's list no longer holds it."""
    kept: Belief | None = None
    """The belief last put into the history, at ``kept_ns``."""
    kept_ns: int = 0


@dataclass(slots=True)
class InventoryTree:
    """One tree of the world, as all flights together have it. Position in the frame of its site, metres."""

    fid: int
    frame: Frame
    site: int
    x_m: float
    y_m: float
    z_m: float
    radius_m: float
    radius_height_m: float
    height_seen_m: float
    sigma_xy_m: float
    sigma_radius_m: float
    confidence: float
    observations: int
    flights: int
    suitable: bool
    status: Status
    merged_into: int | None
    first_ns: int
    last_ns: int
    visited: bool = False


@dataclass(frozen=True, slots=True)
class Measurement:
    """One entry of the history: what a flight believed of a tree at one time."""

    sighting: int
    tree: int
    time_ns: int
    stamp_ns: int
    belief: Belief
    x_m: float
    y_m: float
    """In the inventory's frame, by the place that the flight had then."""


@dataclass(frozen=True, slots=True)
class AuditLine:
    """One event of the station's log."""

    time_ns: int
    uav: str
    kind: str
    level: str
    who: str
    text: str


@dataclass(frozen=True, slots=True)
class Site:
    """A frame that flights share: with latitude and longitude the tangent plane there, without them a flight's map."""

    number: int
    frame: Frame
    latitude_deg: float = 0.0
    longitude_deg: float = 0.0
    altitude_m: float = 0.0


@dataclass(slots=True)
class Changes:
    """What must be written: whole rows, by number."""

    sites: dict[int, Site] = field(default_factory=dict)
    flights: dict[int, Flight] = field(default_factory=dict)
    sightings: dict[int, Sighting] = field(default_factory=dict)
    trees: dict[int, InventoryTree] = field(default_factory=dict)
    measurements: list[Measurement] = field(default_factory=list)
    audit: list[AuditLine] = field(default_factory=list)
    placed: list[int] = field(default_factory=list)
    """Trees that were local and are global now: they leave the one table for the other."""

    def add(self, later: Changes) -> None:
        """Take over later changes: a row written twice is written as it is last."""
        self.sites.update(later.sites)
        self.flights.update(later.flights)
        self.sightings.update(later.sightings)
        self.trees.update(later.trees)
        self.measurements += later.measurements
        self.audit += later.audit
        self.placed += later.placed

    def __bool__(self) -> bool:
        return bool(self.sites or self.flights or self.sightings or self.trees or self.measurements or self.audit)


@dataclass(frozen=True, slots=True)
class Contents:
    """All that a database holds, less history and log."""

    sites: tuple[Site, ...] = ()
    flights: tuple[Flight, ...] = ()
    sightings: tuple[Sighting, ...] = ()
    trees: tuple[InventoryTree, ...] = ()
