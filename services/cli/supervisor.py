"""Keeps the services of one machine running: starts them, restarts the dead and the hung, stops them all.

It looks from outside only: at the process, and at the health that the service's own work loop sends.
"""

from __future__ import annotations

import logging
import signal
import subprocess
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Protocol

from services.cli.run_config import SupervisorConfig

LOG = logging.getLogger(__name__)

_EXIT_INPUT = 2
_ROUTER = "router"
_ROUTER_SILENT_S = 3.0
"""All health comes by way of the router: when its own stays away, that of the others says nothing."""
_OWN_PAUSE_S = 1.0
"""After a longer pause between two looks the silence of the others is our own: this machine slept, or had no time for us."""
EXPENDABLE = frozenset({"recorder", "preview", "station"})
"""No flight needs them: once all was well they are tried again for ever."""


class Process(Protocol):
    """What the supervisor needs of a process; ``subprocess.Popen`` has it."""

    pid: int

    def poll(self) -> int | None:
        """Return the exit code, None while it runs."""
        ...

    def send_signal(self, sig: int) -> None:
        """Send a signal."""
        ...

    def wait(self, timeout: float | None = None) -> int:
        """Wait for the end."""
        ...


@dataclass
class Child:
    """One supervised service."""

    name: str
    process: Process | None = None
    started_s: float = 0.0
    ready: bool = False
    heard_s: float = 0.0
    """When its last health came."""
    restarts: int = 0
    deaths_in_a_row: int = 0
    """Without having become ready in between."""
    start_at_s: float = 0.0
    last_fault: str = ""
    killed: bool = False
    """By us; a process that the kernel holds ends some time later."""
    was_ready: bool = False
    """At any time: what it is started with was good once."""
    lost: str = ""
    """What ended it when it was ready, the last time; empty: what it did for others was never lost."""

    @property
    def alive(self) -> bool:
        """Whether its process runs."""
        return self.process is not None and self.process.poll() is None


@dataclass
class Supervisor:
    """Watches the services ``names``; ``spawn`` starts one of them; times are monotonic seconds."""

    names: Iterable[str]
    spawn: Callable[[str], Process]
    limits: SupervisorConfig
    last: frozenset[str] = frozenset()
    """Services that begin only when all others are ready: a source whose first frames nobody would see."""
    now_s: Callable[[], float] = time.monotonic
    children: dict[str, Child] = field(init=False)
    given_up: Child | None = None
    """The service that cannot be kept running: the run is over."""

    def __post_init__(self) -> None:
        self.children = {name: Child(name) for name in self.names}
        self._looked_s = self.now_s()

    def heard(self, name: str, pid: int, state: str) -> None:
        """Take note of a health message."""
        child = self.children.get(name)
        if child is None or child.process is None or child.process.pid != pid:
            return  # of a process that was replaced
        child.heard_s = self.now_s()
        if state in {"ready", "degraded"} and not child.ready:
            child.ready = child.was_ready = True
            child.deaths_in_a_row = 0
            if name == _ROUTER:
                self._hear_anew()

    @property
    def all_ready(self) -> bool:
        """Whether every service has told that it is ready."""
        return all(child.ready for child in self.children.values())

    @property
    def restarts(self) -> int:
        """Restarts of all services so far."""
        return sum(child.restarts for child in self.children.values())

    def check(self) -> None:
        """Start what is due, notice the dead, kill the hung. Called several times a second."""
        paused_s, self._looked_s = self.now_s() - self._looked_s, self.now_s()
        if paused_s > _OWN_PAUSE_S:  # a pause of ours is nobody's silence
            for child in self.children.values():
                child.heard_s = min(child.heard_s + paused_s, self.now_s())
        for child in self.children.values():
            if child.process is None:
                if self.now_s() >= child.start_at_s and not self._held_back(child):
                    self._start(child)
                continue
            code = child.process.poll()
            if code is not None:
                self._died(child, code)
            elif not child.killed and (reason := self._hung(child)):
                LOG.warning("%s (pid %d) %s: it is killed and started again", child.name, child.process.pid, reason)
                child.last_fault, child.killed = reason, True
                child.process.send_signal(signal.SIGKILL)

    def _held_back(self, child: Child) -> bool:
        """Whether the first start waits for other services."""
        first = child.restarts == 0
        return (
            first
            and child.name in self.last
            and not all(other.ready for other in self.children.values() if other.name not in self.last)
        )

    def _start(self, child: Child) -> None:
        child.process = self.spawn(child.name)
        child.started_s = child.heard_s = self.now_s()
        child.ready = False

    def _hear_anew(self) -> None:
        """Give everybody time: while the router was away nobody could be heard."""
        for child in self.children.values():
            child.heard_s = self.now_s()

    @property
    def _deaf(self) -> bool:
        """Whether the others' health would not reach us."""
        router = self.children.get(_ROUTER)
        return router is not None and (not router.ready or self.now_s() - router.heard_s > _ROUTER_SILENT_S)

    def _hung(self, child: Child) -> str:
        """Return in words why the running child counts as hung, or an empty text."""
        if not child.ready:
            waited_s = self.now_s() - child.started_s
            return f"was not ready after {waited_s:.0f} s" if waited_s > self.limits.start_within_s else ""
        if child.name != _ROUTER and self._deaf:
            return ""
        silent_s = self.now_s() - child.heard_s
        return f"was silent for {silent_s:.0f} s" if silent_s > self.limits.hung_after_s else ""

    def _died(self, child: Child, code: int) -> None:
        if not (child.killed and code == -signal.SIGKILL):  # else that we killed it is known, and why is kept
            child.last_fault = _words(code)
        child.lost = child.last_fault if child.ready else child.lost
        child.process, child.killed = None, False
        child.deaths_in_a_row += 0 if child.ready else 1
        child.ready = False
        child.restarts += 1
        refused = code == _EXIT_INPUT and not child.was_ready
        hopeless = child.deaths_in_a_row >= self.limits.give_up_after
        if refused or (hopeless and not (child.was_ready and child.name in EXPENDABLE)):
            self.given_up = child
        pause_s = min(self.limits.backoff_s * 2 ** max(0, child.deaths_in_a_row - 1), self.limits.backoff_max_s)
        child.start_at_s = self.now_s() + pause_s
        LOG.warning("%s %s: started again in %.1f s", child.name, child.last_fault, pause_s)

    def stop_all(self) -> None:
        """Stop every service: SIGTERM to all but the router, then the router, SIGKILL to what is left in time."""
        others = [c for c in self.children.values() if c.name != "router"]
        routers = [c for c in self.children.values() if c.name == "router"]
        for group in (others, routers):
            self._stop(group)

    def _stop(self, group: list[Child]) -> None:
        running = [child.process for child in group if child.process is not None and child.process.poll() is None]
        for process in running:
            process.send_signal(signal.SIGTERM)
        deadline_s = self.now_s() + self.limits.stop_within_s
        for process in running:
            try:
                process.wait(timeout=max(0.05, deadline_s - self.now_s()))
            except subprocess.TimeoutExpired:
                process.send_signal(signal.SIGKILL)
                process.wait()


def _words(code: int) -> str:
    if code < 0:
        try:
            return f"was ended by {signal.Signals(-code).name}"
        except ValueError:
            return f"was ended by signal {-code}"
    return "ended unasked" if code == 0 else f"ended with exit code {code}"
