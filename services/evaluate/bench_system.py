"""The whole onboard set over a recording at 30 Hz: latency, processor, memory, losses, start; frames by shared memory.

Every service that flies runs as a process of its own, the recorder and somebody who looks at the preview included; the
simulated autopilot stands in for PX4 behind MAVLink, in a process that is not counted. Nobody gives the start command:
a recording cannot follow a mission, so the navigator watches.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from services.evaluate.bench import BenchOptions, BenchReport
from services.evaluate.frame_ways import Way, compare, table_of
from services.evaluate.live_set import READY_WITHIN_S, Flight, fly, frames_for, live_config, observed, told
from services.evaluate.passages import HEAD, figures_of, late_line, line_of, stage_lines
from services.evaluate.processes import Processes
from services.evaluate.usage import Budget, group_priority, over_budget

if TYPE_CHECKING:
    pass

RATE_HZ = 30.0
ONBOARD = ("camera", "slam", "mapper", "detector", "refiner", "navigator", "autopilot", "preview", "recorder")
"""With the router: what deploy/units.py runs on an aircraft."""
BUDGETS: Mapping[str, Budget] = {
    "router": Budget(0.10, 95.0),
    "camera": Budget(0.40, 150.0),
    "slam": Budget(1.00, 260.0),
    "mapper": Budget(0.30, 420.0),
    "detector": Budget(0.25, 160.0),
    "refiner": Budget(0.15, 150.0),
    "navigator": Budget(0.10, 80.0),
    "autopilot": Budget(0.12, 60.0),
    "preview": Budget(0.12, 115.0),
    "recorder": Budget(0.30, 110.0),
}
"""What each may use. The memory adds up to the aim; processor time does not: the bursts of mapper and detector, which one
budget has to cover, do not come together."""
_AIMS = {
    "latency_ms_p99": 80.0,
    "latency_ms_p99_under_way": 80.0,
    "cpu_cores": 1.8,
    "memory_mb": 1600.0,
    "ready_s": 6.0,
    "ready_alone_s_max": 3.0,
}


def run(options: BenchOptions) -> BenchReport:
    """Measure the ways of a frame, the whole set, and how soon services are ready."""
    name, frames = frames_for(options)
    ways = compare(frames[0], quick=options.quick)
    options.tell("frames by shared memory and TCP: measured")
    flight = fly(frames, RATE_HZ, ONBOARD, autopilot=True)
    options.tell(f"whole set: {figures_of(flight.seen)}")
    alone = {} if options.quick else ready_alone()
    figures = _figures(flight, alone, ways)
    conditions = {
        "recording": told(name, frames) + f" at {RATE_HZ:.0f} Hz",
        "processes": f"router, {', '.join(ONBOARD)}; beside them the sensor with the observer, and the simulated autopilot",
        "latency": "from the camera's stamp to the arrival of trees/target at an observer",
        "memory": "PSS: what processes share is counted once",
        "dropped": "frames handed to the camera service that trees/target did not answer",
    }
    conditions["beside them"] = ", ".join(
        f"{name} {usage.cpu_cores:.2f} cores" for name, usage in flight.used.items() if name not in flight.aboard
    )
    if (priority := group_priority()) != 0:
        conditions["priority"] = f"all of it ran before other work on the machine (nice {priority})"
    parts = (_summary(figures), _flown(flight), _processes(flight), table_of(ways), _ready(flight, alone))
    return BenchReport(figures, conditions, "\n\n".join(part for part in parts if part))


def ready_alone() -> dict[str, float]:
    """Return for each service the seconds from its start until it is ready, nothing but a router beside it."""
    found = {}
    with tempfile.TemporaryDirectory(prefix="treedock-system-") as folder:
        config = live_config(Path(folder))
        with (
            Processes(config, Path(folder)) as running,
            observed(running, config.router.endpoint, config.uav) as (bus, _),
        ):
            for name in ONBOARD:
                begin_s = time.monotonic()
                running.start(name)
                running.wait(lambda name=name: bus.alive(name), READY_WITHIN_S, f"{name} to be ready")  # type: ignore[misc]
                found[name] = round(time.monotonic() - begin_s, 2)
                running.stop(name)
    return found


def _figures(flight: Flight, alone: Mapping[str, float], ways: Sequence[Way]) -> dict[str, float]:
    found = figures_of(flight.seen)
    found["dropped"] = float(flight.dropped)
    found["cpu_cores"] = round(sum(usage.cpu_cores for usage in flight.aboard.values()), 2)
    found["memory_mb"] = round(sum(usage.pss_mb for usage in flight.aboard.values()), 1)
    found["over_budget"] = float(len(over_budget(flight.aboard, BUDGETS)))
    found["ready_s"] = round(flight.ready_s, 2)
    if alone:
        found["ready_alone_s_max"] = max(alone.values())
    for way in ways:
        key = "shm" if way.shared else "tcp"
        found |= {
            f"frame_{key}_ms_p50": way.p50_ms,
            f"frame_{key}_ms_p99": way.p99_ms,
            f"frame_{key}_cores": round(way.cores, 2),
        }
    return found


def _summary(figures: Mapping[str, float]) -> str:
    lines = ["| | measured | aim |", "|---|---|---|"]
    words = {
        "latency_ms_p99": "stamp to target, p99 (ms)",
        "latency_ms_p99_under_way": "the same without the first second (ms)", "cpu_cores": "processor, whole set (cores)",
        "memory_mb": "memory, whole set (MB)", "ready_s": "whole set ready after (s)",
        "ready_alone_s_max": "slowest service alone ready after (s)",
    }  # fmt: skip
    lines += [f"| {text} | {figures[key]:g} | <= {_AIMS[key]:g} |" for key, text in words.items() if key in figures]
    return "\n".join([*lines, f"| frames dropped of {figures['frames']:.0f} | {figures['dropped']:.0f} | |"])


def _flown(flight: Flight) -> str:
    found = figures_of(flight.seen)
    late = late_line(flight.seen, _AIMS["latency_ms_p99"])
    return "\n".join([*HEAD, line_of(RATE_HZ, found), "", late, "", *stage_lines(RATE_HZ, flight.seen)])


def _processes(flight: Flight) -> str:
    lines = [
        "| process | processor (cores) | budget | memory (MB) | budget | samples it missed |",
        "|---|---|---|---|---|---|",
    ]
    for name, usage in flight.aboard.items():
        budget = BUDGETS[name]
        lines.append(
            f"| {name} | {usage.cpu_cores:.3f} | {budget.cpu_cores:.2f} | {usage.pss_mb:.0f} | {budget.pss_mb:.0f} | {_missed(flight, name)} |"
        )
    over = over_budget(flight.aboard, BUDGETS)
    return "\n".join([*lines, "", f"Over budget by more than a fifth: {'; '.join(over) or 'none'}."])


def _missed(flight: Flight, name: str) -> str:
    """Return what a service's last health tells of samples that it did not get."""
    counters = flight.seen.health[name].counters if name in flight.seen.health else {}
    lost = {key.removeprefix("dropped."): n for key, n in counters.items() if key.startswith("dropped.")}
    return ", ".join(f"{n} {key}" for key, n in sorted(lost.items())) or "none"


def _ready(flight: Flight, alone: Mapping[str, float]) -> str:
    if not alone:
        return ""
    each = ", ".join(f"{name} {seconds:.1f}" for name, seconds in alone.items())
    return f"Ready after, each alone (s): {each}; all at once {flight.ready_s:.1f}."
