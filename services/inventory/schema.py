"""The inventory's tables, as SQL that SQLite and PostgreSQL both understand, and the rows that fill them. Pure.

Feature tables differ only in their reference system: ``trees`` holds latitude and longitude (EPSG:4326),
``trees_local`` metres in the map of a flight without a start point.
"""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime
from typing import Any

from services.inventory.geodesy import TangentPlane
from services.inventory.values import (
    AuditLine,
    Belief,
    Contents,
    Flight,
    Frame,
    InventoryTree,
    Measurement,
    Rigid2,
    Sighting,
    Site,
)

VERSION = 1
GLOBAL_TABLE, LOCAL_TABLE = "trees", "trees_local"

_BELIEF = (
    "x_m REAL, y_m REAL, z_m REAL, radius_m REAL, radius_height_m REAL, height_seen_m REAL, sigma_xy_m REAL, "
    "sigma_radius_m REAL, confidence REAL, observations INTEGER, suitable BOOLEAN"
)
_TREE = (
    "tree_id INTEGER, diameter_cm REAL, radius_m REAL, sigma_xy_m REAL, sigma_radius_m REAL, suitable BOOLEAN, "
    "visited BOOLEAN, status TEXT, merged_into INTEGER, flights INTEGER, observations INTEGER, confidence REAL, "
    "radius_height_m REAL, height_seen_m REAL, altitude_m REAL, site INTEGER, x_m REAL, y_m REAL, z_m REAL, "
    "first_seen DATETIME, last_seen DATETIME, first_ns BIGINT, last_ns BIGINT"
)
TABLES: dict[str, str] = {
    "sites": "frame TEXT, latitude_deg REAL, longitude_deg REAL, altitude_m REAL",
    "flights": "uav TEXT, map_id TEXT, run INTEGER, frame TEXT, site INTEGER, theta_rad REAL, x_m REAL, y_m REAL, z_m REAL, "
    "sigma_m REAL, sigma_heading_rad REAL, aligned BOOLEAN, first_ns BIGINT, last_ns BIGINT, stamp_ns BIGINT, "
    "version BIGINT, note TEXT, first_seen DATETIME, last_seen DATETIME",
    "sightings": f"flight INTEGER, flight_tree_id BIGINT, tree_id INTEGER, present BOOLEAN, kept_ns BIGINT, {_BELIEF}",
    "measurements": f"sighting INTEGER, tree_id INTEGER, time_ns BIGINT, stamp_ns BIGINT, measured DATETIME, "
    f"inventory_x_m REAL, inventory_y_m REAL, {_BELIEF}",
    "events": "time_ns BIGINT, time DATETIME, uav TEXT, kind TEXT, level TEXT, operator TEXT, text TEXT",
}
"""Tables without geometry: name -> columns after the key ``fid``."""
FEATURES: dict[str, str] = {GLOBAL_TABLE: _TREE, LOCAL_TABLE: _TREE}
ABOUT = {
    "trees": "trees, placed on the globe by the start points of their flights",
    "trees_local": "trees of flights without a start point: metres in the map of the site's first flight, not on the globe",
    "sites": "frames that flights share",
    "flights": "maps of aircraft and how they lie in their site",
    "sightings": "which tree of which flight is which tree of the inventory, with the flight's newest belief",
    "measurements": "every measurement that told something new",
    "events": "what happened, and who commanded what",
}


def columns(table: str) -> list[str]:
    """Return a table's column names after ``fid`` (and the geometry)."""
    body = TABLES.get(table) or FEATURES[table]
    return [part.strip().split(" ")[0] for part in body.split(",")]


def kinds(table: str) -> list[str]:
    """Return the types of ``columns(table)``."""
    body = TABLES.get(table) or FEATURES[table]
    return [part.strip().split(" ")[1] for part in body.split(",")]


