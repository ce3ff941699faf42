"""Plants a scene from a recipe: places things where there is room and none hides another from the start."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from services.simulator.scene import Backdrop, Bush, Ground, Person, Post, Scene, SceneTree, Table, Wave

FREE_RADIUS_M = 1.5
"""Nothing stands nearer to the start than this."""
FAR_TRUNKS_M = (11.5, 20.0)
"""Background trunks stand so far out that no depth reaches them, even from a docked aircraft."""
_ATTEMPTS = 400


@dataclass(frozen=True, slots=True)
class Recipe:
    """What a scene is made of; counts, and the ranges they are drawn from."""

    trees: int
    radius_m: tuple[float, float] = (0.05, 0.18)
    distance_m: tuple[float, float] = (2.2, 4.8)
    spacing_m: float = 1.2
    """Smallest distance between the surfaces of two things."""
    max_lean_rad: float = math.radians(5.0)
    slope_rad: float = 0.0
    relief_m: float = 0.08
    posts: int = 0
    bushes: int = 1
    undergrowth: int = 0
    tables: int = 0
    people: int = 0
    thick: int = 0
    """Trunks of ``thick_radius_m``, not suitable."""
    thick_radius_m: tuple[float, float] = (0.26, 0.45)
    forked: int = 0
    """Trunks that fork below 1 m, not suitable."""
    trios: int = 0
    """Groups of three trunks with gaps of 0.15 to 0.3 m between their surfaces."""
    pairs: int = 0
    """Two trunks whose axes stand 0.5 m apart."""


class _Builder:
    """Places things one after another where there is room and no earlier thing hides them from the start."""

    def __init__(self, seed: int, recipe: Recipe) -> None:
        self.rng = np.random.default_rng([seed, 101])
        self.recipe = recipe
        self.ground = _ground(self.rng, recipe)
        self.trees: list[SceneTree] = []
        self._taken: list[tuple[float, float, float]] = []

    def spot(self, radius_m: float, spacing_m: float | None = None, distance_m: tuple[float, float] | None = None
             ) -> tuple[float, float]:  # fmt: skip
        """Return a free place for something of ``radius_m`` and take it."""
        gap = self.recipe.spacing_m if spacing_m is None else spacing_m
        near, far = self.recipe.distance_m if distance_m is None else distance_m
        for attempt in range(_ATTEMPTS):
            r, heading = self.rng.uniform(near, far), self.rng.uniform(-math.pi, math.pi)
            x, y = r * math.cos(heading), r * math.sin(heading)
            relaxed = gap * (1.0 - 0.7 * attempt / _ATTEMPTS)
            if r - radius_m > FREE_RADIUS_M and self._free(x, y, radius_m, relaxed):
                break
        self.take(x, y, radius_m)
        return x, y

    def take(self, x: float, y: float, radius_m: float) -> None:
        """Mark a place as used."""
        self._taken.append((x, y, radius_m))

    def _free(self, x: float, y: float, radius_m: float, gap_m: float) -> bool:
        for other_x, other_y, other_radius in self._taken:
            if math.hypot(x - other_x, y - other_y) < radius_m + other_radius + gap_m:
                return False
            bearing = math.remainder(math.atan2(y, x) - math.atan2(other_y, other_x), 2.0 * math.pi)
            width = radius_m / math.hypot(x, y) + other_radius / math.hypot(other_x, other_y)
            if abs(bearing) < width + math.radians(2.0):
                return False
        return True

    def tree(self, x: float, y: float, radius_m: float, lean_rad: float | None = None, fork_m: float | None = None
             ) -> None:  # fmt: skip
        """Add a tree at a place already taken."""
        lean = self.rng.uniform(0.0, self.recipe.max_lean_rad) if lean_rad is None else lean_rad
        self.trees.append(_tree(self.rng, self.ground, x, y, radius_m, lean, fork_m))

    def single(self, radius_m: float) -> None:
        """Add a tree of a radius somewhere; thin ones near enough to be a dozen pixels wide."""
        near, far = self.recipe.distance_m
        far = max(near + 0.3, min(far, radius_m / 0.0145))
        self.tree(*self.spot(radius_m, distance_m=(near, far)), radius_m)

    def group(self, count: int, gaps_m: tuple[float, float] | None) -> None:
        """Add trunks in a row across the line of sight, by gaps between surfaces or axes 0.5 m apart."""
        x, y = self.spot(0.8, distance_m=(2.8, 3.6))
        across = math.atan2(y, x) + math.pi / 2 + self.rng.uniform(-0.5, 0.5)
        radii = self.rng.uniform(max(0.07, self.recipe.radius_m[0]), 0.13, count)
        offset, previous = -0.45 if count == 3 else -0.25, 0.0
        for index, radius in enumerate(radii):
            if index:
                offset += 0.5 if gaps_m is None else previous + radius + self.rng.uniform(*gaps_m)
            self.tree(x + offset * math.cos(across), y + offset * math.sin(across), float(radius), lean_rad=0.0)
            previous = float(radius)

    def build(self, name: str, seed: int) -> Scene:
        """Return the finished scene."""
        rng, recipe = self.rng, self.recipe
        for _ in range(recipe.trios):
            self.group(3, (0.17, 0.28))
        for _ in range(recipe.pairs):
            self.group(2, None)
        for _ in range(recipe.trees - 3 * recipe.trios - 2 * recipe.pairs):
            self.single(float(rng.uniform(*recipe.radius_m)))
        for _ in range(recipe.thick):
            radius = float(rng.uniform(*recipe.thick_radius_m))
            self.tree(*self.spot(radius, distance_m=(3.0, 4.8)), radius)
        for _ in range(recipe.forked):
            self.tree(*self.spot(0.35), float(rng.uniform(0.08, 0.15)), fork_m=float(rng.uniform(0.4, 0.8)))
        tables = tuple(Table(*self.spot(0.8), yaw_rad=float(rng.uniform(0, math.pi))) for _ in range(recipe.tables))
        people = tuple(Person(*self.spot(0.3), yaw_rad=float(rng.uniform(0, math.pi))) for _ in range(recipe.people))
        posts = tuple(Post(*self.spot(0.06), radius_m=float(rng.uniform(0.035, 0.06)),
                           height_m=float(rng.uniform(0.8, 1.3))) for _ in range(recipe.posts))  # fmt: skip
        return Scene(
            name=name, seed=seed, trees=tuple(self.trees), posts=posts, bushes=self._bushes(), tables=tables,
            people=people, ground=self.ground, backdrop=_backdrop(rng, self.ground),
            start_yaw_rad=float(rng.uniform(-math.pi, math.pi)),
        )  # fmt: skip

    def _bushes(self) -> tuple[Bush, ...]:
        rng = self.rng
        bushes = []
        for _ in range(self.recipe.bushes):
            radius = float(rng.uniform(0.25, 0.5))
            height = float(rng.uniform(0.5, 1.0))
            bushes.append(Bush(*self.spot(radius), radius, height, int(1400 * radius * height / 0.3), _seed(rng)))
        for _ in range(self.recipe.undergrowth):
            radius, height = float(rng.uniform(0.15, 0.4)), float(rng.uniform(0.2, 0.65))
            r, heading = FREE_RADIUS_M + radius + 4.5 * math.sqrt(rng.uniform()), rng.uniform(-math.pi, math.pi)
            place = float(r * math.cos(heading)), float(r * math.sin(heading))
            bushes.append(Bush(*place, radius, height, int(900 * radius * height / 0.12), _seed(rng)))
        return tuple(bushes)


def _seed(rng: np.random.Generator) -> int:
    return int(rng.integers(0, 2**31))


def _ground(rng: np.random.Generator, recipe: Recipe) -> Ground:
    waves = []
    for _ in range(7):
        length, heading = rng.uniform(1.8, 7.0), rng.uniform(0.0, 2.0 * math.pi)
        k = 2.0 * math.pi / length
        amplitude = recipe.relief_m * min(1.0, length / 5.0) / math.sqrt(3.5)
        waves.append(Wave(amplitude, k * math.cos(heading), k * math.sin(heading), rng.uniform(0.0, 2.0 * math.pi)))
    return Ground(recipe.slope_rad, float(rng.uniform(-math.pi, math.pi)), tuple(waves))


def _tree(
    rng: np.random.Generator, ground: Ground, x: float, y: float, radius_m: float, lean_rad: float, fork_m: float | None
) -> SceneTree:
    heading = rng.uniform(-math.pi, math.pi)
    axis = (math.sin(lean_rad) * math.cos(heading), math.sin(lean_rad) * math.sin(heading), math.cos(lean_rad))
    return SceneTree(
        x_m=x, y_m=y, z_m=ground.at(x, y), axis=axis, radius_m=radius_m, seed=_seed(rng),
        taper=float(rng.uniform(0.03, 0.07)) * radius_m, bumps=float(rng.uniform(0.01, 0.03)),
        height_m=float(rng.uniform(6.0, 9.0)), branch_start_m=float(rng.uniform(3.1, 3.8)), fork_height_m=fork_m,
    )  # fmt: skip


def _backdrop(rng: np.random.Generator, ground: Ground) -> Backdrop:
    trunks = []
    for index in range(26):
        heading = 2.0 * math.pi * (index + rng.uniform(-0.4, 0.4)) / 26
        r = rng.uniform(*FAR_TRUNKS_M)
        x, y = float(r * math.cos(heading)), float(r * math.sin(heading))
        lean = float(rng.uniform(0.0, 0.1))
        trunks.append(_tree(rng, ground, x, y, float(rng.uniform(0.08, 0.25)), lean, None))
    return Backdrop(trunks=tuple(trunks))


def build(name: str, seed: int, recipe: Recipe) -> Scene:
    """Return the scene that a recipe and a seed give; the same ones give the same scene."""
    return _Builder(seed, recipe).build(name, seed)
