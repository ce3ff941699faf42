"""The whole onboard system as real processes under the real supervisor, watched over the bus, with somebody who harms it."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Self

from schemas.health import Health
from schemas.topics import HEALTH
from services.cli.run_config import SupervisorConfig
from services.cli.supervisor import Supervisor
from services.common.bus import Bus
from services.common.config import TreedockConfig
from services.common.context import HealthBook
from services.common.errors import InputError
from services.common.session import opened_client
from services.evaluate.faults.flown import Flown

ONBOARD = ("router", "recorder", "camera", "slam", "mapper", "detector", "refiner", "navigator", "autopilot")
FUSED = ("fusion", "second_camera", "second_slam")
"""What flies only where the configuration says so."""
STANDINS = frozenset({"slam", "mapper", "detector", "refiner", "second_slam"})
_LOOK_S = 0.02
_ROUTER_WITHIN_S = 240.0
_READY = frozenset({"ready", "degraded"})


@dataclass(frozen=True, slots=True)
class Comeback:
    """What became of a process that was harmed; seconds of the wall."""

    service: str
    noticed_s: float
    """From the signal to its end: nothing for a kill, the supervisor's patience for one that hangs."""
    back_s: float
    """From its end until another process of that service says that it is ready."""
    cpu_s: float
    """Processor time that the other process took for it."""
    waited_s: float = 0.0
    """How long its threads, runnable, waited for a processor meanwhile: a machine with more to do than processors."""

    def ready_after_s(self) -> float:
        """Return when it was ready by the wall, less what it waited for a processor; never less than its pause and its own work."""
        own_s = min(self.back_s, SupervisorConfig().backoff_s + self.cpu_s)
        return max(self.back_s - self.waited_s, own_s)


