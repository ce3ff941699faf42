"""Triangle meshes of the things in a scene. Each function returns vertices (N, 3) and triangles (M, 3), world frame."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from services.simulator.scene import Backdrop, Bush, Floats, Ground, Person, Post, SceneTree, Table

Triangles = NDArray[np.uint32]

TRUNK_SIDES = 48
BURIED_M = 0.4
"""How far trunks and posts reach below the ground, so that no relief lays them bare."""


@dataclass(frozen=True, slots=True)
class Mesh:
    """Vertices (N, 3), metres, and triangles (M, 3), indices of vertices."""

    vertices: Floats
    triangles: Triangles


Meshes: TypeAlias = "list[Mesh] | tuple[Mesh, ...]"


def join(meshes: Meshes) -> Mesh:
    """Return one mesh of several."""
    offsets = np.cumsum([0] + [len(m.vertices) for m in meshes[:-1]])
    triangles = [m.triangles + np.uint32(o) for m, o in zip(meshes, offsets, strict=True)]
    return Mesh(np.concatenate([m.vertices for m in meshes]), np.concatenate(triangles))


def tube(rings: Floats) -> Mesh:
    """Return the surface through closed rings of vertices (rings, sides, 3), capped at the end."""
    count, sides, _ = rings.shape
    index = np.arange(count * sides, dtype=np.uint32).reshape(count, sides)
    following = np.roll(index, -1, axis=1)
    a, b, c, d = index[:-1].ravel(), following[:-1].ravel(), index[1:].ravel(), following[1:].ravel()
    tip = np.full(sides, count * sides, dtype=np.uint32)
    triangles = np.concatenate([
        np.stack([a, b, c], axis=1), np.stack([b, d, c], axis=1), np.stack([index[-1], following[-1], tip], axis=1)
    ])  # fmt: skip
    return Mesh(np.concatenate([rings.reshape(-1, 3), rings[-1].mean(axis=0)[None]]), triangles)


def frame_across(axis: ArrayLike) -> tuple[Floats, Floats]:
    """Return two unit vectors that span the plane across ``axis``."""
    axis = np.asarray(axis, dtype=float)
    helper = np.eye(3)[int(np.argmin(np.abs(axis)))]
    first = np.cross(axis, helper)
    first /= np.linalg.norm(first)
    return first, np.cross(axis, first)


def stem(centres: Floats, radii: Floats, axis: ArrayLike, sides: int = 8) -> Mesh:
    """Return a round stem along ``centres`` (rings, 3) with ``radii`` (rings,) or (rings, sides)."""
    first, second = frame_across(axis)
    angle = np.arange(sides) * (2.0 * math.pi / sides)
    circle = np.cos(angle)[:, None] * first + np.sin(angle)[:, None] * second
    radii = radii[:, None] if radii.ndim == 1 else radii
    return tube(centres[:, None, :] + radii[..., None] * circle)


def trunk(tree: SceneTree) -> Mesh:
    """Return a tree's trunk, with both stems where it forks."""
    end_m = tree.height_m if tree.fork_height_m is None else tree.fork_height_m
    heights = np.concatenate([np.arange(-BURIED_M, min(end_m, 3.6), 0.08), np.arange(3.6, end_m, 0.5), [end_m]])
    heights = heights[heights <= end_m]
    centres = tree.base + np.outer(heights / tree.axis[2], tree.axis)
    main = stem(centres, _bumpy_radii(tree, heights), tree.axis, TRUNK_SIDES)
    if tree.fork_height_m is None:
        return main
    return join([main, *_fork_stems(tree, tree.fork_height_m)])


def _bumpy_radii(tree: SceneTree, heights: Floats) -> Floats:
    """Radius by height and side; a polygon's mean radius is brought up to the circle's."""
    rng = np.random.default_rng([tree.seed, 1])
    angle = np.arange(TRUNK_SIDES) * (2.0 * math.pi / TRUNK_SIDES)
    bumps = np.zeros((len(heights), TRUNK_SIDES))
    waves = ((2, 0.7), (3, 2.5), (5, 6.0), (7, 11.0))
    for turns, per_metre in waves:
        phase, sign = rng.uniform(0.0, 2.0 * math.pi), rng.choice([-1.0, 1.0])
        bumps += np.sin(turns * angle + sign * per_metre * heights[:, None] + phase) / len(waves)
    polygon = 2.0 / (1.0 + math.cos(math.pi / TRUNK_SIDES))
    scale = tree.bumps * math.sqrt(len(waves))
    return np.asarray(polygon * tree.mean_radius(heights)[:, None] * (1.0 + scale * bumps))


