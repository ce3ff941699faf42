"""``treedock run --aircraft N``: several aircraft in one simulated forest, one router and one station with the arbiter.

Router and station are supervised here; each aircraft is a ``treedock run --join`` of its own, so one that fails takes no
other along. The aircraft are not drawn: what keeps them apart is their claims.
"""

from __future__ import annotations

import json
import math
import os
import signal
import subprocess
import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from services.cli import scratch
from services.cli.run_plan import with_port
from services.cli.spawning import last_line, started
from services.common.errors import GoalNotReachedError, InputError
from services.station.launch import announce, station_services, with_station

if TYPE_CHECKING:
    from rich.console import Console

    from services.cli.supervisor import Supervisor
    from services.common.config import TreedockConfig
    from services.common.stop import StopSignal
    from services.inventory.config import StartPoint

_SITE_DEG = (48.1, 11.5)
"""Where the simulated forest is laid on the earth."""
_SIGMA_M, _SIGMA_HEADING_DEG = 0.05, 0.3
_LOOK_S = 0.2
_END_WITHIN_S = 20.0
_EXIT_NOT_REACHED = 3
_MOST_TREES = 12


class FleetRun:
    """One flight of a fleet, from the router's start to the summary."""

    def __init__(
        self, tree: TreedockConfig, aircraft: int, console: Console, logs: Path | None, record: Path | None, *,
        fixed_port: bool,
    ) -> None:  # fmt: skip
        self._console, self._keep, self._begun_s = console, logs is not None, time.monotonic()
        self._folder, self._record = logs or scratch.made(), record
        self._ground, self._crafts = fleet_configs(with_port(tree, fixed=fixed_port), aircraft, self._folder)
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            self._forget_the_last()
        except OSError as error:
            raise InputError(f"--logs {self._folder}: cannot be written: {error.strerror}") from None
        for name, config in {"ground": self._ground, **self._crafts}.items():
            (self._folder / f"{name}.json").write_text(config.model_dump_json(indent=1))

    def _forget_the_last(self) -> None:
        """Remove what a run of before left in the folder: its trees done, which are the same, and what it came to."""
        inventory = self._folder / "inventory.gpkg"
        gone = [self._folder / "fleet.json", *(self._folder / uav / "summary.json" for uav in self._crafts)]
        if self._ground.station.inventory.database == str(inventory):
            gone += [inventory.with_name(inventory.name + tail) for tail in ("", "-wal", "-shm")]
        for path in gone:
            path.unlink(missing_ok=True)

    def to_the_end(self, *, as_json: bool, browser: bool) -> int:
        """Fly until all are down or the user stops it; print the summary and return the exit code.

        Raises:
            InputError: router or station refused the configuration; GoalNotReachedError: they could not be kept alive.
        """
        from services.cli.supervisor import Supervisor
        from services.common.logging import set_up
        from services.common.stop import StopSignal

        set_up("run", "warning" if self._console.is_terminal else self._ground.log_level)
        stop = StopSignal()
        stop.install(force=False)
        supervisor = Supervisor(("router", *station_services()), self._spawn_ground, self._ground.supervisor)
        flights: dict[str, subprocess.Popen[bytes]] = {}
        try:
            self._fly(supervisor, flights, stop, browser=browser)
            _end(flights)
            rows = {uav: _summary(self._folder / uav) for uav in self._crafts}
        finally:
            _end(flights)
            supervisor.stop_all()
            good = all(flight.returncode in (0, _EXIT_NOT_REACHED) for flight in flights.values())
            if not self._keep:
                scratch.let_go(self._folder, keep=not good or not flights)
        return self._told(rows, stop, as_json=as_json)

    def _fly(
        self, supervisor: Supervisor, flights: dict[str, subprocess.Popen[bytes]], stop: StopSignal, *, browser: bool
    ) -> None:  # fmt: skip
        from services.cli.watch import Watch
        from services.common.session import opened_node

        supervisor.check()

        def given_up() -> bool:
            supervisor.check()
            self._raise_if_given_up(supervisor)
            return stop.is_set

        endpoint = self._ground.router.endpoint
        with opened_node(self._ground, None, given_up, self._ground.supervisor.start_within_s) as session:
            watch = Watch(session, self._ground.uav, lambda h: supervisor.heard(h.service, h.pid, h.state))
            self._console.print(f"treedock: router on {endpoint}, logs in {self._folder}", highlight=False)
            announce(self._console, self._folder, browser=browser)
            while not stop.is_set:
                watch.pump(_LOOK_S)
                supervisor.check()
                self._raise_if_given_up(supervisor)
                if not flights and supervisor.all_ready:
                    flights |= {uav: self._spawn(uav) for uav in self._crafts}
                if flights and all(flight.poll() is not None for flight in flights.values()):
                    return

    def _raise_if_given_up(self, supervisor: Supervisor) -> None:
        child = supervisor.given_up
        if child is None:
            return
        last = last_line(self._folder / f"{child.name}.log").removeprefix("treedock: ")
        if child.last_fault.endswith("exit code 2"):
            raise InputError(last)
        raise GoalNotReachedError(
            f"{child.name} {child.last_fault}, {child.deaths_in_a_row} starts in a row failed: {last}"
        )

    def _spawn_ground(self, name: str) -> subprocess.Popen[bytes]:
        return started([name, "--parent", str(os.getpid())], self._folder / "ground.json", self._folder / f"{name}.log")

    def _spawn(self, uav: str) -> subprocess.Popen[bytes]:
        logs = self._folder / uav
        logs.mkdir(exist_ok=True)
        command = ["run", "--join", "--json", "--logs", str(logs), "--parent", str(os.getpid())]
        command += [] if self._record is None else ["--record", str(self._record / uav)]
        return started(command, self._folder / f"{uav}.json", logs / "run.log", logs / "summary.json")

    def _told(self, rows: Mapping[str, Mapping[str, Any]], stop: StopSignal, *, as_json: bool) -> int:
        values = fleet_figures(rows) | {"duration_s": round(time.monotonic() - self._begun_s, 1)}
        if as_json:
            typer.echo(json.dumps(values))
        else:
            for line in fleet_lines(values):
                typer.echo(f"treedock: {line}")
        if stop.is_set:
            return 128 + int(stop.received or signal.SIGINT)
        return 0 if values["reached"] else _EXIT_NOT_REACHED


