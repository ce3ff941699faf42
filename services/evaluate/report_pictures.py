"""Pictures of the report as inline SVG: a trunk's cross-section with its fit, and the filters' work over time."""

from __future__ import annotations

import html

import numpy as np
from numpy.typing import NDArray

from schemas.trees import Tree
from services.evaluate.sightings import Sightings, begins

_SLICE_HALF_M = 0.10
"""Half the height of the slice that a cross-section shows."""
_AROUND_M = 0.15
_MAX_POINTS = 500
_SIDE_PX = 190.0
_PLOT_PX, _PLOT_HEIGHT_PX, _LEFT_PX = 720.0, 130.0, 62.0
_INK, _FAINT, _FIT, _RAW = "#1d2a20", "#5c6b60", "#15803d", "#9aa69d"


def cross_section_svg(tree: Tree, points_m: NDArray[np.float32], mark: str = "c") -> str:
    """Return the slice of the map (N, 3) about the height where the radius holds, seen from above, with the circle.

    x (first heading) is up and y (left) is left, as on the map. Thinned to a few hundred points. ``mark`` tells two
    pictures of one tree on a page apart.
    """
    half_m = max(tree.radius_m + _AROUND_M, 0.25)
    axis = np.array(tree.axis)
    foot = np.array([tree.x_m, tree.y_m, tree.z_m])
    centre = foot + tree.radius_height_m / max(axis[2], 0.2) * axis
    slice_m = _slice(points_m, centre, half_m)
    scale = _SIDE_PX / (2.0 * half_m)
    middle = 0.5 * _SIDE_PX
    dots = "".join(f'<circle cx="{middle - scale * y:.1f}" cy="{middle - scale * x:.1f}" r="1.3"/>' for x, y in slice_m)
    words = f"tree {tree.id}: diameter {200.0 * tree.radius_m:.1f} cm"
    bar_px = 0.1 * scale
    return "\n".join([
        f'<svg viewBox="0 0 {_SIDE_PX:.0f} {_SIDE_PX + 36:.0f}" width="{_SIDE_PX:.0f}" role="img" aria-label="{html.escape(words)}" font-size="12">',
        f'<clipPath id="{mark}{tree.id}"><rect width="{_SIDE_PX:.0f}" height="{_SIDE_PX:.0f}"/></clipPath>',
        f'<g clip-path="url(#{mark}{tree.id})"><g fill="{_FAINT}">{dots}</g>',
        f'<circle cx="{middle:.1f}" cy="{middle:.1f}" r="{scale * tree.radius_m:.1f}" fill="none" stroke="{_FIT}" stroke-width="2"/>',
        f'<path d="M{middle - 5:.1f} {middle:.1f}h10M{middle:.1f} {middle - 5:.1f}v10" stroke="{_FIT}"/></g>',
        f'<path d="M8 {_SIDE_PX - 8:.0f}h{bar_px:.1f}" stroke="{_INK}" stroke-width="2"/>',
        f'<text x="8" y="{_SIDE_PX - 13:.0f}" fill="{_INK}">10 cm</text>',
        f'<text x="4" y="{_SIDE_PX + 15:.0f}" font-weight="600">{tree.id}: {200.0 * tree.radius_m:.1f} ± {200.0 * tree.sigma_radius_m:.1f} cm</text>',
        f'<text x="4" y="{_SIDE_PX + 31:.0f}" fill="{_FAINT}">at {tree.radius_height_m:.2f} m, {f"{len(slice_m)} points shown" if len(slice_m) else "no map points here"}</text>',
        "</svg>",
    ])  # fmt: skip


