"""The live slam on a long walk: 6,000 frames over 200 m of simulated forest at 30 Hz, as a process on the bus.

The walk is rendered in as many calls as it takes, then measured in one of four minutes; both are kept in ``--out``.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict
from itertools import pairwise
from pathlib import Path

import numpy as np

from services.evaluate.bench import BenchOptions, BenchReport, code_version
from services.evaluate.slam_live import Live, run_live
from services.evaluate.slam_walk import CIRCUIT_M, FRAMES, LENGTH_M, render_walk

QUICK_FRAMES = 600
RATE_HZ = 30.0
SEED = 1
_TELL_EVERY = 500
_PARTS = 6
"""Of the walk, each with a line in the table."""
_CODE = ("schemas", "services.common", "services.camera", "services.slam", "services.evaluate.slam_live")


def run(options: BenchOptions) -> BenchReport:
    """Render the walk (90 KB a frame, 3 min of CPU), run slam over it, unless a call before has.

    Raises:
        InputError: the service failed.
    """
    seed = SEED if options.seed is None else options.seed
    frames = QUICK_FRAMES if options.quick else FRAMES
    walk = _rendered(options, seed, frames)
    file = options.out / f"slam-long-{walk.stem}-{code_version(_CODE)}.json"
    if not file.exists():
        options.tell(f"{frames} frames at {RATE_HZ:g} Hz: {frames / RATE_HZ:.0f} s")
        file.write_text(json.dumps(asdict(run_live(walk, frames, RATE_HZ))), encoding="utf-8")
    live = Live(**json.loads(file.read_text(encoding="utf-8")))
    if live.sent < frames - 1:
        options.tell(
            f"only {live.sent} of {frames} frames in {live.wall_s:.0f} s: the machine is busy; delete {file} to try again"
        )
    return _report(live, frames, seed)


def _rendered(options: BenchOptions, seed: int, frames: int) -> Path:
    options.out.mkdir(parents=True, exist_ok=True)
    version = code_version(("services.simulator", "services.evaluate.slam_walk"))
    walk = options.out / f"walk-{seed}-{frames}-{version}.bin"
    if not walk.exists():
        half = walk.with_suffix(".part")

        def tell(count: int) -> None:
            if count % _TELL_EVERY == 0:
                options.tell(f"walk: {count} of {frames} frames rendered")

        render_walk(half, seed, frames, tell)
        half.rename(walk)
    return walk


def _percentiles(values: Sequence[float]) -> tuple[float, float, float]:
    p50, p95, worst = np.percentile(values, [50, 95, 100])
    return float(p50), float(p95), float(worst)


def _report(live: Live, frames: int, seed: int) -> BenchReport:
    track, latency = _percentiles(live.track_ms), _percentiles(live.latency_ms)
    parts = _parts(live, live.sent)
    rows = [
        "| frames | tracking (ms), median | p95 | max | pose after (ms), median | p95 | cores | keyframes in the map | memory (MB) | not answered |",
        "|---|---|---|---|---|---|---|---|---|---|",
        *parts,
        "",
        f"{live.sent} of {frames} frames sent in {live.wall_s:.0f} s, {live.dropped} not answered, {live.lost} lost; {live.keyframes} keyframes made, {live.alive[-1]} of them in the map "
        f"at the end; {live.loops} loops; {live.peak_mb:.0f} MB at most; position error {live.error_m[-1]:.2f} m at the end, "
        f"{max(live.error_m):.2f} m at most; {live.first_pose_s:.2f} s from the start of the process to the first pose.",
    ]
    third = len(live.track_ms) // 3
    return BenchReport(
        figures={
            "frames": live.sent, "dropped": live.dropped, "lost": live.lost, "track_ms_p50": round(track[0], 1),
            "track_ms_p95": round(track[1], 1), "latency_ms_p50": round(latency[0], 1),
            "latency_ms_p95": round(latency[1], 1), "first_ms_p50": round(float(np.median(live.track_ms[:third])), 1),
            "last_ms_p50": round(float(np.median(live.track_ms[-third:])), 1), "cores": round(live.cores, 2),
            "keyframes": live.keyframes, "keyframes_alive": live.alive[-1], "loops": live.loops,
            "memory_mb": round(live.peak_mb), "error_m": round(live.error_m[-1], 2),
            "start_s": round(live.first_pose_s, 2),
        },
        conditions={
            "walk": f"{frames} frames, {LENGTH_M * frames / FRAMES:g} m at 1 m/s on a circuit of {CIRCUIT_M:g} m, forest of seed {seed}, 640x480 "
            "rendered at half size, s 0.08 px",
            "service": f"`treedock slam` and a router as processes, raw frames over Zenoh at {RATE_HZ:g} Hz, 1000 features, map kept on disk",
            "cores": "CPU time of all threads of the slam process over the walk's length; a frame is sent when the one before is answered",
        },
        table="\n".join(rows),
    )  # fmt: skip


def _parts(live: Live, frames: int) -> list[str]:
    """Return the table's lines: equal parts of the walk."""
    index, cpu_s = np.array(live.index), np.array([0.0, *live.cpu_s])
    looks, lines = len(live.cpu_s), []
    edges = np.linspace(0, frames, _PARTS + 1).astype(int)
    for begin, end in pairwise(edges):
        inside = np.flatnonzero((index >= begin) & (index < end))
        track = _percentiles(np.array(live.track_ms)[inside].tolist())
        latency = _percentiles(np.array(live.latency_ms)[inside].tolist())
        a, b = round(looks * begin / frames), round(looks * end / frames)
        seconds = live.walk_s * (b - a) / looks
        lines.append(
            f"| {begin} to {end} | {track[0]:.1f} | {track[1]:.1f} | {track[2]:.0f} | {latency[0]:.1f} | {latency[1]:.1f} "
            f"| {(cpu_s[b] - cpu_s[a]) / seconds:.2f} | {live.alive[b - 1]} | {live.rss_mb[b - 1]:.0f} | {end - begin - len(inside)} |"
        )
    return lines
