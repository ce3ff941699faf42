"""Two leaning axes that meet near the ground are one forked tree, not two trees."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from services.detector.checks import axis_at
from services.detector.cylinders import Cylinder
from services.detector.model import Floats, Ground


@dataclass(frozen=True, slots=True)
class Fork:
    """Where the axes of two arms meet, upright frame."""

    first: int
    second: int
    at_m: Floats
    height_m: float
    """Above ground."""


def _closest(a: Cylinder, b: Cylinder) -> tuple[float, float]:
    """Return the height z at which two axes are nearest in the plan, and that distance."""
    sa, sb = a.axis[:2] / a.axis[2], b.axis[:2] / b.axis[2]
    apart = (b.at_m[:2] - sb * b.at_m[2]) - (a.at_m[:2] - sa * a.at_m[2])
    spread = sb - sa
    steep = float(spread @ spread)
    if steep < 1e-9:
        return -np.inf, float(np.linalg.norm(apart))
    z = -float(spread @ apart) / steep
    return z, float(np.linalg.norm(apart + spread * z))


def find_forks(cylinders: list[Cylinder], ground: Ground, min_angle_rad: float = 0.14) -> list[Fork]:
    """Return pairs of arms: axes at an angle that meet below both arms, between a little under ground and 2 m above.

    Trees that merely stand close have axes that pass each other, or meet far below the ground.
    """
    forks = []
    for i, a in enumerate(cylinders):
        for j in range(i + 1, len(cylinders)):
            b = cylinders[j]
            if float(np.arccos(min(1.0, float(a.axis @ b.axis)))) < min_angle_rad:
                continue
            z, distance = _closest(a, b)
            if distance > 0.5 * (a.radius_m + b.radius_m) + 0.02 or z > min(a.z_low_m, b.z_low_m) + 0.25:
                continue
            at = 0.5 * (axis_at(a, z) + axis_at(b, z))
            height = z - ground.height_m(float(at[0]), float(at[1]))
            if -0.15 <= height <= 2.0:
                forks.append(Fork(i, j, at, height))
    return forks
