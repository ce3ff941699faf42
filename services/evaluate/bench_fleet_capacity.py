"""How many aircraft one router and one station carry on this machine, and what breaks first: ``treedock bench fleet-capacity``.

The number of aircraft goes up until something breaks. Each says what the radio carries of it (docs/fleet.md); the load is
made on the same machine, so its share of the processor is told too.
"""

from __future__ import annotations

import json
import tempfile
import time
from contextlib import ExitStack, closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from schemas.fleet import ClaimGoal, ClaimReply, ClaimRequest
from schemas.health import Health
from schemas.topics import FLEET_CLAIM, HEALTH
from services.common.bus import Bus
from services.common.context import HealthBook
from services.common.session import opened_client
from services.evaluate.bench import BenchOptions, BenchReport, code_version
from services.evaluate.bench_catalogue import _append, _read_results
from services.evaluate.station_ground import Ground, Page, until
from services.evaluate.station_load import Load

_RATE_HZ, _TREES, _LIST_EVERY, _SERVICES = 5.0, 100, 5, 9
_STEPS, _QUICK_STEPS = (5, 10, 20, 30, 40, 50, 60, 120, 240), (2, 4)
_MEASURE_S, _QUICK_S = 10.0, 4.0
_PAGE_HZ, _LATE_SHARE, _CLAIM_S, _LOST_SHARE = 5.0, 0.8, 0.5, 0.001
_CODE = ("schemas", "services.station", "services.router", "services.common", "services.fleet",
         "services.evaluate.bench_fleet_capacity", "services.evaluate.station_load")  # fmt: skip


def run(options: BenchOptions) -> BenchReport:
    """Step up until something breaks; what an earlier call with the same code has measured is taken over."""
    version = code_version(_CODE)
    seconds = _QUICK_S if options.quick else _MEASURE_S
    done = _read_results(options.out / "fleet-capacity.jsonl")
    rows: list[dict[str, Any]] = []
    for aircraft in _QUICK_STEPS if options.quick else _STEPS:
        key = json.dumps({"aircraft": aircraft, "seconds": seconds, "code": version})
        row = done.get(key)
        if row is None:
            row = measured(aircraft, seconds, options.seed or 0)
            _append(options.out / "fleet-capacity.jsonl", {"key": key, **row})
        rows.append(dict(row))
        options.tell(f"{aircraft} aircraft: {row}")
        if broken(row):
            break
    return report_of(rows, seconds, version)


def measured(aircraft: int, seconds: float, seed: int) -> dict[str, Any]:
    """Return what so many aircraft cost, and what was lost or late."""
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="treedock-bench-")))
        settings = (
            "station.max_aircraft=256",
            "station.fleet.enabled=true",
            f"station.fleet.book={folder / 'fleet.json'}",
        )
        ground = Ground(folder, settings)
        stack.callback(ground.close)
        ground.start("router")
        ground.start("station")
        load = stack.enter_context(Load(ground.endpoint, aircraft, _RATE_HZ, _TREES, seed, _LIST_EVERY, _SERVICES))
        until(ground.served, 60.0)
        session = stack.enter_context(opened_client(ground.endpoint, lambda: False, wait_s=20.0))
        return _Measuring(ground, load, Bus(session, "uav1", HealthBook()), aircraft).over(seconds)


