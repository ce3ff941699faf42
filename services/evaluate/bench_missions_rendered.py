"""Missions as a user runs them: rendered, in real processes, one after the other, to the end.

``treedock bench missions --rendered --count 10``. Each mission is a line in ``missions-rendered.jsonl``; a later call
goes on from there. Results of other code of navigator or simulator are not reused.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from services.evaluate.bench import BenchOptions, BenchReport, code_version
from services.evaluate.bench_catalogue import _append, _read_results
from services.navigator.config import NavigatorConfig

_CODE = (
    "schemas",
    "services.navigator",
    "services.navigator.autopilot",
    "services.simulator",
    "services.simulator.px4",
)
_COUNT, _QUICK_COUNT = 10, 1
_WITHIN_S = 1200.0
_DROP_SHARE = 0.02


def run(options: BenchOptions) -> BenchReport:
    """Fly what is not flown yet, and report on all."""
    count = options.count or (_QUICK_COUNT if options.quick else _COUNT)
    first = 100 * (options.seed or 0) + 1
    version = code_version(_CODE)
    path = options.out / "missions-rendered.jsonl"
    done = _read_results(path)
    rows: list[dict[str, Any]] = []
    for seed in range(first, first + count):
        key = json.dumps({"seed": seed, "code": version})
        row = done.get(key)
        if row is None:
            row = fly(seed)
            _append(path, {"key": key, **row})
        options.tell(f"{len(rows) + 1}/{count} {line_of(row)}")
        rows.append(row)
    return report_of(rows, first, version)


def settings_of(seed: int) -> list[str]:
    """Return what differs from the default run: the weather of a seed, and frames that are lost."""
    rng = np.random.default_rng([seed, 80])
    mean, gust = float(rng.uniform(0.0, 1.5)), float(rng.uniform(0.2, 0.8))
    return [f"simulator.px4.wind.mean_m_s={mean:.2f}", f"simulator.px4.wind.gust_m_s={gust:.2f}",
            f"simulator.flight.drop_share={_DROP_SHARE}"]  # fmt: skip


def fly(seed: int) -> dict[str, Any]:
    """Run one mission and return its row."""
    settings = settings_of(seed)
    command = [sys.executable, "-m", "services.cli.app", "run", "--source", "sim", "--seed", str(seed), "--json",
               "--no-browser", *(word for value in settings for word in ("--set", value))]  # fmt: skip
    with tempfile.TemporaryFile("w+") as told:
        ended = subprocess.run(
            command, stdout=subprocess.PIPE, stderr=told, text=True, timeout=_WITHIN_S, check=False,
            env={**os.environ, "OMP_NUM_THREADS": "1"},
        )  # fmt: skip
        told.seek(0)
        last = told.read().strip().splitlines()[-1:] or ["it said nothing"]
    if ended.returncode not in (0, 3) or not ended.stdout.strip():
        return {"seed": seed, "code_of_exit": ended.returncode, "end": "failed", "reason": last[0], "docks": [],
                "docked": False, "touches": 0, "settings": settings}  # fmt: skip
    return row_of(seed, json.loads(ended.stdout.splitlines()[-1]), ended.returncode) | {"settings": settings}


def row_of(seed: int, summary: Mapping[str, Any], exit_code: int) -> dict[str, Any]:
    """Return the row of a run's summary (``treedock run --json``)."""
    mission = summary["mission"]
    frames, simulated_s = summary["frames"], mission.get("simulated_s", 0.0)
    return {
        "seed": seed, "code_of_exit": exit_code, "end": mission["state"], "reason": mission["reason"],
        "docked": bool(mission["docked"]), "docks": mission["docks"], "touches": mission.get("touches", 0),
        "clearance_m": mission.get("clearance_m", 0.0), "simulated_s": simulated_s,
        "wall_s": summary["duration_s"], "frames": frames,
        "camera_hz": round(frames / simulated_s, 1) if simulated_s else 0.0,
        "holds": [e["reason"] for e in mission["events"] if e["state"] == "hold"],
        "false_trees": summary.get("truth", {}).get("false", 0), "restarts": sum(summary["restarts"].values()),
    }  # fmt: skip


def line_of(row: Mapping[str, Any]) -> str:
    """Return a mission's row as one line; why, when it is not docked."""
    where = ", ".join(f"{d['true_distance_m']:.3f} m {d['true_heading_deg']:+z.1f} deg" for d in _true(row))
    verdict = "docked" if row["docked"] else f"NOT docked ({row['end']}: {row['reason']})"
    return f"seed {row['seed']}: {verdict} {where}, {row['touches']} touches, {row.get('simulated_s', 0):.0f} s"


def _true(row: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    return [dock for dock in row["docks"] if "true_distance_m" in dock]


def report_of(rows: Sequence[Mapping[str, Any]], first: int, version: str) -> BenchReport:
    """Return figures and table of all missions."""
    aim = NavigatorConfig().dock.aim_m
    distances = np.array([d["true_distance_m"] for row in rows for d in _true(row)])
    headings = np.abs([d["true_heading_deg"] for row in rows for d in _true(row)])
    flown = [row for row in rows if row.get("frames")]
    figures = {
        "runs": len(rows), "docked": sum(row["docked"] for row in rows),
        "touches": sum(row["touches"] for row in rows),
        "distance_rmse_m": round(float(np.sqrt(np.mean((distances - aim) ** 2))), 4) if len(distances) else -1.0,
        "distance_min_m": float(distances.min()) if len(distances) else -1.0,
        "distance_max_m": float(distances.max()) if len(distances) else -1.0,
        "heading_deg_p95": round(float(np.percentile(headings, 95)), 3) if len(headings) else -1.0,
        "clearance_min_m": min((row["clearance_m"] for row in flown), default=-1.0),
        "seconds_median": float(np.median([row["simulated_s"] for row in flown])) if flown else -1.0,
        "camera_hz": round(float(np.median([row["camera_hz"] for row in flown])), 1) if flown else -1.0,
    }  # fmt: skip
    lines = ["| seed | docked | true distance (m) | true heading (deg) | touches | clearance (m) | simulated (s) "
             "| wall (s) | camera (Hz) | holds |", "|---|---|---|---|---|---|---|---|---|---|"]  # fmt: skip
    for row in rows:
        d = _true(row)
        distance, heading = (f"{d[-1]['true_distance_m']:.3f}", f"{d[-1]['true_heading_deg']:+z.2f}") if d else ("", "")
        word = "yes" if row["docked"] else f"no: {row['end']}, {row['reason']}"
        lines.append(
            f"| {row['seed']} | {word} | {distance} | {heading} | {row['touches']} | {row.get('clearance_m', 0):.2f} "
            f"| {row.get('simulated_s', 0):.0f} | {row.get('wall_s', 0):.0f} | {row.get('camera_hz', 0)} "
            f"| {'; '.join(row.get('holds', ()))} |"
        )
    conditions = {
        "mode": "rendered, real processes over Zenoh, simulated PX4 over MAVLink; time waits for slam and refiner",
        "camera": f"640x480, 15 Hz of simulated time, disparity noise 0.08 px, {100 * _DROP_SHARE:.0f} % of frames lost",
        "scenes": "random-mission: 2 to 4 trees, posts, bushes, thick trunks, tables and people by chance",
        "seeds": f"{first}..{first + len(rows) - 1}, wind 0..1.5 m/s with gusts 0.2..0.8",
        "code": version,
    }
    return BenchReport(figures=figures, conditions=conditions, table="\n".join(lines))
