"""What IMU, GPS and a second camera buy: simulated flights with and without them, errors against the truth.

Blackout and low texture are rendered and located by the real slam, the others by a model of slam's errors over many metres.
Each row is kept in ``fusion.jsonl``; a later call with the same code goes on from there.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from services.evaluate.bench import BenchOptions, BenchReport, code_version
from services.evaluate.bench_catalogue import _SIMULATOR, _append, _read_results
from services.evaluate.fusion_scenarios import SCENARIOS, SETUPS, Flight, Scenario, make, measure

_CODE = (
    "schemas", "services.common.geometry", "services.fusion", "services.slam", "services.simulator.px4", *_SIMULATOR,
    *(f"services.evaluate.fusion_{name}" for name in ("flight", "model", "rendered", "run", "scenarios")),
)  # fmt: skip
_FIRST_SEED = 301
_EARTH_AFTER_S = 30.0
"""By then every flight knows its heading on the earth."""
_QUICK_SEEDS = 1
Row = Mapping[str, Any]


def seeds_of(scenario: Scenario, options: BenchOptions) -> range:
    """Return the seeds of a scenario's flights."""
    count = min(options.count or scenario.seeds, _QUICK_SEEDS if options.quick else 10_000)
    first = _FIRST_SEED if options.seed is None else _FIRST_SEED + 1000 * (1 + options.seed)
    return range(first, first + count)


def run(options: BenchOptions) -> BenchReport:
    """Fly what is not flown yet, and report on all of it."""
    path, code = options.out / "fusion.jsonl", code_version(_CODE)
    options.out.mkdir(parents=True, exist_ok=True)
    done = _read_results(path)
    rows: dict[tuple[str, str], list[Row]] = {}
    wanted = [s for s in SCENARIOS if not options.scenes or s.name in options.scenes]
    if options.quick:
        wanted = [s for s in wanted if not s.fault and s.seconds <= 130.0]
    for scenario in wanted:
        for seed in seeds_of(scenario, options):
            flight: Flight | None = None
            for setup in scenario.setups:
                key = json.dumps({"scenario": scenario.name, "seed": seed, "setup": setup, "code": code})
                if key not in done:
                    options.tell(f"{scenario.name}, seed {seed}: {setup}")
                    flight = flight or make(scenario, seed, options.out / "fusion", options.tell)
                    done[key] = measure(flight, setup, _EARTH_AFTER_S)
                    _append(path, {"key": key, **done[key]})
                rows.setdefault((scenario.name, setup), []).append(done[key])
    return BenchReport(_figures(rows), _conditions(wanted, options), "\n".join(_tables(rows, wanted)))


def _mean(rows: Sequence[Row], name: str) -> float | None:
    values = [row[name] for row in rows if row.get(name) is not None]
    return float(np.mean(values)) if values else None


def _most(rows: Sequence[Row], name: str) -> float | None:
    values = [row[name] for row in rows if row.get(name) is not None]
    return float(max(values)) if values else None


def _rms(rows: Sequence[Row], name: str) -> float | None:
    values = [row[name] for row in rows if row.get(name) is not None]
    return float(np.sqrt(np.mean(np.square(values)))) if values else None


