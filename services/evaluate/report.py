"""report.html: one self-contained page with summary, trees, a map from above and timings."""

from __future__ import annotations

import html
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from schemas.trees import Tree
from services.common.words import plural
from services.evaluate.exports import Stamped, tree_rows
from services.evaluate.report_pictures import cross_section_svg, filter_plots_svg
from services.evaluate.sightings import Sightings
from services.evaluate.top_view import top_view_svg

_MAX_PICTURES = 60
_FILES = (
    ("trees.gpkg, trees.geojson, trees.csv", "the trees; QGIS opens the GeoPackage as it is, in metres of the map (`treedock inventory` places the trees of flights on the globe)"),
    ("trees.json", "the trees with everything that is known of them"),
    ("cloud.laz, cloud.ply", "the map's points; CloudCompare and QGIS open both"),
    ("trajectory.txt, trajectory_online.txt", "the camera's path in TUM's format: final estimate, and as a live run would have told it"),
    ("targets.jsonl", "the tracked trunk in each frame"),
    ("metrics.json", "the figures of this page"),
)  # fmt: skip
STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; margin: 2rem auto; max-width: 60rem; padding: 0 1rem; color: #1d2a20; }
h1, h2 { font-weight: 600; } table { border-collapse: collapse; margin: 0.5rem 0 1.5rem; }
th, td { padding: 0.2rem 0.5rem; text-align: right; border-bottom: 1px solid #d5ddd6; font-variant-numeric: tabular-nums; }
th:first-child, td:first-child, .left2 th:nth-child(-n+3), .left2 td:nth-child(-n+3), .left5 th, .left5 td { text-align: left; }
svg { width: 100%; height: auto; background: #f6f8f5; border: 1px solid #d5ddd6; }
.warn { color: #9a3412; } .wide { overflow-x: auto; } th { white-space: nowrap; } p { max-width: 46rem; }
.verdict { padding: 0.6rem 1rem; border-left: 6px solid #9aa69d; background: #f6f8f5; font-size: 1.1rem; font-weight: 600; }
.verdict.good { border-color: #15803d; color: #14532d; } .verdict.warn { border-color: #d97706; }
.trunks { display: flex; flex-wrap: wrap; gap: 0.75rem; } .trunks svg { width: 190px; }
.cards { display: flex; flex-wrap: wrap; gap: 0.75rem; }
.cards div { flex: 1 1 7.5rem; border: 1px solid #d5ddd6; border-radius: 6px; padding: 0.5rem 0.8rem; }
@media print { body { margin: 0; max-width: none; } h2, svg, tr { break-inside: avoid; } }
.cards small { display: block; color: #5c6b60; } .cards b { font-size: 1.4rem; font-weight: 600; }
"""


def report_bytes(
    title: str,
    values: Mapping[str, Any],
    trees: Sequence[Tree],
    trajectory: Sequence[Stamped],
    points_m: NDArray[np.float32],
    seen: Sightings | None = None,
    more: Sequence[str] = (),
) -> bytes:
    """Return the page for a run's metrics ``values``, its trees, final trajectory, map points (N, 3) and what was seen of the target.

    ``more``: lines of HTML that stand before the target's section.
    """
    bad = [f'<p class="warn">left out: {html.escape(reason)}</p>' for reason in values["bad_frame_reasons"][:20]]
    body = [
        "<!doctype html>", '<html lang="en"><head><meta charset="utf-8">', f"<title>{html.escape(title)}</title>",
        f"<style>{STYLE}</style></head><body>", f"<h1>{html.escape(title)}</h1>", _summary(values), *bad,
        "<h2>Trees</h2>", tree_table(trees), "<h2>From above</h2>", top_view_svg(trees, trajectory, points_m),
        *trunks_section(trees, points_m), *more, *filters_section(seen), "<h2>Time</h2>", _timings(values["ms"]),
        "<h2>Files beside this page</h2>", table(("file", "what it is"), _FILES, left=2), "</body></html>",
    ]  # fmt: skip
    return ("\n".join(body) + "\n").encode()


def table(head: Iterable[str], rows: Iterable[Iterable[str]], left: int = 1) -> str:
    """Return a table; the first ``left`` columns are words and stand at the left."""
    heads = "".join(f"<th>{html.escape(cell)}</th>" for cell in head)
    lines = ["<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in row) + "</tr>" for row in rows]
    words = f' class="left{left}"' if left > 1 else ""
    return "\n".join(['<div class="wide">', f"<table{words}>", f"<tr>{heads}</tr>", *lines, "</table></div>"])


def _summary(values: Mapping[str, Any]) -> str:
    share = 100.0 * values["tracked_final"] / max(values["frames"], 1)
    cards = [
        (plural(values["trees"], "tree"), f"{values['trees']}", f"{values['trees_suitable']} suitable"),
        (plural(values["frames"], "frame"), f"{values['frames']}", f"{values['bad_frames']} left out"),
        ("tracked", f"{share:.1f} %", f"{values['tracked_final']} {plural(values['tracked_final'], 'frame')}"),
        ("map", f"{values['cloud_points']:,}".replace(",", "\u202f"), plural(values["cloud_points"], "point")),
        ("time", f"{values['duration_s']:.1f} s", f"{values['ms']['frame']['median']:.0f} ms a frame"),
        ("memory", f"{values['peak_memory_mb']:.0f} MB", "at its peak"),
    ]
    lines = [
        f"<div><small>{html.escape(name)}</small><b>{html.escape(value)}</b><small>{html.escape(more)}</small></div>"
        for name, value, more in cards
    ]
    return "\n".join(['<section class="cards">', *lines, "</section>"])


def tree_table(trees: Sequence[Tree]) -> str:
    """Return the trees as a table."""
    if not trees:
        return "<p>No trees were found.</p>"
    head = ("tree", "x m", "y m", "± cm", "z m", "diameter cm", "± cm", "at m", "seen m", "lean °", "arc °", "conf.", "suitable")  # fmt: skip
    rows = []
    for row in tree_rows(trees):
        lean_deg = np.degrees(np.arccos(np.clip(row["axis"][2], -1.0, 1.0)))
        rows.append((
            f"{row['id']}", f"{row['x_m']:.2f}", f"{row['y_m']:.2f}", f"{100.0 * row['sigma_xy_m']:.1f}", f"{row['z_m']:.2f}",
            f"{200.0 * row['radius_m']:.1f}", f"{200.0 * row['sigma_radius_m']:.1f}", f"{row['radius_height_m']:.2f}", f"{row['height_seen_m']:.2f}",
            f"{lean_deg:.1f}", f"{np.degrees(row['arc_rad']):.0f}", f"{row['confidence']:.2f}",
            "yes" if row["suitable"] else "no",
        ))  # fmt: skip
    words = "Diameters and their standard deviations at the height named; x ahead and y left of the start, z the ground where the trunk meets it."
    return f"<p>{words}</p>\n" + table(head, rows)


def trunks_section(trees: Sequence[Tree], points_m: NDArray[np.float32]) -> list[str]:
    """Return a cross-section of every trunk."""
    if not trees:
        return []
    shown = sorted(trees, key=lambda tree: (not tree.suitable, tree.id))[:_MAX_PICTURES]
    left_out = f" The first {_MAX_PICTURES} of {len(trees)} are shown." if len(trees) > _MAX_PICTURES else ""
    words = "Points of the map within 10 cm of the height where the diameter was measured, from above, and the fit."
    pictures = [cross_section_svg(tree, points_m) for tree in shown]
    return ["<h2>Trunks</h2>", f"<p>{words}{left_out}</p>", '<section class="trunks">', *pictures, "</section>"]


def filters_section(seen: Sightings | None, begin_ns: int | None = None) -> list[str]:
    """Return the filters' work over time since ``begin_ns`` (else the first of ``seen``), nothing when no target was tracked."""
    plots = "" if seen is None else filter_plots_svg(seen, begin_ns)
    return ["<h2>Target</h2>", plots] if plots else []


def _timings(stages: Mapping[str, Mapping[str, float]]) -> str:
    rows = [
        (name, *(f"{stage[key]:.1f}" for key in ("median", "p99", "max")), f"{stage['count']:.0f}")
        for name, stage in stages.items()
    ]
    return table(("stage (ms)", "median", "p99", "max", "times"), rows)