def fleet_configs(
    tree: TreedockConfig, aircraft: int, folder: Path
) -> tuple[TreedockConfig, dict[str, TreedockConfig]]:
    """Return the configuration of the ground (router, station, arbiter) and that of each aircraft by its name.

    Raises:
        InputError: nothing is simulated, or the scene has no room for so many.
    """
    from services.simulator.catalogue import scene_for
    from services.simulator.fleet_places import fleet_places

    if tree.camera.source != "sim" or tree.simulator.mode != "flight" or tree.navigator.handheld:
        raise InputError("--aircraft: several aircraft fly in simulation only (--source sim, simulator.mode flight)")
    simulator = tree.simulator
    if simulator.trees is None and simulator.scene.startswith("random-"):
        wanted = min(_MOST_TREES, max(2, tree.navigator.trees_wanted) * aircraft)
        simulator = simulator.model_copy(update={"trees": wanted})
    scene = scene_for(simulator.scene, simulator.seed, simulator.trees)
    places = {f"uav{k + 1}": place for k, place in enumerate(fleet_places(scene, aircraft))}
    ground = _ground(tree, start_points(places, scene.start_yaw_rad), folder)
    navigator = tree.navigator.model_copy(update={"claims": tree.navigator.claims.model_copy(update={"enabled": True})})
    # without a book the arbiter waits for a lease of wall time, and preflight for 60 s of simulated time
    flight = simulator.flight.model_copy(update={"max_speed": 1.0, "limit_s": 2.0 * simulator.flight.limit_s})
    limits = tree.supervisor.model_copy(update={"mission_within_s": aircraft * tree.supervisor.mission_within_s})
    common = tree.model_copy(update={"router": ground.router, "navigator": navigator, "supervisor": limits})
    crafts = {
        uav: common.model_copy(update={
            "uav": uav, "simulator": simulator.model_copy(update={"start_m": place, "flight": flight}),
        })
        for uav, place in places.items()
    }  # fmt: skip
    return ground, crafts


