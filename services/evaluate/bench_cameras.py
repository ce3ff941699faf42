"""Six depth sensors on the same forest flights: what each one's map shows of the trees, and what it costs."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from services.detector.detect import detect_trees
from services.evaluate.bench import BenchOptions, BenchReport
from services.evaluate.detection_accuracy import Tally, judged
from services.evaluate.sensor_clouds import RIGS, Rig, sensor_cloud
from services.evaluate.sensor_facts import FACTS, facts_table
from services.evaluate.sensor_pictures import comparison
from services.evaluate.trees import rmse

KINDS = ("single", "multi", "slope", "undergrowth", "close", "lean")
PER_KIND = 2
_FIRST, _STEP = 9500, 20


@dataclass(slots=True)
class _Row:
    """What one sensor came to."""

    tally: Tally = field(default_factory=Tally)
    points: list[int] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)


def scene_names(options: BenchOptions) -> tuple[str, ...]:
    """Return the scenes to do: those asked for, else some of each kind, fresh ones for each seed."""
    count = options.count or (1 if options.quick else PER_KIND)
    first = _FIRST + _STEP * (options.seed or 0)
    return options.scenes or tuple(f"random-{kind}-{first + i}" for kind in KINDS for i in range(min(count, _STEP)))


def run(options: BenchOptions) -> BenchReport:
    """Show each scene to each sensor (what was done before is kept in ``options.out``), and compare."""
    from services.detector.warm import warm

    warm()
    cache, names = options.out / "cameras", scene_names(options)
    cache.mkdir(parents=True, exist_ok=True)
    rows = {rig.name: _Row() for rig in RIGS}
    for number, name in enumerate(names, start=1):
        for rig in RIGS:
            options.tell(f"{number}/{len(names)} {name}: {rig.name}")
            _look(name, rig, cache, rows[rig.name])
    picture = (options.doc.parent / "images" if options.doc else options.out) / "sensors.webp"
    comparison(names[0], cache, picture)
    text = ["### What is published", "", *facts_table(), "", "### On the same flights", "", *_table(rows), ""]
    text += [*_notes(rows), f"![Depth and trunk of {names[0]} as each sensor has it](images/{picture.name})"]
    return BenchReport(_figures(rows), _conditions(names), "\n".join(text))


def _look(name: str, rig: Rig, cache: Path, row: _Row) -> None:
    cloud = sensor_cloud(name, rig, cache)
    begin = time.perf_counter()
    result = detect_trees(cloud.points_m, (0.0, 0.0, 1.0), cloud.views, rig.detector())
    row.seconds.append(time.perf_counter() - begin)
    row.points.append(len(cloud.points_m))
    row.tally.add(name, *judged(cloud, result))


def _table(rows: dict[str, _Row]) -> list[str]:
    lines = [
        "| sensor | technology | depth used to (m) | noise at 3 m (cm) | found | false | centre RMSE (cm) | radius RMSE (cm) "
        "| radius bias (cm) | points of the map | in sunlight | weight | price |",
        "|---" * 13 + "|",
    ]
    for rig in RIGS:
        t, row, facts = rows[rig.name].tally, rows[rig.name], FACTS[rig.name]
        noise_cm = 100.0 * float(np.hypot(9.0 * rig.per_square_m, rig.floor_m))
        lines.append(
            f"| {rig.name} | {rig.technology} | {rig.mapper().max_range_m:g} | {noise_cm:.1f} | {t.found}/{t.suitable} | {len(t.false)} "
            f"| {100 * rmse(t.centre_m):.2f} | {100 * rmse(t.radius_m):.2f} | {100 * float(np.mean(t.radius_m or [0.0])):+.2f} "
            f"| {int(np.median(row.points)):,} | {_short(facts.sunlight)} | {_short(facts.weight)} | {_short(facts.price)} |"
        )
    return lines


def _short(text: str) -> str:
    """Return a fact without its sources, up to the first colon or semicolon."""
    return text.split(" [", 1)[0].split(":", 1)[0].split(";", 1)[0]


def _notes(rows: dict[str, _Row]) -> list[str]:
    lines = []
    for name, row in rows.items():
        lines += [f"- {name} missed: {what}" for what in row.tally.missed]
        lines += [f"- {name} false: {what}" for what in row.tally.false]
    return [*lines, ""] if lines else []


def _figures(rows: dict[str, _Row]) -> dict[str, float]:
    figures: dict[str, float] = {"scenes": next(iter(rows.values())).tally.scenes}
    for rig in RIGS:
        t, key = rows[rig.name].tally, rig.name.lower().replace(" ", "").replace("-", "")
        figures |= {
            f"{key}_suitable": t.suitable, f"{key}_found": t.found, f"{key}_false": len(t.false),
            f"{key}_centre_rmse_m": round(rmse(t.centre_m), 4), f"{key}_radius_rmse_m": round(rmse(t.radius_m), 4),
            f"{key}_detect_s": round(float(np.median(rows[rig.name].seconds)), 3),
        }  # fmt: skip
    return figures


def _conditions(names: tuple[str, ...]) -> dict[str, str]:
    return {
        "scenes": ", ".join(names),
        "flight": "the reference's path, true poses, keyframes every 0.3 m or 15 degrees, fused by the mapper's core",
        "light": "shade (every sensor works); in direct sun the Kinect 1 has no depth and finds nothing",
        "asked for": "the same trees of every sensor: those that can be seen from the path within 6 m; found beyond them counts as found",
        "settings": "mapper and detector know each sensor's range and noise; nothing else differs",
        "LiDAR": "level, all round, one turn a keyframe",
    }
