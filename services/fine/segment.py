"""Tells the fine cloud apart: ground, the trees one by one, the rest."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from schemas.trees import Tree
from services.detector.ground import find_ground
from services.detector.model import Ground
from services.detector.upright import upright_frame
from services.fine.config import FineConfig
from services.fine.model import Floats
from services.fine.stem_kernels import nearest_stem

NO_TREE = 0
_GROUND_WITHIN_M = 0.08
_STEM_WITHIN_M = 0.06
_CROWN_FROM_M = 1.5
"""Below this only the stem is a tree's: what touches it there is undergrowth."""
_CELL_M = 0.08
"""Parts of the cloud that are nearer than about this are connected."""
_LEAST_CLOUD = 500


@dataclass(frozen=True, slots=True)
class Segments:
    """What each point of the cloud is part of."""

    tree_id: NDArray[np.uint32] = field(repr=False)
    """(N,), 0 for none; trees' own ids plus one, as ids begin at 0."""
    ground: NDArray[np.bool_] = field(repr=False)
    """(N,)."""
    height_m: NDArray[np.float32] = field(repr=False)
    """(N,) above ground."""
    model: Ground | None
    """Ground per cell, in coordinates less ``shift_m``; None where none shows."""
    shift_m: Floats
    ground_cells: NDArray[np.bool_] = field(repr=False)
    """(nx, ny) which of the model's cells hold ground points."""


def segment(points_m: NDArray[np.float32], trees: Sequence[Tree], config: FineConfig) -> Segments:
    """Return the parts of a cloud (N, 3) in map, z up."""
    n = len(points_m)
    tree_id = np.zeros(n, dtype=np.uint32)
    if n < _LEAST_CLOUD:
        nothing = np.zeros((0, 0), dtype=bool)
        return Segments(tree_id, np.zeros(n, dtype=bool), np.zeros(n, dtype=np.float32), None, np.zeros(3), nothing)
    frame = upright_frame(points_m, (0.0, 0.0, 1.0))
    ground = find_ground(frame, config.ground_cell_m).ground
    xyz = frame.xyz_m.astype(np.float64)
    height = xyz[:, 2] - ground.heights_m(xyz[:, :2])
    is_ground = (np.abs(height) < _GROUND_WITHIN_M) & ground.seen
    stem = _stem_of(points_m, trees)
    tree_id[stem >= 0] = stem[stem >= 0] + 1
    tree_id[is_ground] = NO_TREE
    crown = _crowns(points_m, tree_id, height, config.crown_reach_m, trees)
    ids = np.array([NO_TREE, *(tree.id + 1 for tree in trees)], dtype=np.uint32)
    is_ground &= crown == NO_TREE
    model = ground if ground.seen else None
    cells = _cells_with(xyz[is_ground, :2], ground)
    return Segments(ids[crown], is_ground, height.astype(np.float32), model, frame.shift, cells)


def _cells_with(xy_m: Floats, ground: Ground) -> NDArray[np.bool_]:
    """Return (nx, ny) which cells of the ground hold points."""
    nx, ny, _ = ground.planes.shape
    cell = ((xy_m - np.array([ground.x0_m, ground.y0_m])) // ground.cell_m).astype(np.int64)
    cell = np.clip(cell, 0, [nx - 1, ny - 1])
    out = np.zeros((nx, ny), dtype=bool)
    out[cell[:, 0], cell[:, 1]] = True
    return out


def _stem_of(points_m: NDArray[np.float32], trees: Sequence[Tree]) -> NDArray[np.int64]:
    """Return for each point the tree whose stem it lies on, by place in ``trees``; -1 for none."""
    rows = np.array([
        [t.x_m, t.y_m, t.z_m, t.axis[0] / max(t.axis[2], 0.2), t.axis[1] / max(t.axis[2], 0.2), t.radius_m, t.z_m - 0.1,
         t.z_m + max(t.height_seen_m, _CROWN_FROM_M) + 0.5]
        for t in trees
    ]).reshape(-1, 8)  # fmt: skip
    return np.array([nearest_stem(x, y, z, rows, _STEM_WITHIN_M) for x, y, z in points_m.tolist()], dtype=np.int64)


def _crowns(
    points_m: NDArray[np.float32], tree_id: NDArray[np.uint32], height_m: Floats, reach_m: float, trees: Sequence[Tree]
) -> NDArray[np.uint32]:
    """Let each stem take what hangs on it above undergrowth: nearest along the cloud first (breadth first in cells)."""
    out = tree_id.copy()
    free = (tree_id == NO_TREE) & (height_m > _CROWN_FROM_M)
    cell = np.floor(points_m / _CELL_M).astype(np.int64)
    wanted: dict[tuple[int, ...], list[int]] = {}
    for i in np.flatnonzero(free):
        wanted.setdefault(tuple(cell[i].tolist()), []).append(int(i))
    seeds = np.flatnonzero((tree_id != NO_TREE) & (height_m > _CROWN_FROM_M - _CELL_M))
    keys = np.unique(np.column_stack([cell[seeds], tree_id[seeds].astype(np.int64)]), axis=0)
    queue = deque((tuple(key[:3]), int(key[3])) for key in keys.tolist())
    steps = [(a, b, c) for a in (-1, 0, 1) for b in (-1, 0, 1) for c in (-1, 0, 1)]
    while queue:
        (a, b, c), owner = queue.popleft()
        tree = trees[owner - 1]
        for da, db, dc in steps:
            key = (a + da, b + db, c + dc)
            inside = wanted.get(key)
            if inside is None or np.hypot(key[0] * _CELL_M - tree.x_m, key[1] * _CELL_M - tree.y_m) > reach_m:
                continue
            del wanted[key]
            out[inside] = owner
            queue.append((key, owner))
    return out
