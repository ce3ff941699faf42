"""Two leaning axes that meet near the ground are one forked tree, not two trees."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from services.detector.cylinders import Cylinder
from services.detector.model import Floats, Ground
from services.detector.stacks import Stack

BENT = "lie on one line: a fork, or a bush"
"""How the reason ends for which a bent candidate is dropped."""
_MIN_ANGLE_RAD = 0.14
_SEEN_FROM_M = 0.15
"""An arm begins at least so far above where its stem is seen to begin."""
_HIDDEN_M, _CLEAR_M = 0.6, 0.1
"""A line that is no trunk by itself tells a fork only to an arm whose lowest 0.6 m is hidden, and meets it below both."""


@dataclass(frozen=True, slots=True)
class Arm:
    """An axis that may be one arm of a fork, upright frame."""

    at_m: Floats
    axis: Floats
    radius_m: float
    z_low_m: float
    z_high_m: float
    bent: bool = False
    """Of slices that do not lie on one line: a fork's other arm, or a bush."""

    @classmethod
    def of_cylinder(cls, c: Cylinder) -> Arm:
        """Return the arm of a fitted cylinder."""
        return cls(c.at_m, c.axis, c.radius_m, c.z_low_m, c.z_high_m)

    @classmethod
    def of_stack(cls, s: Stack, *, bent: bool = False) -> Arm:
        """Return the arm that a line of slices shows."""
        axis = np.array([s.slope[0], s.slope[1], 1.0])
        return cls(s.at_m, axis / np.linalg.norm(axis), s.radius_m, s.z_low_m, s.z_high_m, bent)

    def point(self, z_m: float) -> Floats:
        """Return the axis point (3,) at a height."""
        return self.at_m + self.axis * ((z_m - self.at_m[2]) / self.axis[2])


@dataclass(frozen=True, slots=True)
class Stem:
    """A line of slices that is no trunk by itself and may be what an arm grows from."""

    line: Arm
    bent: bool
    """Laid through a stem and an arm, so that it also runs beside the other arm."""


@dataclass(frozen=True, slots=True)
class Fork:
    """Where the axes of two arms meet, upright frame."""

    first: int
    second: int
    at_m: Floats
    height_m: float
    """Above ground."""


def _closest(a: Arm, b: Arm) -> tuple[float, float]:
    """Return the height z at which two axes are nearest in the plan, and that distance."""
    sa, sb = a.axis[:2] / a.axis[2], b.axis[:2] / b.axis[2]
    apart = (b.at_m[:2] - sb * b.at_m[2]) - (a.at_m[:2] - sa * a.at_m[2])
    spread = sb - sa
    steep = float(spread @ spread)
    if steep < 1e-9:
        return -np.inf, float(np.linalg.norm(apart))
    z = -float(spread @ apart) / steep
    return z, float(np.linalg.norm(apart + spread * z))


def _angle(a: Arm, b: Arm) -> float:
    return float(np.arccos(min(1.0, float(a.axis @ b.axis))))


def find_stem(arm: Arm, below: Sequence[Stem]) -> tuple[int, float] | None:
    """Return which axis is the stem that an arm grows from, and the height z where the two meet; None when it stands alone.

    A single leaning trunk is seen down to where slicing begins, or what hides it there is no stem. Where another axis stands
    under the arm's lower end, meets it and points elsewhere, the arm is a fork's, though its fellow is hidden.
    """
    for k, candidate in enumerate(below):
        stem = candidate.line
        middle = stem.z_low_m if candidate.bent else 0.5 * (stem.z_low_m + stem.z_high_m)
        if arm.z_low_m < max(stem.z_low_m + _SEEN_FROM_M, middle) or _angle(arm, stem) < _MIN_ANGLE_RAD:
            continue
        if not 0.7 < stem.radius_m / arm.radius_m < 2.5:
            continue
        z = float(np.clip(_closest(arm, stem)[0], stem.z_low_m, max(stem.z_high_m, arm.z_low_m)))
        apart = float(np.linalg.norm((arm.point(z) - stem.point(z))[:2]))
        if apart < 0.5 * (arm.radius_m + stem.radius_m) + 0.02:
            return k, z
    return None


def find_forks(arms: list[Arm], sure: int, ground: Ground) -> list[Fork]:
    """Return pairs of arms: axes at an angle that meet between a little under ground and 2 m above, below what is seen.

    Only the first ``sure`` arms are trunks; the others can be the second arm of one of those. Two trunks may meet inside
    the lower one's height: its stem is then seen, and no two trees go through each other. Trees that merely stand close
    have axes that pass each other, or meet far below the ground.
    """
    forks = []
    for i, a in enumerate(arms[:sure]):
        for j in range(i + 1, len(arms)):
            b = arms[j]
            if not 0.5 < a.radius_m / b.radius_m < 2.0:
                continue
            if _angle(a, b) < _MIN_ANGLE_RAD:
                continue
            z, distance = _closest(a, b)
            if distance > 0.5 * (a.radius_m + b.radius_m) + 0.02:
                continue
            lower, upper = sorted((a.z_low_m, b.z_low_m))
            if z > (upper if j < sure else lower) + 0.25:
                continue
            at = 0.5 * (a.point(z) + b.point(z))
            foot_m = ground.height_m(float(at[0]), float(at[1]))
            if b.bent and (lower < z + _CLEAR_M or a.z_low_m < foot_m + _HIDDEN_M):
                continue
            if -0.15 <= z - foot_m <= 2.0:
                forks.append(Fork(i, j, at, z - foot_m))
    return forks
