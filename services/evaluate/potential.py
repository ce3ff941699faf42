"""The artificial potential field, as a rival to the planned way (Khatib 1986). Pure.

Attraction ``F_a = k (goal - p)``, of at most ``k`` metres per second; repulsion of every surface nearer than ``rho_0``
``F_r = eta (1/rho - 1/rho_0) / rho^2`` away from it. The aircraft flies along the sum, no faster than ``max_speed_m_s``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from services.common.geometry import Matrix
from services.navigator.path import Disc


@dataclass(frozen=True, slots=True)
class Field:
    """Its constants; metres, seconds."""

    attraction_per_s: float = 0.5
    repulsion: float = 0.05
    reach_m: float = 1.2
    """From a surface, for the aircraft's centre."""
    max_speed_m_s: float = 0.35


def velocity(p: Matrix, goal: Matrix, things: Sequence[Disc], field: Field) -> Matrix:
    """Return the velocity (2,) at ``p`` (2,); ``things`` are surfaces: ``keep_out_m`` is the radius of each."""
    out = field.attraction_per_s * (goal - p)
    norm = float(np.linalg.norm(out))
    if norm > field.max_speed_m_s:
        out = out * (field.max_speed_m_s / norm)
    for d in things:
        away = p - np.array([d.x_m, d.y_m])
        distance = float(np.linalg.norm(away))
        rho = max(distance - d.keep_out_m, 0.05)
        if rho < field.reach_m:
            out = out + field.repulsion * (1.0 / rho - 1.0 / field.reach_m) / rho**2 * away / max(distance, 1e-9)
    norm = float(np.linalg.norm(out))
    return out if norm <= field.max_speed_m_s else out * (field.max_speed_m_s / norm)