def start_points(places: Mapping[str, tuple[float, float]], yaw_rad: float) -> tuple[StartPoint, ...]:
    """Return where each aircraft's map begins on the earth; ``places`` (east, north) in the scene, metres."""
    from services.inventory.config import StartPoint
    from services.inventory.geodesy import TangentPlane

    plane, points = TangentPlane(*_SITE_DEG, 0.0), []
    for uav, (x, y) in places.items():
        latitude, longitude, _ = plane.to_geodetic(x, y, 0.0)
        points.append(
            StartPoint(uav=uav, latitude_deg=latitude, longitude_deg=longitude, heading_deg=90.0 - math.degrees(yaw_rad),
                       sigma_m=_SIGMA_M, sigma_heading_deg=_SIGMA_HEADING_DEG)
        )  # fmt: skip
    return tuple(points)


def _ground(tree: TreedockConfig, points: tuple[StartPoint, ...], folder: Path) -> TreedockConfig:
    """Return the configuration of router and station, which has the arbiter."""
    fleet = tree.station.fleet.model_copy(update={"enabled": True, "book": str(folder / "fleet.json")})
    inventory = tree.station.inventory.model_copy(update={"start_points": points})
    station = tree.station.model_copy(update={"fleet": fleet, "inventory": inventory})
    return with_station(tree.model_copy(update={"uav": "ground", "station": station}), folder)


def fleet_figures(rows: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Return what became of a fleet by each aircraft's own summary, judged by the truth.

    ``reached``: every aircraft docked at least once and landed, each docking well, no trunk twice, nothing touched.
    """
    missions = {uav: row.get("mission", {}) for uav, row in rows.items()}
    docks = [(uav, dock) for uav, mission in missions.items() for dock in mission.get("docks", [])]
    trunks = [dock["true_tree"] for _, dock in docks if dock.get("true_tree") is not None]
    touches = sum(int(mission.get("touches", 0)) for mission in missions.values())
    twice = len(trunks) - len(set(trunks))
    each = all(m.get("docks") and m.get("state") == "landed" for m in missions.values())
    return {
        "aircraft": {
            uav: {"docks": m.get("docks", []), "state": m.get("state", "never flew"), "reason": m.get("reason", ""), "touches": m.get("touches")}
            for uav, m in missions.items()
        },
        "trees": len(set(trunks)), "twice": twice, "touches": touches,
        "reached": bool(each and not twice and not touches and all(dock["good"] for _, dock in docks)),
    }  # fmt: skip


def fleet_lines(values: Mapping[str, Any]) -> list[str]:
    """Return the summary in words."""
    lines = []
    for uav, craft in values["aircraft"].items():
        docks = ", ".join(
            f"tree {d['tree_id']} at {d.get('true_distance_m') or 0.0:.3f} m ({d.get('true_heading_deg') or 0.0:+.1f} deg)"
            for d in craft["docks"]
        )
        lines.append(f"{uav}: {craft['state']}, docked at {docks or 'nothing'}; {craft['reason']}")
    return [*lines, f"{values['trees']} trees, {values['twice']} of them twice, {values['touches']} touches, {values['duration_s']:.0f} s"]  # fmt: skip


def _end(flights: Mapping[str, subprocess.Popen[bytes]]) -> None:
    for flight in flights.values():
        if flight.poll() is None:
            flight.send_signal(signal.SIGTERM)
    deadline_s = time.monotonic() + _END_WITHIN_S
    for flight in flights.values():
        try:
            flight.wait(max(0.1, deadline_s - time.monotonic()))
        except subprocess.TimeoutExpired:
            flight.kill()
            flight.wait()


def _summary(folder: Path) -> dict[str, Any]:
    """Return an aircraft's summary; where it gave none, what its run said last."""
    try:
        found = json.loads((folder / "summary.json").read_text(encoding="utf-8").strip().splitlines()[-1])
    except (OSError, ValueError, IndexError):
        found = None
    if isinstance(found, dict):
        return found
    return {"mission": {"reason": last_line(folder / "run.log").removeprefix("treedock: ")}}
