"""What ``treedock run`` decides before it starts anything: scene, time, folders, ports taken by others."""

from __future__ import annotations

import datetime as dt
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from rich.console import Console

from schemas.navigation import MissionState, MissionStateName
from services.cli import run as run_module
from services.cli import scratch
from services.cli.mission import Conductor, Flown, prepared
from services.cli.run import Run
from services.cli.run_fleet import FleetRun
from services.cli.run_plan import services_for, with_own_inventory, with_trees
from services.common.config import TreedockConfig
from services.common.config_loader import load
from services.common.errors import InputError
from services.common.stop import StopSignal
from services.evaluate.flown import mission_figures
from services.security.authority import Authority
from services.security.identity import READER, Identity
from services.simulator.catalogue import scene_for, trees_to_ask_for
from tests.unit.test_common_supervisor import Bench


def _tree(**simulator: object) -> TreedockConfig:
    wanted = int(simulator.pop("wanted", 3))  # type: ignore[call-overload]
    return TreedockConfig.model_validate(
        {"camera": {"source": "sim"}, "navigator": {"trees_wanted": wanted}, "simulator": simulator}
    )


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("wanted", [2, 3, 5])
def test_the_scene_holds_as_many_trees_as_the_mission_is_to_visit(seed: int, wanted: int) -> None:
    tree = with_trees(_tree(seed=seed, wanted=wanted))
    scene = scene_for(tree.simulator.scene, tree.simulator.seed, tree.simulator.trees)
    assert len(scene.reachable_trees) >= wanted
    assert tree.simulator.flight.limit_s >= 120.0 * wanted


def test_one_tree_changes_nothing_and_a_scene_with_a_name_keeps_its_trees() -> None:
    assert with_trees(_tree(seed=3, wanted=1)) == _tree(seed=3, wanted=1)
    assert trees_to_ask_for("multi-01", 1, 5) is None
    assert with_trees(_tree(seed=3, trees=2)).simulator.trees == 2
    with pytest.raises(InputError, match="no room"):
        trees_to_ask_for("random-single", 1, 60)


def test_a_run_of_three_trees_is_done_with_three_docks_only() -> None:
    flown = Flown([_state("docked", 1, 1), _state("undock", 2, 1), _state("docked", 3, 2), _state("landed", 4, 2)])
    assert mission_figures(flown, 2)["docked"]
    assert not mission_figures(flown, 3)["docked"]


def _state(name: MissionStateName, since_ns: int, docked: int) -> MissionState:
    return MissionState(
        stamp_ns=since_ns, seq=since_ns, map_id="m", state=name, previous="idle", since_ns=since_ns, reason="r",
        target_tree_id=None, visited_tree_ids=(), docked_count=docked, distance_m=None, heading_error_rad=None,
    )  # fmt: skip


def test_folders_of_killed_runs_are_cleared_away_and_no_others(tmp_path: Path) -> None:
    dead = subprocess.Popen([sys.executable, "-c", ""])
    dead.wait()
    owners = {"dead": f"{dead.pid} 12345", "alive": f"{os.getpid()} {scratch._began(os.getpid())}", "odd": "what"}
    for name, owner in owners.items():
        (tmp_path / f"treedock-run-{name}").mkdir()
        (tmp_path / f"treedock-run-{name}" / "owner").write_text(owner)
    (tmp_path / "treedock-run-kept").mkdir()
    assert [p.name for p in scratch.clear_stale(tmp_path)] == ["treedock-run-dead"]
    assert len(list(tmp_path.iterdir())) == 3


