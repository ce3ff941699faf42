"""What a simulated forest consists of. The scene defines the truth; no detector has a say in it.

The world frame has z up and its origin on the ground below the aircraft's start. Lengths in metres.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from schemas.trees import MAX_SUITABLE_LEAN_RAD, MAX_SUITABLE_RADIUS_M, MIN_SUITABLE_RADIUS_M

Floats = NDArray[np.float64]

BREAST_HEIGHT_M = 1.3
MIN_FORK_HEIGHT_M = 1.0


@dataclass(frozen=True, slots=True)
class Wave:
    """One sinusoid of the ground's relief: ``amplitude_m sin(kx x + ky y + phase_rad)``."""

    amplitude_m: float
    kx: float
    ky: float
    phase_rad: float


@dataclass(frozen=True, slots=True)
class Ground:
    """Ground height as a function: a plane through the origin plus waves, zero at the origin."""

    slope_rad: float = 0.0
    slope_heading_rad: float = 0.0
    """Direction in which the ground rises."""
    waves: tuple[Wave, ...] = ()

    def height(self, x: ArrayLike, y: ArrayLike) -> Floats:
        """Return the ground's z at ``x, y`` (any matching shapes)."""
        x, y = np.asarray(x, dtype=float), np.asarray(y, dtype=float)
        gradient = math.tan(self.slope_rad)
        z = gradient * (math.cos(self.slope_heading_rad) * x + math.sin(self.slope_heading_rad) * y)
        for w in self.waves:
            z = z + w.amplitude_m * (np.sin(w.kx * x + w.ky * y + w.phase_rad) - math.sin(w.phase_rad))
        return np.asarray(z)

    def at(self, x: float, y: float) -> float:
        """Return the ground's z at one place."""
        return float(self.height(x, y))


@dataclass(frozen=True, slots=True)
class SceneTree:
    """A tree: a straight, tapered, bumpy trunk, branches and canopy above ``branch_start_m``."""

    x_m: float
    y_m: float
    z_m: float
    """Where the axis meets the ground."""
    axis: tuple[float, float, float]
    """Unit vector, upward."""
    radius_m: float
    """Mean radius at 1.3 m above the ground."""
    seed: int
    taper: float = 0.008
    """Loss of radius per metre of height."""
    bumps: float = 0.02
    """Amplitude of the bark's bumps as a share of the radius; their mean round the trunk is zero."""
    height_m: float = 8.0
    branch_start_m: float = 3.2
    fork_height_m: float | None = None

    @property
    def lean_rad(self) -> float:
        """Angle of the axis against the vertical."""
        return math.acos(min(1.0, self.axis[2]))

    @property
    def suitable(self) -> bool:
        """Radius 0.03..0.20 m, no fork below 1 m, lean at most 20 degrees."""
        forked = self.fork_height_m is not None and self.fork_height_m < MIN_FORK_HEIGHT_M
        return (
            MIN_SUITABLE_RADIUS_M <= self.radius_m <= MAX_SUITABLE_RADIUS_M
            and not forked
            and self.lean_rad <= MAX_SUITABLE_LEAN_RAD
        )

    @property
    def base(self) -> Floats:
        """Return where the axis meets the ground, (3,)."""
        return np.array([self.x_m, self.y_m, self.z_m])

    def centre_at(self, height_m: float) -> Floats:
        """Return the axis point at a height above the ground at the base, (3,)."""
        return self.base + np.array(self.axis) * (height_m / self.axis[2])

    def mean_radius(self, height_m: ArrayLike) -> Floats:
        """Return the mean radius at heights above ground: linear taper and a root flare below 0.3 m."""
        h = np.asarray(height_m, dtype=float)
        tapered = np.maximum(self.radius_m - self.taper * (h - BREAST_HEIGHT_M), 0.25 * self.radius_m)
        return np.asarray(tapered * (1.0 + 0.25 * np.exp(-np.maximum(h, 0.0) / 0.08)))


