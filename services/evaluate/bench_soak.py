"""Missions one after the other for an hour: memory, threads, files, shared memory, rates. ``treedock bench soak --minutes 60``.

The samples lie in ``soak.jsonl``, one line for every ten seconds, written as they come: a run that was broken off is reported as
far as it came (``--count 0`` is not needed: call again with fewer minutes). ``--scenes chain`` soaks the real camera, slam, mapper,
detector and refiner over a recording instead of missions with stand-ins; ``--scenes half-speed`` flies half a second a second,
where others need the processor.
"""

from __future__ import annotations

import itertools
import json
import os
import shutil
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from services.common.errors import InputError
from services.evaluate.bench import BenchOptions, BenchReport, code_version
from services.evaluate.faults.bench_rig import GROUND
from services.evaluate.faults.flown import ENDED
from services.evaluate.faults.missions import Flights
from services.evaluate.faults.rig import ONBOARD, Rig
from services.evaluate.faults.system import flight_config
from services.evaluate.soak_figures import LEAST_S, Sample, SharedFiles, faults_of, of_service, steady

_MINUTES, _QUICK_MINUTES = 60.0, 3.0
_EVERY_S = 10.0
_SPEED, _HALF_SPEED = 1.0, 0.5
_SEED = 9100
_CODE = ("schemas", "services")


def run(options: BenchOptions) -> BenchReport:
    """Fly for so long, unless a run of this code that long is there; report."""
    minutes = options.minutes or (_QUICK_MINUTES if options.quick else _MINUTES)
    kind = "chain" if "chain" in options.scenes else "flight"
    path = options.out / f"soak-{kind}.jsonl"
    version = code_version(_CODE)
    rows = _read(path, version)
    if not rows or rows[-1]["at_s"] < 60.0 * minutes - 2 * _EVERY_S:
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("w", encoding="utf-8") as stream:

            def write(row: dict[str, Any]) -> None:
                stream.write(json.dumps({"code": version, **row}) + "\n")
                stream.flush()
                options.tell(f"{row['at_s'] / 60:.1f} min: {row['missions']} missions, {row['rss_mb']:.0f} MB")

            seed = _SEED if options.seed is None else options.seed
            with tempfile.TemporaryDirectory(prefix="treedock-soak-") as folder:
                try:
                    if kind == "chain":
                        _soak_chain(Path(folder), seed, 60.0 * minutes, write, options.tell)
                    else:
                        speed = _HALF_SPEED if "half-speed" in options.scenes else _SPEED
                        _soak_flights(Path(folder), seed, 60.0 * minutes, write, options.tell, speed)
                finally:
                    _keep_logs(Path(folder), options.out / f"soak-{kind}-logs")
        rows = _read(path, version)
    return report_of(rows, kind, version)


def _keep_logs(folder: Path, kept: Path) -> None:
    """Save what the services said and the recordings' last files: a touch has to be understood afterwards."""
    shutil.rmtree(kept, ignore_errors=True)
    kept.mkdir(parents=True)
    for file in (*folder.rglob("*.log"), *folder.rglob("recordings/*")):
        shutil.move(file, kept)


def _read(path: Path, version: str) -> list[dict[str, Any]]:
    """Return the samples of a run of this code; a torn last line is left out."""
    rows = []
    for line in path.read_text(encoding="utf-8").splitlines() if path.exists() else []:
        try:
            row = json.loads(line)
        except ValueError:
            break
        if row["code"] != version:
            return []
        rows.append(row)
    return rows


Write = Callable[[dict[str, Any]], None]


def _soak_flights(
    folder: Path, seed: int, for_s: float, write: Write, tell: Callable[[str], None], speed: float
) -> None:
    config = flight_config(seed, folder, speed=speed)
    # no frames, for the disk's sake; a file is then begun as often as with them, every ten minutes: its index is held until it is closed
    config = config.model_copy(update={"recorder": config.recorder.model_copy(update={"frames": "off", "file_mb": 10})})
    with Rig(config, folder, (*ONBOARD, *GROUND, "simulator")) as rig:
        flights = Flights(rig, np.random.default_rng(seed), tell)
        flights.begin()
        sampler = _Sampler(rig, write)
        while sampler.age_s < for_s:
            rig.pump(0.2)
            sampler.turn(flights.starts, rig.flown.docks)
            if rig.flown.state in ENDED and not rig.flown.armed:
                flights.begin()


def _soak_chain(folder: Path, seed: int, for_s: float, write: Write, tell: Callable[[str], None]) -> None:
    from services.evaluate.faults.chain import Chain

    with Chain.over_a_recording(seed, folder, tell) as chain:
        sampler = _Sampler(chain.rig, write)
        while sampler.age_s < for_s:
            chain.rig.pump(0.2)
            sampler.turn(0, 0)


