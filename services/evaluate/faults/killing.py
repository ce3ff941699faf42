"""Rows that kill or stop a process in flight, at random moments of missions."""

from __future__ import annotations

import signal
from collections.abc import Callable
from functools import partial

from services.evaluate.faults.bench_rig import Bench
from services.evaluate.faults.flown import ENDED
from services.evaluate.faults.missions import NEVER_S, Back, Flights, Seen, line_of
from services.evaluate.faults.model import Result, Row
from services.evaluate.faults.rig import FUSED
from services.evaluate.faults.verdict import common, faults_of, goes_on, summary

_RESPONSE = {
    "camera": "hold at once, land after 1.2 s", "slam": "hold at once, land after 1.2 s",
    "mapper": "fly on; hold in scan, select and face when it is away for 3.5 s",
    "detector": "fly on; hold in scan, select and face when it is away for 3.5 s",
    "refiner": "hold at once in approach and dock, then on; else fly on",
    "navigator": "the bridge holds at once; by the operator's `resume` it goes on, or it lands",
    "autopilot": "PX4 leaves offboard after its own 1.2 s and lands; the bridge that comes back stays silent",
    "recorder": "fly on", "preview": "fly on", "station": "fly on; hold when it is away for 5 s",
    "router": "hold while nobody hears anybody, or fly on; the others stay alive and join again",
    "fusion": "hold at once, land after 1.2 s", "second_camera": "fly on", "second_slam": "fly on",
}  # fmt: skip
SIGNALS = {"kill -9": signal.SIGKILL, "SIGSTOP": signal.SIGSTOP}


def rows() -> list[Row]:
    """Return the rows: each process killed, each process stopped."""
    return [
        Row(
            f"{how} {service}", "flight",
            f"{how} of {service} at three random moments of missions" + " with fusion and a second camera" * (service in FUSED),
            response if how == "kill -9" else f"{response}; noticed within 11.5 s",
            partial(_strike, service=service, how=how),
        )
        for services in (set(_RESPONSE) - set(FUSED), FUSED)
        for how in SIGNALS
        for service, response in _RESPONSE.items()
        if service in services
    ]  # fmt: skip


def _strike(bench: Bench, service: str, how: str) -> Result:
    seen, failed = [], []
    for _ in range(bench.moments):
        flights = bench.flights(f"{how} {service}", fused=service in FUSED)
        flights.moment()
        others = _pids(flights.rig.supervisor.children, service)
        one = flights.strike(service, SIGNALS[how])
        seen.append(one)
        failed += [f"{one.state}: {word}" for word in faults_of(service, one, bench.limits)]
        gone = [
            name for name, pid in others.items() if _pids(flights.rig.supervisor.children, service).get(name) != pid
        ]
        failed += [f"{one.state}: {name} was started again too" for name in gone]
    return result_of(seen, failed)


def _pids(children: object, but: str) -> dict[str, int]:
    assert isinstance(children, dict)
    return {name: c.process.pid for name, c in children.items() if c.process is not None and name != but}


def passing(
    bench: Bench,
    row: str,
    harm: Callable[[Flights], Back],
    lands: bool,
    also: Callable[[Seen], str] = lambda _: "",
) -> Result:
    """Run a fault that passes by itself at random moments: the mission goes on, or may land where ``lands``.

    ``also`` returns in words what else did not hold in one of them, empty when all did.
    """
    seen, failed = [], []
    for _ in range(bench.moments):
        flights = bench.flights(row)
        flights.moment()
        one = flights.see(row, partial(harm, flights))
        seen.append(one)
        failed += [f"{one.state}: {word}" for word in (*common(one), also(one)) if word]
        if one.back_s is not None and one.back_s >= NEVER_S:
            failed.append(f"{one.state}: it did not come back")
        if one.end in ENDED and not lands and not goes_on(one):
            failed.append(f"{one.state}: the mission ended ({one.end}: {one.reason})")
    return result_of(seen, failed)


def result_of(seen: list[Seen], failed: list[str]) -> Result:
    """Return the result of several faults."""
    return Result(tuple(failed), summary(seen), tuple(line_of(one) for one in seen))