def _slice(points_m: NDArray[np.float32], centre: NDArray[np.float64], half_m: float) -> NDArray[np.float64]:
    """Return (M, 2) of the slice's points about ``centre``, at most a few hundred, evenly thinned."""
    if not len(points_m):
        return np.empty((0, 2))
    offset = points_m - centre.astype(np.float32)
    inside = (np.abs(offset[:, 2]) < _SLICE_HALF_M) & (np.abs(offset[:, :2]).max(axis=1) < half_m)
    found = offset[inside][:, :2].astype(np.float64)
    return found[:: max(1, len(found) // _MAX_POINTS)]


def filter_plots_svg(seen: Sightings, begin_ns: int | None = None) -> str:
    """Return the three filtered quantities over time: raw as dots, filtered as a line; empty when nothing was tracked.

    Seconds count from ``begin_ns``, else from the first of ``seen``.
    """
    tracked = seen[seen["tracking"]]
    if len(tracked) < 2:
        return ""
    seconds = 1e-9 * (tracked["stamp_ns"] - (seen["stamp_ns"][0] if begin_ns is None else begin_ns))
    breaks = begins(seen, seen["tracking"])
    rows = [
        ("x in the image (px)", 1.0, "image_x_px"),
        ("range (m)", 1.0, "range_m"),
        ("radius (cm)", 100.0, "radius_m"),
    ]
    # what was never measured (a source that tells no pixels) has no plot
    rows = [row for row in rows if np.isfinite([tracked[row[2]], tracked[f"raw_{row[2]}"]]).any()]
    plots = [
        _plot(k, name, seconds, factor * tracked[f"raw_{field}"], factor * tracked[field], breaks)
        for k, (name, factor, field) in enumerate(rows)
    ]
    height = len(rows) * (_PLOT_HEIGHT_PX + 24.0) + 22.0
    legend = (
        f'<g transform="translate({_LEFT_PX:.0f} {height - 6:.0f})"><circle cx="4" cy="-4" r="2" fill="{_RAW}"/><text x="12">measured in one frame</text>'
        f'<path d="M170 -4h22" stroke="{_FIT}" stroke-width="2"/><text x="198">filtered</text></g>'
    )
    head = f'<svg viewBox="0 0 {_PLOT_PX:.0f} {height:.0f}" role="img" aria-label="raw and filtered target" font-size="12">'
    return "\n".join([head, *plots, legend, "</svg>"])


def _plot(
    row: int,
    name: str,
    seconds: NDArray[np.float64],
    raw: NDArray[np.float64],
    filtered: NDArray[np.float64],
    breaks: NDArray[np.bool_],
) -> str:
    """Return one plot; its line begins anew at each of ``breaks``."""
    both = np.concatenate([raw, filtered])
    both = both[np.isfinite(both)]
    # a few wild raw values must not flatten the rest
    low, high = np.percentile(both, [1.0, 99.0]) if len(both) else (0.0, 1.0)
    spare = 0.08 * (high - low) + 1e-6
    low, high = low - spare, high + spare
    span_s = max(float(seconds[-1] - seconds[0]), 1e-6)
    top = row * (_PLOT_HEIGHT_PX + 24.0) + 16.0
    x = _LEFT_PX + (seconds - seconds[0]) / span_s * (_PLOT_PX - _LEFT_PX - 6.0)

    def y(values: NDArray[np.float64]) -> NDArray[np.float64]:
        return top + np.clip((high - values) / (high - low), 0.0, 1.0) * _PLOT_HEIGHT_PX

    step = max(1, len(x) // 1500)
    marks = zip(x[::step], y(raw)[::step], strict=True)
    dots = "".join(f'<circle cx="{a:.1f}" cy="{b:.1f}" r="1.6"/>' for a, b in marks if np.isfinite(b))
    bottom = top + _PLOT_HEIGHT_PX
    return "\n".join([
        f'<text x="{_LEFT_PX:.0f}" y="{top - 4:.0f}" font-weight="600">{name}</text>',
        f'<rect x="{_LEFT_PX:.0f}" y="{top:.0f}" width="{_PLOT_PX - _LEFT_PX - 6:.0f}" height="{_PLOT_HEIGHT_PX:.0f}" fill="#fff" stroke="#d5ddd6"/>',
        f'<text x="{_LEFT_PX - 6:.0f}" y="{top + 10:.0f}" text-anchor="end" fill="{_FAINT}">{high:.4g}</text>',
        f'<text x="{_LEFT_PX - 6:.0f}" y="{bottom:.0f}" text-anchor="end" fill="{_FAINT}">{low:.4g}</text>',
        f'<text x="{_PLOT_PX - 6:.0f}" y="{top - 4:.0f}" text-anchor="end" fill="{_FAINT}">{seconds[0]:.1f} to {seconds[-1]:.1f} s</text>',
        f'<g fill="{_RAW}">{dots}</g>',
        f'<path d="{_line(x, y(filtered), breaks)}" fill="none" stroke="{_FIT}" stroke-width="1.8"/>',
    ])  # fmt: skip


def _line(x: NDArray[np.float64], y: NDArray[np.float64], breaks: NDArray[np.bool_]) -> str:
    """Return the path's data, broken where another tree was tracked, or none for a while."""
    parts = []
    broken = True
    for a, b, new in zip(x, y, breaks, strict=True):
        broken = broken or bool(new)
        if np.isfinite(b):
            parts.append(f"{'M' if broken else 'L'}{a:.1f} {b:.1f}")
        broken = not np.isfinite(b)
    return "".join(parts)
