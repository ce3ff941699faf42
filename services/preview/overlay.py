"""What the operator is shown: shapes in pixels, worked out from the messages. Pure; drawing is in ``draw``.

The reference's colours: a red arrow for the command, a blue outline where the map expects the tree, a green one where
the depth image shows it, a green frame when docked.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from schemas.camera import Intrinsics
from schemas.navigation import Guidance, MissionState
from schemas.slam import Pose
from schemas.trees import Target, Tree
from services.common.geometry import apply, from_transform, inverse
from services.detector.refine.view import distort

Array = NDArray[np.float64]
Pixel = tuple[float, float]

_NEAR_M = 0.2
_TRUNK_LOW_M, _TRUNK_HIGH_M = 0.0, 2.5
"""Part of a trunk that is outlined, above its ground."""
_OTHER_WITHIN_M = 8.0
_PLACES = 17
"""Along a trunk's edge, where the lens bends it."""
_WORDS = {
    "take_off": "take off", "landing": "land", "turn_left": "turn left", "turn_right": "turn right", "toward": "forward",
    "backward": "back", "stop": "stop", "docked": "docked",
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Outline:
    """A trunk's outline in the picture."""

    corners: tuple[Pixel, ...]
    """From low left to low right, up the right edge and down the left one, as many on each."""
    label: str


@dataclass(frozen=True, slots=True)
class Overlay:
    """All shapes of one picture, in pixels of the full image."""

    mapped: Outline | None
    """Blue: the target tree as the map has it."""
    seen: Outline | None
    """Green: the target trunk as the depth image has it in this very frame."""
    others: tuple[Outline, ...]
    """Thin: the other trees in view."""
    arrow: tuple[float, float] | None
    """Direction of the red arrow (right, up), a unit vector; None: no arrow."""
    docked: bool
    headline: str
    """The command in words, with its magnitude."""
    status: str
    """State and distance."""
    warning: str
    """What is wrong, empty when nothing is."""


def overlay_of(
    intrinsics: Intrinsics,
    pose: Pose | None,
    trees: tuple[Tree, ...],
    target: Target | None,
    mission: MissionState | None,
    guidance: Guidance | None,
) -> Overlay:
    """Return the shapes for a frame.

    Args:
        intrinsics: of the full image.
        pose: at the frame, None or without transform when slam has none.
        trees: the map's, in map.
        target: of this frame or one just before.
        mission: its latest state.
        guidance: the latest command.
    """
    T = None if pose is None or pose.T_map_camera is None else from_transform(pose.T_map_camera)
    wanted = mission.target_tree_id if mission is not None else None
    outlines = {} if T is None else trunk_outlines(trees, inverse(T), intrinsics)
    command = guidance.command if guidance is not None else None
    return Overlay(
        mapped=outlines.get(wanted) if wanted is not None else None,
        seen=_seen(target, outlines.get(wanted) if wanted is not None else None, intrinsics),
        others=tuple(outline for tree_id, outline in outlines.items() if tree_id != wanted),
        arrow=_ARROWS.get(command) if command else None,
        docked=command == "docked" or (mission is not None and mission.state == "docked"),
        headline=_headline(guidance),
        status=_status(mission),
        warning=_warning(pose, target, mission),
    )


_ARROWS: dict[str, tuple[float, float]] = {
    "turn_left": (-1.0, 0.0), "turn_right": (1.0, 0.0), "toward": (0.0, 1.0), "backward": (0.0, -1.0),
}  # fmt: skip


def trunk_outline(tree: Tree, T_camera_map: Array, i: Intrinsics) -> Outline | None:
    """Return the outline of a trunk, None when it is behind the camera, out of view or far."""
    return trunk_outlines((tree,), T_camera_map, i).get(tree.id)


def trunk_outlines(trees: Sequence[Tree], T_camera_map: Array, i: Intrinsics) -> dict[int, Outline]:
    """Return the outlines of the trunks that are in view and near, by their number: all worked out at once."""
    if not trees:
        return {}
    axes = np.array([t.axis for t in trees])
    feet = np.array([(t.x_m, t.y_m, t.z_m) for t in trees])
    low, high = (apply(T_camera_map, feet + h * axes) for h in (_TRUNK_LOW_M, _TRUNK_HIGH_M))
    sideways = np.cross(high - low, 0.5 * (low + high))
    radii = np.array([t.radius_m for t in trees])
    sideways *= (radii / np.maximum(np.linalg.norm(sideways, axis=1), 1e-9))[:, None]
    share = np.linspace(0.0, 1.0, _PLACES if i.distorted else 2)[:, None]
    middle = low[:, None] + share * (high - low)[:, None]
    left, right = middle - sideways[:, None], middle + sideways[:, None]
    corners = np.concatenate([left[:, :1], right, left[:, :0:-1]], axis=1)
    near = (np.minimum(low[:, 2], high[:, 2]) >= _NEAR_M) & (np.maximum(low[:, 2], high[:, 2]) <= _OTHER_WITHIN_M)
    depth = np.where(near[:, None], corners[:, :, 2], 1.0)
    x, y = _bent(corners[:, :, 0] / depth, corners[:, :, 1] / depth, i)
    u, v = i.fx * x + i.cx, i.fy * y + i.cy
    seen = near & (u.max(axis=1) >= 0) & (u.min(axis=1) <= i.width) & (v.max(axis=1) >= 0) & (v.min(axis=1) <= i.height)
    return {trees[k].id: _named(trees[k], u[k], v[k]) for k in np.flatnonzero(seen).tolist()}


def _bent(x: Array, y: Array, i: Intrinsics) -> tuple[Array, Array]:
    """Return where the lens shows rays; those beyond the picture are moved as its rim is, for its formula folds them back."""
    if not i.distorted:
        return x, y
    beyond = np.maximum(np.hypot(x, y) / _rim(i), 1.0)
    x, y = distort(x / beyond, y / beyond, i)
    return x * beyond, y * beyond


@lru_cache(maxsize=4)
def _rim(i: Intrinsics) -> float:
    """Return how far from the axis (tangent) the lens's formula holds: to the picture's corner, or to where it turns back."""
    corner = math.hypot(max(i.cx, i.width - i.cx) / i.fx, max(i.cy, i.height - i.cy) / i.fy)
    ray = np.linspace(0.0, 2.0 * corner, 401)
    shown = distort(ray, np.zeros_like(ray), i)[0]
    ends = np.flatnonzero((np.diff(shown) <= 0.0) | (shown[:-1] >= corner))
    return float(ray[max(int(ends[0]), 1)] if len(ends) else ray[-1])


def _named(tree: Tree, u: Array, v: Array) -> Outline:
    corners = list(zip(u.tolist(), v.tolist(), strict=True))
    if corners[0][0] > corners[1][0]:  # upside down: the right edge is the left one
        corners = [corners[1], corners[0], *corners[:1:-1]]
    return Outline(tuple(corners), f"{tree.id}  {200.0 * tree.radius_m:.0f} cm")


def _seen(target: Target | None, mapped: Outline | None, i: Intrinsics) -> Outline | None:
    """Return the trunk as the refiner has it: its x, width and range; how high it reaches only the map tells."""
    if target is None or target.status != "tracking" or target.image_x_px is None:
        return None
    if target.range_m is None or target.radius_m is None or target.range_m < target.radius_m + 0.05:
        return None
    half = i.fx * math.tan(math.asin(target.radius_m / target.range_m))
    low, high = 0.98 * i.height, 0.02 * i.height
    if mapped is not None:
        low, high = mapped.corners[0][1], mapped.corners[len(mapped.corners) // 2][1]
    x = target.image_x_px
    corners = ((x - half, low), (x + half, low), (x + half, high), (x - half, high))
    guessed = "" if target.measured else " (predicted)"
    return Outline(corners, f"{target.range_m:.2f} m{guessed}")


def _headline(guidance: Guidance | None) -> str:
    if guidance is None:
        return ""
    words = _WORDS[guidance.command]
    if guidance.unit == "rad":
        return f"{words} {math.degrees(guidance.magnitude):.0f} deg"
    if guidance.unit == "m" and guidance.magnitude > 0.0:
        return f"{words} {guidance.magnitude:.1f} m"
    return words


def _status(mission: MissionState | None) -> str:
    if mission is None:
        return ""
    parts = [mission.state.replace("_", " ")]
    if mission.target_tree_id is not None:
        parts.append(f"tree {mission.target_tree_id}")
    if mission.distance_m is not None:
        parts.append(f"{mission.distance_m:.2f} m")
    return "  ".join(parts)


def _warning(pose: Pose | None, target: Target | None, mission: MissionState | None) -> str:
    if mission is not None and mission.failsafe:
        return mission.failsafe.replace("_", " ")
    if pose is None or pose.T_map_camera is None:
        return "no pose" if pose is None else f"slam {pose.status}"
    if target is not None and target.status == "lost":
        return "target lost"
    return ""
