"""A scene as meshes in Open3D's ray caster (Embree): what rays meet, and how far the nearest surface is."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.simulator import meshes
from services.simulator.scene import Floats, Scene, SceneTree
from services.simulator.texture import BACKDROP, BARK, CLOTH, GROUND, LEAF, WOOD

Floats32 = NDArray[np.float32]

NO_TREE = -1


@dataclass(frozen=True, slots=True)
class Hits:
    """What a block of rays met; arrays of the rays' leading shape."""

    distance: Floats32
    """In lengths of the ray's direction vector; infinite where nothing was met."""
    part: NDArray[np.uint32]
    """Index of the part of the world, ``World.NOTHING`` where nothing was met."""
    normal: Floats32
    """(..., 3), of the triangle met, world frame, either side."""


class World:
    """The ray caster of a scene. Casting is single threaded and gives the same answer each time."""

    NOTHING = 2**32 - 1

    def __init__(self, scene: Scene) -> None:
        import open3d as o3d  # a second of import time: only who renders pays it

        self._core = o3d.core
        self._caster: Any = o3d.t.geometry.RaycastingScene(nthreads=1)
        self._solid: Any = o3d.t.geometry.RaycastingScene(nthreads=1)
        self._things: Any = o3d.t.geometry.RaycastingScene(nthreads=1)
        things = 0
        materials: list[int] = []
        trees: list[int] = []
        for mesh, material, tree in _parts(scene):
            vertices = self._core.Tensor.from_numpy(mesh.vertices.astype(np.float32))
            triangles = self._core.Tensor.from_numpy(np.ascontiguousarray(mesh.triangles))
            self._caster.add_triangles(vertices, triangles)
            if material != BACKDROP:
                self._solid.add_triangles(vertices, triangles)
            if material not in {BACKDROP, GROUND}:
                self._things.add_triangles(vertices, triangles)
                things += 1
            materials.append(material)
            trees.append(tree)
        self.scene = scene
        self._empty = things == 0
        self.material = np.array(materials, dtype=np.int64)
        """Material of each part (texture.py)."""
        self.tree_of_part = np.array(trees, dtype=np.int64)
        """Index into ``scene.trees`` of each part, ``NO_TREE`` for the rest."""

    def cast(self, rays: Floats32) -> Hits:
        """Return what ``rays`` (..., 6: origin, direction) meet."""
        found = self._caster.cast_rays(self._core.Tensor.from_numpy(rays), nthreads=1)
        return Hits(found["t_hit"].numpy(), found["geometry_ids"].numpy(), found["primitive_normals"].numpy())

    def clearance(self, position_m: Floats) -> float:
        """Return the distance from a point in the world to the nearest surface, metres."""
        return self._distance(self._solid, position_m)

    def clearance_of_things(self, position_m: Floats) -> float:
        """Return the distance to the nearest thing that stands on the ground, infinite in an empty scene."""
        return np.inf if self._empty else self._distance(self._things, position_m)

    def _distance(self, scene: Any, position_m: Floats) -> float:  # noqa: ANN401  # open3d has no types
        query = self._core.Tensor.from_numpy(np.asarray(position_m, dtype=np.float32).reshape(1, 3))
        return float(scene.compute_distance(query, nthreads=1).numpy()[0])

    def touches(self, position_m: Floats, radius_m: float) -> bool:
        """Return whether a ball around ``position_m`` reaches into anything."""
        return self.clearance(position_m) < radius_m


def _parts(scene: Scene) -> list[tuple[meshes.Mesh, int, int]]:
    """Return mesh, material and tree index of everything."""
    ground = scene.ground
    parts: list[tuple[meshes.Mesh, int, int]] = [
        (meshes.terrain(ground, 1.4 * scene.backdrop.radius_m), GROUND, NO_TREE),
        (meshes.tree_line(scene.backdrop, ground, scene.seed), BACKDROP, NO_TREE),
    ]
    for index, tree in enumerate(scene.trees):
        parts += _tree_parts(tree, index)
    for tree in scene.backdrop.trunks:
        parts += _tree_parts(tree, NO_TREE)
    parts += [(meshes.post(thing, ground), WOOD, NO_TREE) for thing in scene.posts]
    parts += [(meshes.bush(thing, ground), LEAF, NO_TREE) for thing in scene.bushes]
    parts += [(meshes.table(thing, ground), WOOD, NO_TREE) for thing in scene.tables]
    parts += [(meshes.person(thing, ground), CLOTH, NO_TREE) for thing in scene.people]
    return parts


def _tree_parts(tree: SceneTree, index: int) -> list[tuple[meshes.Mesh, int, int]]:
    limbs, leaves = meshes.branches(tree)
    return [(meshes.trunk(tree), BARK, index), (limbs, BARK, NO_TREE), (leaves, LEAF, NO_TREE)]
