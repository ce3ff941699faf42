"""What other programs do to the inventory's database: a spatial index by QGIS, a PostgreSQL that gives its own types."""

from __future__ import annotations

import math
import sqlite3
import struct
from pathlib import Path

import pytest

from services.inventory.geopackage import GeoPackage, point_blob
from services.inventory.values import Changes
from tests.unit.test_inventory_merge import S, forest, listed
from tests.unit.test_inventory_store import filled

_RTREE = (  # annex F.3 of the standard, as QGIS makes them
    "CREATE VIRTUAL TABLE rtree_trees_geom USING rtree(id, minx, maxx, miny, maxy)",
    "INSERT OR REPLACE INTO rtree_trees_geom SELECT fid, x_m, x_m, y_m, y_m FROM trees",
    "CREATE TRIGGER rtree_trees_geom_insert AFTER INSERT ON trees WHEN (new.geom NOT NULL AND NOT ST_IsEmpty(NEW.geom)) "
    "BEGIN INSERT OR REPLACE INTO rtree_trees_geom VALUES "
    "(NEW.fid, ST_MinX(NEW.geom), ST_MaxX(NEW.geom), ST_MinY(NEW.geom), ST_MaxY(NEW.geom)); END",
    "CREATE TRIGGER rtree_trees_geom_delete AFTER DELETE ON trees WHEN old.geom NOT NULL "
    "BEGIN DELETE FROM rtree_trees_geom WHERE id = OLD.fid; END",
)


def test_a_spatial_index_that_qgis_made_does_not_stop_the_inventory(tmp_path: Path) -> None:
    path = tmp_path / "inventory.gpkg"
    book = filled(path)
    db = sqlite3.connect(path)
    for statement in _RTREE:
        db.execute(statement)
    db.commit()
    db.close()
    store = GeoPackage(path)
    moved = [t.model_copy(update={"x_m": t.x_m + 0.5}) for t in forest(3)]
    book.take("uav1", listed(moved, 3 * S, version=2), 3 * S)
    store.write(book.written(), book.sites)
    store.close()
    db = sqlite3.connect(path)
    rows = db.execute("SELECT geom, minx, maxx, miny, maxy FROM trees JOIN rtree_trees_geom ON id = fid").fetchall()
    db.close()
    assert len(rows) == 14
    for blob, *box in rows:
        x, y = struct.unpack("<dd", blob[13:])
        assert box == pytest.approx([x, x, y, y], rel=1e-6)  # an R-tree keeps 32 bits


def test_points_of_other_programs_are_read_by_the_index(tmp_path: Path) -> None:
    store = GeoPackage(tmp_path / "inventory.gpkg")

    def asked(blob: bytes | None) -> tuple[object, ...]:
        said = store._db.execute(
            "SELECT ST_IsEmpty(?1), ST_MinX(?1), ST_MaxX(?1), ST_MinY(?1), ST_MaxY(?1)", (blob,)
        ).fetchone()
        return tuple(said)

    enveloped = struct.pack("<2sBBi4d", b"GP", 0, 3, 4326, 2.0, 2.0, 3.0, 3.0) + struct.pack("<BIdd", 1, 1, 2.0, 3.0)
    big_endian = struct.pack(">2sBBi", b"GP", 0, 0, 4326) + struct.pack(">BIddd", 0, 1001, 2.0, 3.0, 9.0)
    for blob in (point_blob(2.0, 3.0, 4326), enveloped, big_endian):
        assert asked(blob) == (0, 2.0, 2.0, 3.0, 3.0)
    empty = struct.pack("<2sBBi", b"GP", 0, 17, 4326) + struct.pack("<BIdd", 1, 1, math.nan, math.nan)
    assert asked(empty)[0] == asked(point_blob(math.nan, math.nan, 4326))[0] == 1
    for other in (None, b"", b"GP", b"no geometry at all", point_blob(2.0, 3.0, 4326)[:20]):
        assert asked(other) == (None,) * 5
    store.write(Changes(), {})
    store.close()
