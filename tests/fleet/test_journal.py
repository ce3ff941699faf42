"""The book's file: whole or the old one, one arbiter at a time, set aside when it is broken; and the frame of the fleet."""

from __future__ import annotations

import json
import math
import os
from pathlib import Path

import pytest

from schemas.fleet import ClaimGoal
from services.cli.app import invoke
from services.cli.fleet import forget, list_book
from services.common.errors import InputError
from services.fleet.book import Done, Lease, Memory
from services.fleet.journal import Journal
from services.fleet.placing import SharedFrame
from services.fleet.shapes import Stretch
from services.inventory.config import InventoryConfig, StartPoint
from services.inventory.values import Laid, Rigid2

ORIGIN = (48.0, 11.0, 500.0)
MEMORY = Memory(
    (Lease("uav1", 7, "tree", Stretch((0.0, 0.0), (3.0, 1.0), 0.1), 0.1, 40.0, 2),), (Done("uav2", (5.0, 5.0), 0.1, 3),)
)  # fmt: skip


def test_what_was_written_comes_back(tmp_path: Path) -> None:
    first = Journal(tmp_path / "fleet.json", ORIGIN)
    assert first.memory is None, "a new book knows nothing, not even that nothing was granted"
    first.write(MEMORY)
    first.close()
    again = Journal(tmp_path / "fleet.json", None)
    assert (again.memory, again.name, again.origin_deg) == (MEMORY, first.name, ORIGIN)
    again.close()


def test_a_second_arbiter_is_refused_the_book(tmp_path: Path) -> None:
    first = Journal(tmp_path / "fleet.json", ORIGIN)
    with pytest.raises(InputError, match="another arbiter keeps this book"):
        Journal(tmp_path / "fleet.json", ORIGIN)
    first.close()


def test_a_lock_that_cannot_be_opened_is_told_with_its_name(tmp_path: Path) -> None:
    (tmp_path / ".fleet.json.lock").mkdir()  # for root, too; others see the like of one that root made
    with pytest.raises(InputError, match=r"\.fleet\.json\.lock cannot be opened"):
        Journal(tmp_path / "fleet.json", ORIGIN)


@pytest.mark.parametrize("word", ["forget", "list"])
def test_where_there_is_no_book_the_operator_is_told_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], word: str
) -> None:
    book = tmp_path / "of-somebody-else/fleet.json"
    assert invoke(["fleet", word, "--set", f"station.fleet.book={book}"]) == 2
    assert str(book) in capsys.readouterr().err
    assert not book.parent.exists()


@pytest.mark.parametrize(
    ("words", "key"), [(["fleet", "forget"], "fleet.book"), (["inventory", "show"], "inventory.database")]
)
def test_a_user_who_may_not_look_there_is_told_so(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, words: list[str], key: str
) -> None:
    """The installed station's folder is closed to others, who are no bug."""

    def closed(path: Path) -> bool:
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr(Path, "is_file", closed)
    assert invoke([*words, "--set", f"station.{key}=/nowhere/file"]) == 2
    assert "/nowhere/file: this user may not look there; sudo" in capsys.readouterr().err


@pytest.mark.skipif(os.geteuid() != 0, reason="only root gives files away")
def test_what_an_administrator_does_with_the_book_leaves_it_to_the_station(tmp_path: Path) -> None:
    os.chown(tmp_path, 4711, 4711)
    path = tmp_path / "fleet.json"
    journal = Journal(path, ORIGIN)
    journal.write(MEMORY)
    journal.close()
    os.chown(path, 4711, 4711)
    forget(config=None, settings=[f"station.fleet.book={path}"])
    assert {file.stat().st_uid for file in tmp_path.iterdir()} == {4711}


@pytest.mark.parametrize(
    "text", ["", "{", '{"format": 1}', '{"format": 1, "name": "a", "origin_deg": [NaN, 0, 0], "memory": {}}']
)
def test_a_broken_book_is_set_aside_and_trusted_in_nothing(tmp_path: Path, text: str) -> None:
    (tmp_path / "fleet.json").write_text(text)
    journal = Journal(tmp_path / "fleet.json", ORIGIN)
    assert journal.memory is None
    assert (tmp_path / "fleet.broken").read_text() == text
    journal.close()


def test_the_operator_lists_and_forgets_what_is_done(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    journal = Journal(tmp_path / "fleet.json", ORIGIN)
    journal.write(MEMORY)
    journal.close()
    settings = [f"station.fleet.book={tmp_path / 'fleet.json'}"]
    list_book(as_json=True, config=None, settings=settings)
    row = json.loads(capsys.readouterr().out)["done"][0]
    assert row["uav"] == "uav2"
    assert row["latitude_deg"] == pytest.approx(48.0 + 5.0 / 111_200.0, abs=2e-7)
    forget(config=None, settings=settings)
    kept = Journal(tmp_path / "fleet.json", None)
    assert kept.memory == Memory(MEMORY.leases)
    kept.close()


def start(uav: str, heading_deg: float, sigma_m: float = 0.1) -> StartPoint:
    return StartPoint(uav=uav, latitude_deg=48.0, longitude_deg=11.0, altitude_m=500.0, heading_deg=heading_deg,
                      sigma_m=sigma_m, sigma_heading_deg=1.0)  # fmt: skip


def ahead(metres: float) -> ClaimGoal:
    return ClaimGoal(kind="tree", map_id="m", from_m=(0.0, 0.0), to_m=(metres, 0.0), sigma_m=0.05)


def test_maps_are_brought_into_one_frame_with_their_doubt() -> None:
    frame = SharedFrame(ORIGIN, InventoryConfig(start_points=(start("uav1", 90.0), start("uav2", 0.0))).start_of)
    east, north = (frame.place(uav, ahead(10.0)) for uav in ("uav1", "uav2"))
    assert isinstance(east, Stretch)
    assert isinstance(north, Stretch)
    assert east.to_m == pytest.approx((10.0, 0.0), abs=1e-3)
    assert north.to_m == pytest.approx((0.0, 10.0), abs=1e-3)
    assert north.sigma_m == pytest.approx(math.hypot(0.1, 10.0 * math.radians(1.0), 0.05))


def test_without_a_place_the_reason_says_what_to_configure() -> None:
    frame = SharedFrame(ORIGIN, InventoryConfig().start_of)
    assert "station.inventory.start_points (uav = 'uav1')" in str(frame.place("uav1", ahead(1.0)))
    assert "begun in the air" in str(frame.place("uav1", ahead(1.0), in_air=True))


def test_the_inventory_knows_better_than_the_start_point() -> None:
    frame = SharedFrame(ORIGIN, InventoryConfig(start_points=(start("uav1", 90.0, 3.0),)).start_of)
    laid = Laid(Rigid2(0.0, 2.0, -1.0, 0.0), ORIGIN, 0.03, 0.0)
    placed = frame.place("uav1", ahead(10.0), laid)
    assert isinstance(placed, Stretch)
    assert placed.to_m == pytest.approx((12.0, -1.0), abs=1e-6)
    assert placed.sigma_m < 0.1
