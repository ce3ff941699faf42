"""The arbiter in the station: what the log says, what the page is told, what it cannot place."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest

from schemas.fleet import ClaimReply, ClaimRequest, HeldState
from services.common.context import HealthBook
from services.fleet.config import FleetConfig
from services.inventory.config import InventoryConfig, StartPoint
from services.station.brain import Brain
from services.station.claims import Claims
from services.station.config import StationConfig
from tests.fleet.lease_net import goal
from tests.unit.test_station_brain import FakePages

S = 1_000_000_000


class Ground:
    """Brain and arbiter, with a clock that the test sets."""

    def __init__(self, folder: Path, *names: str) -> None:
        self.pages, self.now_ns, self.health = FakePages(), 0, HealthBook()
        self.brain = Brain(StationConfig(), self.pages, lambda _: None, lambda: 1)
        points = tuple(
            StartPoint(
                uav=n, latitude_deg=48.0, longitude_deg=11.0, heading_deg=90.0, sigma_m=0.05, sigma_heading_deg=0.1
            )
            for n in names
        )
        config = FleetConfig(enabled=True, book=str(folder / "fleet.json"))
        inventory = InventoryConfig(database="none", start_points=points)
        self.claims = Claims(config, inventory, self.brain.log, self.health, dict, lambda: self.now_ns)
        self.brain.fleet_view = self.claims.view

    def ask(self, uav: str, kind: str = "claim", lease_id: int = 1, tree: int = 1) -> ClaimReply:
        request = ClaimRequest(kind=kind, lease_id=lease_id, goal=goal(tree))  # type: ignore[arg-type]
        return self.claims._on_claim(self.brain.aircraft(uav), request)

    @property
    def log(self) -> list[str]:
        return [f"{e.uav}: {e.text}" for e in self.brain.log.latest() if e.kind == "claim"]


@pytest.fixture
def fresh(tmp_path: Path) -> Iterator[Ground]:
    """A new book, which waits for a lease."""
    ground = Ground(tmp_path, "uav1", "uav2")
    yield ground
    ground.claims.close()


@pytest.fixture
def ground(fresh: Ground) -> Ground:
    fresh.now_ns = 41 * S
    return fresh


def test_the_log_has_each_grant_refusal_and_end_once(ground: Ground) -> None:
    ground.ask("uav1")
    ground.ask("uav1", "renew")
    ground.ask("uav2", lease_id=2)
    ground.ask("uav2", lease_id=3)
    ground.ask("uav1", "done")
    ground.ask("uav1", "release")
    assert ground.log == [
        "uav1: claim on tree 1 granted for 40 s", "uav2: claim on tree 1 refused: uav1 holds this tree",
        "uav1: tree 1 is done", "uav1: claim on tree 1 given back",
    ]  # fmt: skip
    assert ground.health.counters["claims_refused"] == 2


def test_the_page_is_told_who_holds_what(ground: Ground) -> None:
    ground.ask("uav1")
    ground.brain.aircraft("uav1").on_held(HeldState(
        stamp_ns=1, seq=0, map_id="m", held=goal(1), left_s=31.4, asked=None, undelivered=0, note="",
    ))  # fmt: skip
    ground.now_ns += 10 * S
    told = json.loads(ground.brain._state_text(0.0))
    assert told["fleet"] == {
        "leases": [{"id": "1", "uav": "uav1", "kind": "tree", "tree": 1, "left": 30.0}],
        "visited": 0,
        "waits": 0.0,
    }
    claim = told["aircraft"][0]["claim"]
    assert (claim["kind"], claim["tree"], claim["left"]) == ("tree", 1, 31.0)


def test_a_new_book_says_that_it_waits(fresh: Ground) -> None:
    assert "grants again in 40 s" in fresh.ask("uav1").reason
    assert fresh.claims.view()["waits"] == 40.0


def test_an_aircraft_without_a_start_point_is_told_what_to_configure(ground: Ground) -> None:
    assert "station.inventory.start_points (uav = 'uav9')" in ground.ask("uav9").reason


def test_where_the_station_is_no_arbiter_the_page_hears_of_none() -> None:
    brain = Brain(StationConfig(), FakePages(), lambda _: None, lambda: 1)
    assert json.loads(brain._state_text(0.0))["fleet"] is None
