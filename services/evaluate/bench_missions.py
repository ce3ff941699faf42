"""Missions without rendering: simulated PX4, bridge and navigator, with the errors of the real chain.

``treedock bench missions --count 50``. Each flight is a line in ``missions.jsonl``; a later call goes on from there.
Docked is judged twice: as the mission believes it and by the true distance and heading, means over the same window.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from services.evaluate.bench import BenchOptions, BenchReport, code_version
from services.evaluate.bench_catalogue import _append, _read_results
from services.evaluate.flight import Flight, FlightCase, obstacle_case, random_case
from services.navigator.config import NavigatorConfig

_CODE = (
    "schemas", "services.navigator", "services.navigator.autopilot", "services.simulator.px4",
    "services.evaluate.flight", "services.evaluate.synthetic", "services.evaluate.eyes",
)  # fmt: skip
_COUNT, _QUICK_COUNT = 50, 10
_LIMIT_S = 300.0


def run(options: BenchOptions) -> BenchReport:
    """Fly what is not flown yet, and report on all."""
    if options.rendered:
        from services.evaluate.bench_missions_rendered import run as rendered

        return rendered(options)
    count = options.count or (_QUICK_COUNT if options.quick else _COUNT)
    first = 1000 * (options.seed or 0)
    version = code_version(_CODE)
    done = _read_results(options.out / "missions.jsonl")
    rows = []
    for number in range(count):
        seed = first + number
        key = json.dumps({"seed": seed, "code": version})
        row = done.get(key)
        if row is None:
            row = fly(_case(seed))
            _append(options.out / "missions.jsonl", {"key": key, **row})
        options.tell(f"{number + 1}/{count} {line_of(row)}")
        rows.append(row)
    return _report(rows, first, version)


def _case(seed: int) -> FlightCase:
    """Return a scattered forest for even seeds, trunks on the way to the only tree for odd ones."""
    return obstacle_case(seed) if seed % 2 else random_case(seed)


def fly(case: FlightCase) -> dict[str, Any]:
    """Fly one case and return its row."""
    flight = Flight(case)
    flight.start()
    end = flight.run(limit_s=_LIMIT_S)
    config = case.navigator.dock
    good = [d for d, b in flight.dock_errors if config.min_m <= d <= config.max_m and abs(b) <= config.bearing_rad]
    holds = [e.reason for e in flight.events if e.after == "hold"]
    return {
        "seed": case.seed,
        "end": end,
        "reason": flight.mission.reason,
        "believed": len(flight.dock_errors),
        "docked": len(good),
        "distances_m": [round(d, 4) for d, _ in flight.dock_errors],
        "headings_deg": [round(float(np.degrees(b)), 3) for _, b in flight.dock_errors],
        "touches": flight.touches,
        "clearance_m": round(flight.clearance_m, 3),
        "holds": holds,
        "seconds": round(flight.elapsed_s, 1),
        "wind_m_s": round(case.wind.mean_m_s, 2),
    }


def line_of(row: Mapping[str, Any]) -> str:
    """Return a flight's row as one line; why, when it is not docked."""
    where = ", ".join(f"{d:.3f} m {h:+z.1f} deg" for d, h in zip(row["distances_m"], row["headings_deg"], strict=True))
    verdict = "docked" if row["docked"] else f"NOT docked ({row['end']}: {row['reason']})"
    holds = f", {len(row['holds'])} holds" if row["holds"] else ""
    return (
        f"seed {row['seed']}: {verdict} {where}, {row['touches']} touches, clearance {row['clearance_m']:.2f} m, "
        f"{row['seconds']:.0f} s, wind {row['wind_m_s']:.1f} m/s{holds}"
    )


def _report(rows: Sequence[Mapping[str, Any]], first: int, version: str) -> BenchReport:
    errors = random_case(first).errors
    aim = NavigatorConfig().dock.aim_m
    distances = np.array([d for row in rows for d in row["distances_m"]])
    headings = np.abs([h for row in rows for h in row["headings_deg"]])
    figures = {
        "runs": len(rows),
        "docked": sum(bool(row["docked"]) for row in rows),
        "believed": sum(bool(row["believed"]) for row in rows),
        "touches": sum(row["touches"] for row in rows),
        "distance_rmse_m": round(float(np.sqrt(np.mean((distances - aim) ** 2))), 4) if len(distances) else -1.0,
        "heading_deg_p95": round(float(np.percentile(headings, 95)), 3) if len(headings) else -1.0,
        "clearance_min_m": min(row["clearance_m"] for row in rows),
        "seconds_median": float(np.median([row["seconds"] for row in rows])),
        "holds": sum(len(row["holds"]) for row in rows),
    }
    table = [
        "| flights | docked (true) | docked (believed) | touches | distance RMSE to the aim (m) | heading p95 (deg) |",
        "|---|---|---|---|---|---|",
        f"| {len(rows)} | {figures['docked']} | {figures['believed']} | {figures['touches']} "
        f"| {figures['distance_rmse_m']} | {figures['heading_deg_p95']} |",
        "",
        *(f"- {line_of(row)}" for row in rows if not row["docked"] or row["touches"] or row["holds"]),
    ]
    return BenchReport(
        figures=figures,
        conditions={
            "mode": "without rendering: simulated PX4 over MAVLink in memory, bridge, mission, synthetic chain",
            "camera": f"{1.0 / errors.frame_s:.0f} Hz, {1e3 * errors.delay_min_s:.0f}..{1e3 * errors.delay_max_s:.0f} ms "
            f"late, {100 * errors.drop_share:.0f} % dropped",
            "errors": errors.model_dump_json(),
            "seeds": f"{first}..{first + len(rows) - 1}, wind 0..1.5 m/s with gusts 0.2..0.8; trunks on the straight way to the tree in every second",
            "docked": "true 3 s mean distance 0.85..1.00 m and heading within 3 deg when the mission says docked",
            "code": version,
        },
        table="\n".join(table),
    )
