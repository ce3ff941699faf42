"""The inventory as a GeoPackage 1.3 (OGC 12-128r17): one SQLite file that QGIS opens as it is.

Written in whole transactions with the write-ahead log and full synchronisation: after a power cut the file holds every
commit that was finished, and nothing of one that was not. Readers (QGIS) do not stop the writer.
"""

from __future__ import annotations

import contextlib
import math
import sqlite3
import struct
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from services.common.errors import InputError
from services.inventory import schema
from services.inventory.values import Changes, Contents, InventoryTree, Site

APPLICATION_ID = 0x47504B47  # "GPKG", requirement 2
_GATHER_S = 5.0
"""The file alone, without the log beside it, is at most about so far behind while the station writes."""
USER_VERSION = 10300
_BUSY_MS = 2_000
_WGS84 = (
    'GEOGCS["WGS 84",DATUM["WGS_1984",SPHEROID["WGS 84",6378137,298.257223563,AUTHORITY["EPSG","7030"]],'
    'AUTHORITY["EPSG","6326"]],PRIMEM["Greenwich",0,AUTHORITY["EPSG","8901"]],'
    'UNIT["degree",0.0174532925199433,AUTHORITY["EPSG","9122"]],AUTHORITY["EPSG","4326"]]'
)
REQUIRED_SRS = (  # table 1 of the standard: these three must be there
    ("WGS 84 geodetic", 4326, "EPSG", 4326, _WGS84, "longitude and latitude in degrees"),
    ("Undefined Cartesian SRS", -1, "NONE", -1, "undefined", "undefined Cartesian coordinate reference system"),
    ("Undefined geographic SRS", 0, "NONE", 0, "undefined", "undefined geographic coordinate reference system"),
)
CORE_SQL = """
CREATE TABLE gpkg_spatial_ref_sys (srs_name TEXT NOT NULL, srs_id INTEGER PRIMARY KEY, organization TEXT NOT NULL,
  organization_coordsys_id INTEGER NOT NULL, definition TEXT NOT NULL, description TEXT);
CREATE TABLE gpkg_contents (table_name TEXT NOT NULL PRIMARY KEY, data_type TEXT NOT NULL, identifier TEXT UNIQUE,
  description TEXT DEFAULT '', last_change DATETIME NOT NULL DEFAULT (strftime('%Y-%m-%dT%H:%M:%fZ','now')),
  min_x DOUBLE, min_y DOUBLE, max_x DOUBLE, max_y DOUBLE, srs_id INTEGER,
  CONSTRAINT fk_gc_r_srs_id FOREIGN KEY (srs_id) REFERENCES gpkg_spatial_ref_sys(srs_id));
CREATE TABLE gpkg_geometry_columns (table_name TEXT NOT NULL, column_name TEXT NOT NULL, geometry_type_name TEXT NOT NULL,
  srs_id INTEGER NOT NULL, z TINYINT NOT NULL, m TINYINT NOT NULL,
  CONSTRAINT pk_geom_cols PRIMARY KEY (table_name, column_name), CONSTRAINT uk_gc_table_name UNIQUE (table_name),
  CONSTRAINT fk_gc_tn FOREIGN KEY (table_name) REFERENCES gpkg_contents(table_name),
  CONSTRAINT fk_gc_srs FOREIGN KEY (srs_id) REFERENCES gpkg_spatial_ref_sys (srs_id));
"""
_SRS = {schema.GLOBAL_TABLE: 4326, schema.LOCAL_TABLE: -1}
_ENVELOPE_BYTES = {0: 0, 1: 32, 2: 48, 3: 48, 4: 64}
"""After the header, by its code for what the envelope holds."""
_ROWS: dict[str, Any] = {
    "sites": schema.site_row,
    "flights": schema.flight_row,
    "sightings": schema.sighting_row,
}


def point_blob(x: float, y: float, srs_id: int) -> bytes:
    """Return a point as GeoPackage stores it: the GP header (2.1.3.1), little endian, no envelope, then WKB."""
    return struct.pack("<2sBBi", b"GP", 0, 1, srs_id) + struct.pack("<BIdd", 1, 1, x, y)


def point_in(blob: object) -> tuple[float, float] | None:
    """Return x and y of a point as GeoPackage stores it, ours or another program's; NaN: it is empty. None: no such point."""
    if not isinstance(blob, bytes) or blob[:2] != b"GP":
        return None
    try:
        at = 8 + _ENVELOPE_BYTES[blob[3] >> 1 & 7]
        order = "<" if blob[at] else ">"
        x, y = struct.unpack_from(f"{order}dd", blob, at + 5)
    except (struct.error, IndexError, KeyError):
        return None
    return x, y


