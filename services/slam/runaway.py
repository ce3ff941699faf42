"""Whether a correction of the map may be believed: the aircraft is flown by the map, and one that ran away must not reach it.

An adjustment goes down the cost, but nothing holds the way it goes: with few good observations left, or many that are behind their
camera, kilometres can be cheaper than the metre that is right.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]

_LEAST_M = 2.0
_SHARE = 0.2
"""So far a camera may move, or this share of how far apart the cameras stand: corrections by loops were spread before by the graph."""


def centres(R: F64, t: F64) -> F64:
    """Return where cameras (C, 3, 3), (C, 3), camera from map, stand in the map (C, 3)."""
    return -np.einsum("cba,cb->ca", R, t)


def span_m(R: F64, t: F64) -> float:
    """Return how far apart cameras (C, 3, 3), (C, 3) stand: the diagonal of the box round their centres."""
    return float(np.linalg.norm(np.ptp(centres(R, t), axis=0)))


def moved_m(before: tuple[F64, F64], after: tuple[F64, F64]) -> float:
    """Return how far the camera that moved farthest went; infinite when one is nowhere."""
    if not all(np.isfinite(a).all() for a in after):
        return np.inf
    return float(np.linalg.norm(centres(*after) - centres(*before), axis=1).max(initial=0.0))


def ran_away(before: tuple[F64, F64], after: tuple[F64, F64]) -> bool:
    """Return whether cameras (C, 3, 3), (C, 3) moved farther than a correction can move them, or to nowhere."""
    return moved_m(before, after) > max(_LEAST_M, _SHARE * span_m(*before))
