"""The words of the finer map."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

BREAST_HEIGHT_M = 1.3


@dataclass(frozen=True, slots=True)
class StemPoints:
    """Raw points near one stem."""

    tree_id: int
    points_m: NDArray[np.float32] = field(repr=False)
    """(N, 3) in map."""
    frame: NDArray[np.int32] = field(repr=False)
    """(N,) which camera saw each: a row of the trajectory."""


@dataclass(frozen=True, slots=True)
class Section:
    """The stem at one height."""

    height_m: float
    """Above ground."""
    diameter_m: float
    sigma_m: float
    arc_rad: float
    points: int
    used: bool
    """Whether the taper function took it for good: above the root flare, near the others."""


@dataclass(frozen=True, slots=True)
class Stem:
    """One measured stem."""

    tree_id: int
    base_m: tuple[float, float, float]
    """Where the axis meets the ground, map."""
    axis: tuple[float, float, float]
    diameter_13_m: float
    """At 1.3 m, of the taper function; of the nearest height seen when 1.3 m is not within the sections."""
    sigma_13_m: float
    height_m: float
    """Height above ground at which ``diameter_13_m`` holds."""
    taper_m_per_m: float
    """Change of diameter per metre of height, negative upward."""
    sigma_taper: float
    sections: tuple[Section, ...]
    points: int
    frames: int
    """Frames that saw it."""
    suitable: bool
