"""Trunks in the words of the messages and of trees.json."""

from __future__ import annotations

import math

from schemas.trees import Tree
from services.detector.model import Trunk


def as_tree(trunk: Trunk, tree_id: int, observations: int) -> Tree:
    """Return the message form of a trunk."""
    x, y, z = trunk.base_m
    return Tree(
        id=tree_id, x_m=x, y_m=y, z_m=z, axis=trunk.axis, radius_m=trunk.radius_m,
        radius_height_m=max(trunk.radius_height_m, 0.0), height_seen_m=max(trunk.height_seen_m, 0.0),
        sigma_xy_m=trunk.sigma_xy_m, sigma_radius_m=trunk.sigma_radius_m, arc_rad=min(trunk.arc_rad, 2.0 * math.pi),
        confidence=trunk.confidence, observations=observations, suitable=trunk.suitable,
    )  # fmt: skip
