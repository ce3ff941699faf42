"""How high the known ground asks the aircraft to be: trees tell where the ground is, and nothing else does. Pure."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from services.common.geometry import Matrix

if TYPE_CHECKING:
    from services.navigator.board import Board

NEAR_M = 3.0
"""So far around a tree's foot the ground is taken to be as high as the foot."""
_FALL = 0.25
"""Farther away it is taken to fall by no more than this (m/m): the aircraft comes down on its way, never on the spot.
Where it falls more steeply there is more room below; where less, the near part makes up for it."""


def least_z_m(b: Board, xy: Matrix) -> float:
    """Return the least height in map that keeps ``min_ground_m`` over the known ground at a place (2,)."""
    feet = [(t.x_m, t.y_m, t.z_m) for t in b.trees if t.confidence >= b.config.select_confidence]
    if b.left_foot_m is not None:
        feet.append((float(b.left_foot_m[0]), float(b.left_foot_m[1]), float(b.left_foot_m[2])))
    ground = (z - _FALL * max(float(np.hypot(x - xy[0], y - xy[1])) - NEAR_M, 0.0) for x, y, z in feet)
    return max(ground, default=float("-inf")) + b.config.min_ground_m


def foot_left_m(b: Board) -> Matrix | None:
    """Return the target's foot (3,) where the aircraft stands before it, else what was known of the tree left last."""
    if b.axis_m is None or float(np.linalg.norm(b.trajectory.position_m[:2] - b.axis_m)) > NEAR_M:
        return b.left_foot_m
    return np.array([b.axis_m[0], b.axis_m[1], b.ground_z_m])
