"""The detector on fresh scenes by difficulty, the reference's Tables 4.1 to 4.5, and its speed."""

from __future__ import annotations

import json
import zlib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np

from services.evaluate import detection_speed as speed
from services.evaluate import detection_tables as tables
from services.evaluate.bench import BenchOptions, BenchReport, code_version
from services.evaluate.detection_accuracy import (
    HARD,
    TABLE_HEAD,
    Tally,
    calibration_rows,
    ours,
    tally,
    within,
)
from services.evaluate.detection_clouds import Drift, SceneCloud, raw_points, scene_cloud
from services.evaluate.trees import rmse

KINDS = ("single", "multi", "slope", "undergrowth", "close", "lean", "drift")
PER_KIND = 15
_RAW_POINTS = 1_856_481
"""Points of the reference's raw cloud (its section 4.2)."""
_CLOSE = 5
_FIRST, _STEP, _DRIFT_SHIFT = 8000, 100, 50
_TABLE_CODE = (
    "services.detector", "services.mapper", "services.simulator", "services.evaluate.detection_tables",
    "services.evaluate.detection_clouds",
)  # fmt: skip


def scene_names(kind: str, options: BenchOptions) -> list[str]:
    """Return the scenes of a difficulty: fresh ones for each seed; drift has multi scenes of its own."""
    count = options.count or (2 if options.quick else PER_KIND)
    first = _FIRST + _STEP * (options.seed or 0)
    if kind == "drift":
        return [f"random-multi-{first + _DRIFT_SHIFT + i}" for i in range(min(count, _STEP - _DRIFT_SHIFT))]
    return [f"random-{kind}-{first + i}" for i in range(min(count, _DRIFT_SHIFT))]


def run(options: BenchOptions) -> BenchReport:
    """Render what is not there yet, detect everywhere, and report."""
    from services.detector.warm import warm

    warm()
    cache = options.out / "detection"
    by_kind: dict[str, Tally] = {}
    for kind, names in _plan(options).items():
        by_kind[kind] = tally(_told(kind, names, cache, options), ours(kind))
    total = Tally()
    for part in by_kind.values():
        total.join(part)
    text = [TABLE_HEAD, *(part.row(kind) for kind, part in by_kind.items()), total.row("all"), ""]
    text += [f"- missed: {what}" for what in total.missed] + [f"- false: {what}" for what in total.false] + [""]
    text += [*calibration_rows(total), ""]
    figures = _figures(by_kind, total)
    if not options.scenes:
        more, timed = _measured(options, cache)
        text += more
        figures |= timed
    return BenchReport(figures, _conditions(options), "\n".join(text))


def _plan(options: BenchOptions) -> dict[str, list[str]]:
    if options.scenes:
        return {"named": list(options.scenes)}
    return {kind: scene_names(kind, options) for kind in KINDS}


def _told(kind: str, names: Sequence[str], cache: Path, options: BenchOptions) -> Iterator[SceneCloud]:
    for number, name in enumerate(names, start=1):
        options.tell(f"{kind} {number}/{len(names)}: {name}")
        yield scene_cloud(name, cache, Drift() if kind == "drift" else None)


