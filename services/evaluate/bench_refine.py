"""How well one depth image corrects a mapped tree: on single, multi and hard scenes, from 1 to 3 m, tree by tree."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from services.common.geometry import Matrix
from services.detector.refine.config import RefinerConfig
from services.detector.refine.model import Depth, Measurement
from services.detector.refine.refine import refine
from services.detector.refine.tracker import RefinerTracker
from services.detector.refine.warm import warm
from services.evaluate.bench import BenchOptions, BenchReport
from services.evaluate.refine_motions import MotionRow, motion_rows, plot_motions
from services.evaluate.refine_views import DISTANCES_M, View, views

FRESH_PER_KIND = 10
GOOD_CENTRE_M = 0.02
FALSE_CENTRE_M = 0.10
_HARD_KINDS = ("close", "undergrowth", "slope", "lean")
_TIMED_REPEATS = 3


@dataclass(frozen=True, slots=True)
class Result:
    """One view's errors; None where nothing was measured."""

    view: View
    measured: Measurement | None
    before_m: float
    centre_m: float | None
    radius_m: float | None
    frame_ms: tuple[tuple[float, float], ...]
    """Of each repetition: by the clock on the wall, and of this thread's processor time."""
    nees: float | None
    """Error of bearing, range and radius, squared over the covariance told: 3 on average when that is right."""


def run(options: BenchOptions) -> BenchReport:
    """Measure the refiner on the reference's twenty scenes, or on fresh ones of a seed, and in three motions."""
    warm()
    names = scene_names(options)
    results: list[Result] = []
    for name in names:
        scene_results = [evaluate(view, RefinerConfig()) for view in views(name, _seed_of(name, options))]
        results += scene_results
        options.tell(line_of(name, scene_results))
    motions = motion_rows(options.seed or 0, quick=options.quick)
    for row in motions:
        options.tell(row.line())
    folder = options.out if options.doc is None else options.doc.parent / "images"
    plot = plot_motions(motions, folder / "refine_motions.png")
    return _report(names, results, motions, options, plot)


def scene_names(options: BenchOptions) -> tuple[str, ...]:
    """Return the scenes asked for, fresh single, multi and hard ones for a seed, else the reference's twenty."""
    from services.simulator.catalogue import MULTI, SINGLE

    if options.scenes:
        return options.scenes
    if options.seed is None:
        return SINGLE + MULTI
    count = 2 if options.quick else FRESH_PER_KIND
    first = options.seed * FRESH_PER_KIND
    names = [f"random-{kind}-{first + i}" for kind in ("single", "multi") for i in range(count)]
    hard = 1 if options.quick else 3
    return tuple(names + [f"random-{kind}-{first + i}" for kind in _HARD_KINDS for i in range(hard)])


def _seed_of(name: str, options: BenchOptions) -> int:
    """Return the seed of a scene's views: its name's own bytes, so that a scene alone gives the same views."""
    return (options.seed or 0) * 1_000_003 + sum(ord(c) * 31**k for k, c in enumerate(name)) % 1_000_003


def evaluate(view: View, config: RefinerConfig) -> Result:
    """Refine one view and compare with the truth; the time is that of a whole frame in the service's core."""
    from services.simulator.render import DEFAULT_INTRINSICS

    depth = view.depth.astype(np.float32) / np.float32(1000.0)
    measured = refine(depth, DEFAULT_INTRINSICS, view.T_told, view.pose_covariance, view.expected, view.others, config)
    before = float(np.hypot(*(view.told_place_m - view.true_place_m)))
    times = _frame_times(view, config)
    view = replace(view, depth=view.depth[:0], colour=view.colour[:0])  # of hundreds of views, the images would not fit
    if measured is None:
        return Result(view, None, before, None, None, times, None)
    centre = float(np.hypot(*(_seen_from_truth(measured, view.T_true) - view.true_place_m)))
    return Result(view, measured, before, centre, measured.radius_m - view.true_radius_m, times, _nees(measured, view))


def _nees(measured: Measurement, view: View) -> float:
    """Return the normalised squared error of (bearing, range, radius)."""
    T = view.T_true
    forward = T[:2, 2] / np.hypot(T[0, 2], T[1, 2])
    offset = view.true_place_m - T[:2, 3]
    bearing = np.arctan2(forward[0] * offset[1] - forward[1] * offset[0], forward @ offset)
    error = np.array([
        measured.bearing_rad - bearing, measured.range_m - np.hypot(offset[0], offset[1]),
        measured.radius_m - view.true_radius_m,
    ])  # fmt: skip
    return float(error @ np.linalg.solve(measured.covariance, error))


def _seen_from_truth(measured: Measurement, T_true: Matrix) -> Matrix:
    """Return where the measured bearing and range put the tree for the true camera: the pose's error is not ours."""
    forward = T_true[:2, 2] / np.hypot(T_true[0, 2], T_true[1, 2])
    c, s = np.cos(measured.bearing_rad), np.sin(measured.bearing_rad)
    away = np.array([c * forward[0] - s * forward[1], s * forward[0] + c * forward[1]])
    return np.asarray(T_true[:2, 3] + measured.range_m * away)


def _frame_times(view: View, config: RefinerConfig) -> tuple[tuple[float, float], ...]:
    """Return the ms (wall, processor) of a frame from the raw depth to the filtered target, a few times over."""
    from services.simulator.render import DEFAULT_INTRINSICS

    tracker = RefinerTracker(config)
    trees = [view.expected, *view.others]
    tracker.set_trees(trees, [tree.id for tree in trees], "bench", 0)
    tracker.choose(view.expected.id)
    times = []
    for k in range(_TIMED_REPEATS + 1):
        begin, begin_cpu = time.perf_counter(), time.thread_time()
        depth: Depth = np.multiply(view.depth, np.float32(0.001), dtype=np.float32)
        tracker.step(k * 66_000_000, depth, DEFAULT_INTRINSICS, view.T_told, view.pose_covariance, "", view.colour)
        times.append(((time.perf_counter() - begin) * 1e3, (time.thread_time() - begin_cpu) * 1e3))
    return tuple(times[1:])


