"""Two aircraft, one router, one station with the arbiter, as processes: each tree is visited once, over a kill of the station."""

from __future__ import annotations

import contextlib
import itertools
import json
import subprocess
import sys
from pathlib import Path

from schemas.fleet import ClaimGoal, HeldState
from schemas.navigation import MissionState
from schemas.topics import FLEET_HELD, MISSION_STATE
from services.common.bus import Bus
from services.common.context import HealthBook
from tests.process.claiming_aircraft import FOREST, LEASE_S, NUMBERS, STARTS
from tests.process.conftest import ROOT, System, pump, until

_LATITUDE, _LONGITUDE = 48.0, 11.0
_DEG_PER_M = 1.0 / 74_625.0
"""Of longitude at 48 degrees north."""


class Listener:
    """What one aircraft tells of itself."""

    def __init__(self, bus: Bus) -> None:
        self.bus = bus
        self.held: ClaimGoal | None = None
        self.told: HeldState | None = None
        self.trees_held: set[int] = set()
        self.mission: MissionState | None = None
        bus.subscribe(FLEET_HELD, self._on_held)
        bus.subscribe(MISSION_STATE, self._on_mission)

    def _on_held(self, state: HeldState) -> None:
        self.held, self.told = state.held, state
        if state.held is not None and state.held.kind == "tree" and state.held.tree_id is not None:
            self.trees_held.add(state.held.tree_id - NUMBERS[self.bus.uav])

    def _on_mission(self, state: MissionState) -> None:
        self.mission = state

    @property
    def state(self) -> str:
        return "" if self.mission is None else self.mission.state

    @property
    def words(self) -> str:
        """For a test that failed."""
        return f"{self.bus.uav}: {self.state}: {self.mission and self.mission.reason}; {self.told}"

    @property
    def visited(self) -> list[int]:
        """Numbers of the trees in the forest."""
        return [] if self.mission is None else [i - NUMBERS[self.bus.uav] for i in self.mission.visited_tree_ids]

    @property
    def tree(self) -> int | None:
        held = self.held
        return None if held is None or held.tree_id is None else held.tree_id - NUMBERS[self.bus.uav]


def station(system: System) -> subprocess.Popen[bytes]:
    points = [
        {"uav": uav, "latitude_deg": _LATITUDE, "longitude_deg": _LONGITUDE + east_m * _DEG_PER_M, "heading_deg": heading,
         "sigma_m": 0.02, "sigma_heading_deg": 0.2}
        for uav, (east_m, heading) in STARTS.items()
    ]  # fmt: skip
    config = system.folder / "station.json"
    config.write_text(json.dumps({"station": {
        "port": 0, "inventory": {"database": "none", "start_points": points},
        "fleet": {"enabled": True, "lease_s": LEASE_S, "separation_m": 1.5, "book": str(system.folder / "fleet.json")},
    }}))  # fmt: skip
    command = [sys.executable, "-m", "services.cli.app", "station", "--port", str(system.port), "--config", str(config)]
    with system.log("station").open("ab") as log:
        process = subprocess.Popen(command, cwd=ROOT, stdout=log, stderr=log)
    system.processes.append(process)
    return process


def aircraft(system: System, uav: str) -> None:
    command = [sys.executable, "-m", "tests.process.claiming_aircraft", str(system.port), uav]
    with system.log(uav).open("ab") as log:
        system.processes.append(subprocess.Popen(command, cwd=ROOT, stdout=log, stderr=log))


def empty_book(folder: Path) -> None:
    """Leave a book that knows of nothing: without one the arbiter would wait for a lease."""
    body = {
        "format": 1,
        "name": "arbiter-test",
        "origin_deg": [_LATITUDE, _LONGITUDE, 0.0],
        "memory": {"leases": [], "done": []},
    }
    (folder / "fleet.json").write_text(json.dumps(body))


def test_two_aircraft_share_a_forest_and_no_tree(routed: System) -> None:
    empty_book(routed.folder)
    first = station(routed)
    with contextlib.ExitStack() as stack:
        ears = []
        for uav in STARTS:
            session = stack.enter_context(routed.session())
            ears.append(Listener(Bus(session, uav, HealthBook())))
            aircraft(routed, uav)

        def shared() -> bool:
            """Handle what has come; whether both say at one time that they hold the same tree."""
            for ear in ears:
                pump(ear.bus)
            return any(a.tree is not None and a.tree == b.tree for a, b in itertools.combinations(ears, 2))

        def after(condition: str, state: str) -> bool:
            def reached() -> bool:
                assert not shared()
                return (
                    any(ear.state == state for ear in ears)
                    if condition == "any"
                    else all(ear.state == state for ear in ears)
                )

            return until(reached, 120.0)

        assert after("any", "approach"), [ear.words for ear in ears]
        first.kill()
        first.wait()
        station(routed)
        assert after("all", "landed"), [ear.words for ear in ears]
        visited = sorted(tree for ear in ears for tree in ear.visited)
        assert visited == list(range(len(FOREST))), [ear.visited for ear in ears]
        assert all(ear.visited for ear in ears), "the forest was shared"
    book = json.loads((routed.folder / "fleet.json").read_text())
    assert len(book["memory"]["done"]) == len(FOREST)
