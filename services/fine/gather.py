"""All frames of a recording fused: a denoised cloud, fine around the stems, and each stem's raw points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from schemas.trees import Tree
from services.fine import voxel_kernels as kernels
from services.fine.config import FineConfig
from services.fine.model import Floats, StemPoints

_BELOW_M, _ABOVE_M = 0.3, 4.5
"""From so far below a stem's foot to so far above it points are its."""
_START = 1 << 18


@dataclass(frozen=True, slots=True)
class FineCloud:
    """The fused surface."""

    points_m: NDArray[np.float32] = field(repr=False)
    """(N, 3) in map."""
    rgb: NDArray[np.uint8] = field(repr=False)
    fine: NDArray[np.bool_] = field(repr=False)
    """(N,): of the fine leaf."""


class FineMap:
    """Takes frames one by one. Where trees stand is known from the live result."""

    def __init__(self, trees: Sequence[Tree], config: FineConfig) -> None:
        self._config = config
        self._trees = list(trees)
        self._stems = np.array([_row(tree) for tree in trees]).reshape(-1, 8)
        c = config
        self._settings = np.array([c.voxel_m, c.coarse_voxel_m, c.reach_m, c.range_noise_per_m, c.surface_noise_m])
        self._held = 0
        size = min(_START, c.max_voxels)
        self._keys = np.empty(size, dtype=np.int64)
        self._sums = np.empty((size, kernels.COLUMNS), dtype=np.float32)
        self._table = _empty_table(size)
        self._points: list[list[NDArray[np.float32]]] = [[] for _ in trees]
        self._frames: list[list[NDArray[np.int32]]] = [[] for _ in trees]
        self._every = [1] * len(self._trees)
        self.left_out = 0
        """Points for which there was no room."""

    def add(self, points_m: NDArray[np.float32], rgb: NDArray[np.uint8], T_map_camera: Floats, frame: int) -> None:
        """Take one frame's points (N, 3), camera frame, with colours (N, 3)."""
        n = len(points_m)
        self._make_room(n)
        stem_of, placed = np.empty(n, dtype=np.int16), np.empty((n, 3), dtype=np.float32)
        self._held, left_out = kernels.add_points(
            points_m, rgb, np.ascontiguousarray(T_map_camera), self._stems, self._settings, self._table, self._keys,
            self._sums, self._held, stem_of, placed,
        )  # fmt: skip
        self.left_out += int(left_out)
        for s in np.unique(stem_of[stem_of >= 0]):
            self._keep(int(s), placed[stem_of == s], frame)

    def _keep(self, s: int, points_m: NDArray[np.float32], frame: int) -> None:
        """Add to a stem's points; beyond the bound every second of all goes."""
        every = self._every[s]
        taken = points_m[frame % every :: every]
        self._points[s].append(taken)
        self._frames[s].append(np.full(len(taken), frame, dtype=np.int32))
        while sum(map(len, self._points[s])) > self._config.max_stem_points:
            self._points[s] = [np.concatenate(self._points[s])[::2]]
            self._frames[s] = [np.concatenate(self._frames[s])[::2]]
            self._every[s] *= 2

    def _make_room(self, more: int) -> None:
        """Grow table and sums so that ``more`` voxels have room, up to the bound."""
        need = min(self._held + more, self._config.max_voxels)
        if need <= len(self._keys):
            return
        size = min(max(2 * len(self._keys), need), self._config.max_voxels)
        keys, sums = np.empty(size, dtype=np.int64), np.empty((size, kernels.COLUMNS), dtype=np.float32)
        keys[: self._held], sums[: self._held] = self._keys[: self._held], self._sums[: self._held]
        self._keys, self._sums = keys, sums
        self._table = _empty_table(size)
        kernels.fill_table(self._table, self._keys[: self._held])

    def stems(self) -> list[tuple[Tree, StemPoints]]:
        """Return what was seen of each tree's stem."""
        out = []
        for tree, points, frames in zip(self._trees, self._points, self._frames, strict=True):
            held = np.concatenate([np.zeros((0, 3), dtype=np.float32), *points])
            out.append((tree, StemPoints(tree.id, held, np.concatenate([np.zeros(0, dtype=np.int32), *frames]))))
        return out

    def cloud(self) -> FineCloud:
        """Return the surface that all frames agree on."""
        keys, sums = self._keys[: self._held], self._sums[: self._held]
        density = np.empty(self._held, dtype=np.float32)
        kernels.densities(self._table, keys, sums, self._settings, density)
        points, rgb = np.empty((self._held, 3)), np.empty((self._held, 3), dtype=np.uint8)
        level = np.empty(self._held, dtype=np.uint8)
        least = self._config.least_observations
        m = int(kernels.surface(self._table, keys, sums, density, self._settings, least, points, rgb, level))
        return FineCloud(points[:m].astype(np.float32), rgb[:m].copy(), level[:m] == 0)


def _empty_table(size: int) -> NDArray[np.int32]:
    """Return a hash table with room for twice ``size`` entries, a power of two."""
    return np.full(1 << int(2 * size - 1).bit_length(), -1, dtype=np.int32)


def _row(tree: Tree) -> list[float]:
    """Return a tree as ``nearest_stem`` takes it."""
    a = tree.axis
    return [
        tree.x_m, tree.y_m, tree.z_m, a[0] / max(a[2], 0.2), a[1] / max(a[2], 0.2), tree.radius_m, tree.z_m - _BELOW_M,
        tree.z_m + _ABOVE_M,
    ]  # fmt: skip