def line_of(name: str, results: Sequence[Result]) -> str:
    """Return a scene's line: trees corrected, errors before and after, misses by name."""
    suitable, corrected = count_trees(results)
    centre = [r.centre_m for r in results if r.centre_m is not None]
    missed = [f"tree {r.view.tree} at {r.view.distance_m} m" for r in results if r.centre_m is None]
    wrong = [
        f"tree {r.view.tree} at {r.view.distance_m} m by {100 * r.centre_m:.1f} cm"
        for r in results
        if r.centre_m is not None and r.centre_m > GOOD_CENTRE_M
    ]
    text = f"{name}: {corrected}/{suitable} corrected, centre {100 * _rms(centre):.2f} cm in {len(centre)} views"
    return text + "".join(f", missed {m}" for m in missed) + "".join(f", off {w}" for w in wrong)


def count_trees(results: Sequence[Result]) -> tuple[int, int]:
    """Return (suitable trees that can be seen, those corrected).

    Corrected: measured in at least half of its views with a median centre error of at most 2 cm, and never taken for
    something 10 cm away.
    """
    trees: dict[tuple[str, int], list[Result]] = {}
    for result in results:
        trees.setdefault((result.view.scene, result.view.tree), []).append(result)
    corrected = 0
    for group in trees.values():
        centre = [r.centre_m for r in group if r.centre_m is not None]
        if 2 * len(centre) >= len(group) and max(centre) < FALSE_CENTRE_M:
            corrected += float(np.median(centre)) <= GOOD_CENTRE_M
    return len(trees), corrected


def _rms(values: Sequence[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if values else 0.0


def _report(
    names: Sequence[str], results: Sequence[Result], motions: Sequence[MotionRow], options: BenchOptions, plot: str
) -> BenchReport:
    suitable, corrected = count_trees(results)
    centre = [r.centre_m for r in results if r.centre_m is not None]
    radius = [r.radius_m for r in results if r.radius_m is not None]
    times = np.concatenate([r.frame_ms for r in results]) if results else np.zeros((1, 2))
    (p50, p50_cpu), (p99, p99_cpu) = np.quantile(times, [0.5, 0.99], axis=0)
    figures = {
        "suitable": float(suitable), "corrected": float(corrected), "views": float(len(results)),
        "measured": float(len(centre)), "false": float(sum(c > FALSE_CENTRE_M for c in centre)),
        "centre_before_rmse_m": _rms([r.before_m for r in results]), "centre_rmse_m": _rms(centre),
        "centre_max_m": max(centre, default=0.0), "radius_rmse_m": _rms(radius),
        "nees_of_3": float(np.mean([r.nees for r in results if r.nees is not None] or [0.0])),
        "frame_ms_p50": float(p50), "frame_ms_p99": float(p99),
        "frame_cpu_ms_p50": float(p50_cpu), "frame_cpu_ms_p99": float(p99_cpu),
    }  # fmt: skip
    for row in motions:
        figures |= row.figures()
    figures = {name: round(value, 5) for name, value in figures.items()}
    conditions = {
        "sensor": "640x480, f 500 px, disparity noise s 0.08 px (40 % of it a fixed pattern), 5 px mixed pixels",
        "scenes": ", ".join(names), "seed": str(options.seed if options.seed is not None else "named scenes"),
        "errors drawn": "map 4 cm, radius 1 cm, lean 0.9 deg; pose 2 cm and 0.5 deg of yaw", "corrected": f"measured in half of its views at least, median error <= {100 * GOOD_CENTRE_M:.0f} cm, never {100 * FALSE_CENTRE_M:.0f} cm off",
    }  # fmt: skip
    picture = (
        f"![The motions, and the errors in them](images/{plot})"
        if options.doc and plot.endswith(".png")
        else f"Plot: {plot}"
    )
    return BenchReport(figures, conditions, f"{_table(results, motions)}\n\n{picture}")


def _table(results: Sequence[Result], motions: Sequence[MotionRow]) -> str:
    lines = ["| distance (m) | views | measured | centre before (cm) | after (cm) | worst (cm) | radius (cm) |"]
    lines.append("|---|---|---|---|---|---|---|")
    for distance in DISTANCES_M:
        group = [r for r in results if r.view.distance_m == distance]
        centre = [r.centre_m for r in group if r.centre_m is not None]
        radius = [r.radius_m for r in group if r.radius_m is not None]
        lines.append(
            f"| {distance} | {len(group)} | {len(centre)} | {100 * _rms([r.before_m for r in group]):.2f} "
            f"| {100 * _rms(centre):.2f} | {100 * max(centre, default=0.0):.2f} | {100 * _rms(radius):.2f} |"
        )
    lines += ["", _rates(results), "", *(f"- {row.line()}" for row in motions)]
    return "\n".join(lines)


def _rates(results: Sequence[Result]) -> str:
    """Return how many trees were corrected in single, multi and other scenes."""
    kinds = {"single": "single", "multi": "multi", "hard": ""}
    parts = []
    for kind, word in kinds.items():
        group = [
            r
            for r in results
            if (word in r.view.scene if word else not any(w in r.view.scene for w in ("single", "multi")))
        ]
        if group:
            suitable, corrected = count_trees(group)
            parts.append(f"{corrected} of {suitable} trees in {len({r.view.scene for r in group})} {kind} scenes")
    return "Corrected: " + ", ".join(parts) + "."
