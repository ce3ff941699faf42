"""Which tree is the target: the mission's, else the nearest suitable one in view."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from schemas.camera import Intrinsics
from services.detector.refine.model import ExpectedTree, Matrix
from services.detector.refine.view import axis_point, project

_MIN_FORWARD_M = 0.2
_KEEP_M = 0.4
"""Another tree must be nearer by this much to take the target's place."""


def image_place(tree: ExpectedTree, T_map_camera: Matrix, intrinsics: Intrinsics) -> tuple[float, float] | None:
    """Return (image x, range) of the axis at the camera's height; None when it is not before the camera."""
    offset = np.append(axis_point(tree, float(T_map_camera[2, 3])) - T_map_camera[:2, 3], 0.0)
    in_camera = offset @ T_map_camera[:3, :3]
    if in_camera[2] < _MIN_FORWARD_M:
        return None
    return float(project(in_camera[None], intrinsics)[0, 0]), float(np.hypot(offset[0], offset[1]))


def in_view(tree: ExpectedTree, T_map_camera: Matrix, intrinsics: Intrinsics, max_range_m: float) -> float | None:
    """Return the range when at least a part of the trunk should be in the image, else None."""
    place = image_place(tree, T_map_camera, intrinsics)
    if place is None:
        return None
    x, distance = place
    margin = intrinsics.fx * tree.radius_m / max(distance, _MIN_FORWARD_M)
    if distance > max_range_m or not -margin <= x <= intrinsics.width - 1 + margin:
        return None
    return distance


def nearest_in_view(
    trees: Sequence[ExpectedTree], T_map_camera: Matrix, intrinsics: Intrinsics, max_range_m: float, present: int | None
) -> int | None:
    """Return the id of the nearest tree in view; the present target keeps its place against one hardly nearer."""
    best: tuple[float, int] | None = None
    for tree in trees:
        distance = in_view(tree, T_map_camera, intrinsics, max_range_m)
        if distance is None:
            continue
        rank = (distance - (_KEEP_M if tree.id == present else 0.0), tree.id)
        if best is None or rank < best:
            best = rank
    return best[1] if best else None
