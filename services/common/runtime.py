"""A live service: the bus joined to one work loop that calls every handler, timer and the health report.

Health comes from the loop that does the work: while a handler hangs no health goes out, and that is how it is noticed.
"""

from __future__ import annotations

import datetime as dt
import logging
import time
from collections.abc import Callable
from contextlib import AbstractContextManager

import zenoh

from schemas.topics import HEALTH
from services.common import sd_notify
from services.common.clock import SimulatedClock
from services.common.clock_sync import ClockSync
from services.common.config import TreedockConfig
from services.common.errors import InputError
from services.common.health import HealthReporter, State
from services.common.live_context import LiveContext
from services.common.logging import set_up
from services.common.overdue import Overdue
from services.common.process import give_back_memory, started
from services.common.session import opened_node, shared_memory_note
from services.common.stop import StopSignal
from services.common.timekeeping import tell
from services.security.expiry import Expiry

LOG = logging.getLogger(__name__)

Build = Callable[[LiveContext], object]

_HEALTH_PERIOD_NS = 1_000_000_000
"""Of the wall's time, and in a simulation that runs faster, of its time: there, too, a silent service is a dead one."""
_GIVE_BACK_PERIOD_S = 60.0
"""How often freed memory goes back to the machine: a queue that once filled would else be held for good. Takes 0.3 to 5 ms."""


def run_service(
    name: str,
    build: Build,
    config: TreedockConfig,
    stop: StopSignal | None = None,
    session: Callable[[StopSignal], AbstractContextManager[zenoh.Session]] | None = None,
) -> int:
    """Run one service until SIGTERM or SIGINT; return its exit code.

    Args:
        name: of the service: its token is ``live/{name}``, its health ``health/{name}``.
        build: makes the core, warms it and registers handlers on the context it is given.
        config: the whole tree.
        stop: given by a test that has no signals; else the signals are taken over.
        session: opens the bus; the default is a client of the configured router, waited for until the stop.

    Raises:
        InputError: a configuration or a file that ``build`` cannot use.
    """
    set_up(name, config.log_level)
    if stop is None:
        stop = StopSignal()
        stop.install()
    if note := shared_memory_note():
        LOG.warning(note)
    open_session = session or (lambda s: opened_node(config, name, lambda: s.is_set))
    try:
        with open_session(stop) as opened:
            clock = SimulatedClock() if config.clock == "sim" else None
            return _serve(LiveContext(name, config, opened, clock), build, stop)
    except InputError:
        if stop.is_set:  # it was only waiting for the router
            return 0
        raise


def _serve(context: LiveContext, build: Build, stop: StopSignal) -> int:
    reporter = HealthReporter(context.service, context.health)
    overdue: Overdue | None = None
    reported_ns = wall_reported_ns = 0

    def report(state: State | None = None) -> None:
        nonlocal reported_ns, wall_reported_ns
        reported_ns, wall_reported_ns = context.clock.now_ns(), time.monotonic_ns()
        waiting = overdue.update() if overdue else ""
        context.bus.count_overflows()
        tell(context.wall, context.health)
        context.health.note("clock", sync.word)
        expiry.tell(context.health, dt.datetime.now(dt.UTC))
        health = reporter.report(context.wall.now_ns(), context.bus.passed, state, waiting)
        context.publish(HEALTH, health, context.service)
        if overdue is not None:
            # only once ready: the first kick arms the watchdog, and kernels may take longer to load than it waits
            sd_notify.notify("WATCHDOG=1")

    def report_by_the_wall() -> None:
        # rates over a moment say nothing: not right after the simulation's own second
        if not context.clock.simulated or time.monotonic_ns() - wall_reported_ns >= _HEALTH_PERIOD_NS // 2:
            report()

    def report_if_due() -> None:
        if context.clock.now_ns() - reported_ns >= _HEALTH_PERIOD_NS:
            report()

    expiry = Expiry(context.config.security, context.uav, context.service)
    sync = ClockSync(context.service, context.wall, context.bus)
    if context.service != "router":
        sync.begin()
        sync.keep(lambda: stop.is_set)
    report("starting")
    context.follow_simulated_clock()
    build(context)
    context.every_wall(_HEALTH_PERIOD_NS * 1e-9, report_by_the_wall)
    if context.clock.simulated:
        context.every(0.25 * _HEALTH_PERIOD_NS * 1e-9, report_if_due)
    context.bus.declare_live(context.service)
    stop.when_set(context.inbox.wake)
    started()
    give_back_memory()
    overdue = Overdue(context)
    sd_notify.notify("READY=1")
    LOG.info("ready")
    report()
    context.every_wall(_GIVE_BACK_PERIOD_S, give_back_memory)
    try:
        while not stop.is_set:
            context.turn()
    except Exception:
        LOG.exception("this is a bug: the service ends, its supervisor starts it again")
        return 1
    sd_notify.notify("STOPPING=1")
    for handler in context.at_stop:
        handler()
    report("stopping")
    LOG.info("stopped")
    return 0
