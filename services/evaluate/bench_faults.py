"""The fault matrix, run: ``treedock bench faults``. Each row is a line in ``faults.jsonl``; a later call goes on from there.

``--scenes NAME,...`` runs only the rows so named (or groups), ``--count`` harms each process so often instead of three times; after
``--minutes N`` no further row is begun, and what was run before is reported.
"""

from __future__ import annotations

import json
import logging
import os
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from services.common.errors import InputError
from services.evaluate.bench import BenchOptions, BenchReport, code_version
from services.evaluate.bench_catalogue import _append, _read_results
from services.evaluate.faults.bench_rig import Bench
from services.evaluate.faults.model import Result, Row
from services.evaluate.faults.rows import ROWS

LOG = logging.getLogger(__name__)

_SEED = 9000
_CODE = ("schemas", "services")
"""Every service takes part."""


def run(options: BenchOptions) -> BenchReport:
    """Run the rows that were not run yet, and report on all."""
    seed = _SEED if options.seed is None else options.seed
    moments = options.count or (1 if options.quick else 3)
    version = code_version(_CODE)
    path = options.out / "faults.jsonl"
    found, begun_s = [], time.monotonic()
    with tempfile.TemporaryDirectory(prefix="treedock-faults-") as folder:
        bench = Bench(seed, Path(folder), fresh_seed=options.seed, moments=moments, tell=options.tell)
        try:
            for row in wanted(options.scenes):
                key = json.dumps(
                    {"row": row.name, "seed": seed, "scene": options.seed, "moments": moments, "code": version}
                )
                values = _read_results(path).get(key)
                if values is None:
                    if options.minutes is not None and time.monotonic() - begun_s > 60.0 * options.minutes:
                        continue
                    values = run_row(bench, row)
                    if not values["skipped"]:  # what the machine could not do then it may do the next time
                        _append(path, {"key": key, **values})
                options.tell(f"{row.name}: {verdict_of(values)}")
                found.append(values)
        finally:
            bench.close()
    return report_of(found, seed, moments, version)


def wanted(names: Sequence[str]) -> list[Row]:
    """Return the rows of those names or groups, all without names.

    Raises:
        InputError: a name that is neither.
    """
    known = {row.name for row in ROWS} | {row.group for row in ROWS}
    if unknown := [name for name in names if name not in known]:
        raise InputError(f"--scenes {unknown[0]!r}: expected a row of docs/faults.md or one of its groups")
    return [row for row in ROWS if not names or row.name in names or row.group in names]


def run_row(bench: Bench, row: Row) -> dict[str, Any]:
    """Run a row and return it as plain values; a system that broke down under it is a failure, not the bench's end."""
    begin_s = time.monotonic()
    try:
        result = row.run(bench)
    except InputError as error:
        bench.close()
        result = Result((str(error),))
    except Exception as error:
        LOG.exception("%s broke down", row.name)
        bench.close()
        result = Result((f"it broke down: {type(error).__name__}: {error}",))
    if result.failed:
        bench.close()  # what failed may be in any state
    return {
        "row": row.name, "group": row.group, "passed": result.passed, "failed": list(result.failed), "skipped": result.skipped,
        "measured": dict(result.measured), "told": list(result.told), "seconds": round(time.monotonic() - begin_s, 1),
        "load": round(os.getloadavg()[0], 1),
    }  # fmt: skip


def verdict_of(values: Mapping[str, Any]) -> str:
    """Return how a row went, in a few words."""
    if values["skipped"]:
        return f"skipped: {values['skipped']}"
    return "passed" if values["passed"] else f"FAILED: {'; '.join(values['failed'])}"


def report_of(rows: Sequence[Mapping[str, Any]], seed: int, moments: int, version: str) -> BenchReport:
    """Return figures and table of all rows."""

    def worst(name: str) -> float:
        values = [row["measured"].get(name) for row in rows]
        return max((v for v in values if v is not None), default=-1.0)

    figures = {
        "rows": len(rows), "passed": sum(row["passed"] for row in rows),
        "failed": sum(bool(row["failed"]) for row in rows), "skipped": sum(bool(row["skipped"]) for row in rows),
        "faults": sum(len(row["told"]) for row in rows), "back_s_max": worst("back_s"), "ready_s_max": worst("ready_s"), "held_s_max": worst("held_s"),
    }  # fmt: skip
    lines = ["| row | where | verdict | held (s) | at rest (s) | way in 2 s (m) | noticed (s) | back (s) | ready (s) | took (s) | load |",
             "|---|---|---|---|---|---|---|---|---|---|---|"]  # fmt: skip
    for row in rows:
        m = row["measured"]
        cells = " | ".join(
            "" if m.get(k) is None else f"{m[k]:.2f}"
            for k in ("held_s", "rest_s", "way_m", "noticed_s", "back_s", "ready_s")
        )
        lines.append(
            f"| {row['row']} | {row['group']} | {verdict_of(row)} | {cells} | {row['seconds']:.0f} | {row['load']} |"
        )
    conditions = {
        "flight": "real processes under the real supervisor, simulated PX4 over MAVLink; slam, mapper, detector and refiner are "
                  "stand-ins with measured errors (services/evaluate/faults/standins.py); held and at rest in simulated time",
        "chain": "the real camera, slam, mapper, detector and refiner over a rendered recording at 15 Hz",
        "ready": "as back, less what the process's threads waited for a processor (schedstat), but never less than 0.5 s of pause and "
                 "the processor time of the start",
        "moments": f"{moments} per process and fault, drawn from the seed", "seed": f"{seed}", "code": version,
    }  # fmt: skip
    return BenchReport(figures=figures, conditions=conditions, table="\n".join(lines))