class _Sampler:
    """Writes a row every ten seconds."""

    def __init__(self, rig: Rig, write: Write) -> None:
        self._rig, self._write = rig, write
        self._begin_s = self._last_s = time.monotonic()
        self._poses, self._sim_ns = rig.flown.poses, rig.flown.now_ns
        self._shared = SharedFiles()

    @property
    def age_s(self) -> float:
        return time.monotonic() - self._begin_s

    def turn(self, missions: int, docks: int) -> None:
        """Write a row when one is due."""
        now_s = time.monotonic()
        if now_s - self._last_s < _EVERY_S:
            return
        flown = self._rig.flown
        # by simulated time where there is one: a busy machine is slower without anything being wrong
        passed_s = (flown.now_ns - self._sim_ns) * 1e-9 if flown.now_ns else now_s - self._last_s
        rate = (flown.poses - self._poses) / passed_s if passed_s > 0 else 0.0
        self._last_s, self._poses, self._sim_ns = now_s, flown.poses, flown.now_ns
        services = [sample for name in self._rig.services if (sample := self._sample(name)) is not None]
        self._write({
            "at_s": round(self.age_s, 1), "sim_s": round(flown.now_ns * 1e-9, 1), "missions": missions, "docks": docks,
            "touches": flown.touches, "pose_hz": round(rate, 2), "rss_mb": sum(s["rss_mb"] for s in services),
            "shm_files": self._shared.left(map(self._maps, self._rig.services)), "own_shm_mb": round(sum(s["shm_mb"] for s in services), 1),
            "services": services,
        })  # fmt: skip

    def _maps(self, name: str) -> str:
        try:
            return Path(f"/proc/{self._rig.pid(name)}/maps").read_text(encoding="utf-8", errors="replace")
        except (OSError, InputError):
            return ""

    def _sample(self, name: str) -> dict[str, Any] | None:
        try:
            process = psutil.Process(self._rig.pid(name))
            memory, cpu = process.memory_info(), process.cpu_times()
            return {
                "service": name, "pid": process.pid, "rss_mb": round(memory.rss / 2**20, 2), "shm_mb": round(memory.shared / 2**20, 2),
                "threads": process.num_threads(), "files": process.num_fds(), "cpu_s": round(cpu.user + cpu.system, 2),
            }  # fmt: skip
        except (psutil.Error, InputError):
            return None  # between two lives


def _speeds(rows: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """Return the simulated seconds a second over the run, its spread, and the last quarter's over the first's; none without simulated time."""
    pairs = itertools.pairwise(rows)
    speeds = [(b["sim_s"] - a["sim_s"]) / (b["at_s"] - a["at_s"]) for a, b in pairs if b["at_s"] > a["at_s"]]
    if not speeds or not rows[-1]["sim_s"]:
        return {}
    quarter = max(1, len(speeds) // 4)
    first, last = float(np.mean(speeds[:quarter])), float(np.mean(speeds[-quarter:]))
    return {
        "speed": round(float(np.mean(speeds)), 3), "speed_spread": round(steady(speeds), 3),
        "speed_last_over_first": round(last / first, 3) if first > 0.0 else 0.0,
    }  # fmt: skip


def report_of(rows: Sequence[Mapping[str, Any]], kind: str, version: str) -> BenchReport:
    """Return figures and table of a run.

    Raises:
        InputError: nothing was sampled.
    """
    if not rows:
        raise InputError("no sample yet: --minutes is too short")
    names = list(dict.fromkeys(s["service"] for row in rows for s in row["services"]))
    lines = ["| service | memory (MB) | slope (MB/h) | +- | last third (MB/h) | cores | threads | more | files | more | restarts | grows |",
             "|---|---|---|---|---|---|---|---|---|---|---|---|"]  # fmt: skip
    grows, total, late, cores = [], 0.0, 0.0, 0.0
    for name in names:
        samples = [
            Sample(row["at_s"], name, s["pid"], s["rss_mb"], s["threads"], s["files"], s.get("cpu_s", 0.0))
            for row in rows for s in row["services"] if s["service"] == name
        ]  # fmt: skip
        f = of_service(samples)
        words = faults_of(f)
        grows += [f"{name}: {word}" for word in words]
        total, late, cores = total + f["mb_per_h"], late + f["mb_per_h_late"], cores + f["cores"]
        lines.append(
            f"| {name} | {f['rss_mb']:.0f} | {f['mb_per_h']:+.2f} | {f['mb_per_h_error']:.2f} "
            f"| {f['mb_per_h_late']:+.2f} | {f['cores']:.3f} "
            f"| {f['threads']:.0f} | {f['threads_more']:+.0f} | {f['files']:.0f} | {f['files_more']:+.0f} | {f['restarts']:.0f} | {'; '.join(words)} |"
        )
    last, quarter = rows[-1], rows[len(rows) // 4]
    figures = {
        "minutes": round(last["at_s"] / 60.0, 1), "simulated_minutes": round(last["sim_s"] / 60.0, 1), "missions": last["missions"],
        "docks": last["docks"], "touches": last["touches"], "mb": round(last["rss_mb"], 0), "mb_per_h": round(total, 2),
        "mb_per_h_late": round(late, 2), "cpu_cores": round(cores, 2),
        "grows": len(grows), "shm_files_more": last["shm_files"] - quarter["shm_files"],
        "pose_hz": round(sum(r["pose_hz"] for r in rows) / len(rows), 2), "pose_hz_spread": round(steady([r["pose_hz"] for r in rows]), 3),
        **_speeds(rows),
    }  # fmt: skip
    conditions = {
        "what": "missions one after the other, stand-ins for slam, mapper, detector, refiner" if kind == "flight"
        else "the real camera, slam, mapper, detector, refiner over a recording that goes on and on",
        "slopes": "least squares over the last three quarters (ten minutes in at the earliest), by means of twelfths; 'grows' beyond 1 %/h and 3 standard errors"
        + ("" if last["at_s"] >= LEAST_S else f"; of a run below {LEAST_S / 60:.0f} min they say nothing"),
        "last third": "the slope of the last third alone, noisier: whether what rose levels off",
        "rates": "pose_hz: poses per second of simulated time (flight; simulated time waits for slam: speed, simulated seconds a second, is what falls "
                 "when something gets slower), of the wall (chain)",
        "load at the end": f"{os.getloadavg()[0]:.1f}", "code": version,
    }  # fmt: skip
    return BenchReport(figures=figures, conditions=conditions, table="\n".join(lines))
