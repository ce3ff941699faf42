"""The inventory in PostgreSQL with PostGIS: the same tables, by URL. The driver is an extra: ``psycopg[binary]``."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, Protocol

from services.common.errors import InputError
from services.inventory import schema
from services.inventory.values import Changes, Contents, Site


class Cursor(Protocol):
    """What is used of psycopg's cursor."""

    def executemany(self, query: str, rows: Iterable[tuple[Any, ...]]) -> object:
        """Execute a statement for each row."""
        ...


_SRID = {schema.GLOBAL_TABLE: 4326, schema.LOCAL_TABLE: 0}
_LOCK = 0x74726565
"""Of the advisory lock: one station writes at a time."""
_TAKEN = "another station writes to it"


class PostGis:
    """One open inventory database."""

    def __init__(self, url: str, *, read_only: bool = False) -> None:
        """Connect and, unless ``read_only``, make the tables where they are missing.

        Raises:
            InputError: no driver, no server, no PostGIS there, or another station at work.
        """
        try:
            import psycopg
            from psycopg.rows import dict_row
        except ImportError:
            raise InputError(
                "inventory: a postgresql:// database needs the driver psycopg: pip install 'psycopg[binary]'"
            ) from None
        self.path = url.rpartition("@")[2]  # the part without a password, for messages
        self.failure: type[Exception] = psycopg.Error
        self._open = lambda: psycopg.connect(url, row_factory=dict_row, connect_timeout=5)
        try:
            self._db: Any = self._open()
        except psycopg.Error as error:
            raise InputError(f"inventory {self.path}: {' '.join(str(error).split())}") from error
        try:
            if not read_only:
                self._create()
        except psycopg.Error as error:
            self._db.close()
            raise InputError(f"inventory {self.path}: {' '.join(str(error).split())}") from error
        except InputError:
            self._db.close()
            raise

    def _create(self) -> None:
        with self._db.transaction():
            if not self._locks():
                raise InputError(f"inventory {self.path}: {_TAKEN}")
            self._db.execute("CREATE EXTENSION IF NOT EXISTS postgis")
            for table, body in schema.TABLES.items():
                key = "BIGSERIAL" if table in {"measurements", "events"} else "BIGINT"
                self._db.execute(f"CREATE TABLE IF NOT EXISTS {table} (fid {key} PRIMARY KEY, {_postgres(body)})")
            for table, body in schema.FEATURES.items():
                self._db.execute(
                    f"CREATE TABLE IF NOT EXISTS {table} (fid BIGINT PRIMARY KEY, geom geometry(Point, {_SRID[table]}), "
                    f"{_postgres(body)})"
                )
            self._db.execute("CREATE INDEX IF NOT EXISTS measurements_of_tree ON measurements (tree_id)")

    def _locks(self) -> bool:
        """Take the lock, which is the connection's, and say whether it is ours."""
        return bool(self._db.execute("SELECT pg_try_advisory_lock(%s) AS got", (_LOCK,)).fetchone()["got"])

    def _open_again(self) -> None:
        """Connect anew; a connection without the lock is not kept: two stations would give the same numbers to trees."""
        self._db = self._open()
        ours = False
        try:
            with self._db.transaction():
                ours = self._locks()
        finally:
            if not ours:
                self._db.close()
        if not ours:
            raise self.failure(_TAKEN)

    def load(self) -> Contents:
        """Return everything but history and log."""
        names = ["sites", "flights", "sightings", *schema.FEATURES]
        return schema.contents_from({name: self.rows(name) for name in names})

    def rows(self, table: str, where: str = "") -> list[dict[str, Any]]:
        """Return a table's rows as mappings, by ``fid``."""
        names = ", ".join(["fid", *schema.columns(table)])
        with self._db.transaction():
            return list(self._db.execute(f"SELECT {names} FROM {table} {where} ORDER BY fid").fetchall())

    def write(self, changes: Changes, sites: dict[int, Site]) -> None:
        """Write all changes in one transaction.

        Raises:
            psycopg.Error: the server refused or is gone, or another station writes there by now; nothing was written
                then, and it is connected to again next time.
        """
        if self._db.closed:
            self._open_again()
        with self._db.transaction(), self._db.cursor() as cursor:
            self._upsert(cursor, "sites", [schema.site_row(v) for v in changes.sites.values()])
            self._upsert(cursor, "flights", [schema.flight_row(v) for v in changes.flights.values()])
            self._upsert(cursor, "sightings", [schema.sighting_row(v) for v in changes.sightings.values()])
            if changes.placed:
                sql = f"DELETE FROM {schema.LOCAL_TABLE} WHERE fid = %s"
                cursor.executemany(sql, [(fid,) for fid in changes.placed])
            for table, frame in ((schema.GLOBAL_TABLE, "global"), (schema.LOCAL_TABLE, "local")):
                rows = []
                for tree in changes.trees.values():
                    site = sites[tree.site]
                    if site.frame == frame:
                        x, y, altitude = schema.point_of(tree, site)
                        rows.append((tree.fid, x, y, *schema.tree_row(tree, altitude)))
                self._upsert_trees(cursor, table, rows)
            self._append(cursor, "measurements", [schema.measurement_row(m) for m in changes.measurements])
            self._append(cursor, "events", [schema.event_row(e) for e in changes.audit])

    @staticmethod
    def _upsert(cursor: Cursor, table: str, rows: list[tuple[Any, ...]]) -> None:
        if not rows:
            return
        names = schema.columns(table)
        sets = ", ".join(f"{name} = EXCLUDED.{name}" for name in names)
        marks = ", ".join(["%s"] * (len(names) + 1))
        sql = f"INSERT INTO {table} (fid, {', '.join(names)}) VALUES ({marks}) ON CONFLICT (fid) DO UPDATE SET {sets}"
        cursor.executemany(sql, [(row[0], *_typed(table, row[1:])) for row in rows])

    @staticmethod
    def _upsert_trees(cursor: Cursor, table: str, rows: list[tuple[Any, ...]]) -> None:
        if not rows:
            return
        names = schema.columns(table)
        sets = ", ".join(f"{name} = EXCLUDED.{name}" for name in ("geom", *names))
        marks = ", ".join(["%s"] * len(names))
        sql = (
            f"INSERT INTO {table} (fid, geom, {', '.join(names)}) "
            f"VALUES (%s, ST_SetSRID(ST_MakePoint(%s, %s), {_SRID[table]}), {marks}) ON CONFLICT (fid) DO UPDATE SET {sets}"
        )
        cursor.executemany(sql, [(*row[:3], *_typed(table, row[3:])) for row in rows])

    @staticmethod
    def _append(cursor: Cursor, table: str, rows: list[tuple[Any, ...]]) -> None:
        if rows:
            names = schema.columns(table)
            marks = ", ".join(["%s"] * len(names))
            sql = f"INSERT INTO {table} ({', '.join(names)}) VALUES ({marks})"
            cursor.executemany(sql, [_typed(table, row) for row in rows])

    def close(self) -> None:
        """Close the connection; its lock goes with it."""
        self._db.close()


def _typed(table: str, row: tuple[Any, ...]) -> tuple[Any, ...]:
    """Return a row with truth values where the table has them: PostgreSQL takes no 1 for true."""
    kinds = schema.kinds(table)
    return tuple(bool(v) if kind == "BOOLEAN" else v for v, kind in zip(row, kinds, strict=True))


def _postgres(body: str) -> str:
    return body.replace("DATETIME", "TIMESTAMPTZ").replace("REAL", "DOUBLE PRECISION")
