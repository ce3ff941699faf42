"""The inventory in a real PostgreSQL with PostGIS, where one is named by INVENTORY_POSTGIS_URL (its tables are dropped)."""

from __future__ import annotations

import os

import pytest

from services.common.errors import InputError
from services.inventory.book import Inventory
from services.inventory.export import tree_rows
from services.inventory.store import open_store
from services.inventory.values import AuditLine, Changes
from tests.unit.test_inventory_merge import S, forest, listed, seen_from, take
from tests.unit.test_inventory_store import PLACED

URL = os.environ.get("INVENTORY_POSTGIS_URL", "")
pytestmark = pytest.mark.skipif(not URL, reason="no PostGIS named by INVENTORY_POSTGIS_URL")


@pytest.fixture(autouse=True)
def emptied() -> None:
    psycopg = pytest.importorskip("psycopg", reason="psycopg is not installed: pip install 'psycopg[binary]'")
    with psycopg.connect(URL, autocommit=True) as db:
        for table in ("trees", "trees_local", "sites", "flights", "sightings", "measurements", "events"):
            db.execute(f"DROP TABLE IF EXISTS {table}")


def test_what_was_written_is_read_back_and_postgis_knows_where_it_is() -> None:
    psycopg = pytest.importorskip("psycopg")
    store = open_store(URL)
    book = Inventory(PLACED, store.load())
    world = forest(5)
    take(book, "uav1", listed(world), S)
    changes = book.written()
    changes.audit.append(AuditLine(S, "uav1", "command", "good", "Anna", "Anna: start: accepted"))
    store.write(changes, book.sites)
    late = seen_from(world, 1.0, 3.0, 2.0, 2)
    book.take("uav1", listed(late, map_id="m2"), 2 * S, in_air=True)
    store.write(book.written(), book.sites)
    assert len(store.rows("trees_local")) == 14
    while book.join_next(2 * S):
        pass
    store.write(book.written(), book.sites)
    contents = store.load()
    assert {t.fid: t for t in contents.trees} == book.trees
    assert {f.fid: f for f in contents.flights} == book.flights
    assert {s.fid: s for s in contents.sightings} == book.sightings
    assert store.rows("trees_local") == []
    found = store.rows("trees", "WHERE ST_DWithin(geom::geography, ST_MakePoint(172.58, -43.52)::geography, 15)")
    assert len([row for row in found if row["status"] == "present"]) >= 13
    assert len(tree_rows(store.rows("trees"), [], store.rows("sites"))) == 14
    with pytest.raises(InputError, match="another station"):
        open_store(URL)
    with psycopg.connect(URL, autocommit=True) as db:  # the server throws everybody out, as at its restart
        db.execute(
            "SELECT pg_terminate_backend(pid) FROM pg_stat_activity WHERE pid <> pg_backend_pid() AND backend_type = 'client backend'"
        )
    changes = Changes(audit=[AuditLine(2 * S, "uav1", "link", "info", "", "later")])
    with pytest.raises(psycopg.Error):
        store.write(changes, book.sites)
    store.write(changes, book.sites)
    reader = open_store(URL, read_only=True)
    assert len(reader.rows("events")) == 2
    reader.close()
    store.close()
    open_store(URL).close()


def test_a_server_that_is_not_there_is_told_in_one_line() -> None:
    with pytest.raises(InputError, match="inventory") as refused:
        open_store("postgresql://user:secret@127.0.0.1:1/none")
    assert "secret" not in str(refused.value)