def trunk_radii(tree: SceneTree, heights_m: Floats) -> tuple[Floats, Floats]:
    """Return angles (S,) round the axis and the surface's mean distance from it (H, S): what the mesh shows at heights."""
    angle = np.asarray(np.arange(TRUNK_SIDES) * (2.0 * math.pi / TRUNK_SIDES), dtype=np.float64)
    polygon = 2.0 / (1.0 + math.cos(math.pi / TRUNK_SIDES))
    return angle, np.asarray(_bumpy_radii(tree, heights_m) / polygon, dtype=np.float64)


def _fork_stems(tree: SceneTree, fork_m: float) -> list[Mesh]:
    rng = np.random.default_rng([tree.seed, 2])
    # within 50 degrees of broadside to the start, or nobody could tell from there that it forks
    heading = math.atan2(tree.y_m, tree.x_m) + 0.5 * math.pi + rng.uniform(-0.87, 0.87)
    across = np.array([math.cos(heading), math.sin(heading), 0.0])
    radius = float(tree.mean_radius(fork_m))
    lengths = np.linspace(-0.1, tree.height_m - fork_m, 20)
    stems = []
    for sign in (-1.0, 1.0):
        axis = np.array(tree.axis) + sign * math.tan(math.radians(14.0)) * across
        axis /= np.linalg.norm(axis)
        radii = np.maximum(0.72 * radius - 0.008 * lengths, 0.2 * radius)
        stems.append(stem(tree.centre_at(fork_m) + np.outer(lengths, axis), radii, axis, 24))
    return stems


def branches(tree: SceneTree) -> tuple[Mesh, Mesh]:
    """Return a tree's branches and its leaves, all above ``branch_start_m``."""
    rng = np.random.default_rng([tree.seed, 3])
    limbs, leaves = [], []
    for height in np.linspace(tree.branch_start_m + 0.15, tree.height_m, 10):
        heading, rise = rng.uniform(0.0, 2.0 * math.pi), rng.uniform(0.15, 0.8)
        axis = np.array([math.cos(heading), math.sin(heading), rise])
        axis /= np.linalg.norm(axis)
        length = rng.uniform(0.7, 1.7)
        radius = 0.22 * float(tree.mean_radius(height))
        root, tip = tree.centre_at(height), tree.centre_at(height) + length * axis
        limbs.append(stem(np.stack([root, tip]), np.array([radius, 0.3 * radius]), axis, 6))
        middle = root + 0.75 * length * axis + np.array([0.0, 0.0, 0.15])
        leaves.append(leaf_cloud(rng, middle, np.array([0.55, 0.55, 0.3]), 70, 0.13))
    return join(limbs), join(leaves)


def leaf_cloud(rng: np.random.Generator, centre: ArrayLike, half_axes: ArrayLike, count: int, size_m: float) -> Mesh:
    """Return ``count`` single triangles of about ``size_m`` spread through an ellipsoid, denser outward."""
    direction = rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    at = np.asarray(centre) + direction * rng.uniform(0.3, 1.0, size=(count, 1)) ** 0.5 * np.asarray(half_axes)
    corners = at[:, None, :] + rng.normal(size=(count, 3, 3)) * (0.5 * size_m)
    return Mesh(corners.reshape(-1, 3), np.arange(3 * count, dtype=np.uint32).reshape(-1, 3))


def bush(thing: Bush, ground: Ground) -> Mesh:
    """Return a bush: leaves, on a few thin stems."""
    rng = np.random.default_rng([thing.seed, 4])
    base = np.array([thing.x_m, thing.y_m, ground.at(thing.x_m, thing.y_m)])
    half = np.array([thing.radius_m, thing.radius_m, 0.5 * thing.height_m])
    middle = base + np.array([0.0, 0.0, 0.5 * thing.height_m])
    leaves = leaf_cloud(rng, middle, half, thing.leaves, 0.055)
    leaves.vertices[:, 2] = np.maximum(leaves.vertices[:, 2], base[2] - 0.02)
    twigs = []
    for _ in range(4):
        axis = np.append(rng.uniform(-0.5, 0.5, 2), 1.0)
        axis /= np.linalg.norm(axis)
        ends = np.stack([base - 0.1 * axis, base + 0.8 * thing.height_m * axis])
        twigs.append(stem(ends, np.array([0.008, 0.004]), axis, 5))
    return join([leaves, *twigs])


def post(thing: Post, ground: Ground) -> Mesh:
    """Return a post with a flat top."""
    base = np.array([thing.x_m, thing.y_m, ground.at(thing.x_m, thing.y_m)])
    heights = np.array([-BURIED_M, thing.height_m])
    return stem(base + np.outer(heights, [0.0, 0.0, 1.0]), np.full(2, thing.radius_m), (0.0, 0.0, 1.0), 32)


