"""Several aircraft in one simulated forest: their places, their configurations, and the judgement of what they did."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from schemas.fleet import ClaimGoal
from services.cli.app import invoke
from services.cli.run_fleet import FleetRun, _summary, fleet_configs, fleet_figures, fleet_lines
from services.cli.run_plan import services_for
from services.common.config import TreedockConfig
from services.common.errors import InputError
from services.common.geometry import rotation_z
from services.fleet.book import Done, Memory
from services.fleet.journal import Journal
from services.fleet.placing import SharedFrame
from services.inventory.config import InventoryConfig
from services.navigator.config import NavigatorConfig
from services.simulator.catalogue import scene_for
from services.simulator.config import SimulatorConfig
from services.simulator.fleet_places import APART_M, ROOM_M, fleet_places
from services.simulator.flight import simulated_px4


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_starts_lie_apart_with_room_and_trees_beside_them(seed: int) -> None:
    scene = scene_for("random-mission", seed, 5)
    places = fleet_places(scene, 3)
    assert places == fleet_places(scene, 3)
    assert places[0] == (0.0, 0.0)
    for k, place in enumerate(places):
        assert all(math.dist(place, other) > APART_M - 1e-6 for other in places[:k])
        assert k == 0 or all(math.dist(place, (x, y)) - r >= ROOM_M for x, y, r in scene.things())
        assert any(math.dist(place, (t.x_m, t.y_m)) < 5.5 for t in scene.suitable_trees)


def test_a_scene_without_room_is_refused_in_words() -> None:
    with pytest.raises(InputError, match=r"--aircraft 30: scene .* has room for \d+ only"):
        fleet_places(scene_for("random-mission", 1, 5), 30)


def test_the_arbiter_places_each_aircraft_where_the_simulator_has_it(tmp_path: Path) -> None:
    """A goal one metre ahead of each start, by its own map, is one metre ahead of its place in the scene."""
    ground, crafts = fleet_configs(TreedockConfig(simulator=SimulatorConfig(seed=2, trees=4)), 2, tmp_path)
    assert list(crafts) == ["uav1", "uav2"]
    assert ground.station.fleet.enabled
    inventory: InventoryConfig = ground.station.inventory
    home = inventory.start_of("uav1")
    assert home is not None
    frame = SharedFrame((home.latitude_deg, home.longitude_deg, 0.0), inventory.start_of)
    for uav, config in crafts.items():
        assert config.navigator.claims.enabled
        assert config.uav == uav
        assert config.router == ground.router
        sim = config.simulator
        scene = scene_for(sim.scene, sim.seed, sim.trees)
        assert simulated_px4(scene, sim).true_pose()[:2, 3] == pytest.approx(sim.start_m)
        way = frame.place(uav, ClaimGoal(kind="way", map_id="m", from_m=(0.0, 0.0), to_m=(1.0, 0.0)))
        assert not isinstance(way, str)
        assert way.from_m == pytest.approx(sim.start_m, abs=1e-3)
        ahead = np.array(sim.start_m) + (rotation_z(scene.start_yaw_rad) @ np.array([1.0, 0.0, 0.0]))[:2]
        assert way.to_m == pytest.approx(tuple(ahead), abs=1e-3)


def test_only_what_is_simulated_and_flown_can_be_a_fleet(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="in simulation only"):
        fleet_configs(TreedockConfig(navigator=NavigatorConfig(handheld=True)), 2, tmp_path)


def test_who_joins_starts_neither_router_nor_station() -> None:
    alone, joined = services_for(TreedockConfig()), services_for(TreedockConfig(), join=True)
    assert set(alone) - set(joined) == {"router", "station"}
    assert [name for name in alone if name in joined] == list(joined)


def _mission(*trunks: int, state: str = "landed", touches: int = 0) -> dict[str, Any]:
    docks = [
        {"tree_id": 10 + t, "true_tree": t, "true_distance_m": 0.95, "true_heading_deg": 0.2, "good": True}
        for t in trunks
    ]
    return {"mission": {"docks": docks, "state": state, "touches": touches, "reason": "down"}}  # fmt: skip


@pytest.mark.parametrize(
    ("rows", "reached"),
    [
        ({"uav1": _mission(0, 1), "uav2": _mission(2)}, True),
        ({"uav1": _mission(0, 1), "uav2": _mission(1)}, False),
        ({"uav1": _mission(0), "uav2": _mission()}, False),
        ({"uav1": _mission(0), "uav2": _mission(1, touches=1)}, False),
        ({"uav1": _mission(0), "uav2": _mission(1, state="hold")}, False),
        ({"uav1": _mission(0), "uav2": {"mission": {"reason": "no scene"}}}, False),
    ],
    ids=["good", "one trunk twice", "one without a tree", "a touch", "not down", "no summary"],
)
def test_a_fleet_is_judged_by_the_truth(rows: dict[str, Any], reached: bool) -> None:
    values = fleet_figures(rows)
    assert values["reached"] is reached
    lines = fleet_lines(values | {"duration_s": 10.0})
    assert len(lines) == 3
    assert lines[0].startswith("uav1: landed, docked at tree 10 at 0.950 m")


def test_what_an_aircraft_said_last_stands_for_a_summary_it_did_not_give(tmp_path: Path) -> None:
    (tmp_path / "run.log").write_text("treedock: ready\ntreedock: no scene 'nowhere'\n")
    assert _summary(tmp_path)["mission"]["reason"] == "no scene 'nowhere'"
    (tmp_path / "summary.json").write_text('{"mission": {"state": "landed"}}\n')
    assert _summary(tmp_path)["mission"]["state"] == "landed"


def test_a_second_flight_with_the_same_logs_begins_without_the_first_ones_book_trees_and_summaries(
    tmp_path: Path,
) -> None:
    tree = TreedockConfig(simulator=SimulatorConfig(seed=2, trees=4))
    book = Journal(tmp_path / "fleet.json", (48.1, 11.5, 0.0))
    book.write(Memory(done=(Done("uav1", (3.0, 1.0), 0.05, 4),)))
    book.close()
    for name in (
        "inventory.gpkg",
        "inventory.gpkg-wal",
        "inventory.gpkg-shm",
        "notes.txt",
        "uav1/summary.json",
        "old/summary.json",
    ):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text('{"mission": {"state": "landed"}}\n')
    FleetRun(tree, 2, Console(), tmp_path, None, fixed_port=True)
    left = {str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*") if path.is_file()}
    assert left - {"ground.json", "uav1.json", "uav2.json", ".fleet.json.lock"} == {"notes.txt", "old/summary.json"}
    assert _summary(tmp_path / "uav1")["mission"].get("state") is None


@pytest.mark.parametrize("flags", [["--join"], ["--autopilot", "udpin:0.0.0.0:14540"]])
def test_a_fleet_brings_its_own_router_and_autopilots(flags: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert invoke(["run", "--aircraft", "2", *flags]) == 2
    assert "leave --join, --autopilot out" in capsys.readouterr().err
