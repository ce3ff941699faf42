"""report.html: one self-contained page with summary, trees, a map from above and timings."""

from __future__ import annotations

import html
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from schemas.trees import Tree
from services.evaluate.exports import Stamped, tree_rows

_MARGIN_M = 1.0
_WIDTH_PX = 720.0
_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; margin: 2rem auto; max-width: 60rem; padding: 0 1rem; color: #1d2a20; }
h1, h2 { font-weight: 600; } table { border-collapse: collapse; margin: 0.5rem 0 1.5rem; }
th, td { padding: 0.2rem 0.7rem; text-align: right; border-bottom: 1px solid #d5ddd6; font-variant-numeric: tabular-nums; }
th:first-child, td:first-child { text-align: left; }
svg { width: 100%; height: auto; background: #f6f8f5; border: 1px solid #d5ddd6; }
.warn { color: #9a3412; }
"""


def report_bytes(title: str, values: Mapping[str, Any], trees: Sequence[Tree], trajectory: Sequence[Stamped]) -> bytes:
    """Return the page for a run's metrics ``values``, its trees and final trajectory."""
    bad = [f'<p class="warn">left out: {html.escape(reason)}</p>' for reason in values["bad_frame_reasons"][:20]]
    body = [
        "<!doctype html>", '<html lang="en"><head><meta charset="utf-8">', f"<title>{html.escape(title)}</title>",
        f"<style>{_STYLE}</style></head><body>", f"<h1>{html.escape(title)}</h1>", _summary(values), *bad,
        "<h2>Trees</h2>", _tree_table(trees), "<h2>From above</h2>", top_view_svg(trees, trajectory),
        "<h2>Time</h2>", _timings(values["ms"]), "</body></html>",
    ]  # fmt: skip
    return ("\n".join(body) + "\n").encode()


def _table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    heads = "".join(f"<th>{html.escape(cell)}</th>" for cell in head)
    lines = ["<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in row) + "</tr>" for row in rows]
    return "\n".join(["<table>", f"<tr>{heads}</tr>", *lines, "</table>"])


def _summary(values: Mapping[str, Any]) -> str:
    rows = [
        ("frames", f"{values['frames']}"),
        ("tracked", f"{values['tracked_final']} ({100.0 * values['tracked_final'] / max(values['frames'], 1):.1f} %)"),
        ("left out", f"{values['bad_frames']}"),
        ("trees", f"{values['trees']}, {values['trees_suitable']} suitable"),
        ("points in the map", f"{values['cloud_points']}"),
        ("duration", f"{values['duration_s']:.1f} s"),
        ("peak memory", f"{values['peak_memory_mb']:.0f} MB"),
    ]
    return _table(("what", "value"), rows)


def _tree_table(trees: Sequence[Tree]) -> str:
    if not trees:
        return "<p>No trees were found.</p>"
    head = (
        "id",
        "x m",
        "y m",
        "ground z m",
        "radius cm",
        "at height m",
        "seen m",
        "lean deg",
        "arc deg",
        "confidence",
        "suitable",
    )
    rows = []
    for row in tree_rows(trees):
        lean_deg = np.degrees(np.arccos(np.clip(row["axis"][2], -1.0, 1.0)))
        rows.append((
            f"{row['id']}", f"{row['x_m']:.2f}", f"{row['y_m']:.2f}", f"{row['z_m']:.2f}",
            f"{100.0 * row['radius_m']:.1f}", f"{row['radius_height_m']:.2f}", f"{row['height_seen_m']:.2f}",
            f"{lean_deg:.1f}", f"{np.degrees(row['arc_rad']):.0f}", f"{row['confidence']:.2f}",
            "yes" if row["suitable"] else "no",
        ))  # fmt: skip
    return _table(head, rows)


def _timings(stages: Mapping[str, Mapping[str, float]]) -> str:
    rows = [
        (name, *(f"{stage[key]:.1f}" for key in ("median", "p99", "max")), f"{stage['count']:.0f}")
        for name, stage in stages.items()
    ]
    return _table(("stage (ms)", "median", "p99", "max", "times"), rows)


def top_view_svg(trees: Sequence[Tree], trajectory: Sequence[Stamped]) -> str:
    """Return the map from above as inline SVG: x (first heading) up, y (left) to the left, a line for each metre."""
    path = np.array([T[:2, 3] for _, T in trajectory]).reshape(-1, 2)
    ends = np.vstack([path, np.array([(t.x_m, t.y_m) for t in trees]).reshape(-1, 2), np.zeros((1, 2))])
    low, high = ends.min(axis=0) - _MARGIN_M, ends.max(axis=0) + _MARGIN_M
    scale = _WIDTH_PX / (high[1] - low[1])
    height_px = scale * (high[0] - low[0])

    def place(x_m: float, y_m: float) -> tuple[str, str]:
        return f"{scale * (high[1] - y_m):.1f}", f"{scale * (high[0] - x_m):.1f}"

    parts = [f'<svg viewBox="0 0 {_WIDTH_PX:.0f} {height_px:.0f}" role="img" aria-label="map from above">']
    for metre in range(int(np.ceil(low[0])), int(np.floor(high[0])) + 1):
        y = place(metre, 0.0)[1]
        parts.append(f'<line x1="0" x2="{_WIDTH_PX:.0f}" y1="{y}" y2="{y}" stroke="#e1e7e1"/>')
    for metre in range(int(np.ceil(low[1])), int(np.floor(high[1])) + 1):
        x = place(0.0, metre)[0]
        parts.append(f'<line y1="0" y2="{height_px:.0f}" x1="{x}" x2="{x}" stroke="#e1e7e1"/>')
    points = " ".join(",".join(place(float(x), float(y))) for x, y in path)
    parts.append(f'<polyline points="{points}" fill="none" stroke="#2563eb" stroke-width="2"/>')
    for tree in sorted(trees, key=lambda tree: tree.id):
        x, y = place(tree.x_m, tree.y_m)
        colour = "#15803d" if tree.suitable else "#a16207"
        parts.append(f'<circle cx="{x}" cy="{y}" r="{max(scale * tree.radius_m, 2.0):.1f}" fill="{colour}"/>')
        parts.append(f'<text x="{x}" y="{y}" dx="8" dy="-8" font-size="13">{tree.id}</text>')
    x, y = place(0.0, 0.0)
    parts.append(f'<circle cx="{x}" cy="{y}" r="4" fill="none" stroke="#2563eb" stroke-width="2"/></svg>')
    return "\n".join(parts)