def _add_functions(db: sqlite3.Connection) -> None:
    """Give the connection what the triggers of a spatial index call, which QGIS puts into the file (annex F.3)."""

    def part(k: int) -> Callable[[object], float | None]:
        def of(blob: object) -> float | None:
            point = point_in(blob)
            return None if point is None else point[k]

        return of

    def empty(blob: object) -> bool | None:
        point = point_in(blob)
        return None if point is None else math.isnan(point[0])

    functions = {"ST_MinX": part(0), "ST_MaxX": part(0), "ST_MinY": part(1), "ST_MaxY": part(1), "ST_IsEmpty": empty}
    for name, function in functions.items():
        db.create_function(name, 1, function, deterministic=True)


class GeoPackage:
    """One open inventory file."""

    def __init__(self, path: Path, *, read_only: bool = False) -> None:
        """Open the file, or make it unless ``read_only``.

        Raises:
            InputError: a folder that cannot be written, or a file that is no inventory of ours.
        """
        self.path = path
        self._read_only = read_only
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._db = sqlite3.connect(path, timeout=_BUSY_MS / 1e3, isolation_level=None, check_same_thread=False)
            self._db.row_factory = sqlite3.Row
            _add_functions(self._db)
            if read_only:
                self._db.execute("PRAGMA query_only = ON")
            else:
                self._db.execute("PRAGMA journal_mode = WAL")
                self._db.execute("PRAGMA synchronous = FULL")
            self._prepare()
        except InputError:
            self._db.close()
            raise
        except (OSError, sqlite3.Error) as error:
            if hasattr(self, "_db"):
                self._db.close()
            raise InputError(f"inventory {path}: cannot be opened ({error}); name another with --set station.inventory.database=FILE") from error  # fmt: skip
        self._extents: dict[str, tuple[float, float, float, float]] = {}
        self._gathered_s = time.monotonic()

    def _prepare(self) -> None:
        db = self._db
        kind = int(db.execute("PRAGMA application_id").fetchone()[0])
        tables = {row[0] for row in db.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
        if not tables and not self._read_only:
            self._create()
        elif kind != APPLICATION_ID or "sightings" not in tables:
            raise InputError(f"inventory {self.path}: is another program's database; name another file")
        version = db.execute("SELECT version FROM treedock_inventory").fetchone()
        if version is None or version[0] != schema.VERSION:
            found = None if version is None else version[0]
            raise InputError(f"inventory {self.path}: of version {found}, this treedock writes {schema.VERSION}")

    def _create(self) -> None:
        """Make all tables in one transaction: a file is either whole or empty."""
        db = self._db
        db.execute(f"PRAGMA application_id = {APPLICATION_ID}")
        db.execute(f"PRAGMA user_version = {USER_VERSION}")
        db.execute("BEGIN IMMEDIATE")
        for statement in CORE_SQL.split(";"):
            if statement.strip():
                db.execute(statement)
        db.executemany("INSERT INTO gpkg_spatial_ref_sys VALUES (?,?,?,?,?,?)", REQUIRED_SRS)
        for table, body in schema.TABLES.items():
            db.execute(f"CREATE TABLE {table} (fid INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL, {_sqlite(body)})")
            self._register(table, "attributes", None)
        for table, body in schema.FEATURES.items():
            db.execute(
                f"CREATE TABLE {table} (fid INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL, geom POINT, {_sqlite(body)})"
            )
            self._register(table, "features", _SRS[table])
            db.execute("INSERT INTO gpkg_geometry_columns VALUES (?, 'geom', 'POINT', ?, 0, 0)", (table, _SRS[table]))
        db.execute("CREATE INDEX measurements_of_tree ON measurements (tree_id)")
        db.execute("CREATE TABLE treedock_inventory (version INTEGER NOT NULL)")
        db.execute("INSERT INTO treedock_inventory VALUES (?)", (schema.VERSION,))
        db.execute("COMMIT")
        db.execute("PRAGMA wal_checkpoint(TRUNCATE)")

    def _register(self, table: str, kind: str, srs: int | None) -> None:
        self._db.execute(
            "INSERT INTO gpkg_contents (table_name, data_type, identifier, description, srs_id) VALUES (?,?,?,?,?)",
            (table, kind, table, schema.ABOUT[table], srs),
        )

    def load(self) -> Contents:
        """Return everything but history and log."""
        names = ["sites", "flights", "sightings", *schema.FEATURES]
        return schema.contents_from({name: self.rows(name) for name in names})

    def rows(self, table: str, where: str = "") -> list[dict[str, Any]]:
        """Return a table's rows as mappings, by ``fid``; the geometry is left out."""
        names = ", ".join(["fid", *schema.columns(table)])
        return [dict(row) for row in self._db.execute(f"SELECT {names} FROM {table} {where} ORDER BY fid")]

    def write(self, changes: Changes, sites: dict[int, Site]) -> None:
        """Write all changes in one transaction: after it returned they survive a power cut.

        Raises:
            sqlite3.Error: a full disk, or another program that holds the file for long; nothing was written then.
        """
        db = self._db
        db.execute("BEGIN IMMEDIATE")
        try:
            for table, values in (
                ("sites", changes.sites),
                ("flights", changes.flights),
                ("sightings", changes.sightings),
            ):
                self._upsert(table, [_ROWS[table](value) for value in values.values()])
            db.executemany(f"DELETE FROM {schema.LOCAL_TABLE} WHERE fid = ?", [(fid,) for fid in changes.placed])
            self._write_trees(list(changes.trees.values()), sites)
            self._append("measurements", [schema.measurement_row(m) for m in changes.measurements])
            self._append("events", [schema.event_row(e) for e in changes.audit])
            db.execute("COMMIT")
        except sqlite3.Error:
            if db.in_transaction:
                db.execute("ROLLBACK")
            raise
        self._gather()

    def _gather(self) -> None:
        """Now and then bring what is safe in the log beside the file into the file: whoever copies it alone has it."""
        now_s = time.monotonic()
        if now_s - self._gathered_s >= _GATHER_S:
            self._gathered_s = now_s
            with contextlib.suppress(sqlite3.Error):  # it is safe where it is, and comes with the next
                self._db.execute("PRAGMA wal_checkpoint(PASSIVE)")

    def _upsert(self, table: str, rows: list[tuple[Any, ...]]) -> None:
        if rows:
            marks = ",".join("?" * len(rows[0]))
            self._db.executemany(f"INSERT OR REPLACE INTO {table} VALUES ({marks})", rows)

    def _append(self, table: str, rows: list[tuple[Any, ...]]) -> None:
        if rows:
            marks = ",".join("?" * len(rows[0]))
            names = ", ".join(schema.columns(table))
            self._db.executemany(f"INSERT INTO {table} ({names}) VALUES ({marks})", rows)

    def _write_trees(self, trees: list[InventoryTree], sites: dict[int, Site]) -> None:
        by_table: dict[str, list[tuple[Any, ...]]] = {}
        for tree in trees:
            site = sites[tree.site]
            table = schema.GLOBAL_TABLE if site.frame == "global" else schema.LOCAL_TABLE
            x, y, altitude = schema.point_of(tree, site)
            row = (tree.fid, point_blob(x, y, _SRS[table]), *schema.tree_row(tree, altitude))
            by_table.setdefault(table, []).append(row)
            self._widen(table, x, y)
        for table, rows in by_table.items():
            self._upsert(table, rows)
            stamp = schema.iso(time.time_ns())
            self._db.execute(
                "UPDATE gpkg_contents SET last_change = ?, min_x = ?, min_y = ?, max_x = ?, max_y = ? WHERE table_name = ?",
                (stamp, *self._extents[table], table),
            )

    def _widen(self, table: str, x: float, y: float) -> None:
        box = self._extents.get(table)
        if box is None:
            found = self._db.execute(
                "SELECT min_x, min_y, max_x, max_y FROM gpkg_contents WHERE table_name = ?", (table,)
            ).fetchone()
            box = (x, y, x, y) if found[0] is None else tuple(found)
        self._extents[table] = (min(box[0], x), min(box[1], y), max(box[2], x), max(box[3], y))

    def close(self) -> None:
        """Bring everything into the one file and close it."""
        try:
            if not self._read_only:
                self._db.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        finally:
            self._db.close()


def _sqlite(body: str) -> str:
    """Return the columns with the type names that GeoPackage knows (table 1 of the standard)."""
    return body.replace("BIGINT", "INTEGER").replace("REAL", "DOUBLE")
