"""Diameters of the finer map against those of the live result, on flights of which the truth is known."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from services.common.config import TreedockConfig
from services.evaluate.bench import BenchOptions, BenchReport, code_version
from services.evaluate.bench_catalogue import _CODE, _append, _read_results, _rendered
from services.evaluate.trees import read_trees, read_truth, rmse, score

if TYPE_CHECKING:
    from services.simulator.scene import SceneTree

KINDS = ("single", "multi", "slope", "undergrowth")
PER_KIND = 3
_FIRST, _STEP = 9700, 20
RATE_HZ = 7.5
"""Half the camera's rate: both results get the same frames."""


def scene_names(options: BenchOptions) -> tuple[str, ...]:
    """Return the scenes to do: those asked for, else some of each kind, fresh ones for each seed."""
    count = options.count or (1 if options.quick else PER_KIND)
    first = _FIRST + _STEP * (options.seed or 0)
    return options.scenes or tuple(f"random-{kind}-{first + i}" for i in range(min(count, _STEP)) for kind in KINDS)


def run(options: BenchOptions) -> BenchReport:
    """Fly, process with ``--fine`` and compare what is not done yet; report on all of it."""
    config = TreedockConfig()
    version = code_version((*_CODE, "services.fine", "services.evaluate.fine", "services.evaluate.bench_fine"))
    done = _read_results(options.out / "fine.jsonl")
    names, rows = scene_names(options), []
    for number, name in enumerate(names, start=1):
        key = json.dumps(
            {"scene": name, "quick": options.quick, "code": version, "config": config.model_dump(mode="json")},
            sort_keys=True,
        )
        row = done.get(key)
        if row is None:
            row = run_scene(name, config, options)
            _append(options.out / "fine.jsonl", {"key": key, **row})
        options.tell(f"{number}/{len(names)} {line_of(row)}")
        rows.append(row)
    return _report(rows, options, version)


def run_scene(name: str, config: TreedockConfig, options: BenchOptions) -> dict[str, Any]:
    """Render a scene, process it, and return what became of each tree that the live result found."""
    from services.evaluate.sequence import process_sequence

    keep = options.out / "fine" / name
    with _rendered(name, options, RATE_HZ) as sequence:
        values = process_sequence(sequence, keep, config, fine=True)
        truth = read_truth(sequence / "truth.json")
    live = score(read_trees(keep / "trees.json"), truth)
    fine = {tree["id"]: tree for tree in json.loads((keep / "trees_fine.json").read_text(encoding="utf-8"))["trees"]}
    trees = [
        _tree(
            name, truth.index(m.true), m.true.radius_m, m.found.radius_m, m.found.sigma_radius_m, fine.get(m.found.id)
        )
        for m in live.matches
    ]
    seconds = values["duration_s"] - values["setup_s"]
    return {
        "scene": name,
        "trees": trees,
        "frames": values["frames"],
        "live_s": round(seconds, 1),
        "fine_s": values["fine"]["seconds"],
    }


def _tree(
    scene: str, index: int, radius_m: float, live_m: float, live_sigma_m: float, fine: Mapping[str, Any] | None
) -> dict[str, Any]:
    """Return one tree's errors, in diameters."""
    from services.simulator.catalogue import scene_by_name

    true = scene_by_name(scene).trees[index]
    row: dict[str, Any] = {
        "true_m": round(2.0 * radius_m, 4), "live_error_m": round(2.0 * (live_m - radius_m), 5), "live_sigma_m": round(2.0 * live_sigma_m, 5),
    }  # fmt: skip
    if fine is None:
        return row
    used = [s for s in fine["sections"] if s["used"]]
    row["limit_m"] = round(2.0 * side_error_m(true, math.atan2(-true.y_m, -true.x_m)), 5)
    off = [s["diameter_m"] - 2.0 * float(true.mean_radius(s["height_m"])) for s in used]
    return row | {
        "fine_error_m": round(fine["diameter_13_m"] - 2.0 * float(true.mean_radius(fine["diameter_height_m"])), 5),
        "fine_sigma_m": fine["sigma_13_m"], "frames": fine["frames"],
        "taper_error": round(fine["taper_m_per_m"] + 2.0 * true.taper, 5), "taper_sigma": fine["sigma_taper"],
        "section_errors_m": [round(e, 5) for e in off], "section_sigmas_m": [s["sigma_m"] for s in used],
    }  # fmt: skip


def side_error_m(tree: SceneTree, toward_rad: float) -> float:
    """Return the error of the radius that a perfect camera makes which sees only one side of a bumpy trunk.

    Axis, radius and taper fitted without noise to the 140 degrees that face ``toward_rad``, from 0.4 to 2.5 m: what no
    number of frames from there can better.
    """
    from services.simulator.meshes import trunk_radii

    heights = np.arange(0.4, 2.5, 0.1)
    angles, radii = trunk_radii(tree, heights)
    aside = (angles - toward_rad + np.pi) % (2.0 * np.pi) - np.pi
    shown = np.abs(aside) < np.radians(70.0)
    off = (radii - tree.mean_radius(heights)[:, None])[:, shown].ravel()
    h, a = (grid.ravel() for grid in np.meshgrid(heights - 1.3, angles[shown], indexing="ij"))
    terms = np.stack([np.ones_like(h), h, np.cos(a), np.sin(a), h * np.cos(a), h * np.sin(a)], axis=1)
    weight = np.tile(np.cos(aside[shown]), len(heights))
    return float(np.linalg.lstsq(terms * weight[:, None], off * weight)[0][0])


