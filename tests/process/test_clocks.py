"""Services on machines whose clocks differ, over the real bus: one time for all, also after the router was started again."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Iterator
from itertools import pairwise

from schemas.health import Health
from schemas.simulation import SimClock
from schemas.topics import HEALTH, SIM_CLOCK
from services.common.config import TreedockConfig
from services.common.runtime import run_service
from services.common.session import free_port
from services.common.stop import StopSignal
from services.navigator.config import NavigatorConfig
from services.router.config import RouterConfig
from services.router.service import run as run_router
from tests.process.conftest import HealthWatch, System, pump, until

CLOSE_S = 0.1
"""A busy machine takes so long to deliver a message; the offsets are larger."""


def config(port: int, ahead_s: float) -> TreedockConfig:
    return TreedockConfig(router=RouterConfig(port=port), clock_ahead_s=ahead_s)


@contextlib.contextmanager
def running(name: str, tree: TreedockConfig) -> Iterator[None]:
    stop = StopSignal()
    target = run_router if name == "router" else lambda t, s: run_service(name, lambda _: None, t, s)
    thread = threading.Thread(target=target, args=(tree, stop), daemon=True)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join(10.0)


def off_s(watch: HealthWatch, service: str) -> float:
    """Return how far a service's clock is ahead of ours, by a health that came just now."""
    before = watch.latest[service].stamp_ns if service in watch.latest else 0
    assert until(lambda: service in watch.latest and watch.latest[service].stamp_ns != before, 20.0, watch.bus)
    return watch.latest[service].stamp_ns * 1e-9 - time.time()


def test_a_clock_200_ms_ahead_is_measured_and_corrected(system: System) -> None:
    with running("router", config(system.port, 0.0)), running("slam", config(system.port, 0.2)), system.bus() as bus:
        watch = HealthWatch(bus)
        assert abs(off_s(watch, "slam")) < CLOSE_S
        assert abs(watch.counter("slam", "clock_ahead_us") - 200_000) < 20_000


def test_a_router_started_again_on_a_machine_whose_clock_was_set_goes_on_in_the_old_time(system: System) -> None:
    system.port = free_port()
    with running("slam", config(system.port, 0.0)):
        with running("router", config(system.port, 0.0)), system.bus() as bus:
            off_s(HealthWatch(bus), "slam")
            time.sleep(1.2)  # the service is older than the next router by more than a health's period
        with running("router", config(system.port, 3600.0)), system.bus() as bus:
            watch = HealthWatch(bus)
            assert until(lambda: abs(off_s(watch, "router")) < CLOSE_S, 20.0, bus)
            assert abs(off_s(watch, "slam")) < CLOSE_S
            with running("mapper", config(system.port, -60.0)):  # one that joins now is told the same
                assert abs(off_s(watch, "mapper")) < CLOSE_S


def test_in_a_simulation_five_times_as_fast_no_living_service_is_taken_for_dead(system: System) -> None:
    """The navigator counts a service's silence in the simulation's time: 3.5 s of it are 0.7 s here."""
    speed, heard_s = 5.0, [0.0]
    tree = config(system.port, 0.0).model_copy(update={"clock": "sim"})
    with running("router", config(system.port, 0.0)), running("mapper", tree), system.bus() as bus:
        watch = HealthWatch(bus)
        assert until(lambda: watch.state("mapper") == "ready", 20.0, bus)
        begin_s, seq, simulated_s = time.monotonic(), 0, 0.0

        def hear(health: Health) -> None:
            if health.service == "mapper":
                heard_s.append(simulated_s)

        bus.subscribe(HEALTH, hear)
        while simulated_s < 20.0:
            simulated_s, seq = speed * (time.monotonic() - begin_s), seq + 1
            bus.publish(SIM_CLOCK, SimClock(stamp_ns=round(simulated_s * 1e9), seq=seq, phase="running", frames=0))
            time.sleep(0.01)
            pump(bus)
    silent_s = max(b - a for a, b in pairwise([*heard_s, simulated_s]))
    assert silent_s < NavigatorConfig().failsafe.service_silent_s
    assert len(heard_s) <= 30  # and no flood
