"""Several flights in one forest, without rendering: one arbiter behind a bad link, each aircraft with a clock of its own.

The judge looks at the truth alone: which trunk each aircraft believes to hold, which it docked at, how near they came.
"""

from __future__ import annotations

import functools
import itertools
import random
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from schemas.fleet import ClaimGoal, ClaimReply
from services.evaluate.eyes import Round
from services.evaluate.fleet_link import Clock, FleetLink, LinkFaults
from services.evaluate.flight import TICK_NS, Flight, FlightCase, weather
from services.evaluate.glider import STEP_NS, Glider
from services.evaluate.synthetic import TrueTrunk
from services.fleet.book import Memory
from services.fleet.config import ClaimConfig, FleetConfig
from services.fleet.holder import Asked, ClaimView, Holder, Wish
from services.fleet.placing import SharedFrame
from services.fleet.shapes import Stretch
from services.inventory.config import InventoryConfig, StartPoint
from services.inventory.geodesy import TangentPlane
from services.navigator.config import NavigatorConfig

_SITE_DEG = (48.1, 11.5, 520.0)
_SIGMA_M, _SIGMA_HEADING_DEG = 0.05, 0.3
"""Of the start points as they are configured."""
_SPACING_M = 6.5
_TREES_EACH = 3
_BODY_M = 0.35
_IN_AIR_M = 0.4
_DRIFT = 0.01


@dataclass(frozen=True, slots=True)
class Outage:
    """Somebody out of reach: an aircraft's name, or the arbiter, which is started anew afterwards."""

    who: str
    from_s: float
    to_s: float


@dataclass(frozen=True, slots=True)
class FleetCase:
    """What is flown."""

    seed: int
    flights: dict[str, FlightCase]
    starts: tuple[StartPoint, ...]
    outages: tuple[Outage, ...]
    rates: dict[str, float]
    """How fast each clock runs; the arbiter's under ``arbiter``."""
    px4: bool = False
    """Each on a simulated PX4, with eyes for the live guard; else gliders, ten times as fast."""


class AirDesk:
    """One aircraft's claims over the link."""

    def __init__(self, uav: str, link: FleetLink, clock: Clock, config: ClaimConfig) -> None:
        self.uav, self.holder = uav, Holder(config, functools.partial(next, itertools.count(1)))
        self._link, self._clock = link, clock
        self.now_ns = 0

    def view(self) -> ClaimView:
        """Return what the mission is to know."""
        return self.holder.view(self._clock.at(self.now_ns))

    def follow(self, wish: Wish) -> None:
        """Do what the mission wants."""
        self.holder.follow(wish)
        for asked in self.holder.questions(self._clock.at(self.now_ns)):
            self._link.send(self.uav, asked, self._take, self.now_ns)

    def _take(self, asked: Asked, replies: list[ClaimReply]) -> None:
        self.holder.answered(asked, replies, self._clock.at(self.now_ns))


