"""A router on a free port and services as real processes; whatever a test leaves running is killed after it."""

from __future__ import annotations

import contextlib
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import pytest
import zenoh

from schemas.health import Health
from schemas.topics import HEALTH
from services.common.bus import Bus
from services.common.context import HealthBook
from services.common.session import free_port, opened_client

ROOT = Path(__file__).parents[2]


@dataclass
class System:
    port: int
    folder: Path
    processes: list[subprocess.Popen[bytes]] = field(default_factory=list)

    @property
    def endpoint(self) -> str:
        return f"tcp/127.0.0.1:{self.port}"

    def start(self, role: str) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", "tests.process.nodes", role, str(self.port)]
        with self.log(role).open("ab") as log:
            process = subprocess.Popen(command, cwd=ROOT, stdout=log, stderr=log)
        self.processes.append(process)
        return process

    def log(self, role: str) -> Path:
        return self.folder / f"{role}.log"

    def said(self, role: str) -> str:
        return self.log(role).read_text()

    @contextlib.contextmanager
    def session(self) -> Iterator[zenoh.Session]:
        with opened_client(self.endpoint, lambda: False, wait_s=60.0) as session:
            yield session

    @contextlib.contextmanager
    def bus(self) -> Iterator[Bus]:
        with self.session() as session:
            yield Bus(session, "uav1", HealthBook())

    def kill_all(self) -> None:
        for process in self.processes:
            if process.poll() is None:
                process.kill()
            process.wait()


class HealthWatch:
    """The latest health of each service."""

    def __init__(self, bus: Bus) -> None:
        self.bus = bus
        self.latest: dict[str, Health] = {}
        bus.subscribe(HEALTH, self._take)

    def _take(self, health: Health) -> None:
        self.latest[health.service] = health

    def counter(self, service: str, name: str) -> int:
        health = self.latest.get(service)
        return health.counters.get(name, 0) if health else 0

    def state(self, service: str) -> str:
        health = self.latest.get(service)
        return health.state if health else ""


def pump(bus: Bus) -> None:
    """Handle what has come."""
    while (taken := bus.inbox.take()) is not None:
        taken[0].handler(taken[1])


def until(condition: Callable[[], bool], timeout_s: float = 8.0, bus: Bus | None = None) -> bool:
    """Wait for ``condition``, handling what comes meanwhile; False when it did not come true in time."""
    end_s = time.monotonic() + timeout_s
    while time.monotonic() < end_s:
        if bus is not None:
            pump(bus)
        if condition():
            return True
        time.sleep(0.02)
    return False


def stop_time_s(process: subprocess.Popen[bytes], number: int = signal.SIGTERM) -> float:
    """Send a signal and return how long the process took to end."""
    begin_s = time.monotonic()
    process.send_signal(number)
    process.wait(timeout=10)
    return time.monotonic() - begin_s


@pytest.fixture
def system(tmp_path: Path) -> Iterator[System]:
    system = System(free_port(), tmp_path)
    try:
        yield system
    finally:
        system.kill_all()


@pytest.fixture
def routed(system: System) -> System:
    """The same with a router that is up."""
    system.start("router")
    with system.session():
        pass
    return system