def _measured(options: BenchOptions, cache: Path) -> tuple[list[str], dict[str, float]]:
    """Return the tables of the reference and the timings, with their figures.

    Tables are kept in ``cache`` for a later call with the same code; times of ours are always measured anew.
    """
    from services.simulator.catalogue import MULTI, SINGLE

    few = 2 if options.quick else None
    timing_scene = f"random-multi-{_FIRST + _STEP * (options.seed or 0)}"
    timed = speed.timings(timing_scene, cache, options.tell)
    start = speed.start_up_s()
    text = ["### Speed", "", f"Scene {timing_scene}.", "", *speed.table(timed, start), ""]
    figures = {
        "ms_170k": round(timed[0].median_ms, 2), "ms_1040k": round(timed[1].median_ms, 2),
        "ms_170k_least": round(timed[0].least_ms, 2), "ms_1040k_least": round(timed[1].least_ms, 2),
        "cpu_ms_170k": round(timed[0].cpu_ms, 2), "cpu_ms_1040k": round(timed[1].cpu_ms, 2),
        "reference_ms_170k": round(1e3 * timed[0].reference_s, 1), "reference_ms_1040k": round(1e3 * timed[1].reference_s, 1),
        "startup_s": round(start[0], 2), "first_ms": round(1e3 * start[1], 1),
    }  # fmt: skip
    single, multi, close = SINGLE[:few], MULTI[:few], scene_names("close", options)[: few or _CLOSE]

    def named(names: Sequence[str]) -> list[SceneCloud]:
        return [scene_cloud(name, cache) for name in names]

    def methods() -> tuple[list[str], dict[str, float]]:
        return tables.method_table(named(single), named(multi), options.tell)

    def leaves() -> tuple[list[str], dict[str, float]]:
        count = _RAW_POINTS // 10 if options.quick else _RAW_POINTS
        return tables.leaf_table(*raw_points(timing_scene, cache, count)), {}

    parts: dict[str, Callable[[], tuple[list[str], dict[str, float]]]] = {
        "Tables 4.4 and 4.5: the three methods on the 20 named scenes": methods,
        "Table 4.2: points of a trunk in one layer of 2.76 cm": lambda: (tables.points_per_layer(named([*single, *multi])), {}),
        f"Table 4.1: voxel leaf, density, thickness, time (slicing-reference) of {_RAW_POINTS} raw points, as the reference had": leaves,
        "Table 4.3: clustering distance (slicing-reference), the named multi scenes": lambda: (tables.distance_table(named(multi), options.tell), {}),
        "Table 4.3 again where trees stand close (0.5 m)": lambda: (tables.distance_table(named(close), options.tell), {}),
    }  # fmt: skip
    for title, make in parts.items():
        options.tell(title)
        lines, more = _kept(cache, f"{title} {timing_scene} {options.quick}", make)
        text += [f"### {title}", "", *lines, ""]
        figures |= more
    return text, figures


def _kept(
    cache: Path, title: str, make: Callable[[], tuple[list[str], dict[str, float]]]
) -> tuple[list[str], dict[str, float]]:
    """Return a table made now, or by an earlier call with the same code."""
    key = f"{title} {code_version(_TABLE_CODE)}"
    path = cache / f"table-{zlib.crc32(key.encode()):08x}.json"
    if not path.exists():
        path.write_text(json.dumps(make()), encoding="utf-8")
    lines, figures = json.loads(path.read_text(encoding="utf-8"))
    return lines, figures


def _figures(by_kind: dict[str, Tally], total: Tally) -> dict[str, float]:
    figures: dict[str, float] = {
        "scenes": total.scenes, "suitable": total.suitable, "found": total.found, "false": len(total.false),
        "hidden": total.hidden, "centre_rmse_m": round(rmse(total.centre_m), 4), "radius_rmse_m": round(rmse(total.radius_m), 4),
    }  # fmt: skip
    easy, hard = Tally(), Tally()
    for kind, part in by_kind.items():
        (hard if kind in HARD else easy).join(part)
        for name, value in (("centre", part.centre_m), ("radius", part.radius_m)):
            figures[f"{name}_rmse_m_{kind}"] = round(rmse(value), 4)
    for name, part in (("flat", easy), ("hard", hard)):
        figures[f"centre_rmse_m_{name}"] = round(rmse(part.centre_m), 4)
        figures[f"radius_rmse_m_{name}"] = round(rmse(part.radius_m), 4)
    for name, shares in (("radius", total.radius_share), ("centre", total.centre_share)):
        figures[f"{name}_within_68"] = round(within(shares, 1.0), 3)
        figures[f"{name}_within_95"] = round(within(shares, 1.96), 3)
    if total.confidence:
        figures["confidence_mean"] = round(float(np.mean([c for c, _ in total.confidence])), 3)
        figures["precision"] = round(float(np.mean([good for _, good in total.confidence])), 3)
    return figures


def _conditions(options: BenchOptions) -> dict[str, str]:
    first = _FIRST + _STEP * (options.seed or 0)
    names = (
        ", ".join(options.scenes)
        if options.scenes
        else f"{', '.join(KINDS)}; seeds from {first}, drift from {first + _DRIFT_SHIFT}"
    )
    return {
        "sensor": "simulated RGB-D depth, 640x480, keyframes every 0.3 m or 15 degrees of the reference path, fused by the mapper's core",
        "noise": "sigma_z = z^2 s / (f B), s 0.08 px, f 565 px, B 0.070 m, partly fixed pattern, mixed pixels, holes",
        "poses": "true; drift: lean 0.74 deg per axis, 6 mm and 0.14 deg slow, 2 mm and 0.03 deg white (standard deviations)",
        "scenes": names,
        "found": "axis within 0.30 m at the ground and radius within 0.07 m, of suitable trees seen at least 12 px wide and unhidden",
        "times": "two threads; other work on this machine shows in the load: the least and the processor time suffer less than the median",
        "code": code_version(("services.detector", "services.mapper", "services.simulator")),
    }  # fmt: skip
