"""The inventory's file: the GeoPackage standard, transactions, power cuts, exports."""

from __future__ import annotations

import csv
import io
import json
import shutil
import sqlite3
import struct
import subprocess
import sys
from pathlib import Path

import pytest

from services.cli.app import invoke
from services.common.errors import InputError
from services.inventory import schema
from services.inventory.book import Inventory
from services.inventory.config import InventoryConfig, StartPoint
from services.inventory.export import csv_bytes, geojson_bytes, tree_rows
from services.inventory.geopackage import GeoPackage
from services.inventory.keeper import Keeper
from services.inventory.store import open_store
from services.inventory.values import AuditLine, Changes
from tests.unit.navigator_world import tree
from tests.unit.test_inventory_merge import START, S, forest, listed

PLACED = InventoryConfig(start_points=(START,))


def filled(path: Path, config: InventoryConfig = PLACED, seed: int = 3) -> Inventory:
    store = GeoPackage(path)
    book = Inventory(config, store.load())
    book.take("uav1", listed(forest(seed)), S)
    changes = book.written()
    changes.audit.append(AuditLine(S, "uav1", "command", "good", "Anna", "Anna: start: accepted"))
    store.write(changes, book.sites)
    store.close()
    return book


def test_the_file_is_a_geopackage_as_the_standard_says(tmp_path: Path) -> None:
    path = tmp_path / "inventory.gpkg"
    book = filled(path)
    assert not (tmp_path / "inventory.gpkg-wal").exists()  # all in the one file
    data = path.read_bytes()[:100]
    assert data[68:72] == b"GPKG"
    assert struct.unpack(">I", data[60:64])[0] == 10300
    db = sqlite3.connect(path)
    assert {row[0] for row in db.execute("SELECT srs_id FROM gpkg_spatial_ref_sys")} >= {-1, 0, 4326}
    assert db.execute("PRAGMA integrity_check").fetchone()[0] == "ok"
    assert db.execute("PRAGMA foreign_key_check").fetchall() == []
    kinds = dict(db.execute("SELECT table_name, data_type FROM gpkg_contents").fetchall())
    assert kinds["trees"] == kinds["trees_local"] == "features"
    assert set(kinds) - {"trees", "trees_local"} == set(schema.TABLES)
    blob, x, y = db.execute("SELECT geom, x_m, y_m FROM trees WHERE fid = 1").fetchone()
    magic, version, flags, srs, order, wkb, lon, lat = struct.unpack("<2sBBiBIdd", blob)
    assert (magic, version, flags, srs, order, wkb) == (b"GP", 0, 1, 4326, 1, 1)
    # one second of latitude is about 30.9 m there: metres and degrees agree
    assert (lat - START.latitude_deg) * 111_100.0 == pytest.approx(y, abs=0.02)
    assert (lon - START.longitude_deg) * 111_320.0 * 0.7266 == pytest.approx(x, abs=0.02)
    box = db.execute("SELECT min_x, min_y, max_x, max_y FROM gpkg_contents WHERE table_name='trees'").fetchone()
    assert box[0] <= lon <= box[2]
    assert box[1] <= lat <= box[3]
    assert len(book.trees) == db.execute("SELECT count(*) FROM trees").fetchone()[0]
    db.close()


@pytest.mark.skipif(shutil.which("ogrinfo") is None, reason="ogrinfo is not installed: apt-get install gdal-bin")
def test_gdal_reads_it(tmp_path: Path) -> None:
    path = tmp_path / "inventory.gpkg"
    filled(path)
    said = subprocess.run(["ogrinfo", "-al", "-so", str(path)], capture_output=True, text=True, check=True)
    assert "Warning" not in said.stderr
    assert "ERROR" not in said.stderr
    layer = said.stdout.split("Layer name: trees\n")[1].split("Layer name:")[0]
    assert "Geometry: Point" in layer
    assert "Feature Count: 14" in layer
    assert 'GEOGCRS["WGS 84"' in layer
    assert "suitable: Integer(Boolean)" in layer
    assert "first_seen: DateTime" in layer
    measurements = said.stdout.split("Layer name: measurements\n")[1]
    assert "Feature Count: 14" in measurements


