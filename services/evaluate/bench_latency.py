"""From the camera's stamp to ``trees/target``: the real services as processes, joined by the bus, over a recording."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from schemas.camera import RgbdFrame
from services.evaluate.bench import BenchOptions, BenchReport
from services.evaluate.live_set import READY_WITHIN_S, frames_for, live_config, send, told
from services.evaluate.passages import HEAD, Passages, figures_of, line_of, stage_lines
from services.evaluate.processes import Processes

RATES_HZ = (15.0, 30.0)
_SERVICES = ("camera", "slam", "mapper", "detector", "refiner")
_DRAIN_S = 2.0


def run(options: BenchOptions) -> BenchReport:
    """Send a simulated recording (or one of ``--scenes tum:DIR``) through the live system at 15 and at 30 Hz."""
    rates = RATES_HZ[:1] if options.quick else RATES_HZ
    figures: dict[str, float] = {}
    lines, stages = list(HEAD), []
    name, frames = frames_for(options)
    for rate in rates:
        seen = measure(frames, rate)
        found = figures_of(seen)
        figures |= found if rate == rates[0] else {f"{key}_{rate:.0f}hz": value for key, value in found.items()}
        lines.append(line_of(rate, found))
        stages += [*stage_lines(rate, seen), ""]
        options.tell(lines[-1])
    conditions = {
        "recording": told(name, frames),
        "processes": "router, camera, slam, mapper, detector, refiner, and this one; Zenoh on one machine",
        "latency": "from the camera's stamp to the arrival of trees/target at an observer",
    }
    return BenchReport(figures, conditions, "\n".join([*lines, "", *stages]).rstrip())


def measure(frames: Sequence[RgbdFrame], rate_hz: float) -> Passages:
    """Run the system over raw frames at a rate, and watch it.

    Raises:
        InputError: a service ended, or was not ready in time.
    """
    from services.common.bus import Bus
    from services.common.context import HealthBook
    from services.common.session import opened_client

    with tempfile.TemporaryDirectory(prefix="treedock-latency-") as folder:
        config = live_config(Path(folder))
        with Processes(config, Path(folder)) as running:
            running.start("router")
            with opened_client(config.router.endpoint, lambda: False, wait_s=60.0) as session:
                bus, seen = Bus(session, config.uav, HealthBook()), Passages(sent=len(frames))
                seen.observe(bus)
                for name in _SERVICES:
                    running.start(name)
                running.wait(lambda: all(bus.alive(name) for name in _SERVICES), READY_WITHIN_S, "services to be ready")
                send(bus, frames, rate_hz, running)
                time.sleep(_DRAIN_S)
    return seen
