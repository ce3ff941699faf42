"""Getting around things: the planned way beside the artificial potential field, and people who walk into the way.

``treedock bench avoid``. Static scenes are flown by a point with the aircraft's speed, everything in sight, so that
the two ways of choosing a direction alone differ. People are met in whole flights without rendering.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from services.common.geometry import Matrix
from services.evaluate.bench import BenchOptions, BenchReport
from services.evaluate.flight import Flight, FlightCase, Walker
from services.evaluate.potential import Field, velocity
from services.evaluate.synthetic import TrueTrunk
from services.navigator.config import NavigatorConfig
from services.navigator.path import Disc, clearance_m, plan

_STEP_S = 0.05
_LIMIT_S = 60.0
_AT_GOAL_M = 0.15
_CONFIG = NavigatorConfig()
_QUICK, _COUNT, _PEOPLE = 5, 20, 6


@dataclass(frozen=True, slots=True)
class Place:
    """A static scene: surfaces (``keep_out_m`` is the radius), from the origin to ``goal``."""

    goal: Matrix
    things: tuple[Disc, ...]


def single(rng: np.random.Generator) -> Place:
    """Return one trunk exactly on the line: the field's saddle."""
    r = float(rng.uniform(0.1, 0.4))
    return Place(np.array([5.0, 0.0]), (Disc(float(rng.uniform(1.8, 3.2)), 0.0, r),))


def gate(rng: np.random.Generator) -> Place:
    """Return two trunks with a gap of about two metres between them, on the line."""
    half, x = float(rng.uniform(1.0, 1.2)), float(rng.uniform(2.0, 3.0))
    return Place(np.array([5.0, 0.0]), (Disc(x, half, 0.15), Disc(x, -half, 0.15)))


def pocket(rng: np.random.Generator) -> Place:
    """Return a half circle of bushes, open towards the start: the field's local minimum."""
    x, radius = float(rng.uniform(2.2, 2.8)), float(rng.uniform(0.9, 1.3))
    angles = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 9)
    ring = (Disc(float(x + radius * np.cos(a)), float(radius * np.sin(a)), 0.2) for a in angles)
    return Place(np.array([x + radius + 2.2, 0.0]), tuple(ring))


def wall(rng: np.random.Generator) -> Place:
    """Return a row of bushes across the way."""
    x, half = float(rng.uniform(2.2, 3.0)), int(rng.integers(2, 4))
    return Place(np.array([5.5, 0.0]), tuple(Disc(x, 0.5 * k, 0.25) for k in range(-half, half + 1)))


def forest(rng: np.random.Generator) -> Place:
    """Return a dozen trunks by chance, none at the start or the goal."""
    goal = np.array([6.0, 0.0])
    things: list[Disc] = []
    while len(things) < 12:
        p = np.array([rng.uniform(0.5, 5.5), rng.uniform(-2.5, 2.5)])
        if min(float(np.linalg.norm(p)), float(np.linalg.norm(p - goal))) > 1.3:
            things.append(Disc(float(p[0]), float(p[1]), float(rng.uniform(0.06, 0.35))))
    return Place(goal, tuple(things))