def test_local_trees_say_that_they_are_nowhere_on_the_globe(tmp_path: Path) -> None:
    path = tmp_path / "inventory.gpkg"
    filled(path, InventoryConfig())
    db = sqlite3.connect(path)
    assert db.execute("SELECT count(*) FROM trees").fetchone()[0] == 0
    assert db.execute("SELECT count(*) FROM trees_local").fetchone()[0] == 14
    assert db.execute("SELECT srs_id FROM gpkg_geometry_columns WHERE table_name='trees_local'").fetchone()[0] == -1
    assert "no start point" in db.execute("SELECT note FROM flights").fetchone()[0]
    db.close()


def test_what_was_written_is_read_back_the_same(tmp_path: Path) -> None:
    path = tmp_path / "inventory.gpkg"
    book = filled(path)
    store = open_store(str(path))
    contents = store.load()
    store.close()
    assert {t.fid: t for t in contents.trees} == book.trees
    assert {f.fid: f for f in contents.flights} == book.flights
    assert {s.fid: s for s in contents.sightings} == book.sightings
    assert {s.number: s for s in contents.sites} == book.sites


def test_the_file_alone_is_a_geopackage_while_the_station_writes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Somebody copies the one file in the field, without the log that SQLite keeps beside it."""
    path, copy = tmp_path / "inventory.gpkg", tmp_path / "copy.gpkg"
    store = GeoPackage(path)
    shutil.copy(path, copy)
    assert copy.read_bytes()[68:72] == b"GPKG"
    early = GeoPackage(copy)
    assert early.rows("trees") == []
    early.close()
    monkeypatch.setattr("services.inventory.geopackage._GATHER_S", 0.0)
    book = Inventory(PLACED, store.load())
    book.take("uav1", listed(forest(3)), S)
    store.write(book.written(), book.sites)
    shutil.copy(path, copy)
    late = GeoPackage(copy)
    assert len(late.rows("trees")) == len(store.rows("trees")) == len(book.trees) > 0
    late.close()
    store.close()


def test_a_commit_is_whole_or_absent(tmp_path: Path) -> None:
    path = tmp_path / "inventory.gpkg"
    book = filled(path)
    store = GeoPackage(path)
    broken = Changes(trees=dict(book.trees), audit=[AuditLine(S, "u", "k", "l", "w", object())])  # type: ignore[arg-type]
    for t in broken.trees.values():
        t.radius_m = 9.0
    with pytest.raises(sqlite3.Error):
        store.write(broken, book.sites)
    assert all(row["radius_m"] < 1.0 for row in store.rows("trees"))
    store.close()


def test_a_process_killed_while_it_writes_leaves_a_file_that_opens(tmp_path: Path) -> None:
    path = tmp_path / "inventory.gpkg"
    script = f"""
import sys
from pathlib import Path
sys.path.insert(0, {str(Path.cwd())!r})
from tests.unit.test_inventory_store import GeoPackage, Inventory, PLACED, listed, forest, S
store = GeoPackage(Path({str(path)!r}))
book = Inventory(PLACED, store.load())
n = 0
while True:
    n += 1
    moved = [t.model_copy(update={{"x_m": t.x_m + 0.02 * n}}) for t in forest(3)]
    book.take("uav1", listed(moved, n * 2 * S, version=n), n * 2 * S)
    store.write(book.written(), book.sites)
    print(n, flush=True)
