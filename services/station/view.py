"""What a page is told, as plain values for JSON: short, rounded, and every value with its age. Pure.

Text of messages passes as text; the page writes it with ``textContent`` only.
"""

from __future__ import annotations

from typing import Any

from schemas.trees import Tree
from services.station.aircraft import CARRIER_WORDS, Aircraft
from services.station.operators import OperatorDesk

TREE_FIELDS = (
    "id",
    "x",
    "y",
    "z",
    "radius",
    "sigma_xy",
    "sigma_radius",
    "confidence",
    "observations",
    "suitable",
    "arc",
)
"""Order of the values of one tree in a page's message."""


def aircraft_view(a: Aircraft, desk: OperatorDesk, now_s: float) -> dict[str, Any]:
    """Return everything but trees and trail of one aircraft."""
    commander = desk.commander(a.uav)
    return {
        "uav": a.uav,
        "link": a.links.link(now_s),
        "link_age": _r(a.links.link_age_s(now_s), 2),
        "commander": None if commander is None else {"n": commander.number, "name": commander.name},
        "pose": _pose(a, now_s),
        "mission": _mission(a, now_s),
        "target": _target(a, now_s),
        "vehicle": _vehicle(a, now_s),
        "claim": _claim(a, now_s),
        "fusion": _fusion(a, now_s),
        "trees_version": a.trees_version,
        "topics": [
            [name, _r(entry.age_s(now_s), 2), entry.level(now_s), _r(entry.rate_hz(now_s), 1), entry.missed]
            for name, entry in sorted(a.links.arrivals.items())
            if not name.startswith("health/")
        ],
        "services": _services(a, now_s),
    }


def _pose(a: Aircraft, now_s: float) -> dict[str, Any] | None:
    if a.pose is None:
        return None
    sigma = None
    if a.pose.covariance is not None:
        sigma = max(0.0, a.pose.covariance[0] + a.pose.covariance[6]) ** 0.5
    placed = None if a.placed is None else [_r(v, 3) for v in a.placed]
    return {
        "at": placed, "status": a.pose.status, "map": a.pose.map_id, "sigma": _r(sigma, 3),
        "age": _r(a.links.age_s("slam/pose", now_s), 2),
    }  # fmt: skip


def _mission(a: Aircraft, now_s: float) -> dict[str, Any] | None:
    m = a.mission
    if m is None:
        return None
    return {
        "state": m.state, "previous": m.previous, "reason": m.reason, "failsafe": m.failsafe,
        "for": _r(max(0.0, (m.stamp_ns - m.since_ns) * 1e-9), 1), "target": m.target_tree_id,
        "visited": list(m.visited_tree_ids), "docked": m.docked_count, "distance": _r(m.distance_m, 2),
        "heading_error": _r(m.heading_error_rad, 3), "map": m.map_id,
        "age": _r(a.links.age_s("mission/state", now_s), 2),
    }  # fmt: skip


def _target(a: Aircraft, now_s: float) -> dict[str, Any] | None:
    t = a.target
    if t is None or t.status == "none":
        return None
    return {
        "status": t.status, "tree": t.tree_id, "measured": t.measured, "bearing": _r(t.bearing_rad, 3),
        "range": _r(t.range_m, 2), "radius": _r(t.radius_m, 3),
        "at": None if t.position_map_m is None else [_r(v, 3) for v in t.position_map_m],
        "age": _r(a.links.age_s("trees/target", now_s), 2),
    }  # fmt: skip


def _claim(a: Aircraft, now_s: float) -> dict[str, Any] | None:
    c = a.held
    if c is None:
        return None
    return {
        "kind": None if c.held is None else c.held.kind, "tree": None if c.held is None else c.held.tree_id,
        "left": _r(c.left_s, 0), "asked": None if c.asked is None else c.asked.tree_id, "undelivered": c.undelivered,
        "note": c.note, "age": _r(a.links.age_s("fleet/held", now_s), 2),
    }  # fmt: skip


def _fusion(a: Aircraft, now_s: float) -> dict[str, Any] | None:
    """Return fusion's state; None where it was never heard, which is where it is off."""
    f = a.fusion
    if f is None:
        return None
    place = None
    if f.place is not None:
        place = [round(f.place.latitude_deg, 7), round(f.place.longitude_deg, 7), _r(f.place.sigma_m, 2)]
    return {
        "carrier": f.carrier, "word": CARRIER_WORDS[f.carrier], "carried": _r(f.carried_s, 1), "gps": f.gps, "gps_word": f.gps_word,
        "place": place, "restarts": f.restarts, "jumps": f.jumps_announced, "age": _r(a.links.age_s("fusion/state", now_s), 2),
    }  # fmt: skip


def _vehicle(a: Aircraft, now_s: float) -> dict[str, Any] | None:
    v = a.vehicle
    if v is None:
        return None
    speed = None
    if v.velocity_map_m_s is not None:
        speed = (v.velocity_map_m_s[0] ** 2 + v.velocity_map_m_s[1] ** 2) ** 0.5
    return {
        "mode": v.mode, "armed": v.armed, "landed": v.landed, "connected": v.connected,
        "battery": _r(v.battery_share, 3), "override": v.operator_override, "fused": v.vision_fused,
        "speed": _r(speed, 2), "note": v.note, "age": _r(a.links.age_s("vehicle/state", now_s), 2),
    }  # fmt: skip


def _services(a: Aircraft, now_s: float) -> list[list[Any]]:
    rows = []
    for name in sorted(a.live | set(a.health)):
        health = a.health.get(name)
        age = a.links.age_s(f"health/{name}", now_s)
        entry = a.links.arrivals.get(f"health/{name}")
        level = "none" if entry is None else entry.level(now_s)
        state = "silent" if health is None else health.state
        rows.append([name, state, level, _r(age, 1), name in a.live, "" if health is None else health.note])
    return rows


def trees_view(a: Aircraft) -> dict[str, Any]:
    """Return an aircraft's trees, rows in the order of ``TREE_FIELDS``."""
    trees = a.trees
    return {
        "uav": a.uav,
        "version": a.trees_version,
        "map": "" if trees is None else trees.map_id,
        "rows": [] if trees is None else [_tree(tree) for tree in trees.trees],
    }


def _tree(t: Tree) -> list[Any]:
    return [
        t.id, round(t.x_m, 3), round(t.y_m, 3), round(t.z_m, 3), round(t.radius_m, 4), round(t.sigma_xy_m, 3),
        round(t.sigma_radius_m, 4), round(t.confidence, 2), t.observations, int(t.suitable), round(t.arc_rad, 2),
    ]  # fmt: skip


def trail_view(a: Aircraft) -> dict[str, Any]:
    """Return an aircraft's trail for a page that was just opened."""
    points = [[round(value, 2) for value in point] for point in a.trail]
    return {"uav": a.uav, "map": a.trail_map, "points": points}


def operators_view(desk: OperatorDesk) -> list[dict[str, Any]]:
    """Return who is there."""
    return [{"n": o.number, "name": o.name} for o in desk.present()]


def _r(value: float | None, digits: int) -> float | None:
    return None if value is None else round(value, digits)
