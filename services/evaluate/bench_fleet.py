"""Several aircraft in one forest, without rendering: ``treedock bench fleet --count 50``.

Each seed is a line in ``fleet.jsonl``; a later call goes on from there. Judged by the truth, never by the arbiter's book.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

from services.evaluate.bench import BenchOptions, BenchReport, code_version
from services.evaluate.bench_catalogue import _append, _read_results
from services.evaluate.fleet_flight import FleetFlight, fleet_case

_CODE = (
    "schemas", "services.fleet", "services.navigator", "services.navigator.autopilot", "services.simulator.px4",
    "services.evaluate.flight", "services.evaluate.fleet_flight", "services.evaluate.fleet_link",
    "services.evaluate.glider", "services.evaluate.synthetic",
)  # fmt: skip
_COUNT, _QUICK_COUNT = 50, 4
_LIMIT_S = 900.0
_AIRCRAFT = (2, 2, 3, 2, 4)
"""So many fly, by turns."""


def run(options: BenchOptions) -> BenchReport:
    """Fly what is not flown yet, and report on all."""
    count = options.count or (_QUICK_COUNT if options.quick else _COUNT)
    first = 1000 * (options.seed or 0)
    version = code_version(_CODE)
    done = _read_results(options.out / "fleet.jsonl")
    rows = []
    for seed in range(first, first + count):
        key = json.dumps({"seed": seed, "code": version})
        row = done.get(key)
        if row is None:
            row = fly(seed, _AIRCRAFT[seed % len(_AIRCRAFT)])
            _append(options.out / "fleet.jsonl", {"key": key, **row})
        options.tell(f"{seed - first + 1}/{count} {line_of(row)}")
        rows.append(row)
    return report_of(rows, version)


def fly(seed: int, aircraft: int, *, px4: bool = False) -> dict[str, Any]:
    """Fly one forest and return its row; ``px4``: on simulated autopilots, with the live guard."""
    fleet = FleetFlight(fleet_case(seed, aircraft, px4=px4))
    fleet.run(_LIMIT_S)
    visits = Counter(trunk for _, trunk in fleet.docked)
    flights = fleet.flights.values()
    return {
        "seed": seed, "aircraft": aircraft, "double_claims": fleet.double_claims, "expected": len(fleet.expected),
        "once": sum(visits[trunk] == 1 for trunk in fleet.expected), "twice": sum(n > 1 for n in visits.values()),
        "missed": sorted(fleet.expected - visits.keys()), "shares": [sum(w == uav for w, _ in fleet.docked) for uav in fleet.flights],
        "touches": sum(f.touches for f in flights), "met": fleet.met, "apart_m": round(min(fleet.apart_m, 99.0), 2),
        "ends": [f.state for f in flights], "reasons": [f.mission.reason for f in flights],
        "claim_lost": sum(e.after == "hold" and e.reason.startswith("claim") for f in flights for e in f.events),
        "seconds": round(fleet.elapsed_s, 1),
    }  # fmt: skip


def line_of(row: Mapping[str, Any]) -> str:
    """Return a forest's row as one line."""
    missed = f", missed {row['missed']}" if row["missed"] else ""
    return (
        f"seed {row['seed']}: {row['aircraft']} aircraft, {row['once']}/{row['expected']} trees once, {row['twice']} twice{missed}, "
        f"double claims {row['double_claims']}, touches {row['touches']} of trunks {row['met']} of each other, "
        f"{row['apart_m']:.2f} m apart, {row['seconds']:.0f} s, {'/'.join(str(n) for n in row['shares'])}"
    )


def report_of(rows: Sequence[Mapping[str, Any]], version: str) -> BenchReport:
    """Return figures and table; the lines are those of forests where something is to be told."""

    def total(name: str) -> int:
        return sum(int(row[name]) for row in rows)

    figures = {
        "forests": len(rows), "aircraft": total("aircraft"), "double_claims": total("double_claims"),
        "trees": total("expected"), "visited_once": total("once"), "visited_twice": total("twice"),
        "touches": total("touches") + total("met"), "apart_min_m": min(float(row["apart_m"]) for row in rows),
        "claims_lost": total("claim_lost"), "landed": sum(end == "landed" for row in rows for end in row["ends"]),
    }  # fmt: skip
    table = [
        "| forests | aircraft | double claims | trees visited once | twice | missed | touches | least distance of two (m) |",
        "|---|---|---|---|---|---|---|---|",
        f"| {len(rows)} | {figures['aircraft']} | {figures['double_claims']} | {figures['visited_once']} of {figures['trees']} "
        f"| {figures['visited_twice']} | {sum(len(row['missed']) for row in rows)} | {figures['touches']} | {figures['apart_min_m']:.2f} |",
        "",
        *(f"- {line_of(row)}" for row in rows if row["missed"] or row["twice"] or row["double_claims"] or row["touches"] or row["met"]),
    ]  # fmt: skip
    conditions = {
        "mode": "without rendering, in lockstep: mission and synthetic chain for each aircraft, which follows its setpoints with a lag and does "
        "not see the others: claims alone keep them apart (`treedock fleet fly --px4`: simulated PX4, bridge and live guard)",
        "link": "10 % lost, 10 % twice, up to 0.5 s late and one in ten up to 2.5 s; each aircraft cut off twice for 3 to 12 s; "
        "the arbiter killed and restarted with its book once or twice; clocks up to 1 % wrong",
        "start points": "6.5 m apart, measured to 0.05 m and 0.3 deg",
        "seeds": f"{rows[0]['seed']}..{rows[-1]['seed']}",
        "code": version,
    }  # fmt: skip
    return BenchReport(figures, conditions, "\n".join(table))