def test_a_run_keeps_out_of_the_installed_stations_inventory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Trees of a simulation would lie among the real ones."""
    text = '[station]\ninventory.database = "/installed.gpkg"\nfleet.book = "/installed.json"\n'
    (tmp_path / "10-treedock.toml").write_text(text)
    monkeypatch.setattr("services.common.config_loader.SYSTEM_DIRECTORY", tmp_path)
    station = with_own_inventory(load(environ={}, system_directory=tmp_path)).station
    assert (station.inventory.database, station.fleet.book) == ("", "")
    asked = load(flags=["station.inventory.database=mine.gpkg"], environ={}, system_directory=tmp_path)
    assert with_own_inventory(asked).station.inventory.database == "mine.gpkg"


@pytest.mark.parametrize("fleet", [False, True])
def test_a_run_joins_an_encrypted_bus_by_its_certificate(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, *, fleet: bool
) -> None:
    """Refused before: `does it want certificates`, with a router of its own that wanted them."""
    names = [f"uav1.{READER}", f"ground.{READER}"]
    authority = Authority.create(tmp_path / "certs", dt.datetime.now(dt.UTC))
    for name in names:
        authority = authority.issue(Identity.parse(name), dt.datetime.now(dt.UTC))
    tree = TreedockConfig.model_validate(
        {"camera": {"source": "sim"}, "router": {"protocol": "tls"}, "security": {"folder": tmp_path / "certs"}}
    )
    shown: list[object] = []

    def opened(*given: Any, **_: object) -> None:
        shown.append(given[3]["transport/link/tls/connect_certificate"] if len(given) > 3 else None)
        raise InputError("seen enough")

    monkeypatch.setattr("services.common.session.opened_client", opened)
    monkeypatch.setattr("services.cli.supervisor.Supervisor.check", lambda _: None)
    console = Console(quiet=True)
    run: Run | FleetRun = Run(lambda: tree, console, tmp_path / "logs", None, as_json=False, browser=False)
    if fleet:
        run = FleetRun(tree, 2, console, tmp_path / "logs", None, fixed_port=True)
    with pytest.raises(InputError, match="seen enough"):
        run.to_the_end() if isinstance(run, Run) else run.to_the_end(as_json=False, browser=False)
    assert shown == [str(tmp_path / "certs" / f"{names[fleet]}.pem")]


def test_a_port_lost_to_another_process_is_chosen_anew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ports = iter(range(7001, 7010))
    tried: list[int] = []

    def configured() -> TreedockConfig:
        base = TreedockConfig()
        return base.model_copy(update={"router": base.router.model_copy(update={"port": next(ports)})})

    def attempt(self: Run, stop: StopSignal) -> int:
        del stop
        tried.append(self._tree.router.port)
        if len(tried) < 3:
            raise run_module._PortTakenError("port 7001 on 127.0.0.1 is in use: ...")
        return 0

    monkeypatch.setattr(Run, "_attempt", attempt)
    made = Run(configured, Console(quiet=True), tmp_path, None, as_json=False, browser=False)
    assert made.to_the_end() == 0
    assert tried == [7001, 7002, 7003]
    assert '"port": 7003' in (tmp_path / "config.json").read_text()


def test_the_version_is_told(capsys: pytest.CaptureFixture[str]) -> None:
    from services.cli.app import invoke

    assert invoke(["--version"]) == 0
    assert capsys.readouterr().out.startswith("treedock ")


@pytest.mark.parametrize("source", ["sim", "tum:somewhere"])
def test_handheld_guides_and_flies_nothing(source: str) -> None:
    tree = TreedockConfig.model_validate({"camera": {"source": source}, "navigator": {"handheld": True}})
    made = prepared(tree, "builtin")
    services = services_for(made)
    assert "navigator" in services
    assert "autopilot" not in services
    assert ("simulator" in services) is (source == "sim")
    if source == "sim":
        assert made.simulator.mode == "scan"
        assert made.simulator.path.hold_s >= made.navigator.dock.window_s + 3.0


class _Watch:
    """What the conductor looks at, all switches."""

    def __init__(self) -> None:
        self.bus = self
        self.pose = SimpleNamespace(status="tracking")
        self.clock = None
        self.source_ended = False

    def subscribe(self, topic: object, handler: object) -> None:
        del topic, handler

    def ask(self, *_: object, **__: object) -> list[object]:
        return []


def test_handheld_starts_without_a_vehicle_and_ends_with_the_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("services.cli.mission._ASK_AGAIN_S", 0.0)
    accepted = SimpleNamespace(accepted=True, reason="")
    monkeypatch.setattr("services.navigator.client.send_command", lambda *_, **__: accepted)
    watch: Any = _Watch()
    person, pilot = Conductor(watch, 60.0, handheld=True), Conductor(watch, 60.0)
    assert not person.update(ready=True)
    assert not pilot.update(ready=True)
    assert person._started
    assert not pilot._started, "nobody flies without a vehicle"
    assert "autopilot" in pilot.word
    assert "is it running" in pilot.word
    watch.source_ended = True
    assert person.update(ready=True)
    late = Conductor(watch, 60.0, handheld=True)
    assert late.update(ready=False)
    assert "ended before" in late.word


def test_a_mission_whose_simulator_died_ends_and_says_so() -> None:
    """Its time begins anew and nobody's clock runs back: the run would stand still until its time was up."""
    supervisor = Bench("router", "simulator")
    supervisor.after(0.0)
    supervisor.ready("simulator")
    supervisor.spawned[1].code = -9
    supervisor.after(0.1)
    told = SimpleNamespace(word="", update=lambda **_: False, headline=lambda: "")
    made = object.__new__(Run)
    watch = SimpleNamespace(pump=lambda _: supervisor.after(0.1), word="")
    looks: list[int] = []

    def show() -> None:
        looks.append(1)
        assert len(looks) < 20, "it goes on without a world"

    made._watch_over(supervisor.supervisor, watch, show, StopSignal(), told)  # type: ignore[arg-type]
    assert "simulator" in told.word
    assert "SIGKILL" in told.word


def test_a_simulator_that_was_slow_to_start_has_lost_no_world() -> None:
    """Killed while it still started, then ready: the run goes on."""
    supervisor = Bench("router", "simulator")
    supervisor.after(0.0)
    supervisor.ready("router")
    supervisor.spawned[1].code = -9
    supervisor.after(1.0)
    supervisor.ready("simulator")
    assert supervisor.supervisor.restarts == 1
    assert not run_module._world_lost(supervisor.supervisor)
    supervisor.spawned[-1].code = -9
    supervisor.after(0.1)
    assert "SIGKILL" in run_module._world_lost(supervisor.supervisor)


def test_state_and_reason_of_a_line_belong_together() -> None:
    supervisor, told, lines = Bench("navigator"), SimpleNamespace(word="", state="idle"), list[str]()
    states = iter(["preflight", "scan", "landed"])
    told.headline = lambda: f"reason of {told.state}"
    told.update = lambda **_: told.state == "landed"
    watch = SimpleNamespace(word="")

    def pump(_: float) -> None:
        told.state = next(states)

    watch.pump = pump
    made = object.__new__(Run)

    def show() -> None:
        lines.append(f"{told.state}: {watch.word}")

    made._watch_over(supervisor.supervisor, watch, show, StopSignal(), told)  # type: ignore[arg-type]
    assert lines == [f"{state}: reason of {state}" for state in ("preflight", "scan", "landed")]
