"""From the camera's stamp to ``trees/target``: the real services as processes, joined by the bus, over a recording."""

from __future__ import annotations

from services.evaluate.bench import BenchOptions, BenchReport
from services.evaluate.live_set import fly, frames_for, told
from services.evaluate.passages import HEAD, figures_of, line_of, stage_lines

RATES_HZ = (15.0, 30.0)
_SERVICES = ("camera", "slam", "mapper", "detector", "refiner")


def run(options: BenchOptions) -> BenchReport:
    """Send a simulated recording (or one of ``--scenes tum:DIR``) through the live system at 15 and at 30 Hz."""
    rates = RATES_HZ[:1] if options.quick else RATES_HZ
    figures: dict[str, float] = {}
    lines, stages = list(HEAD), []
    name, frames = frames_for(options)
    for rate in rates:
        seen = fly(frames, rate, _SERVICES).seen
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
