"""What slam tells after a frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from schemas.slam import GraphReason, SlamStatus

F64 = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class NewKeyframe:
    """A keyframe that has just joined the map."""

    keyframe_id: int
    T_map_camera: F64


@dataclass(frozen=True, slots=True)
class GraphUpdate:
    """All keyframes of the map and where they stand now."""

    version: int
    reason: GraphReason
    nodes: tuple[tuple[int, F64], ...]
    """(keyframe id, T_map_camera)."""


@dataclass(frozen=True, slots=True)
class TrackResult:
    """What slam knows after one frame."""

    stamp_ns: int
    status: SlamStatus
    T_map_camera: F64 | None
    covariance: F64 | None
    """(6, 6) of (x, y, z, rx, ry, rz), left perturbation in the map frame."""
    keyframe_id: int | None
    T_keyframe_camera: F64 | None
    new_keyframes: list[NewKeyframe]
    graph: GraphUpdate | None
    reset_counter: int
    graph_version: int
    inliers: int
    up_sigma_rad: float
