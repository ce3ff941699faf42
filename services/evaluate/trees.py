"""Trees found against the trees of a scene, both in map: found, false, missed, and how well placed."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from schemas.simulation import TrueTree
from schemas.trees import Tree
from services.common.errors import InputError

CENTRE_WITHIN_M = 0.30
RADIUS_WITHIN_M = 0.07
"""The largest radius error that the reference reports for a tree it counts as found."""


@dataclass(frozen=True, slots=True)
class Match:
    """One true tree and the one found for it."""

    true: TrueTree
    found: Tree

    @property
    def centre_error_m(self) -> float:
        """Horizontal distance of the axes at the ground."""
        return float(np.hypot(self.found.x_m - self.true.x_m, self.found.y_m - self.true.y_m))

    @property
    def radius_error_m(self) -> float:
        """Found minus true."""
        return self.found.radius_m - self.true.radius_m


@dataclass(frozen=True, slots=True)
class Score:
    """What became of the suitable trees of one scene."""

    matches: tuple[Match, ...]
    missed: tuple[TrueTree, ...]
    """Suitable and fair to ask for, not found."""
    hidden: tuple[TrueTree, ...]
    """Suitable, not found, and not to be seen on the path: nobody's fault."""
    false: tuple[Tree, ...]
    """Called suitable, where no suitable tree stands."""

    @property
    def suitable(self) -> int:
        """How many suitable trees the scene has."""
        return len(self.matches) + len(self.missed) + len(self.hidden)


def score(found: Sequence[Tree], truth: Sequence[TrueTree]) -> Score:
    """Match the trees that are called suitable with the suitable true ones, nearest first, each used once.

    A match needs the axes within CENTRE_WITHIN_M at the ground and the radii within RADIUS_WITHIN_M.
    """
    called = [tree for tree in found if tree.suitable]
    wanted = [tree for tree in truth if tree.suitable]
    candidates = sorted(
        (match.centre_error_m, i, k)
        for i, true in enumerate(wanted)
        for k, tree in enumerate(called)
        if (match := Match(true, tree)).centre_error_m <= CENTRE_WITHIN_M
        and abs(match.radius_error_m) <= RADIUS_WITHIN_M
    )
    taken: dict[int, int] = {}
    for _, i, k in candidates:
        if i not in taken and k not in taken.values():
            taken[i] = k
    absent = [true for i, true in enumerate(wanted) if i not in taken]
    return Score(
        matches=tuple(Match(wanted[i], called[k]) for i, k in sorted(taken.items())),
        missed=tuple(true for true in absent if true.fair),
        hidden=tuple(true for true in absent if not true.fair),
        false=tuple(tree for k, tree in enumerate(called) if k not in taken.values()),
    )


def rmse(errors: Sequence[float]) -> float:
    """Return the root mean square, 0 of nothing."""
    return float(np.sqrt(np.mean(np.square(errors)))) if errors else 0.0


def read_truth(path: Path) -> list[TrueTree]:
    """Read the truth.json that the simulator writes beside a sequence.

    Raises:
        InputError: no such file, or not such a file.
    """
    try:
        body = json.loads(path.read_text(encoding="utf-8"))
        return [TrueTree.model_validate_json(json.dumps(tree)) for tree in body["trees"]]
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path}: not the truth of a simulated scene: {str(error).splitlines()[0]}") from None


def read_trees(path: Path) -> list[Tree]:
    """Read a trees.json.

    Raises:
        InputError: no such file, or not such a file.
    """
    try:
        body = json.loads(path.read_text(encoding="utf-8"))
        trees = [_normalised(tree) for tree in body["trees"]]
        return [Tree.model_validate_json(json.dumps(tree)) for tree in trees]
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path}: not a trees.json: {str(error).splitlines()[0]}") from None


def _normalised(tree: dict[str, object]) -> dict[str, object]:
    """Undo the rounding of the axis, which must be of length 1 within 1e-6."""
    axis = np.array(tree["axis"], dtype=float)
    return {**tree, "axis": [float(v) for v in axis / np.linalg.norm(axis)]}
