"""A rendered mission in real processes, watched over the bus, with somebody who kills services in it."""

from __future__ import annotations

import contextlib
import json
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from schemas.navigation import Guidance, MissionState
from schemas.simulation import SimClock, SimTruth
from schemas.topics import MISSION_GUIDANCE, MISSION_STATE, SIM_CLOCK, SIM_TRUTH, VEHICLE_STATE
from schemas.vehicle import VehicleState
from services.common.bus import Bus
from services.common.context import HealthBook
from services.common.session import free_port, opened_client

ROOT = Path(__file__).parents[2]


@dataclass
class Watched:
    """A run under way and what its bus has said."""

    process: subprocess.Popen[str]
    bus: Bus
    states: list[MissionState] = field(default_factory=list)
    guidance: list[Guidance] = field(default_factory=list)
    vehicles: list[VehicleState] = field(default_factory=list)
    truths: list[SimTruth] = field(default_factory=list)
    now_ns: int = 0

    def __post_init__(self) -> None:
        self.bus.subscribe(MISSION_STATE, self.states.append)
        self.bus.subscribe(MISSION_GUIDANCE, self.guidance.append)
        self.bus.subscribe(VEHICLE_STATE, self.vehicles.append)
        self.bus.subscribe(SIM_TRUTH, self.truths.append)
        self.bus.subscribe_keys(SIM_CLOCK, self._on_clock, at_once=True)

    def _on_clock(self, _: str, clock: SimClock) -> None:
        self.now_ns = max(self.now_ns, clock.stamp_ns)

    @property
    def state(self) -> str:
        return self.states[-1].state if self.states else ""

    def until(self, condition: Callable[[], bool], timeout_s: float) -> bool:
        end_s = time.monotonic() + timeout_s
        while time.monotonic() < end_s:
            while (taken := self.bus.inbox.take()) is not None:
                taken[0].handler(taken[1])
            if condition():
                return True
            if self.process.poll() is not None:
                return False
            time.sleep(0.01)
        return False

    def flown_s(self, seconds: float, timeout_s: float = 60.0) -> bool:
        """Wait for simulated time to pass."""
        end_ns = self.now_ns + round(seconds * 1e9)
        return self.until(lambda: self.now_ns >= end_ns, timeout_s)

    def kill(self, service: str, number: int = signal.SIGKILL) -> int:
        """Send a service a signal and return the simulated time of it."""
        for child in psutil.Process(self.process.pid).children():
            if child.cmdline()[3:4] == [service]:
                child.send_signal(number)
                return self.now_ns
        raise AssertionError(f"no process of {service}")

    def path(self, after_ns: int) -> tuple[np.ndarray, np.ndarray]:
        """Return seconds since ``after_ns`` (n,) and the camera's true places from above (n, 2), m, frame by frame."""
        late = [t for t in self.truths if t.stamp_ns >= after_ns]
        times_s = np.array([(t.stamp_ns - after_ns) * 1e-9 for t in late])
        return times_s, np.array([t.T_map_camera.position_m[:2] for t in late]).reshape(-1, 2)

    def result(self, timeout_s: float = 400.0) -> tuple[int, dict[str, Any], str]:
        """Wait for the end: exit code, summary, what was said on stderr."""
        self.until(lambda: False, timeout_s)
        out, err = self.process.communicate(timeout=20.0)
        return self.process.returncode, json.loads(out) if out else {}, err


@contextlib.contextmanager
def flight(folder: Path, *arguments: str) -> Iterator[Watched]:
    """Start a rendered mission at reduced size on a port of its own; end it whatever happens."""
    port = free_port()
    command = [sys.executable, "-m", "services.cli.app", "run", "--source", "sim", "--json", "--port", str(port),
               "--set", "simulator.reduced=true", "--logs", str(folder / "logs"), *arguments]  # fmt: skip
    process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        with opened_client(f"tcp/127.0.0.1:{port}", lambda: process.poll() is not None, wait_s=60.0) as session:
            yield Watched(process, Bus(session, "uav1", HealthBook()))
    finally:
        if process.poll() is None:
            process.send_signal(signal.SIGTERM)
            try:
                process.communicate(timeout=15.0)
            except subprocess.TimeoutExpired:
                process.kill()
                process.communicate()
