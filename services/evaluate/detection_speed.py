"""How long the detector takes, from an array of all points to the list of trees, warm; and what warming up takes."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from services.detector.detect import detect_trees
from services.detector.model import Views
from services.detector.ransac_cylinder import detect_cylinders
from services.detector.reference import detect_reference
from services.evaluate.detection_clouds import keyframe_points, scene_cloud

SIZES = (170_000, 1_040_000)
_RUNS = 21
_UP = (0.0, 0.0, 1.0)


@dataclass(frozen=True, slots=True)
class Timing:
    """Milliseconds of one size of cloud."""

    points: int
    median_ms: float
    least_ms: float
    cpu_ms: float
    """Least processor time, both threads."""
    stages_ms: dict[str, float]
    """Of the fastest run."""
    trees: int
    reference_s: float
    cylinder_s: float


def thinned(points_m: NDArray[np.float32], views: Views, count: int) -> tuple[NDArray[np.float32], Views]:
    """Return ``count`` evenly taken points of a cloud and their views; all of them when there are fewer."""
    chosen = np.unique(np.linspace(0, len(points_m) - 1, min(count, len(points_m))).astype(np.int64))
    return np.ascontiguousarray(points_m[chosen]), replace(views, index=views.index[chosen].copy())


def timings(scene: str, cache: Path, tell: Callable[[str], None]) -> list[Timing]:
    """Time both sizes: the fused map thinned to the smaller, all keyframes' filtered clouds thinned to the larger."""
    fused = scene_cloud(scene, cache)
    clouds = [thinned(fused.points_m, fused.views, SIZES[0]), thinned(*keyframe_points(scene, cache), SIZES[1])]
    out = []
    for points, views in clouds:
        out.append(_timed(points, views))
        t = out[-1]
        tell(f"{t.points} points: median {t.median_ms:.1f} ms, least {t.least_ms:.1f} ms, processor {t.cpu_ms:.1f} ms")
    return out


def _timed(points: NDArray[np.float32], views: Views) -> Timing:
    detect_trees(points, _UP, views)
    wall, cpu, stages, trees = [], [], {}, 0
    for _ in range(_RUNS):
        begin, used = time.perf_counter(), time.process_time()
        result = detect_trees(points, _UP, views)
        wall.append((time.perf_counter() - begin) * 1e3)
        cpu.append((time.process_time() - used) * 1e3)
        if wall[-1] == min(wall):
            stages, trees = result.stages_ms, len(result.trunks)
    begin = time.perf_counter()
    detect_reference(points, _UP)
    middle = time.perf_counter()
    detect_cylinders(points, _UP)
    return Timing(
        len(points), float(np.median(wall)), min(wall), min(cpu), stages, trees, middle - begin, time.perf_counter() - middle
    )  # fmt: skip


def start_up_s() -> tuple[float, float]:
    """Return seconds to import and warm the detector in a fresh process, and of the first detection after that."""
    code = (
        "import time; a = time.perf_counter()\n"
        "from services.detector.warm import warm; warm(); b = time.perf_counter()\n"
        "import numpy as np; from services.detector.detect import detect_trees\n"
        "p = np.random.default_rng(1).uniform(-3, 3, (170000, 3)).astype(np.float32); p[:, 2] *= 0.01\n"
        "c = time.perf_counter(); detect_trees(p); print(b - a, time.perf_counter() - c)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    load, first = (float(part) for part in done.stdout.split())
    return load, first


def table(rows: list[Timing], start: tuple[float, float]) -> list[str]:
    """Return the timings as Markdown."""
    lines = [
        "| points | trunks | median (ms) | least (ms) | processor time, least (ms) | slicing-reference (s) | cylinder (s) |",
        "|---|---|---|---|---|---|---|",
    ]
    lines += [
        f"| {t.points} | {t.trees} | {t.median_ms:.1f} | {t.least_ms:.1f} | {t.cpu_ms:.1f} | {t.reference_s:.2f} | {t.cylinder_s:.2f} |"
        for t in rows
    ]
    for t in rows:
        stages = ", ".join(f"{name} {ms:.1f}" for name, ms in t.stages_ms.items())
        lines.append(f"\n{t.points} points, the fastest run by stage (ms): {stages}.")
    lines.append(
        f"\nStart-up, not in these figures: importing and loading the compiled kernels {start[0]:.1f} s (a service does it "
        f"before READY); the first detection after that {1e3 * start[1]:.0f} ms."
    )
    return lines
