"""The truth about a scene's trees: where they stand in the map frame, and which of them could be seen at all."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from schemas.simulation import TrueTree
from services.common.geometry import apply, inverse
from services.simulator.path import ReferencePath, sample
from services.simulator.render import DEFAULT_INTRINSICS
from services.simulator.scene import Floats, Scene, SceneTree
from services.simulator.world import World

MIN_WIDTH_PX = 12.0
SENSOR_RANGE_M = 6.0
MIN_SHARE = 0.6
"""Share of the looked-at part of the trunk that must be free to see from one place."""
_HEIGHTS_M = np.linspace(0.5, 2.0, 10)
_ACROSS = np.linspace(-0.8, 0.8, 7)


def truth_trees(scene: Scene, T_world_map: Floats, fair: Sequence[bool]) -> tuple[TrueTree, ...]:
    """Return the scene's trees in the map frame; ``fair`` comes from ``fair_trees``."""
    T_map_world = inverse(T_world_map)
    return tuple(_true_tree(tree, T_map_world, seen) for tree, seen in zip(scene.trees, fair, strict=True))


def _true_tree(tree: SceneTree, T_map_world: Floats, fair: bool) -> TrueTree:
    x, y, z = (float(v) for v in apply(T_map_world, tree.base[None])[0])
    a, b, c = (float(v) for v in T_map_world[:3, :3] @ np.array(tree.axis))
    return TrueTree(x_m=x, y_m=y, z_m=z, axis=(a, b, c), radius_m=tree.radius_m, suitable=tree.suitable, fair=fair)


def fair_trees(world: World, path: ReferencePath, rate_hz: float = 1.0) -> tuple[bool, ...]:
    """Return for each tree whether it could be seen on the path.

    It could when from some pose, within the sensor's range and the camera's view, the trunk is at least 12 px wide
    and 60 % of it between 0.5 and 2 m above its ground is hidden by nothing.
    """
    poses = [T for _, T in sample(path, rate_hz)]
    return tuple(_fair(world, index, poses) for index in range(len(world.scene.trees)))


def _fair(world: World, index: int, poses: Iterable[Floats]) -> bool:
    tree = world.scene.trees[index]
    return any(_visible_share(world, tree, index, T) >= MIN_SHARE for T in poses)


def _visible_share(world: World, tree: SceneTree, index: int, T_world_camera: Floats) -> float:
    """Share of a grid of points across the trunk's face that the camera sees, 0 where it is too thin or too far."""
    eye = T_world_camera[:3, 3]
    points = _face(tree, eye)
    in_camera = apply(inverse(T_world_camera), points)
    k = DEFAULT_INTRINSICS
    z = in_camera[:, 2]
    if z.min() <= 0.3:
        return 0.0
    u, v = k.cx + k.fx * in_camera[:, 0] / z, k.cy + k.fy * in_camera[:, 1] / z
    inside = (u >= 0) & (u < k.width) & (v >= 0) & (v < k.height) & (z <= SENSOR_RANGE_M)
    wide = 2.0 * tree.radius_m * k.fx / z >= MIN_WIDTH_PX
    rays = np.concatenate([np.broadcast_to(eye, points.shape), points - eye], axis=1).astype(np.float32)
    part = world.cast(rays).part
    own: NDArray[np.bool_] = np.zeros(len(part), dtype=bool)
    met = part != World.NOTHING
    own[met] = world.tree_of_part[part[met].astype(np.int64)] == index
    return float(np.mean(inside & wide & own))


def _face(tree: SceneTree, eye: Floats) -> Floats:
    """Points on the plane through the axis that faces the eye, (N, 3)."""
    centres = np.stack([tree.centre_at(float(h)) for h in _HEIGHTS_M])
    across = np.cross(centres.mean(axis=0) - eye, tree.axis)
    across /= np.linalg.norm(across)
    radii = tree.mean_radius(_HEIGHTS_M)
    return np.asarray(
        (centres[:, None, :] + _ACROSS[None, :, None] * radii[:, None, None] * across[None, None, :]).reshape(-1, 3)
    )