@dataclass
class Rig:
    """Processes of the services named; ``standins`` of them are ours. Use as a context manager.

    ``prefix(name)`` may put words before a service's command: the network namespace it runs in.
    """

    config: TreedockConfig
    folder: Path
    services: Sequence[str]
    standins: frozenset[str] = STANDINS
    prefix: Callable[[str], list[str]] = lambda _: []
    configured: Callable[[str, TreedockConfig], TreedockConfig] = lambda _, config: config
    """Gives a service's own configuration, where machines differ."""
    each: Callable[[], None] = lambda: None
    """Called in each turn of ``pump``."""
    flown: Flown = field(default_factory=Flown)
    health: dict[str, Health] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._stack = ExitStack()
        self.heard_s: dict[str, float] = {}
        """When a service's latest health came."""
        self._ready_s: dict[int, tuple[float, float, float]] = {}
        """When a process (by its id) first said that it was ready, its processor time until then, and what it waited for one."""
        self.folder.mkdir(parents=True, exist_ok=True)
        self.write_configs()
        self.supervisor = Supervisor(self.services, self._spawn, self.config.supervisor)

    def write_configs(self) -> None:
        """Write each service's configuration, from which it is started the next time."""
        for name in self.services:
            self.config_file(name).write_text(self.configured(name, self.config).model_dump_json(), encoding="utf-8")

    def config_file(self, name: str) -> Path:
        """Return where a service's configuration lies."""
        return self.folder / f"{name}.json"

    def _spawn(self, name: str) -> subprocess.Popen[bytes]:
        module = ["services.evaluate.faults.standins"] if name in self.standins else ["services.cli.app"]
        command = [*self.prefix(name), sys.executable, "-m", *module, name, "--config", str(self.config_file(name)),
                   "--parent", str(os.getpid())]  # fmt: skip
        with (self.folder / f"{name}.log").open("ab") as log:
            return subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=log, stderr=log, process_group=0)

    def __enter__(self) -> Self:
        try:
            self.supervisor.check()
            session = self._stack.enter_context(
                opened_client(self.config.router.endpoint, lambda: False, _ROUTER_WITHIN_S)
            )
            self.bus = Bus(session, self.config.uav, HealthBook())
            self.bus.subscribe(HEALTH, self._on_health)
            self.flown.listen(self.bus)
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        for child in self.supervisor.children.values():  # a stopped process hears no SIGTERM
            if child.process is not None and child.process.poll() is None:
                child.process.send_signal(signal.SIGCONT)
        self.supervisor.stop_all()
        self._stack.close()

    def _on_health(self, health: Health) -> None:
        self.health[health.service], self.heard_s[health.service] = health, time.monotonic()
        self.supervisor.heard(health.service, health.pid, health.state)
        if health.state in _READY and health.pid not in self._ready_s:
            self._ready_s[health.pid] = time.monotonic(), _cpu_s(health.pid), _waited_s(health.pid)

    def stamp_off_s(self, name: str) -> float:
        """Return how far ahead of this process's clock a service's latest health was stamped; its way here makes it seem less."""
        return self.health[name].stamp_ns * 1e-9 - time.time() + (time.monotonic() - self.heard_s[name])

    # -- time

    def pump(self, for_s: float = _LOOK_S) -> None:
        """Handle what came and look after the processes for a while.

        Raises:
            InputError: a service cannot be kept running.
        """
        end_s = time.monotonic() + for_s
        while True:
            while (taken := self.bus.inbox.take()) is not None:
                taken[0].handler(taken[1])
            self.each()
            self.supervisor.check()
            if (child := self.supervisor.given_up) is not None:
                raise InputError(f"{child.name} {child.last_fault}: see {self.folder / child.name}.log")
            left_s = end_s - time.monotonic()
            if left_s <= 0.0:
                return
            self.bus.inbox.wait(min(_LOOK_S, left_s))

    def until(self, condition: Callable[[], bool], timeout_s: float) -> bool:
        """Pump until ``condition``; False when it did not come true in time (seconds of the wall)."""
        end_s = time.monotonic() + timeout_s
        while not condition():
            if time.monotonic() > end_s:
                return False
            self.pump()
        return True

    def fly_s(self, seconds: float, timeout_s: float = 120.0) -> bool:
        """Pump until so much simulated time has passed."""
        end_ns = self.flown.now_ns + round(seconds * 1e9)
        return self.until(lambda: self.flown.now_ns >= end_ns, timeout_s)

    @property
    def all_ready(self) -> bool:
        """Whether every service has told that it is ready."""
        return self.supervisor.all_ready

    # -- harm

    def pid(self, service: str) -> int:
        """Return the process of a service.

        Raises:
            InputError: it has none at this moment.
        """
        process = self.supervisor.children[service].process
        if process is None:
            raise InputError(f"{service} has no process: see {self.folder / service}.log")
        return process.pid

    def harm(self, service: str, number: int = signal.SIGKILL) -> tuple[int, float]:
        """Send a service's process a signal; return its id and when."""
        pid = self.pid(service)
        os.kill(pid, number)
        return pid, time.monotonic()

    def comeback(self, service: str, pid: int, at_s: float, timeout_s: float) -> Comeback | None:
        """Wait for the process ``pid``, harmed ``at_s``, to be replaced; None when that took too long."""
        if not self.until(lambda: not _running(pid), timeout_s):
            return None
        ended_s = time.monotonic()

        def back() -> bool:
            process = self.supervisor.children[service].process
            return process is not None and process.pid != pid and process.pid in self._ready_s

        if not self.until(back, timeout_s):
            return None
        ready_s, cpu_s, waited_s = self._ready_s[self.pid(service)]
        return Comeback(service, ended_s - at_s, ready_s - ended_s, cpu_s, waited_s)

    def log_size(self, service: str) -> int:
        """Return how much a service has said so far, bytes."""
        path = self.folder / f"{service}.log"
        return path.stat().st_size if path.exists() else 0

    def said_since(self, service: str, size: int) -> str:
        """Return what a service has said since its log had ``size`` bytes."""
        path = self.folder / f"{service}.log"
        return path.read_bytes()[size:].decode(errors="replace") if path.exists() else ""

    def said(self, service: str) -> str:
        """Return the last words of a service."""
        path = self.folder / f"{service}.log"
        lines = path.read_text(errors="replace").strip().splitlines() if path.exists() else []
        return lines[-1] if lines else "it said nothing"


def _cpu_s(pid: int) -> float:
    """Return the processor time of a process so far (proc(5), stat, fields 14 and 15)."""
    try:
        words = Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
    except OSError:
        return float("inf")
    return (int(words[11]) + int(words[12])) / os.sysconf("SC_CLK_TCK")


def _waited_s(pid: int) -> float:
    """Return how long a process's threads have waited for a processor (proc schedstat, second field); 0 where that is not told."""
    waited_ns = 0
    for path in Path(f"/proc/{pid}/task").glob("*/schedstat"):
        with contextlib.suppress(OSError, IndexError, ValueError):
            waited_ns += int(path.read_text(encoding="ascii").split()[1])
    return waited_ns * 1e-9


def _running(pid: int) -> bool:
    """Whether a child process runs, the dead that nobody has asked after not counted."""
    try:
        return Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rpartition(")")[2].split()[0] != "Z"
    except (OSError, IndexError):
        return False
