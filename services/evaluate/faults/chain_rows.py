"""Rows of the real camera, slam, mapper, detector and refiner over a recording: killed, stopped, maps damaged, clocks set."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np

from schemas.health import Health
from services.evaluate.faults.bench_rig import Bench
from services.evaluate.faults.chain import SERVICES as CHAIN
from services.evaluate.faults.chain import Chain
from services.evaluate.faults.killing import SIGNALS
from services.evaluate.faults.model import Result, Row
from services.evaluate.faults.rig import Comeback, Rig
from services.evaluate.faults.verdict import Limits

_LOOKS = 5
_CLOCK_S = 0.02
_SAID_WITHIN_S = 10.0
"""Health comes once a second."""


def rows() -> list[Row]:
    """Return the rows of the real services over a recording."""
    return [
        Row(
            f"{how} {service} (real)", "chain", f"{how} of the real {service} at three random moments of a recording",
            "back and READY within 3.5 s of its end; poses come again; every tree is there again, under its id within 5 cm",
            partial(_strike_real, service=service, how=how),
        )
        for how in SIGNALS
        for service in CHAIN[1:]
    ] + [
        Row("corrupt map", "chain", "slam and mapper are killed and their saved maps overwritten with noise, or cut short",
            "both are READY within 3.5 s, name the damaged file and say what became of the map, and poses and trees come again", _corrupt_map),
        Row("clock step", "chain", "slam, and then the router, are killed and started again on a machine whose clock was set by an hour (slam: ahead, then back)",
            "stamps go on as before within 20 ms; poses come again", _clock_step),
    ]  # fmt: skip


def _strike_real(bench: Bench, service: str, how: str) -> Result:
    chain, rng = bench.chain(), bench.rng(f"{how} {service} (real)")
    failed, told, backs, noticed, ready = [], [], [], [], []
    for _ in range(bench.moments):
        chain.rig.pump(float(rng.uniform(0.5, 6.0)))
        before = chain.known()
        since_ns, submaps = time.time_ns(), chain.submaps
        back = chain.harm(service, SIGNALS[how])
        words = faults_of_comeback(back, bench.limits) + chain.whole_again(
            before, since_ns if service == "detector" else 0, submaps=submaps
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
        name: max((value for value in values if value is not None), default=None)
        for name, values in (("back_s", backs), ("noticed_s", noticed), ("ready_s", ready))
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


def _corrupt_map(bench: Bench) -> Result:
    chain, rng = bench.chain(), bench.rng("corrupt map")
    failed, backs, told = list[str](), list[float](), list[str]()
    for damage in ("noise", "cut short"):
        for service in ("slam", "mapper"):
            back, words = _strike_map(chain, rng, bench.limits, damage, service)
            failed += [f"{service}, {damage}: {word}" for word in words]
            backs += [back.back_s] if back else []
            told.append(
                f"{service}, {damage}: {'; '.join(words) or 'whole again'}; it says: {chain.rig.said(service)[:160]}"
            )
            bench.tell(told[-1])
    return Result(tuple(failed), {"back_s": max(backs, default=None)}, tuple(told))


def _strike_map(
    chain: Chain, rng: np.random.Generator, limits: Limits, damage: str, service: str
) -> tuple[Comeback | None, list[str]]:
    """Kill a service and damage its map; return how it came back, and what did not hold."""
    before, size, files = chain.known(), chain.rig.log_size(service), list[Path]()
    harm = partial(_damage_when_dead, chain.rig.folder / "state", rng, damage, service, files)
    back = chain.harm(service, before_restart=harm)
    words = faults_of_comeback(back, limits) + chain.whole_again(before, 0, anew=True)

    def silent() -> list[str]:
        return unsaid(chain.rig.said_since(service, size), chain.rig.health.get(service), files)

    chain.rig.until(lambda: not silent(), _SAID_WITHIN_S)
    return back, words + silent()


def _damage_when_dead(state: Path, rng: np.random.Generator, damage: str, service: str, files: list[Path]) -> None:
    """Overwrite the files of a service's map while it is dead; add them to ``files``."""
    files += sorted((state / "slam").glob("*") if service == "slam" else state.glob("map-*.tdmap"))
    for path in files:
        size = path.stat().st_size
        path.write_bytes(rng.bytes(size) if damage == "noise" else path.read_bytes()[: size // 2])


def unsaid(log: str, health: Health | None, damaged: Sequence[Path]) -> list[str]:
    """Return what a service whose map files were ``damaged`` does not say: their name in its log, their number in its health."""
    if not damaged:
        return ["it had saved no map that could be damaged"]
    words = []
    if not any(path.name in line for line in log.splitlines() if "WARNING" in line for path in damaged):
        words.append(f"its log does not name {' or '.join(path.name for path in damaged)}")
    if health is None or not health.counters.get("bad_map_files"):
        words.append("its health does not count the damaged map (bad_map_files)")
    return words


def _clock_step(bench: Bench) -> Result:
    chain = bench.chain()
    rig, failed, told, worst = chain.rig, list[str](), list[str](), 0.0
    for service, hours in (("slam", 1), ("slam", -2), ("router", 1)):  # slam: an hour ahead, then an hour behind
        before, submaps = chain.known(), chain.submaps
        path = rig.config_file(service)
        values = json.loads(path.read_text(encoding="utf-8"))
        ahead_s = values["clock_ahead_s"] + 3600.0 * hours
        path.write_text(json.dumps({**values, "clock_ahead_s": ahead_s}), encoding="utf-8")
        back = chain.harm(service)
        off_s = _clocks_off_s(rig)
        failed += [f"{service}: {name} told no health any more" for name in rig.health if name not in off_s]
        off = max((abs(v) for v in off_s.values()), default=0.0)
        worst = max(worst, off)
        failed += [f"{service}: {name} {v:+.2f} s off" for name, v in off_s.items() if abs(v) > _CLOCK_S]
        failed += faults_of_comeback(back, bench.limits) + chain.whole_again(before, 0, submaps=submaps)
        where = "ahead" if ahead_s > 0.0 else "behind"
        told.append(f"{service} on a clock an hour {where}: stamps within {off:.3f} s")
    bench.close()  # its clocks are no longer this machine's
    return Result(tuple(failed), {"clock_off_s": worst}, tuple(told))


def _clocks_off_s(rig: Rig) -> dict[str, float]:
    """Return how far off each service's stamps are by those of its next seconds: a message's way makes it late, never early."""
    since_s, off_s = time.monotonic(), dict[str, float]()
    for _ in range(_LOOKS):
        rig.pump(1.0)
        for name in rig.health:
            if rig.heard_s[name] > since_s:
                off_s[name] = max(off_s.get(name, float("-inf")), rig.stamp_off_s(name))
    return off_s
