"""``treedock run``: the whole system on this machine, as real processes joined by the bus, watched over to the end."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from services.cli import scratch
from services.cli.options import AsJson, ConfigFile, Port, Settings, loaded
from services.cli.run_plan import (
    expected_frames,
    services_for,
    with_own_inventory,
    with_port,
    with_recorder,
    with_state,
    with_trees,
)
from services.cli.spawning import last_line, started
from services.common.errors import InputError
from services.station.launch import announce, with_station

if TYPE_CHECKING:
    from rich.console import Console

    from services.cli.mission import Conductor
    from services.cli.supervisor import Supervisor
    from services.cli.watch import Watch
    from services.common.config import TreedockConfig
    from services.common.stop import StopSignal

_EXIT_NOT_REACHED = 3
_ROUTER_WITHIN_S = 60.0
_LOOK_S = 0.2
_REPORT_WITHIN_S = 2.0
_TRIES = 4


def run(
    *,
    source: Annotated[
        str | None, typer.Option("--source", help="sim, tum:DIR, mcap:FILE, bag:FILE or realsense.", metavar="SOURCE")
    ] = None,
    seed: Annotated[int | None, typer.Option("--seed", help="Of the simulated scene and its noise.", min=0)] = None,
    scene: Annotated[str | None, typer.Option("--scene", help="Name of the simulated scene.")] = None,
    autopilot: Annotated[
        str, typer.Option("--autopilot", help="builtin, or udpin:HOST:PORT where a PX4 speaks MAVLink.")
    ] = "builtin",
    trees: Annotated[int | None, typer.Option("--trees", help="Trees to dock at.", min=1)] = None,
    handheld: Annotated[bool, typer.Option("--handheld", help="A person carries the camera.")] = False,
    aircraft: Annotated[
        int,
        typer.Option("--aircraft", help="So many in one simulated forest, with one router and station.", min=1, max=4),
    ] = 1,
    join: Annotated[
        bool, typer.Option("--join", help="Router and station run elsewhere (router.host, --port): start neither.")
    ] = False,
    parent: Annotated[int | None, typer.Option("--parent", hidden=True)] = None,
    no_browser: Annotated[bool, typer.Option("--no-browser", help="Open no browser.")] = False,
    record: Annotated[Path | None, typer.Option("--record", help="Record everything into this folder (MCAP).")] = None,
    logs: Annotated[Path | None, typer.Option("--logs", help="Keep the services' logs in this folder.")] = None,
    as_json: AsJson = False,
    config: ConfigFile = None,
    settings: Settings = None,
    port: Port = None,
) -> int:
    """Run the whole system on this machine, in simulation unless --source says otherwise."""
    from rich.console import Console

    from services.cli.mission import prepared
    from services.cli.service_command import end_with

    flags = {"camera.source": source, "simulator.seed": seed, "simulator.scene": scene,
             "navigator.trees_wanted": trees, "navigator.handheld": True if handheld else None}  # fmt: skip
    found = loaded(config, settings, port, {k: v for k, v in flags.items() if v is not None})
    tree = with_trees(with_own_inventory(found))
    tree = with_recorder(tree, record, logs)
    expected = expected_frames(tree)
    if parent is not None:
        end_with(parent)
    if aircraft > 1:
        from services.cli.run_fleet import FleetRun

        if join or autopilot != "builtin":
            raise InputError(
                "--aircraft: each has the built-in autopilot, and the run its own router: leave --join, --autopilot out"
            )
        fleet = FleetRun(tree, aircraft, Console(stderr=True), logs, record, fixed_port=port is not None)
        return fleet.to_the_end(as_json=as_json, browser=not no_browser)

    def configured() -> TreedockConfig:
        return prepared(tree if join else with_port(tree, fixed=port is not None), autopilot)

    return Run(
        configured, Console(stderr=True), logs, expected, as_json=as_json, browser=not (no_browser or join), join=join
    ).to_the_end()


class _PortTakenError(InputError):
    """Another process took a port between our finding it free and the service's opening it."""


_ON_PORTS = frozenset({"router", "autopilot", "simulator"})


