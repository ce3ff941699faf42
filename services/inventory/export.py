"""The inventory as CSV and GeoJSON. Pure: rows in, bytes out; equal rows give equal bytes."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Sequence
from datetime import datetime
from typing import Any

from services.inventory.geodesy import TangentPlane
from services.inventory.schema import utc

Row = dict[str, Any]
Cell = str | int | float | bool | None

COLUMNS = (
    "tree_id", "longitude_deg", "latitude_deg", "altitude_m", "site", "frame", "x_m", "y_m", "z_m", "diameter_cm",
    "radius_m", "radius_height_m", "height_seen_m", "sigma_xy_m", "sigma_radius_m", "suitable", "visited", "status",
    "flights", "observations", "confidence", "first_seen", "last_seen",
)  # fmt: skip
_FORMULA = ("=", "+", "-", "@", "\t", "\r")


def tree_rows(
    trees: Sequence[Row], local: Sequence[Row], sites: Sequence[Row], *, everything: bool = False
) -> list[Row]:
    """Return the trees of both tables for export; merged and withdrawn ones only with ``everything``.

    Longitude and latitude are absent for local ones, whose x and y are metres in the map of their site's first flight.
    """
    planes = {s["fid"]: TangentPlane(s["latitude_deg"], s["longitude_deg"], s["altitude_m"]) for s in sites}
    rows = []
    for frame, table in (("global", trees), ("local", local)):
        for tree in table:
            if tree["status"] != "present" and not everything:
                continue
            row = {**tree, "frame": frame, "longitude_deg": None, "latitude_deg": None}
            if frame == "global":
                latitude, longitude, _ = planes[tree["site"]].to_geodetic(tree["x_m"], tree["y_m"], tree["z_m"])
                row["longitude_deg"], row["latitude_deg"] = longitude, latitude
            rows.append({name: _tidy(name, row[name]) for name in COLUMNS})
    return sorted(rows, key=lambda row: int(row["tree_id"]))


def _tidy(name: str, value: Cell | datetime) -> Cell:
    if name in ("suitable", "visited"):
        return bool(value)
    if isinstance(value, float):
        return round(value, 9 if name.endswith("_deg") else 4)
    if isinstance(value, datetime):  # PostgreSQL's, in the session's time zone
        return utc(value)
    return value


def csv_bytes(rows: Sequence[Row]) -> bytes:
    """Return rows as CSV with a header; text that a spreadsheet would take for a formula is quoted as text."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    for row in rows:
        writer.writerow([_cell(row[name]) for name in COLUMNS])
    return text.getvalue().encode()


def _cell(value: Cell) -> Cell:
    if value is None:
        return ""
    if isinstance(value, bool):
        return "true" if value else "false"
    return f"'{value}" if isinstance(value, str) and value.startswith(_FORMULA) else value


def geojson_bytes(rows: Sequence[Row]) -> bytes:
    """Return rows as GeoJSON (RFC 7946): global trees as points, local ones without geometry, their metres as properties."""
    features = []
    for row in rows:
        geometry = None
        if row["longitude_deg"] is not None:
            at = [row["longitude_deg"], row["latitude_deg"], row["altitude_m"]]
            geometry = {"type": "Point", "coordinates": at}
        features.append({"type": "Feature", "id": row["tree_id"], "geometry": geometry, "properties": row})
    body = {"type": "FeatureCollection", "features": features}
    return (json.dumps(body, ensure_ascii=False, allow_nan=False, separators=(",", ":")) + "\n").encode()