def table(thing: Table, ground: Ground) -> Mesh:
    """Return a table; its top is level."""
    c, s = math.cos(thing.yaw_rad), math.sin(thing.yaw_rad)
    top_z = ground.at(thing.x_m, thing.y_m) + thing.height_m
    half = 0.5 * np.array([thing.length_m, thing.width_m])
    corners = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])

    def placed(flat: Floats) -> Floats:
        return np.stack([thing.x_m + c * flat[:, 0] - s * flat[:, 1], thing.y_m + s * flat[:, 0] + c * flat[:, 1]], 1)

    outline = placed(corners * half)
    rings = [np.column_stack([outline, np.full(4, z)]) for z in (top_z - 0.05, top_z)]
    slab = tube(np.stack([rings[0], rings[1]]))
    underside = Mesh(rings[0], np.array([[0, 2, 1], [0, 3, 2]], dtype=np.uint32))
    parts = [slab, underside]
    for x, y in placed(corners * (half - 0.1)):
        ends = np.array([[x, y, ground.at(x, y) - 0.2], [x, y, top_z - 0.03]])
        parts.append(stem(ends, np.full(2, thing.leg_radius_m), (0.0, 0.0, 1.0), 16))
    return join(parts)


def person(thing: Person, ground: Ground) -> Mesh:
    """Return a standing person: two legs, trunk with shoulders, two arms, head."""
    scale = thing.height_m / 1.75
    base = np.array([thing.x_m, thing.y_m, ground.at(thing.x_m, thing.y_m)])
    c, s = math.cos(thing.yaw_rad), math.sin(thing.yaw_rad)
    angle = np.arange(20) * (2.0 * math.pi / 20)

    def limb(offset: tuple[float, float], profile: list[tuple[float, float, float]]) -> Mesh:
        rings = []
        for z, a, b in profile:
            x, y = offset[0] + a * np.cos(angle), offset[1] + b * np.sin(angle)
            rings.append(np.stack([c * x - s * y, s * x + c * y, np.full(20, z)], axis=1))
        return tube(base + scale * np.stack(rings))

    leg = [(-0.1, 0.08, 0.06), (0.1, 0.06, 0.06), (0.45, 0.07, 0.07), (0.85, 0.09, 0.09)]
    arm = [(0.75, 0.04, 0.04), (1.1, 0.05, 0.05), (1.42, 0.06, 0.06)]
    torso = [(0.8, 0.16, 0.11), (1.1, 0.15, 0.10), (1.35, 0.20, 0.12), (1.46, 0.12, 0.08), (1.5, 0.06, 0.06)]
    head = [(1.48, 0.06, 0.06), (1.55, 0.085, 0.095), (1.65, 0.09, 0.1), (1.73, 0.06, 0.07)]
    return join([limb((-0.1, 0.0), leg), limb((0.1, 0.0), leg), limb((-0.26, 0.0), arm), limb((0.26, 0.0), arm),
                 limb((0.0, 0.0), torso), limb((0.0, 0.0), head)])  # fmt: skip


def terrain(ground: Ground, reach_m: float) -> Mesh:
    """Return the ground as a grid that is fine (0.15 m) near the origin and widens outward."""
    fine = np.arange(0.0, 7.0, 0.15)
    coarse = np.geomspace(7.0, reach_m, 40)
    half = np.concatenate([fine, coarse])
    line = np.concatenate([-half[:0:-1], half])
    x, y = np.meshgrid(line, line, indexing="ij")
    vertices = np.stack([x, y, ground.height(x, y)], axis=-1).reshape(-1, 3)
    index = np.arange(len(line) ** 2, dtype=np.uint32).reshape(len(line), len(line))
    a, b, c, d = index[:-1, :-1].ravel(), index[1:, :-1].ravel(), index[:-1, 1:].ravel(), index[1:, 1:].ravel()
    return Mesh(vertices, np.concatenate([np.stack([a, b, c], axis=1), np.stack([b, d, c], axis=1)]))


def tree_line(backdrop: Backdrop, ground: Ground, seed: int) -> Mesh:
    """Return the ring of forest behind everything, its upper edge ragged."""
    rng = np.random.default_rng([seed, 5])
    angle = np.linspace(0.0, 2.0 * math.pi, 721)
    radius = backdrop.radius_m * (1.0 + 0.06 * np.sin(5.0 * angle) + 0.04 * np.sin(13.0 * angle + 1.0))
    crown = backdrop.height_m * (1.0 + 0.15 * np.sin(9.0 * angle) + rng.uniform(-0.12, 0.12, angle.size))
    crown[-1] = crown[0]
    x, y = radius * np.cos(angle), radius * np.sin(angle)
    z = ground.height(x, y)
    vertices = np.concatenate([np.stack([x, y, z - 2.0], axis=1), np.stack([x, y, z + crown], axis=1)])
    low = np.arange(angle.size - 1, dtype=np.uint32)
    high = low + np.uint32(angle.size)
    return Mesh(vertices, np.concatenate([np.stack([low, low + 1, high], 1), np.stack([low + 1, high + 1, high], 1)]))
