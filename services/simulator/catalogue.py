"""Scenes by name: ten with a single tree, ten with several, hard ones, and fresh random ones of each kind."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Literal, get_args

import numpy as np

from services.common.errors import InputError
from services.simulator.planting import Recipe, build
from services.simulator.scene import Scene

Kind = Literal["single", "multi", "slope", "undergrowth", "close", "lean", "mission"]
KINDS: tuple[Kind, ...] = get_args(Kind)


def _catalogue() -> dict[str, tuple[int, Recipe]]:
    table: dict[str, tuple[int, Recipe]] = {}
    for i in range(10):
        radius = 0.05 + 0.015 * i
        table[f"single-{i + 1:02d}"] = (
            1000 + i,
            Recipe(1, radius_m=(radius, radius + 0.01), posts=i % 3, bushes=1 + i % 2, relief_m=0.05 + 0.01 * i),
        )
    two, three = Recipe(2), Recipe(3)
    multi = (
        two, dataclasses.replace(two, posts=2), dataclasses.replace(two, bushes=3),
        dataclasses.replace(three, trios=1), dataclasses.replace(two, tables=1), dataclasses.replace(two, thick=1, thick_radius_m=(0.4, 0.4)),
        dataclasses.replace(two, relief_m=0.12, posts=1), dataclasses.replace(two, forked=1),
        dataclasses.replace(two, max_lean_rad=math.radians(10.0)), dataclasses.replace(three, bushes=2, posts=1),
    )  # fmt: skip
    for i, recipe in enumerate(multi):
        table[f"multi-{i + 1:02d}"] = (2000 + i, recipe)
    return table | _hard()


def _hard() -> dict[str, tuple[int, Recipe]]:
    radians = math.radians
    return {
        "hard-slope-1": (3000, Recipe(2, slope_rad=radians(12.0))),
        "hard-slope-2": (3001, Recipe(3, slope_rad=radians(18.0), posts=1)),
        "hard-slope-3": (3002, Recipe(3, slope_rad=radians(25.0))),
        "hard-undergrowth-1": (3010, Recipe(2, undergrowth=40)),
        "hard-undergrowth-2": (3011, Recipe(3, undergrowth=70, bushes=3)),
        "hard-close-1": (3020, Recipe(3, pairs=1)),
        "hard-close-2": (3021, Recipe(4, pairs=2, bushes=0)),
        "hard-lean-1": (3030, Recipe(2, max_lean_rad=radians(20.0))),
        "hard-lean-2": (3031, Recipe(3, max_lean_rad=radians(30.0))),
        "hard-people-1": (3040, Recipe(2, people=2, tables=1)),
    }


CATALOGUE: dict[str, tuple[int, Recipe]] = _catalogue()
"""Seed and recipe of each named scene."""

SINGLE: tuple[str, ...] = tuple(name for name in CATALOGUE if name.startswith("single-"))
MULTI: tuple[str, ...] = tuple(name for name in CATALOGUE if name.startswith("multi-"))
HARD: tuple[str, ...] = tuple(name for name in CATALOGUE if name.startswith("hard-"))


def random_recipe(seed: int, kind: Kind, trees: int | None = None) -> Recipe:
    """Return a recipe drawn for a kind of scene; ``trees`` sets the number of suitable trees asked for."""
    rng = np.random.default_rng([seed, 202, KINDS.index(kind)])

    def upto(n: int) -> int:
        return int(rng.integers(0, n + 1))

    common = Recipe(1, relief_m=float(rng.uniform(0.04, 0.14)), posts=upto(2), bushes=upto(3))
    count = trees if trees is not None else int(rng.integers(2, 5))
    makers: dict[Kind, Callable[[], Recipe]] = {
        "single": lambda: dataclasses.replace(common, trees=trees or 1),
        "multi": lambda: dataclasses.replace(common, trees=count, tables=upto(1), thick=upto(1), forked=upto(1)),
        "slope": lambda: dataclasses.replace(common, trees=count, slope_rad=math.radians(float(rng.uniform(8, 25)))),
        "undergrowth": lambda: dataclasses.replace(common, trees=count, undergrowth=int(rng.integers(30, 80))),
        "close": lambda: dataclasses.replace(common, trees=max(count, 3), pairs=0, trios=1) if upto(1) else
        dataclasses.replace(common, trees=max(count, 2), pairs=1),
        "lean": lambda: dataclasses.replace(common, trees=count, max_lean_rad=math.radians(25.0)),
        "mission": lambda: dataclasses.replace(common, trees=count, slope_rad=math.radians(float(rng.uniform(0, 6))),
                                               thick=upto(1), tables=upto(1), people=upto(1)),
    }  # fmt: skip
    return makers[kind]()


def random_scene(seed: int, kind: Kind = "multi", trees: int | None = None) -> Scene:
    """Return a fresh scene; the same arguments give the same scene. ``trees``: suitable trees asked for."""
    name = f"random-{kind}-{seed}" if trees is None else f"random-{kind}-{seed}-{trees}"
    return build(name, seed, random_recipe(seed, kind, trees))


def scene_by_name(name: str) -> Scene:
    """Return a scene of the catalogue, or a random one by ``random-KIND-SEED`` or ``random-KIND-SEED-TREES``.

    Raises:
        InputError: for a name that is neither.
    """
    if name in CATALOGUE:
        return build(name, *CATALOGUE[name])
    head, *rest = name.split("-")
    if head == "random" and len(rest) in (2, 3) and rest[0] in KINDS and all(part.isdecimal() for part in rest[1:]):
        numbers = [int(part) for part in rest[1:]]
        return random_scene(numbers[0], rest[0], numbers[1] if len(numbers) > 1 else None)
    raise InputError(
        f"unknown scene {name!r}: expected one of single-01..10, multi-01..10, {', '.join(HARD)}, "
        f"or random-KIND-SEED with KIND one of {', '.join(KINDS)}"
    )


def scene_for(name: str, seed: int, trees: int | None = None) -> Scene:
    """Return the scene of a name; for ``random-KIND`` without a seed, ``seed`` and ``trees`` draw it.

    Raises:
        InputError: for an unknown name.
    """
    head, _, kind = name.partition("-")
    if head == "random" and kind in KINDS:
        return random_scene(seed, kind, trees)
    return scene_by_name(name)


def trees_to_ask_for(name: str, seed: int, wanted: int) -> int | None:
    """Return how many suitable trees to ask for so that a random scene has ``wanted`` that can be docked at.

    None where the scene as it is has enough, or where it has its name and with it its trees.

    Raises:
        InputError: no scene of this kind and seed has room for so many.
    """
    head, _, kind = name.partition("-")
    if head != "random" or kind not in KINDS or len(scene_for(name, seed).reachable_trees) >= wanted:
        return None
    for count in range(wanted, wanted + _SPARE_TREES + 1):
        if len(scene_for(name, seed, count).reachable_trees) >= wanted:
            return count
    raise InputError(f"--trees {wanted}: scene {name} of seed {seed} has no room for so many; ask for fewer")


_SPARE_TREES = 6