@dataclass
class FleetFlight:
    """All of them, in lockstep."""

    case: FleetCase
    double_claims: int = 0
    """Times at which two began to believe in one trunk."""
    docked: list[tuple[str, int]] = field(default_factory=list)
    """Who, at which trunk of the forest."""
    apart_m: float = float("inf")
    """Least distance of two aircraft in the air, centre to centre."""
    met: int = 0
    """Times two aircraft touched."""

    def __post_init__(self) -> None:
        rng = random.Random(self.case.seed)
        inventory = InventoryConfig(database="none", start_points=self.case.starts)
        frame = SharedFrame(_SITE_DEG, inventory.start_of)

        def place(uav: str, goal: ClaimGoal) -> Stretch | str:
            return frame.place(uav, goal)

        clocks = {name: Clock(rate, rng.randrange(10**12)) for name, rate in self.case.rates.items()}
        self.link = FleetLink(FleetConfig(enabled=True), LinkFaults(), rng, clocks["arbiter"], place, Memory())
        self.flights: dict[str, Flight | Glider] = {
            uav: Flight(case) if self.case.px4 else Glider(case) for uav, case in self.case.flights.items()
        }
        self._tick_ns = TICK_NS if self.case.px4 else STEP_NS
        self.desks = {
            uav: AirDesk(uav, self.link, clocks[uav], f.case.navigator.claims) for uav, f in self.flights.items()
        }
        for uav, flight in self.flights.items():
            flight.desk = self.desks[uav]
        self.now_ns = 0
        self.link.start_arbiter(0)
        self._doubled: set[tuple[str, str]] = set()
        self._touching: set[tuple[str, str]] = set()
        self._heard = dict.fromkeys(self.flights, 0)

    @property
    def elapsed_s(self) -> float:
        """Simulated time flown."""
        return self.now_ns / 1e9

    def run(self, limit_s: float) -> None:
        """Fly until all are down, or the limit."""
        ready_s = {uav: 12.0 + 2.0 * k for k, uav in enumerate(self.flights)}
        while self.elapsed_s < limit_s:
            self.tick()
            for uav in [uav for uav, at_s in ready_s.items() if self.elapsed_s >= at_s]:
                if not self.flights[uav].order("start"):
                    del ready_s[uav]
            if not ready_s and all(f.state in ("landed", "failed", "released") for f in self.flights.values()):
                return

    def tick(self) -> None:
        """Let one tick pass for everybody."""
        self.now_ns += self._tick_ns
        self._outages()
        flying = {uav: f.place_m for uav, f in self.flights.items()}
        flying = {uav: p for uav, p in flying.items() if p[2] > _IN_AIR_M}
        for uav, flight in self.flights.items():
            self.desks[uav].now_ns = self.now_ns
            flight.others = [Round(float(p[0]), float(p[1]), _BODY_M) for other, p in flying.items() if other != uav]
            flight.tick()
        self.link.step(self.now_ns)
        self._judge(flying)

    def _outages(self) -> None:
        t = self.elapsed_s
        out = {o.who for o in self.case.outages if o.from_s <= t < o.to_s}
        self.link.cut = out - {"arbiter"}
        if "arbiter" in out:
            self.link.alive = False
        elif not self.link.alive:
            self.link.start_arbiter(self.now_ns)

    def _judge(self, flying: dict[str, np.ndarray]) -> None:
        believed = {uav: self._believed(uav) for uav in self.flights}
        doubled, touching = set(), set()
        for a, b in itertools.combinations(sorted(self.flights), 2):
            if believed[a] is not None and believed[a] == believed[b]:
                doubled.add((a, b))
            if a in flying and b in flying:
                apart = float(np.linalg.norm(flying[a][:2] - flying[b][:2]))
                self.apart_m = min(self.apart_m, apart)
                if apart < 2.0 * _BODY_M:
                    touching.add((a, b))
        self.double_claims += len(doubled - self._doubled)
        self.met += len(touching - self._touching)
        self._doubled, self._touching = doubled, touching
        for uav, flight in self.flights.items():
            for event in flight.events[self._heard[uav] :]:
                if event.after == "docked" and event.before == "dock":
                    self.docked.append((uav, int(flight.mission.board.visited_ids[-1])))
            self._heard[uav] = len(flight.events)

    def _believed(self, uav: str) -> int | None:
        """Return the trunk that an aircraft believes to hold: in this simulation lists number trees as the forest does."""
        held = self.desks[uav].view().held
        return None if held is None else held.tree_id

    @property
    def expected(self) -> set[int]:
        """Suitable trunks that at least one aircraft has in its list."""
        found = set()
        for flight in self.flights.values():
            reach = flight.chain.errors.range_max_m
            found |= {
                k for k, t in enumerate(flight.case.trunks) if t.suitable and _far(flight.case.start_m, t) <= reach
            }
        return found


