"""The table of ``treedock detect``: fits 80 columns, and no cell is ever cut or wrapped."""

from __future__ import annotations

import math
from collections.abc import Sequence

from services.detector.model import Trunk

_HEAD = ("id", "x m", "y m", "z m", "diam cm", "±", "at m", "lean°", "seen m", "arc°", "conf", "")


def trunk_table(trunks: Sequence[Trunk], points: int) -> str:
    """Return a title and one line per trunk, columns as wide as their contents."""
    if not trunks:
        return f"no trees in {points} points"
    rows = [_HEAD, *(_cells(i + 1, trunk) for i, trunk in enumerate(trunks))]
    widths = [max(len(row[column]) for row in rows) for column in range(len(_HEAD) - 1)]
    lines = [
        " ".join([*(cell.rjust(width) for cell, width in zip(row[:-1], widths, strict=True)), row[-1]]).rstrip()
        for row in rows
    ]
    title = f"{len(trunks)} {'tree' if len(trunks) == 1 else 'trees'} in {points} points"
    return "\n".join([title, lines[0], "-" * max(map(len, lines)), *lines[1:]])


def _cells(number: int, t: Trunk) -> tuple[str, ...]:
    return (
        str(number), *(f"{v:.2f}" for v in t.base_m), f"{200 * t.radius_m:.1f}", f"{200 * t.sigma_radius_m:.1f}",
        f"{t.radius_height_m:.1f}", f"{math.degrees(t.lean_rad):.0f}", f"{t.height_seen_m:.1f}",
        f"{math.degrees(t.arc_rad):.0f}", f"{t.confidence:.2f}", t.remark,
    )  # fmt: skip