def _tables(rows: Mapping[tuple[str, str], Sequence[Row]], wanted: Sequence[Scenario]) -> list[str]:
    lines = [
        "### In the map: what is flown by", "",
        "| flight | with | position RMSE (cm) | worst (cm) | yaw error, worst (deg) | time without a pose (s) | carried without "
        "the first camera (s) | gone astray meanwhile, worst (cm) | its squared error over what it told (3 is right) | ms a frame |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]  # fmt: skip
    for scenario in wanted:
        for setup in scenario.setups:
            r = rows[scenario.name, setup]
            lines.append(
                f"| {scenario.name} | {setup} | {_cell(_rms(r, 'rmse_m'), 100, 1)} | {_cell(_most(r, 'worst_m'), 100, 1)} "
                f"| {_cell(_most(r, 'yaw_deg'), 1, 2)} | {_cell(_mean(r, 'without_s'), 1, 1)} | {_cell(_mean(r, 'carried_s'), 1, 1)} "
                f"| {_cell(_most(r, 'carried_worst_m'), 100, 1)} | {_cell(_mean(r, 'nees'), 1, 2)} | {_cell(_mean(r, 'ms'), 1, 2)} |"
            )
    lines += [
        "", "### On the earth", "",
        "Vision only: had its start been placed without any error, which nobody can; while it is located. With GPS: from 30 s on.", "",
        "| flight | with | horizontal RMSE (m) | worst (m) | at the end (m) | caught lying after (s) |",
        "|---|---|---|---|---|---|",
    ]  # fmt: skip
    for scenario in wanted:
        for setup in scenario.setups:
            r = rows[scenario.name, setup]
            if "GPS" not in setup and setup != "vision only":
                continue
            lines.append(
                f"| {scenario.name} | {setup} | {_cell(_rms(r, 'earth_rmse_m'), 1, 2)} | {_cell(_most(r, 'earth_worst_m'), 1, 2)} "
                f"| {_cell(_rms(r, 'earth_end_m'), 1, 2)} | {_caught(scenario, r)} |"
            )
    return lines


def _cell(value: float | None, factor: float, digits: int) -> str:
    return "-" if value is None else f"{factor * value:.{digits}f}"


def _caught(scenario: Scenario, rows: Sequence[Row]) -> str:
    """Return when lies were found out, in seconds since they began; of honest receivers how often they were suspected."""
    begin = scenario.gps.jump_at_s if scenario.gps.jump_at_s is not None else scenario.gps.drag_from_s
    told = [row["caught_s"] for row in rows if "caught_s" in row]
    if not told:
        return "-"
    if begin is None:
        return f"wrongly in {sum(bool(t) for t in told)} of {len(told)} flights"
    after = [next((t - begin for t in one if t >= begin), None) for one in told]
    return ", ".join("not" if a is None else f"{a:.0f}" for a in after)


def _figures(rows: Mapping[tuple[str, str], Sequence[Row]]) -> dict[str, float]:
    figures: dict[str, float] = {"flights": sum(len(r) for r in rows.values())}
    for (scenario, setup), r in rows.items():
        name = f"{scenario} {setup}".lower().replace(" only", "").replace("+ ", "").replace(" ", "_")
        for key, value in (
            ("rmse_m", _rms(r, "rmse_m")), ("worst_m", _most(r, "worst_m")), ("without_s", _mean(r, "without_s")),
            ("carried_worst_m", _most(r, "carried_worst_m")), ("earth_rmse_m", _rms(r, "earth_rmse_m")),
        ):  # fmt: skip
            if value is not None:
                figures[f"{name}_{key}"] = round(value, 4)
    return figures


def _conditions(wanted: Sequence[Scenario], options: BenchOptions) -> dict[str, str]:
    seeds = {s.name: seeds_of(s, options) for s in wanted}
    model = [s.name for s in wanted if not s.fault]
    return {
        "flights": "; ".join(f"{s.name}: {s.about}" for s in wanted),
        "located by the real slam": ", ".join(s.name for s in wanted if s.fault) or "none",
        "located by a model": f"{', '.join(model) or 'none'} (5 mm and 0.09 deg a frame, drift 4 cm and 0.15 deg per square root of a "
                              "metre, scale 1 %, found again 0.2 s late and 2 cm off)",
        "seeds": ", ".join(f"{name} {r[0]}..{r[-1]}" for name, r in seeds.items()),
        "IMU": "125 Hz, 0.016 m/s^2 and 0.4 mrad/s per square root of Hz, bias 0.08 m/s^2 and 3 mrad/s with a walk (vibration included)",
        "GPS": "5 Hz, 0.4 m white, 1.2 m slow over 80 s, one axis; vertical 1.8 times; 0.1 s late",
        "cameras": "the first looks ahead, the second straight down; 640x480 scaled up from 320x240, 15 Hz, disparity noise s 0.08 px",
        "set-ups": ", ".join(SETUPS),
    }  # fmt: skip