def fleet_case(seed: int, count: int, *, px4: bool = False) -> FleetCase:
    """Return a forest with ``count`` aircraft 6.5 m apart, outages of the link and of the arbiter, clocks up to 1 % wrong."""
    rng = np.random.default_rng([seed, 91])
    starts = [(_SPACING_M * (k % 2), _SPACING_M * (k // 2)) for k in range(count)]
    trunks = _forest(starts, _TREES_EACH * count, rng)
    navigator = NavigatorConfig(trees_wanted=50, claims=ClaimConfig(enabled=True), live_guard=px4)
    wind = weather(rng)
    plane, flights, points = TangentPlane(*_SITE_DEG), {}, []
    for k, start in enumerate(starts):
        yaw = float(rng.uniform(-np.pi, np.pi))
        flights[f"uav{k + 1}"] = FlightCase(
            1000 * seed + k, trunks, wind=wind, start_m=start, start_yaw_rad=yaw, navigator=navigator
        )
        points.append(_start_point(f"uav{k + 1}", start, yaw, plane, rng))
    rates = {name: 1.0 + float(rng.uniform(-_DRIFT, _DRIFT)) for name in ("arbiter", *flights)}
    return FleetCase(seed, flights, tuple(points), _drawn_outages(tuple(flights), rng), rates, px4)


def calm_case(
    trunks: tuple[TrueTrunk, ...], starts: Mapping[str, tuple[float, float]], claims: ClaimConfig
) -> FleetCase:
    """Return aircraft that look along x in a forest of one's own: no outages, right clocks, no wind."""
    navigator = NavigatorConfig(trees_wanted=50, claims=claims, live_guard=False)
    plane, rng = TangentPlane(*_SITE_DEG), np.random.default_rng(1)
    flights = {
        uav: FlightCase(k, trunks, start_m=start, navigator=navigator) for k, (uav, start) in enumerate(starts.items())
    }
    points = tuple(_start_point(uav, start, 0.0, plane, rng) for uav, start in starts.items())
    return FleetCase(0, flights, points, (), dict.fromkeys(("arbiter", *starts), 1.0))


def _start_point(
    uav: str, start_m: tuple[float, float], yaw_rad: float, plane: TangentPlane, rng: np.random.Generator
) -> StartPoint:  # fmt: skip
    """Return a start point as somebody measured it."""
    east, north = np.array(start_m) + rng.normal(0.0, _SIGMA_M, 2)
    latitude, longitude, altitude = plane.to_geodetic(float(east), float(north), 0.0)
    heading = 90.0 - float(np.degrees(yaw_rad)) + float(rng.normal(0.0, _SIGMA_HEADING_DEG))
    return StartPoint(uav=uav, latitude_deg=latitude, longitude_deg=longitude, altitude_m=altitude, heading_deg=heading,
                      sigma_m=_SIGMA_M, sigma_heading_deg=_SIGMA_HEADING_DEG)  # fmt: skip


def _forest(starts: list[tuple[float, float]], count: int, rng: np.random.Generator) -> tuple[TrueTrunk, ...]:
    """Return trunks 2.2 to 5 m from one start and no nearer than that to any, 1.6 m apart."""
    trunks: list[TrueTrunk] = []
    while len(trunks) < count:
        home = starts[int(rng.integers(len(starts)))]
        distance, angle = rng.uniform(2.2, 5.0), rng.uniform(-np.pi, np.pi)
        new = TrueTrunk(
            float(home[0] + distance * np.cos(angle)),
            float(home[1] + distance * np.sin(angle)),
            float(rng.uniform(0.05, 0.19)),
        )
        if all(_far(s, new) > 2.2 for s in starts) and all(_far((t.x_m, t.y_m), new) > 1.6 for t in trunks):
            trunks.append(new)
    return tuple(trunks)


def _drawn_outages(uavs: tuple[str, ...], rng: np.random.Generator) -> tuple[Outage, ...]:
    """Return cuts shorter than half a lease, two for each aircraft, and one or two restarts of the arbiter."""
    found = []
    for who in (*uavs, *uavs, "arbiter", *(["arbiter"] if rng.random() < 0.5 else [])):
        begin = float(rng.uniform(15.0, 180.0))
        found.append(Outage(who, begin, begin + float(rng.uniform(3.0, 12.0))))
    return tuple(found)


def _far(place: tuple[float, float], trunk: TrueTrunk) -> float:
    return float(np.hypot(place[0] - trunk.x_m, place[1] - trunk.y_m))
