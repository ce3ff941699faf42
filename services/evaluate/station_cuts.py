"""Power cuts for the station's benchmark: kill -9 at random moments while it writes, and what its file then holds."""

from __future__ import annotations

import json
import sqlite3
import tempfile
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from services.evaluate.bench import BenchOptions
from services.evaluate.bench_catalogue import _append, _read_results
from services.evaluate.station_ground import Ground, until
from services.evaluate.station_load import Load

_RATE_HZ, _TREES = 5.0, 50
_MOST_LOST_S = 1.0
_LATEST_KILL_S = 1.2


def cuts(options: BenchOptions, kills: int, version: str) -> list[dict[str, Any]]:
    """Return one row per cut: whether the file was broken and how many seconds were missing.

    Rows of earlier calls with the same seed and code are taken from ``options.out``.
    """
    seed, path = options.seed or 0, options.out / "station-cuts.jsonl"
    done = _read_results(path)
    rows: list[dict[str, Any]] = []
    with ExitStack() as stack:
        rig: tuple[Ground, Load] | None = None
        for number in range(kills):
            key = json.dumps({"seed": seed, "cut": number, "code": version})
            row = done.get(key)
            if row is None:
                rig = rig or _rig(stack, seed)
                row = _cut(*rig, np.random.default_rng([seed, number]))
                _append(path, {"key": key, **row})
            rows.append(row)
            if row["broken"] or number % 10 == 9:
                worst = max(float(r["missing_s"]) for r in rows)
                options.tell(
                    f"power cut {number + 1} of {kills}: {sum(r['broken'] for r in rows)} broken, at most {worst:.2f} s missing"
                )
    return rows


def figures_of(rows: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """Return the figures of all cuts."""
    missing_s = [float(row["missing_s"]) for row in rows]
    return {
        "kills": len(rows), "files_broken": sum(row["broken"] for row in rows), "missing_s_max": round(max(missing_s), 2),
        "missing_over_1_s": sum(s > _MOST_LOST_S for s in missing_s),
    }  # fmt: skip


def _rig(stack: ExitStack, seed: int) -> tuple[Ground, Load]:
    ground = Ground(Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="treedock-bench-"))))
    stack.callback(ground.close)
    ground.start("router")
    load = stack.enter_context(Load(ground.endpoint, 1, _RATE_HZ, _TREES, seed + 1))
    load.go(on=True)
    return ground, load


def _cut(ground: Ground, load: Load, rng: np.random.Generator) -> dict[str, Any]:
    """Start the station, kill it at a random moment once it writes, and look at what the file holds."""
    aircraft = load.aircraft[0]
    ground.start("station")
    until(ground.served, 60.0)
    since_s = time.monotonic()
    until(lambda: _version(ground.database) >= _sent_by(aircraft.told, since_s), 60.0)
    time.sleep(float(rng.uniform(0.0, _LATEST_KILL_S)))
    ground.kill("station")
    killed_s = time.monotonic()
    kept = _version(ground.database)
    first_lost_s = next((at for at, version in list(aircraft.told) if version > kept), killed_s)
    return {"broken": not _sound(ground.database), "missing_s": round(max(0.0, killed_s - first_lost_s), 3)}


def _sent_by(told: list[tuple[float, int]], at_s: float) -> int:
    return max((version for when, version in told if when <= at_s), default=0)


def _version(path: Path) -> int:
    """Return the version of the newest list in the file, 0 for none."""
    if not path.exists():
        return 0
    db = sqlite3.connect(path)
    try:
        found = db.execute("SELECT max(version) FROM flights").fetchone()[0]
    except sqlite3.OperationalError:  # killed before its tables were made
        return 0
    finally:
        db.close()
    return int(found or 0)


def _sound(path: Path) -> bool:
    db = sqlite3.connect(path)
    try:
        whole = db.execute("PRAGMA integrity_check").fetchone()[0] == "ok"
        trees = db.execute("SELECT count(*) FROM trees_local WHERE status = 'present'").fetchone()[0]
        return bool(whole and trees in (0, _TREES))
    except sqlite3.DatabaseError:
        return False
    finally:
        db.close()
