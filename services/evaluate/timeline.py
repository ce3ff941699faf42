"""A mission over time as inline SVG: a bar of its states, and the distance to the tree below it. Pure."""

from __future__ import annotations

import html
import itertools
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from schemas.navigation import MissionState
from services.evaluate.sightings import Sightings, begins, sightings

_WIDTH_PX, _BAR_PX, _PLOT_PX, _LEFT_PX = 720.0, 34.0, 130.0, 62.0
_INK, _FAINT, _LINE, _BAND = "#1d2a20", "#5c6b60", "#15803d", "#bbf7d0"
_COLOURS = {
    "take_off": "#bfdbfe", "scan": "#99f6e4", "select": "#99f6e4", "face": "#c7d2fe", "approach": "#a5b4fc", "dock": "#86efac",
    "docked": "#22c55e", "undock": "#c7d2fe", "return": "#bfdbfe", "landing": "#bfdbfe", "landed": "#e5e7eb", "hold": "#fcd34d",
    "failed": "#fca5a5", "released": "#fca5a5",
}  # fmt: skip
_OTHER = "#e5e7eb"
_DOCK_M = (0.85, 1.00)
"""Where a mission is docked: camera to trunk axis."""
_LETTER_PX, _LINE_PX = 6.8, 13.0


def timeline_svg(states: Sequence[MissionState], seen: Sightings | None = None) -> str:
    """Return the picture; empty when fewer than two states were told."""
    if len(states) < 2 or states[-1].stamp_ns <= states[0].stamp_ns:
        return ""
    begin_ns, end_ns = states[0].stamp_ns, states[-1].stamp_ns
    scale = (_WIDTH_PX - _LEFT_PX - 6.0) / (end_ns - begin_ns)
    seen = sightings() if seen is None else seen
    shown = (
        seen["tracking"] & np.isfinite(seen["range_m"]) & (begin_ns <= seen["stamp_ns"]) & (seen["stamp_ns"] <= end_ns)
    )
    plotted = np.count_nonzero(shown) > 1
    height = 20.0 + _BAR_PX + (18.0 + _PLOT_PX if plotted else 0.0) + 22.0
    parts = [
        f'<svg viewBox="0 0 {_WIDTH_PX:.0f} {height:.0f}" role="img" aria-label="states over time" font-size="12">'
    ]
    for a, b in itertools.pairwise(states):
        x, wide = _LEFT_PX + scale * (a.stamp_ns - begin_ns), scale * (b.stamp_ns - a.stamp_ns)
        word = a.state.replace("_", " ")
        parts.append(
            f'<rect x="{x:.1f}" y="20" width="{max(wide, 0.5):.1f}" height="{_BAR_PX:.0f}" fill="{_COLOURS.get(a.state, _OTHER)}" '
            f'stroke="#fff"><title>{html.escape(f"{word}: {a.reason}")}</title></rect>'
        )
        if wide > _LETTER_PX * len(word) + 6.0:
            parts.append(f'<text x="{x + 5:.1f}" y="{24 + _BAR_PX / 2:.0f}" fill="{_INK}">{html.escape(word)}</text>')
    parts += _seconds(1e-9 * (end_ns - begin_ns), 1e9 * scale, height)
    if plotted:
        x = _LEFT_PX + scale * (seen["stamp_ns"][shown] - begin_ns)
        parts += _distances(x, seen["range_m"][shown], begins(seen, shown), 20.0 + _BAR_PX + 18.0)
    return "\n".join([*parts, "</svg>"])


def _seconds(span_s: float, px_per_s: float, height: float) -> list[str]:
    """Return a mark every so many seconds, about ten of them."""
    step = next(s for s in (1, 2, 5, 10, 20, 30, 60, 120, 300, 600, 1800, 3600, 10**9) if s * px_per_s >= 55.0)
    parts = []
    for k in range(int(span_s // step) + 1):
        x = _LEFT_PX + k * step * px_per_s
        parts.append(
            f'<line x1="{x:.1f}" x2="{x:.1f}" y1="16" y2="{height - 18:.0f}" stroke="{_INK}" stroke-opacity="0.12"/>'
        )
        parts.append(f'<text x="{x:.1f}" y="{height - 5:.0f}" text-anchor="middle" fill="{_FAINT}">{k * step} s</text>')
    return parts


def _distances(
    x: NDArray[np.float64], ranges_m: NDArray[np.float64], begun: NDArray[np.bool_], top: float
) -> list[str]:
    """Return the distance to the tree over time, with the band in which it is docked; the line begins anew at ``begun``."""
    high = max(1.3, float(np.percentile(ranges_m, 99.0)) * 1.05)
    low = min(0.7, float(ranges_m.min()))

    def y(metres: float) -> float:
        return top + (high - min(high, metres)) / (high - low) * _PLOT_PX

    # the ends of each piece stay when the rest is thinned
    drawn = begun | np.append(begun[1:], True)
    drawn[:: max(1, len(x) // 1500)] = True
    points = zip(begun[drawn], x[drawn].tolist(), ranges_m[drawn].tolist(), strict=True)
    path = [f"{'M' if new else 'L'}{a:.1f} {y(metres):.1f}" for new, a, metres in points]
    wide = _WIDTH_PX - _LEFT_PX - 6.0
    labels: list[float] = []
    for metres in (_DOCK_M[1], high, low, _DOCK_M[0]):  # those that matter first; none upon another
        if all(abs(y(metres) - y(other)) >= _LINE_PX for other in labels):
            labels.append(metres)
    return [
        f'<rect x="{_LEFT_PX:.0f}" y="{y(_DOCK_M[1]):.1f}" width="{wide:.0f}" height="{y(_DOCK_M[0]) - y(_DOCK_M[1]):.1f}" fill="{_BAND}"/>',
        f'<rect x="{_LEFT_PX:.0f}" y="{top:.0f}" width="{wide:.0f}" height="{_PLOT_PX:.0f}" fill="none" stroke="#d5ddd6"/>',
        *(f'<text x="{_LEFT_PX - 6:.0f}" y="{y(m) + 4:.1f}" text-anchor="end" fill="{_FAINT}">{m:.2f} m</text>' for m in labels),
        f'<text x="{_LEFT_PX:.0f}" y="{top - 5:.0f}" font-weight="600">distance to the tree, green where it is docked ({_DOCK_M[0]:.2f} to {_DOCK_M[1]:.2f} m)</text>',
        f'<path d="{"".join(path)}" fill="none" stroke="{_LINE}" stroke-width="1.8"/>',
    ]  # fmt: skip
