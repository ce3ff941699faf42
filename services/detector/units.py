"""The unit of a cloud's coordinates, where they cannot be metres or make no sense as such."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from services.detector.config import DetectorConfig
from services.detector.model import Floats
from services.detector.vertical import Vertical, find_vertical

Unit = Literal["m", "cm", "mm", "ft"]
UNITS: tuple[Unit, ...] = get_args(Unit)
METRES: dict[Unit, float] = {"m": 1.0, "cm": 0.01, "mm": 0.001, "ft": 0.3048}
NAMES: dict[Unit, str] = {"m": "metres", "cm": "centimetres", "mm": "millimetres", "ft": "feet"}

_SPARSEST_M = 0.5
"""Points of a cloud that shows trunks are nearer to each other than this."""
_THICK_M = 0.33
"""Median radius of trunks from which on the unit is doubted: 1 ft read as 1 m."""


@dataclass(frozen=True, slots=True)
class Scaled:
    """A unit, the vertical found with it, and a line that says so (empty for plain metres)."""

    unit: Unit
    vertical: Vertical
    note: str


def find_unit(points: Floats, config: DetectorConfig | None = None) -> Scaled:
    """Return the unit in which the cloud looks most like trees.

    Metres stay unless the points then lie too far apart for any trunk to show. Where the unit is only doubtful (no trunk
    shows in metres but some in another unit, or all are three times too thick) it is asked about, not changed.
    """
    metres = find_vertical(points, config)
    spacing = typical_spacing(points)
    if spacing < _SPARSEST_M and metres.score > 0.0:
        return Scaled("m", metres, _thick_note(points, metres, config))
    unit, vertical = max((_in(unit, points, config) for unit in UNITS[1:]), key=lambda found: found[1].score)
    if vertical.score <= max(metres.score, 0.0):
        return Scaled("m", metres, "")
    if spacing < _SPARSEST_M:
        note = f"no trunk shows in metres, some would in {NAMES[unit]}: --units {unit} reads them so"
        return Scaled("m", metres, note)
    why = f"points are {spacing:.3g} apart"
    note = f"the coordinates look like {NAMES[unit]}, not metres ({why}): read as {NAMES[unit]}; --units m refuses that"
    return Scaled(unit, vertical, note)


def typical_spacing(points: Floats) -> float:
    """Return the median distance of a sample of points to their nearest neighbour, in the cloud's unit."""
    from scipy.spatial import cKDTree

    few = points[:: max(1, len(points) // 400_000)]
    if len(few) < 2:
        return 0.0
    distance = cKDTree(few).query(few[:: max(1, len(few) // 500)], k=2)[0][:, 1]
    # a sample of a surface is sparser than the surface by the root of its share
    return float(np.median(distance) / np.sqrt(max(1.0, len(points) / len(few))))


def _in(unit: Unit, points: Floats, config: DetectorConfig | None) -> tuple[Unit, Vertical]:
    scaled = points * METRES[unit]
    extent = float(np.ptp(np.percentile(scaled, [1.0, 99.0], axis=0), axis=0).max())
    if not 0.3 < extent < 5_000.0:
        return unit, Vertical((0.0, 0.0, 1.0), "", 0.0)
    return unit, find_vertical(scaled, config)


def _thick_note(points: Floats, metres: Vertical, config: DetectorConfig | None) -> str:
    if metres.median_radius_m < _THICK_M:
        return ""
    feet = find_vertical(points * METRES["ft"], config)
    if feet.score < 0.8 * metres.score:
        return ""
    return f"trunks of {2 * metres.median_radius_m:.2f} m diameter: are these feet? --units ft reads them so"