def line_of(row: Mapping[str, Any]) -> str:
    """Return a scene's row as one line."""
    trees = [
        f"{100 * t['true_m']:.1f} cm: live {1000 * t['live_error_m']:+.1f} ± {1000 * t['live_sigma_m']:.1f} mm, "
        + (f"fine {1000 * t['fine_error_m']:+.1f} ± {1000 * t['fine_sigma_m']:.1f}" if "fine_error_m" in t else "not measured")
        for t in row["trees"]
    ]  # fmt: skip
    return (
        f"{row['scene']} ({row['frames']} frames, live {row['live_s']:.0f} s, fine {row['fine_s']:.0f} s): "
        + "; ".join(trees)
    )


def _report(rows: Sequence[Mapping[str, Any]], options: BenchOptions, version: str) -> BenchReport:
    trees = [t for row in rows for t in row["trees"]]
    both = [t for t in trees if "fine_error_m" in t]
    sections = [e for t in both for e in t["section_errors_m"]]
    shares = [e / max(s, 1e-6) for t in both for e, s in zip(t["section_errors_m"], t["section_sigmas_m"], strict=True)]
    table = [
        "| diameters at 1.3 m | trees | RMSE (mm) | bias (mm) | worst (mm) | within 1, 1.96 sigma (%) |",
        "|---|---|---|---|---|---|",
        _line("live", [t["live_error_m"] for t in both], [t["live_sigma_m"] for t in both]),
        _line("fine", [t["fine_error_m"] for t in both], [t["fine_sigma_m"] for t in both]),
        f"| without any noise, from one side | {len(both)} | {1000 * rmse([t['limit_m'] for t in both]):.2f} | {1000 * float(np.mean([t['limit_m'] for t in both] or [0.0])):+.2f} "
        f"| {1000 * max((abs(t['limit_m']) for t in both), default=0.0):.1f} | - |",
        "",
        f"Fine was nearer to the truth for {sum(abs(t['fine_error_m']) < abs(t['live_error_m']) for t in both)} of {len(both)} trees; "
        f"{len(trees) - len(both)} found live were not measured. Along the stems, {len(sections)} sections of 10 cm: RMSE "
        f"{1000 * rmse(sections):.1f} mm, within 1 and 1.96 sigma {_within(shares)} %; taper RMSE "
        f"{1000 * rmse([t['taper_error'] for t in both]):.1f} mm a metre.",
        "",
        *(f"- {line_of(row)}" for row in rows),
    ]  # fmt: skip
    return BenchReport(_figures(rows, trees, both, sections), _conditions(options, version), "\n".join(table))


def _line(what: str, errors: Sequence[float], sigmas: Sequence[float]) -> str:
    shares = [e / max(s, 1e-6) for e, s in zip(errors, sigmas, strict=True)]
    worst = max(map(abs, errors), default=0.0)
    return f"| {what} | {len(errors)} | {1000 * rmse(errors):.2f} | {1000 * float(np.mean(errors or [0.0])):+.2f} | {1000 * worst:.1f} | {_within(shares)} |"


def _within(shares: Sequence[float]) -> str:
    inside = np.abs(np.array(shares or [0.0]))
    return f"{100 * float(np.mean(inside <= 1.0)):.0f}, {100 * float(np.mean(inside <= 1.96)):.0f}"


def _figures(
    rows: Sequence[Mapping[str, Any]], trees: Sequence[Mapping[str, Any]], both: Sequence[Mapping[str, Any]], sections: Sequence[float]
) -> dict[str, float]:  # fmt: skip
    return {
        "scenes": len(rows), "trees": len(trees), "measured": len(both),
        "live_diameter_rmse_m": round(rmse([t["live_error_m"] for t in both]), 5),
        "fine_diameter_rmse_m": round(rmse([t["fine_error_m"] for t in both]), 5),
        "one_side_limit_m": round(rmse([t["limit_m"] for t in both]), 5),
        "section_rmse_m": round(rmse(sections), 5),
        "taper_rmse": round(rmse([t["taper_error"] for t in both]), 5),
        "fine_s_median": round(float(np.median([row["fine_s"] for row in rows])), 1),
    }  # fmt: skip


def _conditions(options: BenchOptions, version: str) -> dict[str, str]:
    return {
        "sensor": f"simulated RGB-D, 640x480, {RATE_HZ:g} Hz, s 0.08 px, reference path"
        + (", rendered at half size" if options.quick else ""),
        "scenes": "fresh, seed " + str(options.seed or 0) if not options.scenes else "named",
        "compared": "trees that the live result found, diameters against the scene's mean diameter at the same height",
        "code": version,
    }
