"""A fleet in one forest, judged by the truth; and the judge notices when the arbiter does not do its work."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from schemas.fleet import ClaimGoal
from services.evaluate import bench_fleet, bench_fleet_capacity
from services.evaluate.bench import BenchOptions
from services.evaluate.fleet_flight import FleetFlight, calm_case, fleet_case
from services.evaluate.synthetic import TrueTrunk
from services.fleet.config import ClaimConfig
from services.fleet.shapes import Stretch


def test_two_aircraft_visit_each_tree_once_over_a_link_that_drops() -> None:
    row = bench_fleet.fly(1, 2)
    assert (row["double_claims"], row["twice"], row["touches"], row["met"]) == (0, 0, 0, 0)
    assert row["once"] == row["expected"] > 0
    assert row["ends"] == ["landed", "landed"]
    assert min(row["shares"]) > 0


def test_two_that_wait_for_each_others_place_give_way_and_leave_no_tree() -> None:
    """Each docks first at a tree that stands too near to the other's last; neither lists the other's last."""
    at = ((4.3, -1.6), (5.7, 1.6), (3.7, 2.9), (6.3, -2.9))
    trunks = tuple(TrueTrunk(x, y, 0.1) for x, y in at)
    fleet = FleetFlight(calm_case(trunks, {"uav1": (0.0, 0.0), "uav2": (10.0, 0.0)}, ClaimConfig(enabled=True)))
    fleet.run(400.0)
    assert any(e.after == "return" and "giving way" in e.reason for f in fleet.flights.values() for e in f.events)
    assert sorted(trunk for _, trunk in fleet.docked) == [0, 1, 2, 3]
    assert (fleet.double_claims, fleet.met) == (0, 0)
    assert {f.state for f in fleet.flights.values()} == {"landed"}


def test_an_arbiter_that_takes_two_places_for_different_ones_is_found_out() -> None:
    """As if start points were off by a kilometre: the truth shows what the book cannot."""
    fleet = FleetFlight(fleet_case(1, 2))

    def apart(uav: str, goal: ClaimGoal) -> Stretch:
        away = 1000.0 * int(uav[-1])
        return Stretch((goal.from_m[0] + away, goal.from_m[1]), (goal.to_m[0] + away, goal.to_m[1]))

    fleet.link.place = apart
    fleet.run(400.0)
    trees = [trunk for _, trunk in fleet.docked]
    assert fleet.double_claims or len(trees) > len(set(trees))


def _row(seed: int, aircraft: int) -> dict[str, Any]:
    bad = seed == 1
    return {
        "seed": seed, "aircraft": aircraft, "double_claims": int(bad), "expected": 4, "once": 3 if bad else 4, "twice": int(bad),
        "missed": [], "shares": [2] * aircraft, "touches": 0, "met": 0, "apart_m": 3.1, "ends": ["landed"] * aircraft,
        "reasons": [""] * aircraft, "claim_lost": 0, "seconds": 200.0,
    }  # fmt: skip


def test_the_bench_flies_once_and_tells_what_went_wrong(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    flown: list[int] = []

    def fly(seed: int, aircraft: int) -> dict[str, Any]:
        flown.append(seed)
        return _row(seed, aircraft)

    monkeypatch.setattr(bench_fleet, "fly", fly)
    bench_fleet.run(BenchOptions(out=tmp_path, count=2))
    report = bench_fleet.run(BenchOptions(out=tmp_path, count=3))
    assert flown == [0, 1, 2]
    assert report.figures["double_claims"] == 1
    assert report.figures["visited_once"] == 11
    assert "- seed 1:" in report.table
    assert "- seed 0:" not in report.table


def test_what_breaks_is_told_and_the_last_good_number_counts() -> None:
    good = {"aircraft": 10, "sent_per_s": 300, "wanted_per_s": 300, "lost": 0, "sent": 3000, "router_cores": 0.1, "station_cores": 0.3,
            "load_cores": 0.4, "station_mb": 150, "page_hz": 5.0, "claim_ms_p50": 3.0, "claim_ms_max": 20.0}  # fmt: skip
    assert bench_fleet_capacity.broken(good) == []
    for change, word in (({"lost": 40}, "lost"), ({"page_hz": 2.0}, "page late"), ({"claim_ms_max": 900.0}, "claims late"),
                         ({"sent_per_s": 200}, "no processor left")):  # fmt: skip
        bad = {**good, "aircraft": 20, **change}
        report = bench_fleet_capacity.report_of([good, bad], 10.0, "v")
        assert report.figures["aircraft_carried"] == 10
        assert word in report.table
