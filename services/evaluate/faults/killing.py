"""Rows that kill or stop a process in flight, at random moments of missions."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable
from functools import partial

from services.evaluate.faults.bench_rig import Bench
from services.evaluate.faults.chain import SERVICES as CHAIN
from services.evaluate.faults.missions import Back, Flights, Seen, line_of
from services.evaluate.faults.model import Result, Row
from services.evaluate.faults.rig import Comeback
from services.evaluate.faults.verdict import Limits, common, faults_of, summary

_RESPONSE = {
    "camera": "hold at once, land after 1.2 s", "slam": "hold at once, land after 1.2 s",
    "mapper": "fly on; hold in scan, select and face when it is away for 3.5 s",
    "detector": "fly on; hold in scan, select and face when it is away for 3.5 s",
    "refiner": "hold at once in approach and dock, then on; else fly on",
    "navigator": "the bridge holds at once; by the operator's `resume` it goes on, or it lands",
    "autopilot": "PX4 leaves offboard after its own 1.2 s and lands; the bridge that comes back stays silent",
    "recorder": "fly on", "preview": "fly on", "station": "fly on; hold when it is away for 5 s",
    "router": "hold while nobody hears anybody, or fly on; the others stay alive and join again",
}  # fmt: skip
_SIGNALS = {"kill -9": signal.SIGKILL, "SIGSTOP": signal.SIGSTOP}


def rows() -> list[Row]:
    """Return the rows: each process killed, each process stopped."""
    return [
        Row(
            f"{how} {service}", "flight", f"{how} of {service} at three random moments of missions",
            response if how == "kill -9" else f"{response}; noticed within 11.5 s",
            partial(_strike, service=service, how=how),
        )
        for how in _SIGNALS
        for service, response in _RESPONSE.items()
    ]  # fmt: skip


def chain_rows() -> list[Row]:
    """Return the rows of the real services over a recording."""
    return [
        Row(
            f"{how} {service} (real)", "chain", f"{how} of the real {service} at three random moments of a recording",
            "back and READY within 3.5 s of its end; poses come again; every tree is there again, under its id within 5 cm",
            partial(_strike_real, service=service, how=how),
        )
        for how in _SIGNALS
        for service in CHAIN[1:]
    ]  # fmt: skip


def _strike_real(bench: Bench, service: str, how: str) -> Result:
    chain, rng = bench.chain(), bench.rng(f"{how} {service} (real)")
    failed, told, backs, noticed, ready = [], [], [], [], []
    for _ in range(bench.moments):
        chain.rig.pump(float(rng.uniform(0.5, 6.0)))
        before = chain.trees
        assert before is not None, "the chain's start waits for trees"
        back = chain.harm(service, _SIGNALS[how])
        since_ns = time.time_ns()
        words = faults_of_comeback(back, bench.limits) + chain.whole_again(
            before, since_ns if service == "detector" else 0
        )
        failed += words
        backs.append(back.back_s if back else None)
        noticed.append(back.noticed_s if back else None)
        ready.append(back.ready_after_s() if back else None)
        told.append(
            f"{how} {service}: back {backs[-1] or -1:.2f} s, {len(before.trees)} trees, {'; '.join(words) or 'whole again'}"
        )
        bench.tell(told[-1])
    measured = {
        "back_s": max((b for b in backs if b), default=None),
        "noticed_s": max((n for n in noticed if n), default=None),
    }
    return Result(tuple(failed), measured, tuple(told))


def faults_of_comeback(back: Comeback | None, limits: Limits) -> list[str]:
    """Return what of a service's return did not hold."""
    if back is None:
        return ["it did not come back"]
    ready_s = back.ready_after_s()
    late = [f"ready after {ready_s:.1f} s, not within {limits.back_s}"] if ready_s > limits.back_s else []
    slow = back.noticed_s > limits.noticed_s
    return late + ([f"noticed after {back.noticed_s:.1f} s, not within {limits.noticed_s}"] if slow else [])


def _strike(bench: Bench, service: str, how: str) -> Result:
    seen, failed = [], []
    for _ in range(bench.moments):
        flights = bench.flights(f"{how} {service}")
        flights.moment()
        others = _pids(flights.rig.supervisor.children, service)
        one = flights.strike(service, _SIGNALS[how])
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


def passing(bench: Bench, row: str, harm: Callable[[Flights], Back], lands: bool) -> Result:
    """Run a fault that passes by itself at random moments: the mission goes on, or may land where ``lands``."""
    seen, failed = [], []
    for _ in range(bench.moments):
        flights = bench.flights(row)
        flights.moment()
        one = flights.see(row, partial(harm, flights))
        seen.append(one)
        failed += [f"{one.state}: {word}" for word in common(one)]
        if (
            one.end in {"landed", "released", "failed"}
            and not lands
            and one.state not in {"docked", "landing", "undock"}
        ):
            failed.append(f"{one.state}: the mission ended ({one.end}: {one.reason})")
    return result_of(seen, failed)


def result_of(seen: list[Seen], failed: list[str]) -> Result:
    """Return the result of several faults."""
    return Result(tuple(failed), summary(seen), tuple(line_of(one) for one in seen))
