"""Which tree is the target: the mission's, else the nearest suitable one in view."""

from __future__ import annotations

import math
from collections.abc import Sequence

from schemas.camera import Intrinsics
from services.detector.refine.model import ExpectedTree, Matrix
from services.detector.refine.view import axis_xy, project_point

_MIN_FORWARD_M = 0.2
_KEEP_M = 0.4
"""Another tree must be nearer by this much to take the target's place."""


def image_place(tree: ExpectedTree, T_map_camera: Matrix, intrinsics: Intrinsics) -> tuple[float, float] | None:
    """Return (image x, range) of the axis at the camera's height; None when it is not before the camera."""
    (a, b, c, camera_x), (d, e, f, camera_y), (_, _, _, camera_z) = T_map_camera[:3].tolist()
    x, y = axis_xy(tree, camera_z)
    x, y = x - camera_x, y - camera_y
    forward = x * c + y * f
    if forward < _MIN_FORWARD_M:
        return None
    return project_point(x * a + y * d, x * b + y * e, forward, intrinsics)[0], math.hypot(x, y)


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
