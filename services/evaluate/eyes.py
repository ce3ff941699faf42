"""What the live guard would see without rendering: round things of the scene, from above, as a view. Pure.

Every column of the camera is a ray in the plane; the nearest thing it meets gives a few points, one above the other.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from services.common.geometry import Matrix, rotation_z
from services.navigator.guard import TRUSTED_M, Fan, View

_COLUMNS = 80
_HALF_VIEW_RAD = float(np.radians(32.0))
_HEIGHTS_M = (-0.2, -0.1, 0.0, 0.1, 0.2)
_NEAREST_M, _FARTHEST_M = 0.5, 6.0
_SIGMA_SHARE = 0.002
"""Depth noise grows with the square of the distance: this times z squared, about design.md section 8's."""


@dataclass(frozen=True, slots=True)
class Round:
    """Something upright and round, as high as the aircraft flies: a trunk, a person, a bush."""

    x_m: float
    y_m: float
    radius_m: float


def see(
    things: Sequence[Round], true_m: Matrix, true_yaw_rad: float, believed_m: Matrix, believed_yaw_rad: float,
    stamp_ns: int, map_key: tuple[str, int], rng: np.random.Generator | None = None,
) -> View:  # fmt: skip
    """Return the view from a true place (2,) and heading, told in the map where they are believed to be others.

    ``believed_m`` (3,). Without ``rng`` there is no noise.
    """
    beside = np.linspace(-_HALF_VIEW_RAD, _HALF_VIEW_RAD, _COLUMNS)
    azimuth = true_yaw_rad + beside
    hit = np.full(_COLUMNS, np.inf)
    for t in things:
        offset = np.array([t.x_m, t.y_m]) - true_m
        along = offset[0] * np.cos(azimuth) + offset[1] * np.sin(azimuth)
        aside2 = float(offset @ offset) - along**2
        within = (along > 0.0) & (aside2 < t.radius_m**2)
        reach = along - np.sqrt(np.maximum(t.radius_m**2 - aside2, 0.0))
        hit = np.where(within & (reach < hit), np.maximum(reach, 0.0), hit)
    if rng is not None:
        hit = hit + rng.normal(0.0, 1.0, _COLUMNS) * _SIGMA_SHARE * np.minimum(hit, _FARTHEST_M) ** 2
    blind = hit < _NEAREST_M
    seen = ~blind & (hit < _FARTHEST_M)
    ranges, angles = hit[seen], azimuth[seen]
    flat = np.stack([ranges * np.cos(angles), ranges * np.sin(angles)], axis=1)
    points = np.concatenate([np.column_stack([flat, np.full(len(flat), h)]) for h in _HEIGHTS_M])
    R = rotation_z(believed_yaw_rad - true_yaw_rad)
    free = np.where(blind, 0.0, np.clip(hit - 0.1, 0.0, TRUSTED_M))
    fan = Fan(azimuth + believed_yaw_rad - true_yaw_rad, free)
    return View(stamp_ns, points @ R.T, fan, believed_m.copy(), map_key=map_key)