class Run:
    """One run, from the router's start to the summary."""

    def __init__(
        self, configured: Callable[[], TreedockConfig], console: Console, logs: Path | None, expected: int | None, *,
        as_json: bool, browser: bool, join: bool = False,
    ) -> None:  # fmt: skip
        self._join = join
        self._configured = configured
        """Gives the configuration with the ports that are free at this moment."""
        self._tree = configured()
        self._expected = expected
        self._console = console
        self._as_json = as_json
        self._browser = browser
        self._begun_s = time.time()
        self._keep_logs = logs is not None
        self._own_folder = logs is None
        self._folder = logs or scratch.made()
        self._config_file = self._folder / "config.json"
        self._write_config()

    def _write_config(self) -> None:
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            tree = with_station(with_state(self._tree, self._folder / "state"), self._folder)
            self._config_file.write_text(tree.model_dump_json(indent=1))
        except OSError as error:
            raise InputError(f"--logs {self._folder}: cannot be written: {error.strerror}") from None

    def to_the_end(self) -> int:
        """Run until the source has ended or the user stops it; print the summary and return the exit code.

        Raises:
            InputError: a service refused its configuration or input; GoalNotReachedError: one could not be kept alive.
        """
        from services.common.logging import set_up
        from services.common.stop import StopSignal

        set_up("run", "warning" if self._console.is_terminal else self._tree.log_level)
        stop = StopSignal()
        stop.install(force=False)
        for left in reversed(range(_TRIES)):
            try:
                return self._attempt(stop)
            except _PortTakenError as error:
                if not left or stop.is_set:
                    raise
                self._console.print(f"treedock: {error}: trying another port", highlight=False, soft_wrap=True)
                self._tree = self._configured()
                self._write_config()
        raise AssertionError("unreachable")

    def _attempt(self, stop: StopSignal) -> int:
        from services.cli.supervisor import Supervisor

        # a recording does not wait for its consumers as the simulator does
        last = frozenset[str]() if self._tree.camera.source == "sim" else frozenset({"camera"})
        supervisor = Supervisor(services_for(self._tree, join=self._join), self._spawn, self._tree.supervisor, last)
        again = False
        try:
            return self._supervised(supervisor, stop)
        except _PortTakenError:
            again = True
            raise
        except InputError:
            if stop.is_set:  # interrupted before the router was up
                return _stopped(stop)
            raise
        finally:
            supervisor.stop_all()
            if self._own_folder and not again:
                scratch.let_go(self._folder, keep=self._keep_logs or supervisor.restarts > 0)

    def _spawn(self, name: str) -> subprocess.Popen[bytes]:
        return started([name, "--parent", str(os.getpid())], self._config_file, self._folder / f"{name}.log")

    def _supervised(self, supervisor: Supervisor, stop: StopSignal) -> int:
        from services.cli.status import Status
        from services.cli.watch import Watch
        from services.common.session import opened_node

        begin_s = time.monotonic()
        supervisor.check()
        with ExitStack() as stack:
            endpoint = self._tree.router.endpoint
            waiting = self._still_waiting(supervisor, stop)
            session = stack.enter_context(opened_node(self._tree, None, waiting, _ROUTER_WITHIN_S))
            watch = Watch(session, self._tree.uav, lambda h: supervisor.heard(h.service, h.pid, h.state))
            with Status(watch, supervisor, self._console, self._expected) as status:
                self._console.print(f"treedock: router on {endpoint}, logs in {self._folder}", highlight=False)
                if not self._join:
                    announce(self._console, self._folder, browser=self._browser)
                conductor = self._conductor(watch)
                self._watch_over(supervisor, watch, status.update, stop, conductor)
            values = self._close(watch, supervisor, time.monotonic() - begin_s, conductor)
            self._print(watch, values)
        if stop.is_set:
            return _stopped(stop)
        return 0 if conductor is None or values["mission"]["docked"] else _EXIT_NOT_REACHED

    def _conductor(self, watch: Watch) -> Conductor | None:
        from services.cli.mission import Conductor, guides

        if not guides(self._tree):
            return None
        navigator = self._tree.navigator
        within_s = self._tree.supervisor.mission_within_s
        return Conductor(watch, within_s, navigator.trees_wanted, handheld=navigator.handheld)

    def _still_waiting(self, supervisor: Supervisor, stop: StopSignal) -> Callable[[], bool]:
        def given_up() -> bool:
            supervisor.check()
            self._raise_if_given_up(supervisor)
            return stop.is_set

        return given_up

    def _watch_over(
        self, supervisor: Supervisor, watch: Watch, show: Callable[[], None], stop: StopSignal,
        conductor: Conductor | None,
    ) -> None:  # fmt: skip
        """Look after the services until mission or source has ended and the last frames are worked off, or the stop."""
        ended_s: float | None = None
        while not stop.is_set:
            watch.pump(_LOOK_S)
            supervisor.check()
            self._raise_if_given_up(supervisor)
            over = False
            if conductor is not None:
                lost = _world_lost(supervisor)
                conductor.word = lost or conductor.word
                over = bool(lost) or conductor.update(ready=supervisor.all_ready)
                watch.word = conductor.headline()
            show()  # after the words were renewed: a state is shown with its own reason
            if over:
                return
            if conductor is None and watch.source_ended:
                ended_s = ended_s or time.monotonic()
                late = time.monotonic() - ended_s > self._tree.supervisor.drain_within_s
                if watch.drained or late:
                    return

    def _raise_if_given_up(self, supervisor: Supervisor) -> None:
        from services.common.errors import GoalNotReachedError

        child = supervisor.given_up
        if child is None:
            return
        self._keep_logs = True
        last = last_line(self._folder / f"{child.name}.log").removeprefix("treedock: ")
        if child.last_fault.endswith("exit code 2"):
            self._keep_logs = False
            raise _PortTakenError(last) if "in use" in last and child.name in _ON_PORTS else InputError(last)
        raise GoalNotReachedError(f"{child.name} {child.last_fault}, {child.deaths_in_a_row} starts in a row failed: "
                                  f"{last} (all of it in {self._folder / child.name}.log)")  # fmt: skip

    def _close(
        self, watch: Watch, supervisor: Supervisor, duration_s: float, conductor: Conductor | None
    ) -> dict[str, Any]:
        from services.cli.summary import figures

        values = figures(watch, supervisor, duration_s)
        if conductor is not None:
            values["mission"] = conductor.figures()
            values["report"] = self._report(watch)
        if supervisor.restarts and not self._keep_logs:
            values["logs"] = str(self._folder)
        return values

    def _report(self, watch: Watch) -> str | None:
        """Return where the recorder wrote this mission's report, None when it has not within two seconds."""
        deadline_s = time.monotonic() + _REPORT_WITHIN_S
        while time.monotonic() < deadline_s:
            found = [p for p in self._tree.recorder.folder.glob("*report*.html") if p.stat().st_mtime >= self._begun_s]
            if found:
                return str(max(found, key=lambda path: path.stat().st_mtime))
            watch.pump(_LOOK_S)
        return None

    def _print(self, watch: Watch, values: dict[str, Any]) -> None:
        from rich.console import Console

        from services.cli.summary import closing_line, mission_lines, tree_table

        if self._as_json:
            typer.echo(json.dumps(values))
            return
        console = Console()
        if values["trees"] or watch.truth is not None:
            console.print(tree_table(watch.trees, watch.truth))
        console.print(f"treedock: {closing_line(values)}", highlight=False, soft_wrap=True)
        for line in mission_lines(values):
            console.print(f"treedock: {line}", highlight=False, soft_wrap=True)


def _world_lost(supervisor: Supervisor) -> str:
    """Return what became of the simulator when it died: another one is another world, and its time begins anew."""
    child = supervisor.children.get("simulator")
    if child is None or not child.lost:  # killed while it still started, it took nothing along
        return ""
    return f"the simulator {child.lost}: with it aircraft and world are gone"


def _stopped(stop: StopSignal) -> int:
    """Return the exit code of a run that was stopped, as shells write it: 130 after Ctrl-C, 143 after SIGTERM."""
    return 128 + int(stop.received or signal.SIGINT)