"""
    with subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        told = 0
        for _ in range(30):
            told = int(process.stdout.readline())
        process.kill()
        told = max([told, *(int(line) for line in process.stdout.read().split())])
    store = open_store(str(path))
    flights = store.load().flights
    assert flights[0].version >= told  # every commit that was told is there
    assert len(store.rows("trees")) == 14
    store.close()


def test_two_stations_do_not_write_to_one_file(tmp_path: Path) -> None:
    path = str(tmp_path / "inventory.gpkg")
    first = open_store(path)
    with pytest.raises(InputError, match="another station"):
        open_store(path)
    first.close()
    open_store(path).close()


def test_files_that_are_no_inventory_are_refused_in_one_line(tmp_path: Path) -> None:
    text = tmp_path / "text.gpkg"
    text.write_text("this is no database, and long enough to be taken for one" * 20)
    with pytest.raises(InputError, match="cannot be opened"):
        open_store(str(text))
    other = tmp_path / "other.gpkg"
    db = sqlite3.connect(other)
    db.execute("CREATE TABLE things (a)")
    db.close()
    with pytest.raises(InputError, match="another program"):
        open_store(str(other))
    with pytest.raises(InputError, match="no such file"):
        open_store(str(tmp_path / "absent.gpkg"), read_only=True)


def test_postgis_without_its_driver_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "psycopg", None)
    with pytest.raises(InputError, match=r"pip install 'psycopg\[binary\]'"):
        open_store("postgresql://user:secret@host/db")


def test_a_disk_that_takes_nothing_is_told_and_nothing_is_lost_when_it_does_again(tmp_path: Path) -> None:
    store = GeoPackage(tmp_path / "inventory.gpkg")
    said: list[tuple[str, str]] = []
    keeper = Keeper(store, PLACED, lambda text, tone: said.append((tone, text)))
    write = store.write

    def full(*_: object) -> None:
        raise sqlite3.OperationalError("database or disk is full")

    store.write = full  # type: ignore[method-assign, assignment]
    keeper.offer("uav1", listed(forest(3)), frozenset())
    keeper.turn(S)
    keeper.turn(2 * S)
    assert [tone for tone, _ in said] == ["info", "bad"]
    assert "disk is full" in said[1][1]
    store.write = write  # type: ignore[method-assign]
    keeper.turn(3 * S)
    assert said[-1][0] == "good"
    assert len(store.rows("trees")) == len(store.rows("measurements")) == 14
    store.close()


def test_a_bug_in_the_inventory_is_told_and_ends_nothing_else(tmp_path: Path) -> None:
    said: list[tuple[str, str]] = []
    keeper = Keeper(GeoPackage(tmp_path / "inventory.gpkg"), PLACED, lambda text, tone: said.append((tone, text)))

    def fall(_: int) -> None:
        raise RuntimeError("on purpose")

    keeper.turn = fall  # type: ignore[method-assign, assignment]
    keeper.start()
    keeper._thread.join(5.0)
    assert said == [("bad", "the inventory stopped by a bug: start the station again")]
    keeper.offer("uav1", listed(forest(3)), frozenset())
    keeper.close()


def test_exports_hold_the_trees_and_no_formulas(tmp_path: Path) -> None:
    path = tmp_path / "inventory.gpkg"
    filled(path)
    store = open_store(str(path), read_only=True)
    rows = tree_rows(store.rows("trees"), store.rows("trees_local"), store.rows("sites"))
    store.close()
    table = list(csv.DictReader(io.StringIO(csv_bytes(rows).decode())))
    assert len(table) == 14
    assert float(table[0]["latitude_deg"]) == pytest.approx(START.latitude_deg, abs=1e-3)
    collection = json.loads(geojson_bytes(rows))
    assert collection["features"][0]["geometry"]["coordinates"][0] == pytest.approx(START.longitude_deg, abs=1e-3)
    assert b"'=1+1" in csv_bytes([{**rows[0], "status": "=1+1"}])


def test_export_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "inventory.gpkg"
    filled(path)
    out = tmp_path / "trees.geojson"
    assert invoke(["inventory", "export", str(out), "--database", str(path)]) == 0
    assert len(json.loads(out.read_text())["features"]) == 14
    assert invoke(["inventory", "show", "--json", "--database", str(path)]) == 0
    assert len(json.loads(capsys.readouterr().out)["trees"]) == 14
    assert invoke(["inventory", "export", str(tmp_path / "trees.xyz"), "--database", str(path)]) == 2
    assert invoke(["inventory", "show", "--database", str(tmp_path / "none.gpkg")]) == 2


def test_start_points_are_one_each() -> None:
    with pytest.raises(ValueError, match="twice"):
        InventoryConfig(start_points=(StartPoint(uav="a", latitude_deg=0, longitude_deg=0, heading_deg=0),) * 2)
    assert PLACED.start_of("anything") is START
    assert tree(1, 0.0, 0.0).id == 1