def iso(time_ns: int) -> str:
    """Return a time as GeoPackage writes it; see ``utc``."""
    return utc(datetime.fromtimestamp(time_ns // 10**9, UTC).replace(microsecond=time_ns % 10**9 // 1000))


def utc(moment: datetime) -> str:
    """Return a moment as GeoPackage writes it: UTC with milliseconds."""
    return f"{moment.astimezone(UTC).strftime('%Y-%m-%dT%H:%M:%S.%f')[:-3]}Z"


def _belief(b: Belief) -> tuple[Any, ...]:
    return (b.x_m, b.y_m, b.z_m, b.radius_m, b.radius_height_m, b.height_seen_m, b.sigma_xy_m, b.sigma_radius_m,
            b.confidence, b.observations, int(b.suitable))  # fmt: skip


def site_row(s: Site) -> tuple[Any, ...]:
    """Return a row of ``sites``, its key first."""
    return s.number, s.frame, s.latitude_deg, s.longitude_deg, s.altitude_m


def flight_row(f: Flight) -> tuple[Any, ...]:
    """Return a row of ``flights``."""
    p = f.place
    return (f.fid, f.uav, f.map_id, f.run, f.frame, f.site, p.theta_rad, p.x_m, p.y_m, p.z_m, f.sigma_m,
            f.sigma_heading_rad, int(f.aligned), f.first_ns, f.last_ns, f.stamp_ns, f.version, f.note, iso(f.first_ns),
            iso(f.last_ns))  # fmt: skip


def sighting_row(s: Sighting) -> tuple[Any, ...]:
    """Return a row of ``sightings``."""
    return s.fid, s.flight, s.tree_id, s.tree, int(s.present), s.kept_ns, *_belief(s.belief)


def measurement_row(m: Measurement) -> tuple[Any, ...]:
    """Return a row of ``measurements``; its key is the database's."""
    return m.sighting, m.tree, m.time_ns, m.stamp_ns, iso(m.time_ns), m.x_m, m.y_m, *_belief(m.belief)


def event_row(e: AuditLine) -> tuple[Any, ...]:
    """Return a row of ``events``; its key is the database's."""
    return e.time_ns, iso(e.time_ns), e.uav, e.kind, e.level, e.who, e.text


def point_of(t: InventoryTree, site: Site) -> tuple[float, float, float]:
    """Return the tree's coordinates in its table's reference system, x first (longitude), and its altitude."""
    if site.frame == "local":
        return t.x_m, t.y_m, t.z_m
    plane = TangentPlane(site.latitude_deg, site.longitude_deg, site.altitude_m)
    latitude, longitude, altitude = plane.to_geodetic(t.x_m, t.y_m, t.z_m)
    return longitude, latitude, altitude


def tree_row(t: InventoryTree, altitude_m: float) -> tuple[Any, ...]:
    """Return a tree's row after key and geometry."""
    return (t.fid, round(t.radius_m * 200.0, 2), t.radius_m, t.sigma_xy_m, t.sigma_radius_m, int(t.suitable),
            int(t.visited), t.status, t.merged_into, t.flights, t.observations, t.confidence, t.radius_height_m,
            t.height_seen_m, altitude_m, t.site, t.x_m, t.y_m, t.z_m, iso(t.first_ns), iso(t.last_ns), t.first_ns,
            t.last_ns)  # fmt: skip


def contents_from(rows: dict[str, Sequence[dict[str, Any]]]) -> Contents:
    """Return the contents of tables read as mappings, each with its ``fid``."""
    trees: list[tuple[dict[str, Any], Frame]] = [(row, "global") for row in rows[GLOBAL_TABLE]]
    trees += [(row, "local") for row in rows[LOCAL_TABLE]]
    return Contents(
        tuple(
            Site(r["fid"], r["frame"], r["latitude_deg"], r["longitude_deg"], r["altitude_m"]) for r in rows["sites"]
        ),
        tuple(_flight(r) for r in rows["flights"]),
        tuple(_sighting(r) for r in rows["sightings"]),
        tuple(_tree(row, frame) for row, frame in sorted(trees, key=lambda pair: int(pair[0]["fid"]))),
    )


def _flight(r: dict[str, Any]) -> Flight:
    return Flight(
        r["fid"], r["uav"], r["map_id"], r["run"], r["frame"], r["site"],
        Rigid2(r["theta_rad"], r["x_m"], r["y_m"], r["z_m"]), r["sigma_m"], r["sigma_heading_rad"],
        aligned=bool(r["aligned"]), first_ns=r["first_ns"], last_ns=r["last_ns"], stamp_ns=r["stamp_ns"],
        version=r["version"], note=r["note"],
    )  # fmt: skip


def _belief_of(r: dict[str, Any]) -> Belief:
    return Belief(r["x_m"], r["y_m"], r["z_m"], r["radius_m"], r["radius_height_m"], r["height_seen_m"], r["sigma_xy_m"],
                  r["sigma_radius_m"], r["confidence"], r["observations"], bool(r["suitable"]))  # fmt: skip


def _sighting(r: dict[str, Any]) -> Sighting:
    belief = _belief_of(r)
    kept = belief if r["kept_ns"] else None
    return Sighting(
        r["fid"], r["flight"], r["flight_tree_id"], r["tree_id"], belief, bool(r["present"]), kept, r["kept_ns"]
    )


def _tree(r: dict[str, Any], frame: Frame) -> InventoryTree:
    return InventoryTree(
        r["fid"], frame, r["site"], r["x_m"], r["y_m"], r["z_m"], r["radius_m"], r["radius_height_m"], r["height_seen_m"],
        r["sigma_xy_m"], r["sigma_radius_m"], r["confidence"], r["observations"], r["flights"],
        suitable=bool(r["suitable"]), status=r["status"], merged_into=r["merged_into"], first_ns=r["first_ns"],
        last_ns=r["last_ns"], visited=bool(r["visited"]),
    )  # fmt: skip
