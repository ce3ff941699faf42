"""Views of simulated trees from 1 to 3 m with the map's and the pose's errors drawn: what the refiner is measured on."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from services.common.geometry import R_BODY_CAMERA, Matrix, exp_rotation, pose, rotation_z
from services.detector.refine.model import ExpectedTree

if TYPE_CHECKING:
    from services.simulator.scene import Floats, SceneTree
    from services.simulator.world import World

DISTANCES_M = (1.0, 1.5, 2.0, 2.5, 3.0)
CAMERA_HEIGHT_M = 1.5
POSE_SIGMA = (0.02, 0.02, 0.01, 0.003, 0.003, 0.009)
"""Of the pose's error: metres and radians (half a degree of yaw)."""
MAP_SIGMA_M = 0.04
MAP_SIGMA_RADIUS_M = 0.01
MAP_SIGMA_LEAN = 0.015
_FREE_M = 0.35
_LOOK_ASIDE_RAD = 0.35
_MIN_SHARE = 0.6


@dataclass(frozen=True, slots=True)
class View:
    """One depth image of a tree, with truth and with what the refiner is told."""

    scene: str
    tree: int
    distance_m: float
    depth: NDArray[np.uint16]
    colour: NDArray[np.uint8]
    T_true: Matrix
    T_told: Matrix
    pose_covariance: Matrix
    expected: ExpectedTree
    others: tuple[ExpectedTree, ...]
    true_place_m: Matrix
    """(2,) of the axis at the true camera's height."""
    true_radius_m: float
    told_place_m: Matrix
    """(2,) of the mapped axis at the told camera's height."""


def views(scene_name: str, seed: int) -> Iterator[View]:
    """Yield views of each suitable tree of a scene, at each distance from where it can be seen."""
    from services.simulator.camera import SimulatedCamera
    from services.simulator.catalogue import scene_by_name
    from services.simulator.config import SensorConfig
    from services.simulator.world import World

    scene = scene_by_name(scene_name)
    world = World(scene)
    camera = SimulatedCamera(world, SensorConfig(), seed=seed)
    rng = np.random.default_rng([seed, 401])
    for index, tree in enumerate(scene.trees):
        if not tree.suitable:
            continue
        for number, distance in enumerate(DISTANCES_M):
            T = _look_at(world, index, distance, rng)
            if T is None:
                continue
            told, common = _wrong_pose(T, rng)
            trees = [_mapped(k, other, rng) for k, other in enumerate(scene.trees)]
            images = camera.look(T, 100 * index + number)
            yield View(
                scene_name, index, distance, images.depth.copy(), images.colour.copy(), T, told, common, trees[index],
                tuple(t for t in trees if t.id != index), tree.centre_at(float(T[2, 3]) - tree.z_m)[:2],
                tree.radius_m, _axis_at(trees[index], float(told[2, 3])),
            )  # fmt: skip


def _axis_at(tree: ExpectedTree, z_m: float) -> Matrix:
    along = (z_m - tree.z_m) / tree.axis[2]
    return np.array([tree.x_m + along * tree.axis[0], tree.y_m + along * tree.axis[1]])


def _look_at(world: World, index: int, distance_m: float, rng: np.random.Generator) -> Matrix | None:
    """Return a free camera pose (4, 4) that sees the tree's trunk, or None when a dozen directions have none."""
    tree = world.scene.trees[index]
    first = rng.uniform(0.0, 2.0 * math.pi)
    aside, tilt = rng.uniform(-_LOOK_ASIDE_RAD, _LOOK_ASIDE_RAD), rng.normal(0.0, 0.017, 2)
    for k in range(12):
        direction = first + k * math.pi / 6.0
        x, y = tree.x_m + distance_m * math.cos(direction), tree.y_m + distance_m * math.sin(direction)
        z = world.scene.ground.at(x, y) + CAMERA_HEIGHT_M
        centre = tree.centre_at(z - tree.z_m)
        x, y = centre[0] + distance_m * math.cos(direction), centre[1] + distance_m * math.sin(direction)
        eye = np.array([x, y, z])
        if world.clearance(eye) < _FREE_M or _visible_share(world, index, tree, eye) < _MIN_SHARE:
            continue
        yaw = direction + math.pi + aside
        return pose(rotation_z(yaw) @ exp_rotation([tilt[0], tilt[1], 0.0]) @ R_BODY_CAMERA, eye)
    return None


def _visible_share(world: World, index: int, tree: SceneTree, eye: Floats) -> float:
    """Return the share of points on the trunk's face, within 0.4 m of the eye's height, that the eye sees."""
    heights = np.linspace(eye[2] - tree.z_m - 0.4, eye[2] - tree.z_m + 0.4, 9)
    centres = np.stack([tree.centre_at(float(h)) for h in heights])
    across = np.cross(centres.mean(axis=0) - eye, tree.axis)
    across /= np.linalg.norm(across)
    points = (centres[:, None] + np.linspace(-0.8, 0.8, 7)[None, :, None] * tree.radius_m * across).reshape(-1, 3)
    rays = np.concatenate([np.broadcast_to(eye, points.shape), points - eye], axis=1).astype(np.float32)
    part = world.cast(rays).part
    own = np.zeros(len(part), dtype=bool)
    met = part != world.NOTHING
    own[met] = world.tree_of_part[part[met].astype(np.int64)] == index
    return float(np.mean(own))


def _wrong_pose(T: Matrix, rng: np.random.Generator) -> tuple[Matrix, Matrix]:
    """Return the pose with an error drawn, and its covariance."""
    error = rng.normal(0.0, POSE_SIGMA)
    told = pose(exp_rotation(error[3:]) @ T[:3, :3], T[:3, 3] + error[:3])
    return told, np.diag(np.square(POSE_SIGMA))


def _mapped(index: int, tree: SceneTree, rng: np.random.Generator) -> ExpectedTree:
    """Return the tree as a map would have it."""
    dx, dy, dz = rng.normal(0.0, (MAP_SIGMA_M, MAP_SIGMA_M, 0.03))
    lean = np.array(tree.axis) + np.append(rng.normal(0.0, MAP_SIGMA_LEAN, 2), 0.0)
    lean /= np.linalg.norm(lean)
    # the map is right at breast height, so that the lean's error does not shift the trunk there
    base = tree.centre_at(1.3) - 1.3 / lean[2] * lean
    radius = max(tree.radius_m + rng.normal(0.0, MAP_SIGMA_RADIUS_M), 0.02)
    return ExpectedTree(
        index, float(base[0] + dx), float(base[1] + dy), float(base[2] + dz),
        (float(lean[0]), float(lean[1]), float(lean[2])), float(radius), MAP_SIGMA_M, MAP_SIGMA_RADIUS_M,
    )  # fmt: skip
