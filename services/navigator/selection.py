"""Which tree is next, and where its trunk stands at the camera's height. Pure."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from schemas.trees import Tree
from services.common.geometry import Matrix

SAME_TREE_M = 0.35
"""A listed tree this near to a visited trunk is that trunk under another id."""


@dataclass(frozen=True, slots=True)
class Choice:
    """The tree chosen, or why there is none."""

    tree: Tree | None
    reason: str


def axis_at(tree: Tree, z_m: float) -> Matrix:
    """Return the trunk axis's x, y (2,) in map at height ``z_m``."""
    ax, ay, az = tree.axis
    rise = (z_m - tree.z_m) / max(az, 0.5)
    return np.array([tree.x_m + ax * rise, tree.y_m + ay * rise])


def choose(
    trees: Sequence[Tree],
    position_m: Matrix,
    done_ids: Collection[int],
    done_xy_m: Sequence[Matrix],
    min_confidence: float,
    wanted_id: int | None,
) -> Choice:
    """Return the nearest unvisited suitable tree, or the one the operator wants.

    ``position_m`` (3,) camera in map; ``done_xy_m`` trunk axes (2,) visited or given up.
    """
    if wanted_id is not None:
        named = next((t for t in trees if t.id == wanted_id), None)
        if named is None:
            return Choice(None, f"tree {wanted_id} is not in the list")
        if not named.suitable:
            return Choice(None, f"tree {wanted_id} is not suitable")
        return Choice(named, f"tree {wanted_id}, chosen by the operator")
    open_trees = [
        t
        for t in trees
        if t.suitable and t.confidence >= min_confidence and t.id not in done_ids and not _near(t, done_xy_m)
    ]
    if not open_trees:
        return Choice(None, f"no suitable tree left among {len(trees)} listed")
    ranked = sorted(open_trees, key=lambda t: (_distance(t, position_m), t.id))
    best = ranked[0]
    return Choice(best, f"tree {best.id}, the nearest of {len(ranked)}, {_distance(best, position_m):.2f} m away")


def _distance(tree: Tree, position_m: Matrix) -> float:
    return float(np.linalg.norm(axis_at(tree, float(position_m[2])) - position_m[:2]))


def _near(tree: Tree, places: Sequence[Matrix]) -> bool:
    return any(float(np.hypot(tree.x_m - p[0], tree.y_m - p[1])) < SAME_TREE_M for p in places)
