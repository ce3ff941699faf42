"""The end of a run in figures: the trees found, beside the truth where the run was simulated."""

from __future__ import annotations

import math
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.table import Table

from schemas.simulation import SimTruth, TrueTree
from schemas.trees import Tree, TreeList
from services.cli.supervisor import Supervisor
from services.cli.watch import Watch
from services.common.words import plural

_SAME_TREE_M = 0.5


def pair(trees: tuple[Tree, ...], truth: tuple[TrueTree, ...]) -> dict[int, int]:
    """Return for each found tree (by index) the true one (by index) it stands for: nearest pairs first, within 0.5 m."""
    distances = sorted(
        (math.hypot(t.x_m - u.x_m, t.y_m - u.y_m), i, j) for i, t in enumerate(trees) for j, u in enumerate(truth)
    )
    pairs: dict[int, int] = {}
    for distance_m, i, j in distances:
        if distance_m <= _SAME_TREE_M and i not in pairs and j not in pairs.values():
            pairs[i] = j
    return pairs


def figures(watch: Watch, supervisor: Supervisor, duration_s: float) -> dict[str, Any]:
    """Return the summary as plain values, for ``--json``."""
    trees = watch.trees.trees if watch.trees else ()
    truth = watch.truth.trees if watch.truth else ()
    pairs = pair(trees, truth)
    result: dict[str, Any] = {
        "frames": watch.frames,
        "duration_s": round(duration_s, 2),
        "trees": [tree.model_dump(mode="json") for tree in trees],
        "services": {
            name: {"state": health.state, "rates_hz": health.rates_hz, "counters": health.counters, "note": health.note}
            for name, health in sorted(watch.health.items())
        },
        "dropped": watch.dropped(),
        "frames_left_out": watch.frames_left_out(),
        "restarts": {child.name: child.restarts for child in supervisor.children.values() if child.restarts},
    }
    if watch.truth is not None:
        fair = [j for j, tree in enumerate(truth) if tree.suitable and tree.fair]
        result["truth"] = {
            "scene": watch.truth.scene,
            "trees": [tree.model_dump(mode="json") for tree in truth],
            "pairs": {str(trees[i].id): j for i, j in pairs.items()},
            "suitable": len(fair),
            "found": sum(j in fair and trees[i].suitable for i, j in pairs.items()),
            "false": sum(tree.suitable and i not in pairs for i, tree in enumerate(trees)),
        }
    return result


def tree_table(trees: TreeList | None, truth: SimTruth | None) -> Table:
    """Return the trees found, each beside the true one it stands for; the missed ones last."""
    found = trees.trees if trees else ()
    true = truth.trees if truth else ()
    pairs = pair(found, true)
    table = Table(
        title=None if truth is None else f"scene {truth.scene}", header_style="bold", box=SIMPLE_HEAD, pad_edge=False
    )
    columns = ["tree", "x m", "y m", "r cm", "conf", "good"]
    columns += ["true x", "true y", "true r", "off"] if truth is not None else []
    for column in columns:
        table.add_column(column, justify="right", no_wrap=True)
    for i, tree in enumerate(found):
        cells = [
            str(tree.id), f"{tree.x_m:.2f}", f"{tree.y_m:.2f}", f"{100 * tree.radius_m:.1f}",
            f"{tree.confidence:.2f}", "yes" if tree.suitable else "no",
        ]  # fmt: skip
        table.add_row(*cells, *(_beside(tree, true[pairs[i]] if i in pairs else None) if truth is not None else ()))
    for j, missed in enumerate(true):
        if missed.suitable and missed.fair and j not in pairs.values():
            table.add_row("missed", *[""] * 5, *_true_cells(missed), "")
    return table


def _true_cells(tree: TrueTree) -> tuple[str, str, str]:
    return f"{tree.x_m:.2f}", f"{tree.y_m:.2f}", f"{100 * tree.radius_m:.1f}"


def _beside(tree: Tree, true: TrueTree | None) -> tuple[str, ...]:
    if true is None:
        return ("none", "", "", "")
    return (*_true_cells(true), f"{100 * math.hypot(tree.x_m - true.x_m, tree.y_m - true.y_m):.1f}")


def closing_line(values: dict[str, Any]) -> str:
    """Return the last line of a run."""
    suitable = sum(tree["suitable"] for tree in values["trees"])
    count = len(values["trees"])
    line = f"{count} {plural(count, 'tree')} found, {suitable} suitable"
    if "truth" in values:
        truth = values["truth"]
        line += f"; of {truth['suitable']} true suitable ones {truth['found']} found, {truth['false']} false"
    line += f"; {values['frames']} frames in {values['duration_s']:.0f} s"
    restarts = sum(values["restarts"].values())
    frames = values["frames_left_out"]
    others = sum(values["dropped"].values()) - sum(frames.values())
    line += f", {restarts} restarts" if restarts else ""
    line += f"; frames left out: {', '.join(f'{name} {count}' for name, count in frames.items())}" if frames else ""
    return line + (f"; {others} other samples dropped" if others else "")


def mission_lines(values: dict[str, Any]) -> list[str]:
    """Return the last lines of a flown run: each docking, the believed beside the true, and how it ended."""
    mission = values.get("mission")
    if mission is None:
        return []
    lines = [_dock_line(dock) for dock in mission["docks"]]
    if "touches" in mission:
        lines.append(
            f"{mission['simulated_s']:.0f} s flown in simulated time, touched {mission['touches']} times, "
            f"never nearer than {mission['clearance_m']:.2f} m to anything"
        )
    word = "docked" if mission["docked"] else "NOT docked"
    lines.append(f"{word}; mission {mission['state']}: {mission['reason']}")
    return [*lines, f"report: {values['report']}"] if values.get("report") else lines


def _dock_line(dock: dict[str, Any]) -> str:
    def pair_of(name: str, form: str) -> str:
        believed, true = dock.get(name), dock.get(f"true_{name}")
        text = "unknown" if believed is None else format(believed, form)
        return text if true is None else f"{text} believed, {format(true, form)} true"

    distance, heading = pair_of("distance_m", ".3f"), pair_of("heading_deg", "+z.2f")
    verdict = "" if dock["good"] else " (outside 0.85..1.00 m or 3 deg, or no suitable tree)"
    return f"docked at tree {dock['tree_id']}: distance {distance} m; heading error {heading} deg{verdict}"