@dataclass
class _Measuring:
    ground: Ground
    load: Load
    bus: Bus
    aircraft: int
    _station: Health | None = None

    def over(self, seconds: float) -> dict[str, Any]:
        """Warm up, measure with a page open, and count what arrived once everything is still."""
        self.bus.subscribe(HEALTH, self._take, leaf="station")
        self.load.go(on=True)
        until(lambda: self._counted() > 20 * self.aircraft, 60.0)
        self._still()
        sent, counted = self.load.sent, self._counted()
        names = {n: psutil.Process(p.pid) for n, p in self.ground.processes.items()} | {"load": psutil.Process()}
        before = {name: sum(p.cpu_times()[:2]) for name, p in names.items()}
        begin_s = time.monotonic()
        self.load.go(on=True)
        with closing(Page(self.ground)) as page:
            claims_s = self._look(page, seconds)
            took_s = time.monotonic() - begin_s
            cpu = {n: (sum(p.cpu_times()[:2]) - before[n]) / took_s for n, p in names.items()}
            states = page.states
        self._still()
        told = self.load.sent - sent
        return {
            "aircraft": self.aircraft, "sent_per_s": round(told / took_s), "wanted_per_s": round(self.aircraft * per_second()),
            "lost": max(0, told - (self._counted() - counted)), "sent": told,
            "router_cores": round(cpu["router"], 3), "station_cores": round(cpu["station"], 3), "load_cores": round(cpu["load"], 3),
            "station_mb": round(names["station"].memory_info().rss / 1e6), "page_hz": round(states / took_s, 2),
            "claim_ms_p50": round(1e3 * float(np.median(claims_s)), 1), "claim_ms_max": round(1e3 * max(claims_s), 1),
        }  # fmt: skip

    def _take(self, health: Health) -> None:
        self._station = health

    def _counted(self) -> int:
        while (taken := self.bus.inbox.take()) is not None:
            taken[0].handler(taken[1])
        return -1 if self._station is None else self._station.counters.get("messages", 0)

    def _still(self) -> None:
        """Pause the load until the station has counted everything that is on its way."""
        self.load.go(on=False)
        time.sleep(1.5)
        last = self._counted()
        for _ in range(10):
            time.sleep(1.2)
            now = self._counted()
            if now == last:
                return
            last = now

    def _look(self, page: Page, seconds: float) -> list[float]:
        """Read the page and ask for a claim now and then; return how long the answers took, seconds."""
        goal = ClaimGoal(kind="place", map_id="bench", from_m=(0.0, 0.0), to_m=(0.0, 0.0))
        took: list[float] = []
        end_s, asked_s = time.monotonic() + seconds, 0.0
        while time.monotonic() < end_s:
            page.hear(5.0)
            if time.monotonic() - asked_s > 0.5:
                asked_s = time.monotonic()
                request = ClaimRequest(kind="claim", lease_id=len(took) + 1, goal=goal)
                answered = self.bus.ask(FLEET_CLAIM, request, ClaimReply, 2.0)
                took.append(time.monotonic() - asked_s if answered else 2.0)
        return took


def per_second() -> float:
    """Return the messages that one aircraft sends each second."""
    return 4 * _RATE_HZ + _RATE_HZ / _LIST_EVERY + _SERVICES


def broken(row: dict[str, Any]) -> list[str]:
    """Return what no longer holds, in words."""
    found = []
    if row["lost"] > _LOST_SHARE * row["sent"]:
        found.append(f"messages lost: {row['lost']} of {row['sent']}")
    if row["page_hz"] < _LATE_SHARE * _PAGE_HZ:
        found.append(f"page late: {row['page_hz']} of {_PAGE_HZ:g} states a second")
    if row["claim_ms_max"] > 1e3 * _CLAIM_S:
        found.append(f"claims late: {row['claim_ms_max']:g} ms")
    if row["sent_per_s"] < 0.9 * row["wanted_per_s"]:
        found.append(f"no processor left: the load itself sends {row['sent_per_s']} of {row['wanted_per_s']} a second")
    return found


def report_of(rows: list[dict[str, Any]], seconds: float, version: str) -> BenchReport:
    """Return the table, and what broke first."""
    table = [
        "| aircraft | messages/s | lost | router (cores) | station (cores) | load (cores) | station (MB) | page (1/s) | claim p50, worst (ms) | what breaks |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    table += [
        f"| {r['aircraft']} | {r['sent_per_s']} | {r['lost']} | {r['router_cores']:.2f} | {r['station_cores']:.2f} "
        f"| {r['load_cores']:.2f} | {r['station_mb']} | {r['page_hz']:.1f} | {r['claim_ms_p50']:g}, {r['claim_ms_max']:g} "
        f"| {'; '.join(broken(r)) or '-'} |"
        for r in rows
    ]
    good = [r for r in rows if not broken(r)]
    best = good[-1] if good else None
    figures = {
        "aircraft_carried": float(best["aircraft"]) if best else 0.0, "broke": float(bool(broken(rows[-1]))),
        "router_cores": best["router_cores"] if best else -1.0, "station_cores": best["station_cores"] if best else -1.0,
        "messages_per_s": float(best["sent_per_s"]) if best else 0.0,
    }  # fmt: skip
    conditions = {
        "load": f"each aircraft {_RATE_HZ:g} Hz of pose, mission, vehicle and target, a list of {_TREES} trees a second, health of "
        f"{_SERVICES} services: {per_second():g} messages a second; a page open; {seconds:g} s each; plain tcp on one machine",
        "broken": f"more than {100 * _LOST_SHARE:g} % lost, the page below {_LATE_SHARE * _PAGE_HZ:g} states a second, a claim answered "
        f"after {_CLAIM_S:g} s, or no processor left for the load",
        "code": version,
    }  # fmt: skip
    return BenchReport(figures, conditions, "\n".join(table))
