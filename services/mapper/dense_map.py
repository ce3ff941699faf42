"""The dense map: one submap per keyframe, re-anchored when the graph changes, bounded by the surface it covers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numba import njit
from numpy.typing import NDArray

from services.common.geometry import inverse, log_rotation
from services.mapper.cloud import KeyframeCloud
from services.mapper.config import MapperConfig
from services.mapper.ground_grid import GroundGrid

Matrix = NDArray[np.float64]


@dataclass(slots=True)
class MapSubmap:
    """What the map holds of one keyframe."""

    submap_id: int
    stamp_ns: int
    points_m: NDArray[np.float32] = field(repr=False)
    """(N, 3) in the keyframe's camera frame."""
    rgb: NDArray[np.uint8] = field(repr=False)
    T_map_submap: Matrix
    version: int = 1
    """Of the points."""
    anchor_id: int = 0
    """The keyframe whose pose places it: its own, or the nearest left when slam culled that."""
    T_anchor_submap: Matrix = field(default_factory=lambda: np.eye(4))


@dataclass(frozen=True, slots=True)
class MapCloud:
    """The whole map in the map frame: points (N, 3) float32 and colours (N, 3) uint8 RGB."""

    points_m: NDArray[np.float32]
    rgb: NDArray[np.uint8]


@njit(cache=True, nogil=True)
def _admit(
    points: NDArray[np.float32], T: Matrix, lows: NDArray[np.float32], cell: float, fine_low: float, fine_high: float,
    fine: float, coarse: float, per_voxel: int, nearer: float, table_keys: NDArray[np.int64],
    table_count: NDArray[np.uint8], table_range: NDArray[np.float32], keep: NDArray[np.bool_],
) -> int:  # fmt: skip
    """Enter points into the voxel table; mark those that their voxel takes. Return the number of new voxels."""
    mask = table_keys.shape[0] - 1
    half = lows.shape[0] // 2
    fresh = 0
    for i in range(points.shape[0]):
        px, py, pz = points[i, 0], points[i, 1], points[i, 2]
        x = T[0, 0] * px + T[0, 1] * py + T[0, 2] * pz + T[0, 3]
        y = T[1, 0] * px + T[1, 1] * py + T[1, 2] * pz + T[1, 3]
        z = T[2, 0] * px + T[2, 1] * py + T[2, 2] * pz + T[2, 3]
        a = min(max(int(np.floor(x / cell)) + half, 0), 2 * half - 1)
        b = min(max(int(np.floor(y / cell)) + half, 0), 2 * half - 1)
        voxel, level = coarse, np.int64(1)
        if fine_low <= z - lows[a, b] <= fine_high:
            voxel, level = fine, np.int64(0)
        key = np.int64(np.floor(x / voxel)) + 1048576
        key = key * np.int64(2097152) + np.int64(np.floor(y / voxel)) + 1048576
        key = key * np.int64(2097152) + 2 * (np.int64(np.floor(z / voxel)) + 524288) + level
        at = (key * np.int64(-7046029254386353131) >> 20) & mask
        while table_keys[at] != -1 and table_keys[at] != key:
            at = (at + 1) & mask
        r = np.sqrt(px * px + py * py + pz * pz)
        if table_keys[at] == -1:
            table_keys[at] = key
            table_count[at] = 1
            table_range[at] = r
            fresh += 1
            keep[i] = True
        elif table_count[at] < per_voxel or r < nearer * table_range[at]:
            table_count[at] = min(255, table_count[at] + 1)
            table_range[at] = min(table_range[at], r)
            keep[i] = True
        else:
            keep[i] = False
    return fresh