@dataclass(frozen=True, slots=True)
class Post:
    """An upright round post."""

    x_m: float
    y_m: float
    radius_m: float
    height_m: float


@dataclass(frozen=True, slots=True)
class Bush:
    """A ball of leaves on the ground, an ellipsoid of ``radius_m`` by ``height_m``."""

    x_m: float
    y_m: float
    radius_m: float
    height_m: float
    leaves: int
    seed: int


@dataclass(frozen=True, slots=True)
class Table:
    """A picnic table: a top on four round legs."""

    x_m: float
    y_m: float
    yaw_rad: float
    length_m: float = 1.4
    width_m: float = 0.8
    height_m: float = 0.75
    leg_radius_m: float = 0.035


@dataclass(frozen=True, slots=True)
class Person:
    """Somebody who stands and watches."""

    x_m: float
    y_m: float
    yaw_rad: float
    height_m: float = 1.75


@dataclass(frozen=True, slots=True)
class Backdrop:
    """What lies beyond the sensor's range: a ring of forest, and single trunks before it."""

    radius_m: float = 24.0
    height_m: float = 9.0
    trunks: tuple[SceneTree, ...] = ()
    """All further away than the camera can see depth, from anywhere on its path: not part of the truth."""


@dataclass(frozen=True, slots=True)
class Scene:
    """A whole simulated place."""

    name: str
    seed: int
    trees: tuple[SceneTree, ...]
    posts: tuple[Post, ...] = ()
    bushes: tuple[Bush, ...] = ()
    tables: tuple[Table, ...] = ()
    people: tuple[Person, ...] = ()
    ground: Ground = field(default_factory=Ground)
    backdrop: Backdrop = field(default_factory=Backdrop)
    start_yaw_rad: float = 0.0
    """The camera's first heading in the world."""

    @property
    def suitable_trees(self) -> tuple[SceneTree, ...]:
        """Return the trees that the mission may choose."""
        return tuple(tree for tree in self.trees if tree.suitable)

    @property
    def reachable_trees(self) -> tuple[SceneTree, ...]:
        """Return the suitable trees with a free place in front of them, and none in the line of sight to the start."""
        return tuple(tree for tree in self.suitable_trees if self._has_place(tree) and not self._hidden(tree))

    def things(self, but: SceneTree | None = None) -> list[tuple[float, float, float]]:
        """Return x, y and radius of all that stands here, ``but`` one tree."""
        found = [(t.x_m, t.y_m, t.radius_m) for t in self.trees if t is not but]
        found += [(p.x_m, p.y_m, p.radius_m) for p in self.posts]
        found += [(b.x_m, b.y_m, b.radius_m) for b in self.bushes]
        found += [(t.x_m, t.y_m, 0.5 * math.hypot(t.length_m, t.width_m)) for t in self.tables]
        return found + [(p.x_m, p.y_m, _PERSON_RADIUS_M) for p in self.people]

    def _has_place(self, tree: SceneTree) -> bool:
        things = self.things(tree)
        for k in range(_AZIMUTHS):
            angle = 2.0 * math.pi * k / _AZIMUTHS
            x, y = tree.x_m + _DOCK_M * math.cos(angle), tree.y_m + _DOCK_M * math.sin(angle)
            if all(math.hypot(x - a, y - b) - r >= _ROOM_M for a, b, r in things):
                return True
        return False

    def _hidden(self, tree: SceneTree) -> bool:
        """Whether something as tall as the camera flies hides the trunk's middle from the start."""
        length = math.hypot(tree.x_m, tree.y_m)
        for x, y, radius in [(t.x_m, t.y_m, t.radius_m) for t in self.trees if t is not tree]:
            along = (x * tree.x_m + y * tree.y_m) / length
            if 0.0 < along < length and abs(x * tree.y_m - y * tree.x_m) / length < radius:
                return True
        return False


_DOCK_M, _ROOM_M, _AZIMUTHS = 0.95, 0.60, 36
"""Where docking is, and the room that an aircraft of 0.35 m radius asks for there."""
_PERSON_RADIUS_M = 0.3