SCENES: dict[str, Callable[[np.random.Generator], Place]] = {
    "trunk on the line": single, "gate": gate, "pocket": pocket, "wall": wall, "forest": forest,
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Run:
    """How one of them fared."""

    arrived: bool
    clearance_m: float
    length_m: float


def by_field(place: Place) -> Run:
    """Fly along the potential field."""
    return _flown(place, lambda p, _: velocity(p, place.goal, place.things, Field()))


def by_plan(place: Place) -> Run:
    """Fly along the planned way, planned anew every second as in flight."""
    corners: list[Matrix] = []

    def direction(p: Matrix, tick: int) -> Matrix:
        nonlocal corners
        if tick % round(1.0 / _STEP_S) == 0:
            grown = [Disc(d.x_m, d.y_m, d.keep_out_m + _CONFIG.safety_radius_m) for d in place.things]
            corners = plan(p, place.goal, grown) or _narrow(p, place)
        while len(corners) > 1 and float(np.linalg.norm(corners[0] - p)) < _AT_GOAL_M:
            corners = corners[1:]
        if not corners:
            return np.zeros(2)
        way = corners[0] - p
        return np.asarray(way * min(0.35 / max(float(np.linalg.norm(way)), 1e-9), 1.0))

    return _flown(place, direction)


def _narrow(p: Matrix, place: Place) -> list[Matrix]:
    """Return no way: where the safety radius does not fit, the mission chooses another tree."""
    del p, place
    return []


def _flown(place: Place, direction: Callable[[Matrix, int], Matrix]) -> Run:
    p, v, length = np.zeros(2), np.zeros(2), 0.0
    clear = np.inf
    for tick in range(round(_LIMIT_S / _STEP_S)):
        change = direction(p, tick) - v
        most = _CONFIG.motion.max_accel_m_s2 * _STEP_S
        size = float(np.linalg.norm(change))
        v = v + (change if size <= most else change * (most / size))
        p = p + v * _STEP_S
        length += float(np.linalg.norm(v)) * _STEP_S
        clear = min(clear, clearance_m(p, place.things))
        if float(np.linalg.norm(p - place.goal)) < _AT_GOAL_M:
            return Run(arrived=clear > _CONFIG.aircraft_radius_m, clearance_m=clear, length_m=length)
    return Run(arrived=False, clearance_m=clear, length_m=length)


def meeting(seed: int) -> FlightCase:
    """Return a flight to the only tree, with somebody who crosses the way, stops on it, or comes along it.

    They are on the line when the aircraft, if it flew on, would be about a metre before them: nearer they walk into it
    from the side, where a camera that looks ahead sees nobody.
    """
    rng = np.random.default_rng([seed, 81])
    angle, distance = float(rng.uniform(-np.pi, np.pi)), float(rng.uniform(4.2, 5.0))
    ahead, aside = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
    x, y = (float(c) for c in distance * ahead)
    side, speed = float(rng.choice([-1.0, 1.0])), float(rng.uniform(0.5, 1.2))
    begin, lead = float(rng.uniform(0.0, 1.0)), float(rng.uniform(0.9, 1.3))
    on_the_line_s = begin + _FROM_M / speed
    middle = (_CONFIG.approach_speed_m_s * on_the_line_s + lead) * ahead
    start = middle + (_FROM_M * ahead if seed % 3 == 2 else _FROM_M * side * aside)
    end = middle - (2.2 * side * aside if seed % 3 == 0 else 0.0)
    walker = Walker(_pair(start), _pair(end), speed, begin)
    return FlightCase(seed, (TrueTrunk(x, y, float(rng.uniform(0.08, 0.18))),), walkers=(walker,))


_FROM_M = 1.8


def _pair(p: Matrix) -> tuple[float, float]:
    return float(p[0]), float(p[1])


def run(options: BenchOptions) -> BenchReport:
    """Compare the two on all scenes, and meet people."""
    count = options.count or (_QUICK if options.quick else _COUNT)
    seed = options.seed or 0
    figures: dict[str, float] = {}
    table = ["| scene | planned: arrived | least clearance (m) | way (m) | field: arrived | least clearance (m) |",
             "|---|---|---|---|---|---|"]  # fmt: skip
    totals = {"plan": 0, "field": 0}
    for name, make in SCENES.items():
        places = [make(np.random.default_rng([seed, n, 82])) for n in range(count)]
        planned, drawn = [by_plan(p) for p in places], [by_field(p) for p in places]
        totals["plan"] += sum(r.arrived for r in planned)
        totals["field"] += sum(r.arrived for r in drawn)
        table.append(f"| {name} | {_line(planned)} | {_length(planned)} | {_line(drawn)} |")
        options.tell(table[-1])
    figures |= {"scenes": len(SCENES) * count, "arrived_plan": totals["plan"], "arrived_field": totals["field"]}
    people = [_meet(seed + n, options) for n in range(min(count, _PEOPLE))]
    figures |= {
        "people": len(people), "people_docked": sum(docked for docked, _, _ in people),
        "people_touches": sum(touches for _, _, touches in people),
        "people_nearest_m": round(min(near for _, near, _ in people), 3),
    }  # fmt: skip
    return BenchReport(
        figures=figures,
        conditions={
            "scenes": f"{count} of each kind, seed {seed}; speed 0.35 m/s, safety radius {_CONFIG.safety_radius_m} m",
            "arrived": f"at the goal within {_LIMIT_S:.0f} s, never nearer than {_CONFIG.aircraft_radius_m} m to a surface",
            "people": "whole flights without rendering: somebody crosses the way, stops on it, or comes along it, "
                      "0.5..1.2 m/s; distance from the aircraft's centre to the body (radius 0.25 m)",
        },
        table="\n".join(table),
    )  # fmt: skip


def _meet(seed: int, options: BenchOptions) -> tuple[bool, float, int]:
    flight = Flight(meeting(seed))
    flight.start()
    flight.run(limit_s=240.0)
    holds = [e.reason for e in flight.events if e.after == "hold"]
    options.tell(f"person, seed {seed}: {flight.mission.reason}; nearest {flight.near_person_m:.2f} m; {holds}")
    return bool(flight.dock_errors), flight.near_person_m, flight.touches


def _line(runs: Sequence[Run]) -> str:
    return f"{sum(r.arrived for r in runs)} of {len(runs)} | {min(r.clearance_m for r in runs):.2f}"


def _length(runs: Sequence[Run]) -> str:
    arrived = [r.length_m for r in runs if r.arrived]
    return f"{np.mean(arrived):.1f}" if arrived else "-"