class DenseMap:
    """Submaps by keyframe id, in order of arrival. Poses come from slam; nothing is rebuilt when they change.

    A point enters only where its map voxel is not full yet, so that looking again at the same place costs no memory;
    a voxel also takes what was seen from clearly nearer, because depth noise grows with the square of range.
    """

    def __init__(self, config: MapperConfig) -> None:
        self._config = config
        self.map_id = ""
        self.submaps: dict[int, MapSubmap] = {}
        self._ground = GroundGrid(config.ground_cell_m)
        self._clear_voxels()

    @property
    def size(self) -> int:
        """Number of points."""
        return sum(len(s.points_m) for s in self.submaps.values())

    def reset(self, map_id: str) -> list[MapSubmap]:
        """Begin a new map; return the submaps of the old one."""
        gone = list(self.submaps.values())
        self.submaps = {}
        self.map_id = map_id
        self._ground = GroundGrid(self._config.ground_cell_m)
        self._clear_voxels()
        return gone

    def add(self, keyframe_id: int, stamp_ns: int, cloud: KeyframeCloud, T_map_camera: Matrix) -> list[MapSubmap]:
        """Take up a keyframe's cloud; return the submaps whose points changed (itself, and any thinned for memory)."""
        keep = np.empty(len(cloud.points_m), dtype=np.bool_)
        self._reserve(len(keep))
        self._ground.take(cloud.points_m, T_map_camera)
        c = self._config
        self._used += int(
            _admit(
                cloud.points_m,
                T_map_camera,
                self._ground.lows_m,
                c.ground_cell_m,
                c.fine_low_m,
                c.fine_high_m,
                c.voxel_m,
                c.coarse_voxel_m,
                c.per_voxel,
                c.nearer,
                self._keys,
                self._counts,
                self._ranges,
                keep,
            )
        )
        submap = MapSubmap(
            keyframe_id, stamp_ns, cloud.points_m[keep], cloud.rgb[keep], T_map_camera.copy(), anchor_id=keyframe_id
        )
        self.submaps[keyframe_id] = submap
        return [submap, *self._thin()]

    def move(self, poses: Mapping[int, Matrix]) -> list[MapSubmap]:
        """Place submaps by a graph's poses (keyframe id to T_map_camera); return those that moved noticeably."""
        moved = []
        for submap in self.submaps.values():
            if submap.anchor_id not in poses:
                self._anchor_elsewhere(submap, poses)
            T = poses.get(submap.anchor_id)
            if T is None:
                continue
            new = T @ submap.T_anchor_submap
            if self._differs(submap.T_map_submap, new):
                submap.T_map_submap = new
                moved.append(submap)
        return moved

    def cloud(self) -> MapCloud:
        """Return the whole map as one cloud."""
        points, rgb = [np.zeros((0, 3), dtype=np.float32)], [np.zeros((0, 3), dtype=np.uint8)]
        for s in self.submaps.values():
            T = s.T_map_submap
            points.append((s.points_m @ T[:3, :3].T + T[:3, 3]).astype(np.float32))
            rgb.append(s.rgb)
        return MapCloud(np.concatenate(points), np.concatenate(rgb))

    def _anchor_elsewhere(self, submap: MapSubmap, poses: Mapping[int, Matrix]) -> None:
        """Hang the submap of a culled keyframe on the keyframe nearest in time, where it stands now."""
        others = [k for k in poses if k in self.submaps and self.submaps[k].anchor_id == k]
        if not others:
            return
        anchor = min(others, key=lambda k: (abs(k - submap.anchor_id), k))
        submap.T_anchor_submap = inverse(self.submaps[anchor].T_map_submap) @ submap.T_map_submap
        submap.anchor_id = anchor

    def _differs(self, a: Matrix, b: Matrix) -> bool:
        if float(np.abs(a[:3, 3] - b[:3, 3]).max()) > self._config.move_m:
            return True
        return float(np.linalg.norm(log_rotation(a[:3, :3].T @ b[:3, :3]))) > self._config.move_rad

    def _clear_voxels(self, slots: int = 1 << 16) -> None:
        self._keys: NDArray[np.int64] = np.full(slots, -1, dtype=np.int64)
        self._counts = np.zeros(slots, dtype=np.uint8)
        self._ranges = np.zeros(slots, dtype=np.float32)
        self._used = 0

    def _reserve(self, more: int) -> None:
        """Grow the voxel table so that it stays at most two thirds full."""
        slots = len(self._keys)
        while 1.5 * (self._used + more) > slots:
            slots *= 2
        if slots == len(self._keys):
            return
        old = self._keys != -1
        keys, counts, ranges = self._keys[old], self._counts[old], self._ranges[old]
        self._clear_voxels(slots)
        _refill(keys, counts, ranges, self._keys, self._counts, self._ranges)
        self._used = len(keys)

    def _thin(self) -> list[MapSubmap]:
        """Halve the oldest submaps until the map keeps its bound; return those that were."""
        changed = []
        excess = self.size - self._config.max_points
        for submap in list(self.submaps.values()):
            if excess <= 0:
                break
            before = len(submap.points_m)
            if before < 1000:
                continue
            submap.points_m, submap.rgb = submap.points_m[::2].copy(), submap.rgb[::2].copy()
            submap.version += 1
            excess -= before - len(submap.points_m)
            changed.append(submap)
        return changed


@njit(cache=True, nogil=True)
def _refill(
    keys: NDArray[np.int64], counts: NDArray[np.uint8], ranges: NDArray[np.float32], table_keys: NDArray[np.int64],
    table_count: NDArray[np.uint8], table_range: NDArray[np.float32],
) -> None:  # fmt: skip
    mask = table_keys.shape[0] - 1
    for i in range(keys.shape[0]):
        at = (keys[i] * np.int64(-7046029254386353131) >> 20) & mask
        while table_keys[at] != -1:
            at = (at + 1) & mask
        table_keys[at] = keys[i]
        table_count[at] = counts[i]
        table_range[at] = ranges[i]
