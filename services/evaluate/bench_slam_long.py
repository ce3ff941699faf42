"""The live slam on a long walk: 6,000 frames over 200 m of simulated forest, at 30 Hz, in a process of its own."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from services.common.errors import InputError
from services.evaluate.bench import BenchOptions, BenchReport, code_version
from services.evaluate.slam_live import Live
from services.evaluate.slam_walk import CIRCUIT_M, LENGTH_M, render_walk

FRAMES, QUICK_FRAMES, PACED_FRAMES = 6000, 600, 1500
RATE_HZ = 30.0
SEED = 1
_TELL_EVERY = 500


def run(options: BenchOptions) -> BenchReport:
    """Render the walk (kept in ``options.out``: 90 KB a frame, a quarter of an hour at most), run slam over it.

    Raises:
        InputError: the process under measurement failed.
    """
    seed = SEED if options.seed is None else options.seed
    frames = QUICK_FRAMES if options.quick else FRAMES
    walk = _rendered(options, seed, frames)
    whole = run_live(walk, frames, 0.0)
    options.tell(f"{frames} frames one after another: {np.median(whole.track_ms):.1f} ms each")
    return _report(whole, run_live(walk, min(frames, PACED_FRAMES), RATE_HZ), frames, seed)


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


def run_live(walk: Path, frames: int, rate_hz: float) -> Live:
    """Run the live service over a walk in a process of its own; return what it measured.

    Raises:
        InputError: it failed.
    """
    with tempfile.TemporaryDirectory(prefix="treedock-walk-") as folder:
        command = [sys.executable, "-m", "services.evaluate.slam_live", str(walk), str(frames), str(rate_hz), folder]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        last = done.stderr.strip().splitlines()[-1:]
        raise InputError(f"slam failed on {walk}: {last[0] if last else 'no word'}")
    return Live(**json.loads(done.stdout.splitlines()[-1]))


def _percentiles(values: Sequence[float]) -> tuple[float, float]:
    p50, p95 = np.percentile(values, [50, 95])
    return float(p50), float(p95)


def _report(whole: Live, paced: Live, frames: int, seed: int) -> BenchReport:
    ends = min(1000, len(whole.track_ms) // 3)
    first, last = whole.track_ms[:ends], whole.track_ms[-ends:]
    track, cpu = _percentiles(whole.track_ms), _percentiles(whole.whole_cpu_ms)
    real = _percentiles(paced.track_ms)
    rows = [
        "| ms a frame | median | p95 |",
        "|---|---|---|",
        f"| tracking, wall | {track[0]:.1f} | {track[1]:.1f} |",
        f"| first {ends} frames | {np.median(first):.1f} | {np.percentile(first, 95):.1f} |",
        f"| last {ends} frames | {np.median(last):.1f} | {np.percentile(last, 95):.1f} |",
        f"| with decoding and publishing, CPU of the thread | {cpu[0]:.1f} | {cpu[1]:.1f} |",
        f"| tracking, wall, frames at {RATE_HZ:g} Hz | {real[0]:.1f} | {real[1]:.1f} |",
        "",
        f"{len(whole.track_ms)} of {frames} frames one after another: {whole.lost} lost, {whole.keyframes} keyframes made, {whole.alive[-1]} of them in "
        f"the map at the end, {whole.loops} loops, {whole.rss_mb:.0f} MB at most; position error {whole.error_m[-1]:.2f} m at the end, "
        f"{max(whole.error_m):.2f} m at most. The first {len(paced.track_ms) + paced.dropped} at {RATE_HZ:g} Hz: "
        f"{paced.cores:.2f} cores, {paced.dropped} dropped, {paced.first_pose_s:.2f} s from the start of the process to the first pose.",
    ]
    return BenchReport(
        figures={
            "frames": len(whole.track_ms), "track_ms_p50": round(track[0], 1), "track_ms_p95": round(track[1], 1), "cpu_ms_p50": round(cpu[0], 1),
            "cpu_ms_p95": round(cpu[1], 1), "first_ms_p50": round(float(np.median(first)), 1),
            "last_ms_p50": round(float(np.median(last)), 1), "lost": whole.lost, "keyframes": whole.keyframes,
            "keyframes_alive": whole.alive[-1], "loops": whole.loops, "memory_mb": round(whole.rss_mb),
            "error_m": round(whole.error_m[-1], 2), "cores": round(paced.cores, 2), "dropped": paced.dropped,
            "start_s": round(paced.first_pose_s, 2),
        },
        conditions={
            "walk": f"{frames} frames, {LENGTH_M:g} m at 1 m/s on a circuit of {CIRCUIT_M:g} m, forest of seed {seed}, 640x480 "
            "rendered at half size, s 0.08 px",
            "service": "live: mapping in a thread, map kept on disk, raw frames, 1000 features; everything but Zenoh itself",
        },
        table="\n".join(rows),
    )  # fmt: skip
