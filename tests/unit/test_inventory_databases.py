"""What other programs do to the inventory's database: a spatial index by QGIS, a PostgreSQL that gives its own types."""

from __future__ import annotations

import json
import math
import sqlite3
import struct
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta, timezone
from pathlib import Path
from types import ModuleType

import pytest

from services.common.errors import InputError
from services.inventory.export import csv_bytes, geojson_bytes, tree_rows
from services.inventory.geopackage import GeoPackage, point_blob
from services.inventory.postgis import PostGis
from services.inventory.values import AuditLine, Changes
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


def test_exports_of_postgis_hold_the_times_as_those_of_a_geopackage(tmp_path: Path) -> None:
    """PostgreSQL gives datetimes, in the session's time zone."""
    path = tmp_path / "inventory.gpkg"
    filled(path)
    store = GeoPackage(path, read_only=True)
    trees, sites = store.rows("trees"), store.rows("sites")
    store.close()
    given = [
        row | {name: datetime.fromisoformat(row[name]).astimezone(timezone(timedelta(hours=2))) for name in ("first_seen", "last_seen")}
        for row in trees
    ]  # fmt: skip
    rows = tree_rows(given, [], sites)
    assert rows[0]["first_seen"] == datetime.fromtimestamp(1, UTC).strftime("%Y-%m-%dT%H:%M:%S.000Z")
    expected = tree_rows(trees, [], sites)
    assert csv_bytes(rows) == csv_bytes(expected)
    assert geojson_bytes(rows) == geojson_bytes(expected)
    assert json.dumps({"trees": rows})


class RefusedError(Exception):
    """Stands for psycopg.Error."""


class Server:
    """A database whose lock is free or taken; each connection keeps what was said to it."""

    def __init__(self) -> None:
        self.free, self.ill = True, False
        self.connections: list[Connection] = []

    def connect(self, *_: object, **__: object) -> Connection:
        self.connections.append(Connection(self))
        return self.connections[-1]


class Connection:
    """As much of psycopg's as is used."""

    def __init__(self, server: Server) -> None:
        self.server, self.closed, self.said, self.rows = server, False, "", 0

    @contextmanager
    def transaction(self) -> Iterator[None]:
        yield

    @contextmanager
    def cursor(self) -> Iterator[Connection]:
        yield self

    def execute(self, query: str, _: object = None) -> Connection:
        if self.server.ill:
            raise RefusedError("terminating connection")
        self.said = query
        return self

    def fetchone(self) -> dict[str, bool]:
        assert "pg_try_advisory_lock" in self.said
        return {"got": self.server.free}

    def executemany(self, _: str, rows: list[object]) -> None:
        self.rows += len(list(rows))

    def close(self) -> None:
        self.closed = True


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch) -> Server:
    there, driver, its_rows = Server(), ModuleType("psycopg"), ModuleType("psycopg.rows")
    monkeypatch.setattr(driver, "Error", RefusedError, raising=False)
    monkeypatch.setattr(driver, "connect", there.connect, raising=False)
    monkeypatch.setattr(its_rows, "dict_row", None, raising=False)
    monkeypatch.setitem(sys.modules, "psycopg", driver)
    monkeypatch.setitem(sys.modules, "psycopg.rows", its_rows)
    return there


NEWS = Changes(audit=[AuditLine(S, "uav1", "link", "info", "", "later")])


def test_a_station_whose_place_another_took_meanwhile_writes_nothing(server: Server) -> None:
    store = PostGis("postgresql://user@host/db")
    server.connections[0].closed = True  # the server was restarted
    server.free = False
    for _ in range(2):
        with pytest.raises(RefusedError, match="another station writes to it"):
            store.write(NEWS, {})
    server.free = True
    store.write(NEWS, {})
    assert [c.rows for c in server.connections] == [0, 0, 0, 1]
    assert [c.closed for c in server.connections] == [True, True, True, False]


def test_a_lock_that_was_not_answered_is_not_taken_for_ours(server: Server) -> None:
    store = PostGis("postgresql://user@host/db")
    server.connections[0].closed = server.ill = True
    with pytest.raises(RefusedError, match="terminating"):
        store.write(NEWS, {})
    server.ill, server.free = False, False
    with pytest.raises(RefusedError, match="another station"):
        store.write(NEWS, {})
    assert not any(c.rows for c in server.connections)


def test_a_second_station_is_refused_at_its_start(server: Server) -> None:
    server.free = False
    with pytest.raises(InputError, match="another station writes to it"):
        PostGis("postgresql://user@host/db")
    assert server.connections[0].closed
