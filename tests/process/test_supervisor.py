"""The supervisor over real processes: a killed, a hung and a hopeless service."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator

import pytest

from schemas.health import Health
from schemas.topics import HEALTH
from services.cli.run_config import SupervisorConfig
from services.cli.supervisor import Supervisor
from services.common.bus import Bus
from tests.process.conftest import ROOT, System, until

LIMITS = SupervisorConfig(hung_after_s=2.0, backoff_s=0.1, stop_within_s=2.0, give_up_after=2)


@pytest.fixture
def bus(routed: System) -> Iterator[Bus]:
    with routed.bus() as bus:
        yield bus


def supervise(system: System, bus: Bus, *names: str) -> Supervisor:
    supervisor = Supervisor(names, system.start, LIMITS)

    def heard(health: Health) -> None:
        supervisor.heard(health.service, health.pid, health.state)

    bus.subscribe(HEALTH, heard)
    return supervisor


def watched(supervisor: Supervisor, bus: Bus, condition: Callable[[], bool], timeout_s: float = 9.0) -> bool:
    def look() -> bool:
        supervisor.check()
        return condition()

    return until(look, timeout_s, bus)


def test_a_killed_service_is_started_again(routed: System, bus: Bus) -> None:
    supervisor = supervise(routed, bus, "camera")
    assert watched(supervisor, bus, lambda: supervisor.all_ready)
    child = supervisor.children["camera"]
    assert child.process is not None
    first = child.process.pid
    os.kill(first, signal.SIGKILL)
    assert watched(supervisor, bus, lambda: child.restarts == 1 and child.ready)
    assert child.process is not None
    assert child.process.pid != first
    assert child.last_fault == "was ended by SIGKILL"
    supervisor.stop_all()
    assert not child.alive


def test_a_hung_service_is_killed_and_started_again(routed: System, bus: Bus) -> None:
    supervisor = supervise(routed, bus, "hanger")
    child = supervisor.children["hanger"]
    assert watched(supervisor, bus, lambda: child.restarts == 1), "health comes from the loop that hangs"
    assert "silent" in routed.said("hanger") or child.last_fault
    supervisor.stop_all()


def test_what_never_becomes_ready_is_given_up(routed: System, bus: Bus) -> None:
    supervisor = supervise(routed, bus, "no-such-role")
    assert watched(supervisor, bus, lambda: supervisor.given_up is not None)
    assert supervisor.given_up is supervisor.children["no-such-role"]


def test_all_are_stopped_within_three_seconds(routed: System, bus: Bus) -> None:
    supervisor = supervise(routed, bus, "camera", "slam", "hanger")
    assert watched(supervisor, bus, lambda: supervisor.all_ready)
    begin_s = time.monotonic()
    supervisor.stop_all()
    assert time.monotonic() - begin_s < 3.0
    assert not any(child.alive for child in supervisor.children.values())


def test_services_end_with_the_supervisor_that_started_them(routed: System, bus: Bus) -> None:
    code = (
        "import os, subprocess, sys, time\n"
        "command = [sys.executable, '-m', 'services.cli.app', 'camera', '--port', sys.argv[1], '--parent', str(os.getpid()),\n"
        "           '--set', 'camera.source=sim']\n"
        "subprocess.Popen(command)\n"
        "time.sleep(60)\n"
    )
    parent = subprocess.Popen([sys.executable, "-c", code, str(routed.port)], cwd=ROOT)
    routed.processes.append(parent)
    assert until(lambda: "camera" in bus.live_services(0.2))
    parent.kill()
    parent.wait()
    assert until(lambda: "camera" not in bus.live_services(0.2), timeout_s=2.0)
