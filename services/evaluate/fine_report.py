"""The report's part on the finer map: each stem's diameters along its height, and its section at breast height."""

from __future__ import annotations

import html
from collections.abc import Sequence

import numpy as np

from schemas.trees import Tree
from services.evaluate.fine import FineResult
from services.evaluate.report import table
from services.evaluate.report_pictures import cross_section_svg
from services.fine.model import BREAST_HEIGHT_M, Stem

_MAX_PICTURES = 60
_WIDE_PX, _HIGH_PX, _LEFT_PX, _FOOT_PX = 260.0, 230.0, 36.0, 40.0
_INK, _FAINT, _FIT, _OFF = "#1d2a20", "#5c6b60", "#15803d", "#c2b8a8"


def fine_section(result: FineResult, trees: Sequence[Tree]) -> list[str]:
    """Return the section's lines; ``trees`` are those of the live result, which it is set against."""
    head = [
        "<h2>Finer map</h2>",
        f"<p>All {result.frames} located frames fused after the flight: {_number(len(result.cloud.points_m))} points "
        f"({_number(int(result.cloud.fine.sum()))} of them around stems), {_number(int(result.segments.ground.sum()))} of the ground. Files: fine_cloud.laz (points with the number of their tree), trees_fine.json, trees_fine.csv, sections_fine.csv, ground_fine.asc (where ground shows).</p>",
    ]
    if not result.stems:
        return [*head, "<p>No stem was seen well enough to be measured.</p>"]
    live = {tree.id: tree for tree in trees}
    shown = sorted(result.stems, key=lambda stem: (not stem.suitable, stem.tree_id))[:_MAX_PICTURES]
    words = (
        "Diameters along each stem: dots are sections of 10 cm with one standard deviation, the line is the taper function; pale dots "
        "are not used for it (root flare, branches). Beside, points of the fine cloud at breast height and the circle there."
    )
    pictures = [f"<div>{profile_svg(stem)}{_breast_height(stem, live[stem.tree_id], result)}</div>" for stem in shown]
    return [
        *head,
        stem_table(result.stems, live),
        f"<p>{words}</p>",
        '<section class="trunks">',
        *pictures,
        "</section>",
    ]


def _number(value: int) -> str:
    return f"{value:,}".replace(",", "\u202f")


def stem_table(stems: Sequence[Stem], live: dict[int, Tree]) -> str:
    """Return the stems, fine beside live."""
    head = ("tree", "diameter cm", "± cm", "at m", "live cm", "± cm", "taper cm/m", "seen m", "sections", "frames")
    rows = []
    for stem in stems:
        tree = live[stem.tree_id]
        low, high = stem.sections[0].height_m, stem.sections[-1].height_m
        rows.append((
            f"{stem.tree_id}", f"{100 * stem.diameter_13_m:.1f}", f"{100 * stem.sigma_13_m:.1f}", f"{stem.height_m:.2f}",
            f"{200 * tree.radius_m:.1f}", f"{200 * tree.sigma_radius_m:.1f}", f"{100 * stem.taper_m_per_m:+.1f}",
            f"{low:.1f} to {high:.1f}", f"{sum(s.used for s in stem.sections)} of {len(stem.sections)}", f"{stem.frames}",
        ))  # fmt: skip
    return table(head, rows)


def _breast_height(stem: Stem, tree: Tree, result: FineResult) -> str:
    x, y, z = stem.base_m
    fine = tree.model_copy(update={
        "x_m": x, "y_m": y, "z_m": z, "axis": stem.axis, "radius_m": 0.5 * stem.diameter_13_m, "sigma_radius_m": 0.5 * stem.sigma_13_m,
        "radius_height_m": stem.height_m,
    })  # fmt: skip
    return cross_section_svg(fine, result.cloud.points_m, "f")


def profile_svg(stem: Stem) -> str:
    """Return diameter over height: height upward, diameter to the right."""
    top_m = max(stem.sections[-1].height_m, BREAST_HEIGHT_M) + 0.2
    widest = max(s.diameter_m + s.sigma_m for s in stem.sections)
    least = min(s.diameter_m - s.sigma_m for s in stem.sections)
    low, high = max(0.0, least - 0.02), widest + 0.02
    scale = (_WIDE_PX - _LEFT_PX - 8.0) / (high - low)

    def place(diameter_m: float, height_m: float) -> tuple[float, float]:
        return _LEFT_PX + scale * (diameter_m - low), _HIGH_PX - (_HIGH_PX - 22.0) * height_m / top_m

    parts = [
        f'<svg viewBox="0 0 {_WIDE_PX:.0f} {_HIGH_PX + _FOOT_PX:.0f}" width="{_WIDE_PX:.0f}" role="img" font-size="12" '
        f'aria-label="{html.escape(f"tree {stem.tree_id}: diameter over height")}">',
        f'<text x="{_LEFT_PX:.0f}" y="14" font-weight="600">{stem.tree_id}: {100 * stem.diameter_13_m:.1f} ± {100 * stem.sigma_13_m:.1f} cm at {stem.height_m:.2f} m</text>',
    ]  # fmt: skip
    for height in np.arange(0.0, top_m, 0.5):
        _, v = place(low, float(height))
        parts.append(f'<path d="M{_LEFT_PX:.0f} {v:.1f}H{_WIDE_PX - 8:.0f}" stroke="#d5ddd6"/><text x="4" y="{v + 4:.1f}" fill="{_FAINT}">{height:.1f}</text>')  # fmt: skip
    step = 0.02 if high - low < 0.12 else 0.05
    for diameter in np.arange(np.ceil(low / step) * step, high, step):
        u, _ = place(float(diameter), 0.0)
        parts.append(f'<text x="{u:.1f}" y="{_HIGH_PX + 16:.0f}" text-anchor="middle" fill="{_FAINT}">{100 * diameter:.0f}</text>')  # fmt: skip
    parts.append(f'<text x="{_WIDE_PX - 8:.0f}" y="{_HIGH_PX + 32:.0f}" text-anchor="end" fill="{_FAINT}">diameter in cm, height in m</text>')  # fmt: skip
    used = [s.height_m for s in stem.sections if s.used]
    ends = [place(stem.diameter_13_m + stem.taper_m_per_m * (h - stem.height_m), h) for h in (min(used), max(used))]
    parts.append(
        f'<path d="M{ends[0][0]:.1f} {ends[0][1]:.1f}L{ends[1][0]:.1f} {ends[1][1]:.1f}" stroke="{_FIT}" stroke-width="2"/>'
    )
    for s in stem.sections:
        (u, v), (left, _), (right, _) = (
            place(d, s.height_m) for d in (s.diameter_m, s.diameter_m - s.sigma_m, s.diameter_m + s.sigma_m)
        )
        colour = _INK if s.used else _OFF
        parts.append(f'<path d="M{left:.1f} {v:.1f}H{right:.1f}" stroke="{colour}"/><circle cx="{u:.1f}" cy="{v:.1f}" r="2.6" fill="{colour}"/>')  # fmt: skip
    return "\n".join([*parts, "</svg>"])
